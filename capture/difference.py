"""What a method for silhouettes must be able to do for one camera: learn nothing any more, look at pictures.

A method looks at a picture twice: coarsely at all of it, which tells where something is and costs next to
nothing, and then finely in the box around the subject alone.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

Picture = UInt8[np.ndarray, "h w 3"]
Mask = UInt8[np.ndarray, "h w"]
Box = tuple[slice, slice]
"""Rows and columns of the full picture, with start and stop, no step."""

COARSE_SIDE = 512
"""The coarse look takes every n-th pixel, so that the longer side has about as many (px)."""


@runtime_checkable
class Look(Protocol):
    """One picture, looked at."""

    @property
    def coarse(self) -> UInt8[np.ndarray, "_h _w"]:
        """(ceil(h / step) ceil(w / step)), 255 where it differs from the background."""

    @property
    def changed(self) -> float:
        """What share of the picture differs, 0 to 1, before specks and shadows are taken out."""

    def fine(self, box: Box) -> UInt8[np.ndarray, "_h _w"]:
        """The same at full size in a box of the picture: 255 or 0."""


@runtime_checkable
class Difference(Protocol):
    """One camera's background, learnt."""

    @property
    def step(self) -> int:
        """Of the coarse look, px."""

    def look(self, picture: UInt8[np.ndarray, "_h _w 3"]) -> Look:
        """Look at one picture (RGB, as filmed). The background is not changed by it, so that frames give the
        same in any order."""


def coarse_step(height: int, width: int) -> int:
    """Every how many pixels the coarse look takes one."""
    return max(1, round(max(height, width) / COARSE_SIDE))


def coarse_of(image: Shaped[np.ndarray, "_h _w *_c"], step: int) -> Shaped[np.ndarray, "_H _W *_c"]:
    """Every `step`-th pixel of a picture or mask of bytes, along both sides."""
    if step == 1:
        return image
    size = (-(-image.shape[1] // step), -(-image.shape[0] // step))
    return cv2.resize(image, size, interpolation=cv2.INTER_NEAREST)


def full_size(small: Mask, step: int, box: Box) -> UInt8[np.ndarray, "_h _w"]:
    """The part of a coarse mask that a box of the full picture covers, at full size."""
    rows, columns = box
    part = small[rows.start // step : (rows.stop - 1) // step + 1]
    part = part[:, columns.start // step : (columns.stop - 1) // step + 1]
    large = part
    if step > 1:
        size = (part.shape[1] * step, part.shape[0] * step)
        large = cv2.resize(part, size, interpolation=cv2.INTER_NEAREST)
    top, left = rows.start % step, columns.start % step
    height, width = rows.stop - rows.start, columns.stop - columns.start
    return large[top : top + height, left : left + width]


def without_specks(mask: Mask) -> Mask:
    """Without what is nowhere two pixels wide."""
    pair = np.ones((2, 2), np.uint8)
    # Even kernels have no middle: taken off on one side, put back on the other.
    return cv2.dilate(cv2.erode(mask, pair), pair, anchor=(0, 0)).astype(np.uint8, copy=False)
