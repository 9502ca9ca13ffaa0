"""The space that all silhouettes share, coarsely: enough to tell where somebody stands and how tall they are.

A few centimetres; the hull room carves properly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from capture.camera import Camera
from capture.rig import Rig
from capture.silhouette_files import PERSON
from capture.world import find_subject

Masks = Sequence[UInt8[np.ndarray, "_h _w"] | None]


def lowest_place(rig: Rig, masks: Masks, up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"] | None:
    """Where the lowest part of what all silhouettes share lies (3); None where they share nothing."""
    inside = _inside_all(rig, masks)
    if inside is None:
        return None
    points, step = inside
    height = points @ up
    low = points[height < height.min() + 1.5 * step]
    return low.mean(axis=0) - up * (float((low @ up).mean()) - float(height.min()) + step / 2)


def extent_along(rig: Rig, masks: Masks, up: Float[np.ndarray, " 3"]) -> tuple[float, float] | None:
    """Lowest and highest coordinate along `up` of what all silhouettes share, world units."""
    inside = _inside_all(rig, masks)
    if inside is None:
        return None
    points, step = inside
    height = points @ up
    return float(height.min() - step / 2), float(height.max() + step / 2)


def _inside_all(rig: Rig, masks: Masks) -> tuple[Float[np.ndarray, "n 3"], float] | None:
    """Points of a grid that lie on every silhouette that can see them, and the grid's step; a coarse hull.

    Two rounds: a cube about where the cameras look, then the box of what was found, finer. A place must be
    seen by half the cameras that have a silhouette at least.
    """
    used = [(camera.pinhole(), mask) for camera, mask in zip(rig, masks, strict=True) if mask is not None]
    used = [(camera, mask) for camera, mask in used if (mask == PERSON).any()]
    if len(used) < 2:
        return None
    middle, _ = find_subject(rig, masks)
    half = max(_half_size(camera, mask, middle) for camera, mask in used)
    low, high = middle - half, middle + half
    points, step = np.zeros((0, 3)), 0.0
    for n_cells in (48, 80):
        step = float((high - low).max()) / n_cells
        axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        votes = np.zeros(len(grid), dtype=int)
        good = np.ones(len(grid), dtype=bool)
        for camera, mask in used:
            pixels, depth = camera.project(grid)
            column, row = (np.rint(np.nan_to_num(pixels[:, k], nan=-9, posinf=-9, neginf=-9)) for k in (0, 1))
            seen = (
                (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.size[0]) & (row < camera.size[1])
            )
            value = mask[row[seen].astype(int), column[seen].astype(int)]
            votes[seen] += value == PERSON
            good[np.flatnonzero(seen)[value == 0]] = False
        points = grid[good & (votes * 2 >= len(used))]
        if not len(points):
            return None
        low, high = points.min(axis=0) - 1.5 * step, points.max(axis=0) + 1.5 * step
    return points, step


def _half_size(camera: Camera, mask: UInt8[np.ndarray, "h w"], middle: Float[np.ndarray, " 3"]) -> float:
    """Half the side of a cube about `middle` that holds what this camera sees of the person, world units."""
    rows, columns = np.nonzero(mask == PERSON)
    depth = abs(float(camera.project(middle[None])[1][0]))
    return 0.75 * depth * max(float(np.ptp(rows)), float(np.ptp(columns)), 2.0) / camera.intrinsics[1, 1]
