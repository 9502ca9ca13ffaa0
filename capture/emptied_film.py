"""An empty scene from a film that somebody is in all the time (no background plate).

The median over time is the empty scene wherever the person covers a pixel in less than half of the frames.
Somebody who walks on the spot covers more. So the person is first cut out of every sample, roughly: whatever
moves is where the person can be, the rest of the picture shows what the scene looks like (GrabCut; Rother,
Kolmogorov, Blake, 2004); then the median is taken over the samples in which a pixel is free. What is never
free is filled from its surroundings.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from capture.background import median_over_time

Samples = UInt8[np.ndarray, "_t _h _w 3"]

_SIDE_PX = 320  # cut at this size
_MOVING_LEVELS = 24  # of 255, between the darkest and the lightest sample: beyond noise and flicker
_LEAST_SHARE, _MOST_SHARE = 0.002, 0.6  # of the picture that moves: less is nobody, more is the light
_CLOSE, _AROUND, _RIM = 0.03, 0.03, 0.012  # of the longer side
_ROUNDS = 4
_LEAST_FREE = 2  # samples
_OFTEN = 0.35  # a pixel covered in a larger share of the samples is not safe with the plain median


def emptied(samples: Samples) -> tuple[UInt8[np.ndarray, "_h _w 3"], Samples]:
    """The empty scene, and the samples with the person painted over by it.

    samples : RGB pictures of one camera over time (T h w 3). Where nobody seems to move, or all does, this is
    the plain median over time and the samples as they are.
    """
    middle = median_over_time(samples)
    covered = _covered(samples)
    if covered is None or not (often := covered.mean(axis=0) > _OFTEN).any():
        return middle, samples
    height, width = middle.shape[:2]
    region = cv2.resize(often.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    rows, columns = np.nonzero(region)
    small_rows = rows * covered.shape[1] // height
    small_columns = columns * covered.shape[2] // width
    taken = covered[:, small_rows, small_columns]
    shown = np.where(taken[:, :, None], np.uint8(255), samples[:, rows, columns])
    free = len(samples) - taken.sum(axis=0)
    # Covered samples are sorted behind the free ones, of which the middle one is taken.
    shown.sort(axis=0)
    chosen = np.take_along_axis(shown, (np.maximum(free - 1, 0) // 2)[None, :, None], axis=0)[0]
    scene = middle.copy()
    scene[rows, columns] = chosen
    never = np.zeros((height, width), np.uint8)
    never[rows, columns] = free < _LEAST_FREE
    scene = _filled(scene, never)
    painted = samples.copy()
    for picture, mask in zip(painted, covered, strict=True):
        full = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        picture[full] = scene[full]
    return scene, painted


def _covered(samples: Samples) -> Bool[np.ndarray, "_t _h _w"] | None:
    """Where the person may be in each sample, small; None where nobody can be told."""
    height, width = samples.shape[1:3]
    scale = min(1.0, _SIDE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.stack([cv2.resize(s, size, interpolation=cv2.INTER_AREA) for s in samples])
    span = (small.max(axis=0).astype(np.int16) - small.min(axis=0)).max(axis=2)
    moving = cv2.morphologyEx(
        (span > _MOVING_LEVELS).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
    )
    moving = cv2.morphologyEx(moving, cv2.MORPH_CLOSE, _disc(_CLOSE * max(size)))
    outlines, _ = cv2.findContours(moving, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros_like(moving)
    cv2.drawContours(filled, outlines, -1, 1, cv2.FILLED)
    if not _LEAST_SHARE < filled.mean() < _MOST_SHARE:
        return None
    region = cv2.dilate(filled, _disc(_AROUND * max(size))) > 0
    if region.all():
        return None
    rim = _disc(_RIM * max(size))
    return np.stack([cv2.dilate(_cut(picture, region), rim) > 0 for picture in small])


def _cut(
    picture: UInt8[np.ndarray, "_h _w 3"], region: Bool[np.ndarray, "_h _w"]
) -> UInt8[np.ndarray, "_h _w"]:
    """1 where a person within the region stands out from what is around it."""
    state = np.where(region, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    scene, person = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(picture, state, (0, 0, 0, 0), scene, person, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    return ((state == cv2.GC_PR_FGD) | (state == cv2.GC_FGD)).astype(np.uint8)


def _filled(
    picture: UInt8[np.ndarray, "_h _w 3"], unknown: UInt8[np.ndarray, "_h _w"]
) -> UInt8[np.ndarray, "_h _w 3"]:
    """The picture, what is unknown filled from around it (at a small size: it is smooth anyway)."""
    if not unknown.any():
        return picture
    height, width = unknown.shape
    scale = min(1.0, _SIDE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    holes = (cv2.resize(unknown.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0).astype(np.uint8)
    guess = cv2.resize(cv2.inpaint(small, holes, 3, cv2.INPAINT_TELEA), (width, height))
    return np.where(unknown[:, :, None] > 0, guess, picture).astype(np.uint8)


def _disc(radius: float) -> UInt8[np.ndarray, "_k _k"]:
    side = 2 * max(1, round(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)
