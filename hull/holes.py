"""Holes that a single camera sees through what all the others see as thick and solid.

A hole in the middle of the trunk contradicts nobody's outline: no other camera looks along it. But an open
space that deep and that narrow, seen by one camera only, is no part of a person: a gap between limbs is as
wide as it is deep, or other cameras see into it as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int

from hull.bounds import Bounds
from hull.evidence import ways_through
from hull.tables import BLOCK_PX, INSIDE, OUTSIDE, SilhouetteTable

# A hole is false when a ball of this radius, or of the hole's own if larger, fits around some place in
# it so that every other camera sees all of the ball as person: a trunk is thicker, what hides between an arm
# and a trunk is not.
_SOLID_M = 0.08
_DIRECTIONS = (
    np.array(
        [d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)],
        dtype=np.float64,
    ).T
    - 1.0
)
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=0)
_FEWEST_CAMERAS = 8
_FEWEST_WITNESSES = 3


def false_holes(tables: Sequence[SilhouetteTable], bounds: Bounds) -> list[int]:
    """Numbers of the tables that have such a hole. With few cameras none is called false."""
    if len(tables) < _FEWEST_CAMERAS:
        return []
    found = []
    for number, table in enumerate(tables):
        others = [other for k, other in enumerate(tables) if k != number]
        for block, radius_px in _holes(table):
            points = _along(table, block, bounds)
            distance = float(np.linalg.norm(bounds.centre - table.centre))
            radius_m = radius_px * distance / float(np.linalg.norm(table.projection[0, :3]))
            if points.shape[1] and _is_solid(others, points, max(_SOLID_M, radius_m)):
                found.append(number)
                break
    return found


def _holes(table: SilhouetteTable) -> list[tuple[int, float]]:
    """The block in the middle of each patch of background that is enclosed by person, and its radius, px."""
    classes = table.squares[0]
    empty = ((classes & INSIDE) == 0).astype(np.uint8)
    n, label, stats, _ = cv2.connectedComponentsWithStats(empty, connectivity=4)
    holes = []
    height, width = classes.shape
    for piece in range(1, n):
        x, y, w, h, _area = (int(v) for v in stats[piece])
        if x == 0 or y == 0 or x + w == width or y + h == height:
            continue
        patch = (label[y : y + h, x : x + w] == piece).astype(np.uint8)
        if (classes[y : y + h, x : x + w][patch > 0] != OUTSIDE).any():
            continue
        depth = cv2.distanceTransform(np.pad(patch, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
        holes.append((int((y + row) * width + x + column), BLOCK_PX * float(depth.max())))
    return holes


def _along(table: SilhouetteTable, block: int, bounds: Bounds) -> Float[np.ndarray, "3 n"]:
    """Points every two centimetres through the box, along the line of sight through a block."""
    way = ways_through(table, np.array([block]))[0]
    middle = float((bounds.centre - table.centre) @ way)
    reach = 0.5 * float(np.linalg.norm(bounds.size_m))
    along: Float[np.ndarray, " n"] = np.arange(middle - reach, middle + reach, 0.02)
    points = table.centre[:, None] + way[:, None] * along
    inside = ((points > bounds.low[:, None]) & (points < bounds.high[:, None])).all(axis=0)
    return points[:, inside]


def _is_solid(others: Sequence[SilhouetteTable], points: Float[np.ndarray, "3 n"], radius_m: float) -> bool:
    ball = radius_m * _DIRECTIONS
    witnesses: Int[np.ndarray, " n"] = np.zeros(points.shape[1], dtype=np.int64)
    for other in others:
        answers = other.ask_points((points[:, :, None] + ball[:, None, :]).reshape(3, -1))
        answers = answers.reshape(points.shape[1], -1)
        kept = (answers != OUTSIDE).all(axis=1)
        points, witnesses = points[:, kept], witnesses[kept] + (answers[kept] == INSIDE).all(axis=1)
        if not points.shape[1]:
            return False
    return bool((witnesses >= _FEWEST_WITNESSES).any())
