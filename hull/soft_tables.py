"""Soft silhouettes: probabilities instead of masks, weighed against each other before anything is cut.

A pixel's value says how surely it shows the person. Instead of cutting each silhouette at one half first and
letting every camera cut the hull alone, each camera states its *doubt* that a place is occupied: the log
likelihood ratio of "empty, though perhaps covered by something else" against "occupied", after the sensor
model of Franco and Boyer 2005 with its two rates, of false alarms and of missed detections. Doubts add up
over the cameras; a place is given up where their sum passes `LIMIT`. Evidence for the person is not added
up: the many cameras that see the person in front of or behind a place say nothing about the place itself.

So one camera that is sure cuts alone, one that merely doubts does not, and several that doubt do. A camera is
as sure of a pixel that is rather background as of the surest background a few pixels around it: a blurred
outline lies at one half, and only patches of doubt inside the person stay doubtful. Here is the image side:
bounds of the doubt for whole cells, the doubt at points, and outlines interpolated in the grey values, so
that anti-aliased mattes give outlines finer than pixels. The carving is in `hull.soft`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from capture.camera import Camera
from hull.tables import BLOCK_PX, OUTSIDE, UNKNOWN, SilhouetteTable, prepare_table

# Rates of the sensor: background taken for person, person taken for background; and how likely an empty place
# is covered by the person anyway.
_FALSE_ALARM, _MISSED, _COVERED = 0.05, 0.05, 0.5
# How far a blurred outline is from sure background, px.
_BLUR_PX = 2
# So much doubt may remain: what one camera that is sure of the person weighs. A single camera passes it where
# its probability is below 0.24.
LIMIT = float(np.log((1 - _MISSED) / (_COVERED * (1 - _MISSED) + (1 - _COVERED) * _FALSE_ALARM)))


def doubt(probability: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """How much a camera that shows the person with this probability speaks against a place; never below 0."""
    occupied = (1 - _MISSED) * probability + _MISSED * (1 - probability)
    covered = _COVERED * (1 - _MISSED) + (1 - _COVERED) * _FALSE_ALARM
    empty = covered * probability + (1 - covered) * (1 - probability)
    return np.maximum(np.log(empty / occupied), 0.0)


_DOUBT_OF_BYTE = doubt(np.arange(256) / 255.0)


@dataclass(frozen=True, eq=False)
class SoftTable(SilhouetteTable):
    """A silhouette table whose outline is interpolated in grey values, and which can tell its doubt.

    Fields
    ------
    grey : (h+1 w+1) 0 to 255, aligned with the codes; beyond what is stored it is background.
    darkest : (h+1 w+1) the least grey around each pixel: how sure a background pixel is.
    least, most : (levels h/4 w/4) of `darkest`, in the square of 2**level blocks from a block on.
    """

    grey: UInt8[np.ndarray, "h1 w1"]
    darkest: UInt8[np.ndarray, "h1 w1"]
    least: UInt8[np.ndarray, "levels hb wb"]
    most: UInt8[np.ndarray, "levels hb wb"]

    def _looked_up(
        self, u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], in_front: np.ndarray | None
    ) -> tuple[UInt8[np.ndarray, " n"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        answers, outline, _ = super()._looked_up(u, v, in_front)
        return answers, outline, self._interpolated(self.grey, u[outline], v[outline])

    def doubts(
        self, points: Float[np.ndarray, "3 n"]
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """(N,) doubt at world points (3 N), 0 without evidence; (N,) whether the camera sees the person
        there."""
        u, v, in_front = self._pixels(points)
        seen = (np.floor(u) >= self.lowest[0]) & (np.floor(u) <= self.highest[0])
        seen &= (np.floor(v) >= self.lowest[1]) & (np.floor(v) <= self.highest[1])
        if in_front is not None:
            seen &= in_front
        u, v = np.where(seen, u, 0.0), np.where(seen, v, 0.0)
        person = self._interpolated(self.grey, u, v) >= 0.5
        doubts = doubt(self._interpolated(self.darkest, u, v))
        return np.where(seen & ~person, doubts, 0.0), seen & person

    def doubts_in_cells(
        self, centres: Float[np.ndarray, "3 n"], half_m: float
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
        """Bounds (N,) of the doubt in cubes around the centres (3 N), and the answers that occur there."""
        answers = self.ask_cells(centres, half_m)
        u, v, depth = self.projected(centres)
        reach_depth = half_m * float(np.abs(self.projection[2, :3]).sum())
        near = np.maximum(depth - reach_depth, 1e-6)
        u, v = u / np.maximum(depth, 1e-6), v / np.maximum(depth, 1e-6)
        reach = [
            half_m / near * sum(np.abs(row[k] - pixel * self.projection[2, k]) for k in range(3)) + 1e-6
            for pixel, row in ((u, self.projection[0]), (v, self.projection[1]))
        ]
        least, most = self._extremes(u - reach[0], u + reach[0], v - reach[1], v + reach[1])
        low, high = _DOUBT_OF_BYTE.take(most), _DOUBT_OF_BYTE.take(least)
        # Doubt needs a place that is seen and rather background; behind the camera anything may be.
        low[answers != OUTSIDE] = 0.0
        high[(answers & OUTSIDE) == 0] = 0.0
        return low, high, answers

    def _interpolated(
        self, grey: UInt8[np.ndarray, "h w"], u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """(N,) probability at pixels, 0 beyond what is stored."""
        height, width = grey.shape
        x, y = u - self.origin[0], v - self.origin[1]
        stored = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
        x, y = np.where(stored, x, 0.0), np.where(stored, y, 0.0)
        column, row = x.astype(np.intp), y.astype(np.intp)
        x, y = x - column, y - row
        place = row * width + column
        flat = grey.ravel()
        upper = flat.take(place) * (1.0 - x) + flat.take(place + 1) * x
        lower = flat.take(place + width) * (1.0 - x) + flat.take(place + width + 1) * x
        return np.where(stored, (upper * (1.0 - y) + lower * y) / 255.0, 0.0)

    def _extremes(
        self, left: np.ndarray, right: np.ndarray, top: np.ndarray, bottom: np.ndarray
    ) -> tuple[UInt8[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
        """(N,) least and most grey in rectangles of the picture, given by their sides, px."""
        levels, height, width = self.least.shape
        bounds = []
        for low, high, origin, n in (
            (left, right, self.origin[0], width),
            (top, bottom, self.origin[1], height),
        ):
            first = np.floor((np.clip(low, -1e6, 1e6) - origin) / BLOCK_PX).astype(np.int64)
            last = np.floor((np.clip(high, -1e6, 1e6) - origin) / BLOCK_PX).astype(np.int64)
            bounds.append((first, last, (first < 0) | (last >= n)))
        (x_0, x_1, over_x), (y_0, y_1, over_y) = bounds
        nothing = (x_1 < 0) | (x_0 >= width) | (y_1 < 0) | (y_0 >= height)
        x_0, x_1 = np.clip(x_0, 0, width - 1), np.clip(x_1, 0, width - 1)
        y_0, y_1 = np.clip(y_0, 0, height - 1), np.clip(y_1, 0, height - 1)
        side = np.maximum(x_1 - x_0, y_1 - y_0) + 1
        level = np.maximum(np.ceil(np.log2(side)).astype(np.int64) - 1, 0)
        large = level >= levels
        level = np.minimum(level, levels - 1)
        x_1 = np.maximum(x_1 - (1 << level) + 1, 0)
        y_1 = np.maximum(y_1 - (1 << level) + 1, 0)
        corners = [(level * height + y) * width + x for y in (y_0, y_1) for x in (x_0, x_1)]
        least = np.minimum.reduce([self.least.ravel().take(c) for c in corners])
        most = np.maximum.reduce([self.most.ravel().take(c) for c in corners])
        least[large | over_x | over_y | nothing] = 0
        most[large] = 255
        most[nothing] = 0
        return least, most


def prepare_soft_tables(rig: Iterable[Camera], images: Sequence[np.ndarray | None]) -> tuple[SoftTable, ...]:
    """One table for each camera that has a picture of probabilities: (h w) uint8, 255 is surely person."""
    return tuple(
        prepare_soft_table(camera, image, camera_idx)
        for camera_idx, (camera, image) in enumerate(zip(rig, images, strict=True))
        if image is not None
    )


def prepare_soft_table(camera: Camera, image: UInt8[np.ndarray, "h w"], camera_idx: int) -> SoftTable:
    """The table of one picture of probabilities. Raises HullError as `prepare_table`."""
    binary = prepare_table(camera, as_mask(image), camera_idx)
    height, width = binary.codes.shape
    (x_0, y_0), (h, w) = binary.origin, image.shape
    # Faint doubts beyond the mask's surroundings are dropped: there the other cameras decide anyway.
    grey = np.zeros((height + 1, width + 1), dtype=np.uint8)
    from_x, to_x = max(x_0, 0), min(x_0 + width + 1, w)
    from_y, to_y = max(y_0, 0), min(y_0 + height + 1, h)
    if to_x > from_x and to_y > from_y:
        grey[from_y - y_0 : to_y - y_0, from_x - x_0 : to_x - x_0] = image[from_y:to_y, from_x:to_x]
    darkest = cv2.erode(grey, np.ones((2 * _BLUR_PX + 1, 2 * _BLUR_PX + 1), np.uint8))
    near = np.stack([darkest[:-1, :-1], darkest[:-1, 1:], darkest[1:, :-1], darkest[1:, 1:]])
    blocks = (height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
    least = near.min(axis=0).reshape(blocks).min(axis=(1, 3))
    most = near.max(axis=0).reshape(blocks).max(axis=(1, 3))
    n_levels = len(binary.squares)
    return SoftTable(
        **{f.name: getattr(binary, f.name) for f in fields(SilhouetteTable)},
        grey=grey,
        darkest=darkest,
        least=_squares(least, n_levels, np.minimum),
        most=_squares(most, n_levels, np.maximum),
    )


def as_mask(image: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Cut at one half: 255 or 0."""
    return np.where(image > UNKNOWN - 1, np.uint8(255), np.uint8(0))


def sure_mask(image: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """What is nearly certain, 255 or 0; the rest is unknown (128)."""
    return np.where(image > 204, np.uint8(255), np.where(image < 51, np.uint8(0), np.uint8(UNKNOWN)))


def _squares(
    blocks: UInt8[np.ndarray, "h w"], n_levels: int, of: np.ufunc
) -> UInt8[np.ndarray, "levels h w"]:
    squares = [blocks]
    for level in range(1, n_levels):
        step = 1 << (level - 1)
        wide = squares[-1].copy()
        wide[:, :-step] = of(squares[-1][:, :-step], squares[-1][:, step:])
        tall = wide.copy()
        tall[:-step] = of(wide[:-step], wide[step:])
        squares.append(tall)
    return np.stack(squares)
