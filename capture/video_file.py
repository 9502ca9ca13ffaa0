"""Frames of one video by their number, read forwards: seeking in compressed video is not exact, so it is not
used."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from threading import Lock

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.errors import RecordingError

_N_KEPT = 3  # the latest frames: a silhouette and then the picture of the same frame are asked for


class VideoFile:
    """A video, opened when first needed; going back to an earlier frame opens it again.

    path; size : (width, height) px; n_frames : as many as the file announces.
    """

    def __init__(self, path: Path) -> None:
        """Look at the file's head. Raises RecordingError for a file that is no readable video."""
        self.path = path
        self._lock = Lock()
        self._capture: cv2.VideoCapture | None = None
        self._next_idx = 0
        self._kept: OrderedDict[int, UInt8[np.ndarray, "h w 3"]] = OrderedDict()
        capture = self._opened()
        self.size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        self.n_frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if self.n_frames < 1 or min(self.size) < 1 or self.read(0) is None:
            raise RecordingError(
                f"{path}: no frame of this video can be decoded; copy it again or re-encode it"
            )

    def read(self, frame_idx: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """The frame as RGB (h w 3), as filmed; None where the video has ended or cannot be decoded.

        Threads may ask at once (silhouettes are read ahead while pictures are looked up): one waits.
        """
        with self._lock:
            return self._read(frame_idx)

    def _read(self, frame_idx: int) -> UInt8[np.ndarray, "h w 3"] | None:
        if frame_idx in self._kept:
            return self._kept[frame_idx]
        if self._capture is None or frame_idx < self._next_idx:
            self._capture, self._next_idx = self._opened(), 0
        while self._next_idx < frame_idx:
            if not self._capture.grab():
                return None
            self._next_idx += 1
        ok, picture = self._capture.read()
        self._next_idx += 1
        if not ok or picture is None:
            return None
        picture = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)
        picture.setflags(write=False)
        self._kept[frame_idx] = picture
        while len(self._kept) > _N_KEPT:
            self._kept.popitem(last=False)
        return picture

    def read_several(self, frame_indices: list[int]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """These frames (ascending) as RGB; the frame before stands in for one that cannot be decoded."""
        last = self.read(0)
        for frame_idx in frame_indices:
            picture = self.read(frame_idx)
            last = last if picture is None else picture
            assert last is not None
            yield last

    def _opened(self) -> cv2.VideoCapture:
        if not self.path.is_file():
            raise RecordingError(f"{self.path}: video missing")
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise RecordingError(f"{self.path}: cannot be opened as a video; copy it again or re-encode it")
        return capture

    def __getstate__(self) -> dict[str, object]:
        # A decoder cannot travel to another process; it is opened again there.
        return {**self.__dict__, "_capture": None, "_next_idx": 0, "_kept": OrderedDict(), "_lock": None}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state, _lock=Lock())
