"""How a picture differs from a background: the two measures that the segmentation's steps share."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

CLEAR_LEVELS = 22  # of 255: beyond noise, compression and soft shadows

Picture = UInt8[np.ndarray, "h w 3"]


def departure(picture: Picture, background: Picture) -> UInt8[np.ndarray, "h w"]:
    """How far (levels, worst channel) each pixel lies outside the background's range over its 3x3 neighbours.

    The range forgives edges that are shifted by up to a pixel: another compression, a plate that was scaled.
    """
    kernel = np.ones((3, 3), np.uint8)
    above = cv2.subtract(picture, cv2.dilate(background, kernel))
    below = cv2.subtract(cv2.erode(background, kernel), picture)
    return np.maximum(above, below).max(axis=2)


def foreground(picture: Picture, background: Picture) -> UInt8[np.ndarray, "h w"]:
    """255 where the picture clearly differs from the background, specks removed."""
    mask = np.where(departure(picture, background) > CLEAR_LEVELS, 255, 0).astype(np.uint8)
    return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(np.uint8)


def shrunk(picture: Picture, scale: float) -> UInt8[np.ndarray, "_h _w 3"]:
    """The picture scaled down by area averaging (as it is at scale 1)."""
    if scale >= 1:
        return picture
    size = scaled_size((picture.shape[1], picture.shape[0]), scale)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """(width, height) px of a picture scaled by `scale`."""
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
