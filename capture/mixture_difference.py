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

from capture.difference import Box, coarse_of, coarse_step, without_specks
from capture.plate_difference import PlateDifference, light_gains, light_table
from capture.plates import Plate, learn_plate

_PERSON = 255  # in the models' masks; a shadow is 127 and no person
_LEAST_TRAINING = 40  # frames; fewer are shown again
_HELD_RATE = {"mog2": 0.0, "knn": 1e-9}
_FEW, _NOISE_LEVELS = 3, 4.0
_CNT_STABLE = 15  # frames that a pixel must keep still for CNT to believe it

Picture = UInt8[np.ndarray, "_h _w 3"]


@dataclass(frozen=True)
class MixtureDifference:
    """A `Difference` by MOG2 or KNN. subtractor : trained; rate : the one that leaves it as it is; small :
    what it was trained on, its mean, at the coarse look's size."""

    subtractor: cv2.BackgroundSubtractor
    rate: float
    step: int
    small: Picture
    lock: Lock = field(default_factory=Lock)

    def look(self, picture: Picture) -> MixtureLook:
        """Ask the model about the whole picture (it cannot be asked about a part)."""
        table = light_table(light_gains(coarse_of(picture, self.step), self.small))
        even = picture if table is None else cv2.LUT(picture, table)
        with self.lock:
            found = self.subtractor.apply(even, learningRate=self.rate)
        full = cv2.threshold(found, _PERSON - 1, 255, cv2.THRESH_BINARY)[1].astype(np.uint8, copy=False)
        coarse = coarse_of(full, self.step)
        # Shadows too: a light that goes out is one all over.
        changed = cv2.countNonZero(coarse_of(found, self.step)) / coarse.size
        return MixtureLook(full, without_specks(coarse), changed)


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
    if len(shown) < _FEW:
        # Without any change to learn from, a model would take the camera's own noise for news.
        rng = np.random.default_rng(0)
        noise = [rng.normal(0, _NOISE_LEVELS, shown[0].shape).astype(np.float32) for _ in range(3)]
        shown = [np.clip(p + change, 0, 255).astype(np.uint8) for p in shown for change in noise]
    rounds = max(1, -(-_LEAST_TRAINING // len(shown)))
    if method in _HELD_RATE:
        make = cv2.createBackgroundSubtractorMOG2 if method == "mog2" else cv2.createBackgroundSubtractorKNN
        subtractor = make(history=rounds * len(shown), detectShadows=True)
        for picture in shown * rounds:
            subtractor.apply(picture)
        step = coarse_step(height, width)
        mean = coarse_of(learn_plate(iter(shown)).mean, step)
        return MixtureDifference(subtractor, _HELD_RATE[method], step, mean)
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
