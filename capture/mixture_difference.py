"""OpenCV's own background models, trained and then held still: MOG2 and KNN, GSOC and CNT (bgsegm).

MOG2 keeps its model at a learning rate of 0. KNN does not (opencv issue 24226): there a rate too small to
ever replace a sample is used. GSOC and CNT follow the film whatever the rate (opencv_contrib issue 3557) and
would take in a subject who stands; of them, the background picture that they have learnt is used, with the
difference of `plate_difference`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from threading import Lock

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.difference import Box, coarse_of, coarse_step
from capture.plate_difference import PlateDifference
from capture.plates import Plate

_PERSON = 255  # in the models' masks; a shadow is 127 and no person
_LEAST_TRAINING = 40  # frames; fewer are shown again
_HELD_RATE = {"mog2": 0.0, "knn": 1e-9}
_CNT_STABLE = 15  # frames that a pixel must keep still for CNT to believe it

Picture = UInt8[np.ndarray, "_h _w 3"]


@dataclass(frozen=True)
class MixtureDifference:
    """A `Difference` by MOG2 or KNN. subtractor : trained; rate : the one that leaves it as it is."""

    subtractor: cv2.BackgroundSubtractor
    rate: float
    step: int
    lock: Lock = field(default_factory=Lock)

    def look(self, picture: Picture) -> MixtureLook:
        """Ask the model about the whole picture (it cannot be asked about a part)."""
        with self.lock:
            found = self.subtractor.apply(picture, learningRate=self.rate)
        full = cv2.threshold(found, _PERSON - 1, 255, cv2.THRESH_BINARY)[1].astype(np.uint8, copy=False)
        changed = cv2.countNonZero(coarse_of(found, self.step)) / coarse_of(found, self.step).size
        coarse = cv2.morphologyEx(coarse_of(full, self.step), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        return MixtureLook(full, coarse.astype(np.uint8), changed)


@dataclass(frozen=True)
class MixtureLook:
    """One picture's answer."""

    full: UInt8[np.ndarray, "_h _w"]
    coarse: UInt8[np.ndarray, "_h _w"]
    changed: float

    def fine(self, box: Box) -> UInt8[np.ndarray, "_h _w"]:
        """255 in the box where the model says foreground."""
        return self.full[box].copy()


def train(method: str, frames: Iterable[Picture]) -> MixtureDifference | PlateDifference:
    """A model of `method` ("mog2", "knn", "gsoc" or "cnt") from empty frames, or from frames spread over a
    film (RGB, at least one). Few frames are shown several times."""
    shown = list(frames)
    height, width = shown[0].shape[:2]
    rounds = max(1, -(-_LEAST_TRAINING // len(shown)))
    if method in _HELD_RATE:
        make = cv2.createBackgroundSubtractorMOG2 if method == "mog2" else cv2.createBackgroundSubtractorKNN
        subtractor = make(history=rounds * len(shown), detectShadows=True)
        for picture in shown * rounds:
            subtractor.apply(picture)
        return MixtureDifference(subtractor, _HELD_RATE[method], coarse_step(height, width))
    if method == "gsoc":
        gsoc = cv2.bgsegm.createBackgroundSubtractorGSOC()
        for picture in shown * rounds:
            gsoc.apply(picture)
        return PlateDifference.of_plate(Plate(gsoc.getBackgroundImage(), None, 1))
    assert method == "cnt", method
    # CNT sees grey alone; each channel is shown to one of its own.
    channels = []
    for channel in range(3):
        cnt = cv2.bgsegm.createBackgroundSubtractorCNT(_CNT_STABLE, True, 60 * _CNT_STABLE)
        # A frame a few times over: it takes frames that follow one another for what keeps still.
        for picture in shown:
            for _ in range(max(1, rounds)):
                cnt.apply(np.ascontiguousarray(picture[..., channel]))
        channels.append(cnt.getBackgroundImage())
    return PlateDifference.of_plate(Plate(np.dstack(channels).astype(np.uint8), None, 1))
