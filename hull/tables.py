"""A silhouette prepared for carving: quick answers about points and about whole cells.

Step: section 4 of Zhang et al. 2017 takes visual hulls as given scans; this is the image side of making them.
One predicate defines the hull everywhere in this package: the binary silhouette, interpolated bilinearly at
the projection of a point, is at least one half. It is answered in two ways that agree exactly:

- for a point, from the *codes*: one byte a pixel that packs the 2 x 2 pixels around it, so that a single
  look-up decides all but the points within a pixel of the outline;
- for a cell, from the *classes*: quarter-size blocks of codes, each marked with the set of answers found in
  it, OR-ed over squares of 1, 2, 4, ... blocks, so that four look-ups give every answer that occurs in a
  rectangle.

Sparse OR tables were chosen over summed areas because they carry three kinds of answer in one byte a block,
and over a pyramid because their squares start at any block, which keeps the rectangle tight.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from capture.camera import Camera
from hull.errors import HullError
from hull.loops import mesh_loops

# Sets of answers are OR-ed together; a set of one element is a decision.
INSIDE = 1
OUTSIDE = 2
NO_EVIDENCE = 4
UNDECIDED = INSIDE | OUTSIDE | NO_EVIDENCE

PERSON, BACKGROUND, UNKNOWN = 255, 0, 128

BLOCK_PX = 4
# What segmentation says of the outermost pixels cannot be trusted: there is no picture beyond them to compare
# with.
BORDER_PX = 2
# Squares of up to 2**MAX_LEVEL blocks; larger rectangles (over 2 * 128 px wide) are undecided in practice
# anyway.
MAX_LEVEL = 5

FIRST_OUTLINE_BLOCK = 8
_UNKNOWN_BIT = 16


@dataclass(frozen=True, eq=False)
class SilhouetteTable:
    """One camera's silhouette, ready to be asked. Pixels are the camera's; pixel (0, 0) is a pixel's centre.

    Fields
    ------
    camera_idx : place of the camera in its rig.
    name : the camera's name.
    projection : (3 4), px from world, third value the depth.
    centre : (3,) where the camera stands, world.
    lowest, highest : the first and the last code (column, row) that holds evidence.
    origin : (column, row) of the first code stored; what lies beyond the stored ones equals the nearest
        stored one.
    codes : (h w) bits 0 to 3: person at the pixel, its right, its lower, its lower right neighbour; bit 4:
        unknown.
    squares : (levels h/4 w/4) sets of answers in the square of 2**level blocks that starts at a block.
    """

    camera_idx: int
    name: str
    projection: Float[np.ndarray, "3 4"]
    centre: Float[np.ndarray, " 3"]
    lowest: tuple[int, int]
    highest: tuple[int, int]
    origin: tuple[int, int]
    codes: UInt8[np.ndarray, "h w"]
    squares: UInt8[np.ndarray, "levels hb wb"]

    @cached_property
    def outline_blocks(self) -> tuple[Int[np.ndarray, "hb wb"], UInt8[np.ndarray, "n 16"]]:
        """The codes again, much smaller: for each block the answer that all its codes give, or, from
        FIRST_OUTLINE_BLOCK on, the number of its codes, which are stored one block after the other."""
        classes = self.squares[0]
        height, width = classes.shape
        index = classes.astype(np.int32)
        row, column = np.nonzero(_IS_MIXED.take(classes))
        index[row, column] = FIRST_OUTLINE_BLOCK + np.arange(len(row), dtype=np.int32)
        codes = self.codes.reshape(height, BLOCK_PX, width, BLOCK_PX)[row, :, column, :]
        return index, codes.reshape(len(row), BLOCK_PX**2)

    @cached_property
    def numbers(self) -> tuple[int, ...]:
        """What the compiled loops need beside the projection, in the order of `hull.compiled`'s columns."""
        index, codes = self.outline_blocks
        assert all(each.flags.c_contiguous for each in (index, codes, self.squares))
        addresses = (each.__array_interface__["data"][0] for each in (index, codes, self.squares))
        return (*addresses, *self.squares.shape, *self.lowest, *self.highest, *self.origin)

    def ask_points(self, points: Float[np.ndarray, "3 n"]) -> UInt8[np.ndarray, " n"]:
        """INSIDE, OUTSIDE or NO_EVIDENCE for each world point. Points are columns: (3 N), metres."""
        answers, outline, value = self._looked_up(*self._pixels(points))
        answers[outline] = np.where(value >= 0.5, np.uint8(INSIDE), np.uint8(OUTSIDE))
        return answers

    def on_outline(self, points: Float[np.ndarray, "3 n"]) -> Int[np.ndarray, " m"]:
        """Which (M,) of the points person and background meet at, among the four pixels around."""
        _, outline, _ = self._looked_up(*self._pixels(points))
        return outline

    def ask_pixels(self, u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """(N,) how much of a person there is at pixels: below one half is OUTSIDE; without evidence 1."""
        answers, outline, value = self._looked_up(u, v, None)
        result = (answers != OUTSIDE).astype(np.float64)
        result[outline] = value
        return result

    def projected(self, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        """World points in the picture, not yet divided by their depth."""
        return self.projected_way(points) + self.projection[:, 3:]

    def projected_way(self, ways: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        """World ways (differences of points), likewise."""
        # Term by term, in the order of `hull.compiled`: a matrix product adds up in an order of its own.
        x, y, z = ways
        return np.stack([(row[0] * x + row[1] * y) + row[2] * z for row in self.projection])

    def ask_cells(self, centres: Float[np.ndarray, "3 n"], half_m: float) -> UInt8[np.ndarray, " n"]:
        """The answers that can occur in each cube of half side `half_m` around the centres (3 N), metres.

        A superset: a set of one element is certain, a larger one means "split and ask again". The bound on
        how far a cube reaches in the picture is the exact one for a projective map with a single division .
        """
        p = self.projection
        u, v, depth = self.projected(centres)
        reach_depth = half_m * float((abs(p[2, 0]) + abs(p[2, 1])) + abs(p[2, 2]))
        all_in_front = bool(len(depth)) and float(depth.min()) > reach_depth
        in_front = depth > reach_depth
        if not all_in_front:
            safe_depth = np.where(in_front, depth, 2.0 * reach_depth + 1.0)
        else:
            safe_depth = depth
        u /= safe_depth
        v /= safe_depth
        per_depth = half_m / (safe_depth - reach_depth)
        reach_u, reach_v = (
            per_depth
            * (
                np.abs(row[0] - pixel * p[2, 0])
                + np.abs(row[1] - pixel * p[2, 1])
                + np.abs(row[2] - pixel * p[2, 2])
            )
            for pixel, row in ((u, p[0]), (v, p[1]))
        )
        # The slack covers rounding: a corner that falls on a pixel's edge must be found on either side of it.
        reach_u += 1e-6
        reach_v += 1e-6
        left, right, top, bottom = u - reach_u, u + reach_u, v - reach_v, v + reach_v

        answers = self._answers_in(left, right, top, bottom)
        (x_0, y_0), (x_1, y_1) = self.lowest, (self.highest[0] + 1, self.highest[1] + 1)
        if not (
            len(u) and left.min() >= x_0 and right.max() < x_1 and top.min() >= y_0 and bottom.max() < y_1
        ):
            within = (left >= x_0) & (right < x_1) & (top >= y_0) & (bottom < y_1)
            answers[~within] |= NO_EVIDENCE
            answers[(right < x_0) | (left >= x_1) | (bottom < y_0) | (top >= y_1)] = NO_EVIDENCE
        if not all_in_front:
            behind = np.flatnonzero(~in_front)
            answers[behind] = np.where(depth[behind] + reach_depth <= 0.0, NO_EVIDENCE, UNDECIDED)
        return answers

    def _pixels(
        self, points: Float[np.ndarray, "3 n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], np.ndarray | None]:
        return _divided(*self.projected(points))

    def _looked_up(
        self, u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], in_front: np.ndarray | None
    ) -> tuple[UInt8[np.ndarray, " n"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """(N,) answers at pixels; which of them (M,) lie on an outline, and the silhouette's value there.

        `in_front`: None where all are.
        """
        height, width = self.codes.shape
        column, row = np.floor(u), np.floor(v)
        unseen = None
        x_0, y_0 = self.origin
        if len(u) and not (
            in_front is None
            and column.min() >= max(x_0, self.lowest[0])
            and column.max() <= min(x_0 + width - 1, self.highest[0])
            and row.min() >= max(y_0, self.lowest[1])
            and row.max() <= min(y_0 + height - 1, self.highest[1])
        ):
            unseen = (column < self.lowest[0]) | (column > self.highest[0])
            unseen |= (row < self.lowest[1]) | (row > self.highest[1])
            if in_front is not None:
                unseen |= ~in_front
            # What lies beyond the stored codes equals the nearest stored one.
            place = np.minimum(np.maximum(row, y_0), y_0 + height - 1) - y_0
            place *= width
            place += np.minimum(np.maximum(column, x_0), x_0 + width - 1) - x_0
        else:
            place = (row - y_0) * width
            place += column - x_0
        codes = self.codes.ravel().take(place.astype(np.intp))
        answers = _ANSWER_OF_CODE.take(codes)
        if unseen is not None:
            answers[unseen] = NO_EVIDENCE
        outline = np.flatnonzero(answers == UNDECIDED)
        fx = u[outline] - column[outline]
        fy = v[outline] - row[outline]
        bits = codes[outline]
        upper = (bits & 1) * (1.0 - fx) + ((bits >> 1) & 1) * fx
        lower = ((bits >> 2) & 1) * (1.0 - fx) + ((bits >> 3) & 1) * fx
        return answers, outline, upper * (1.0 - fy) + lower * fy

    def _answers_in(
        self,
        left: Float[np.ndarray, " n"],
        right: Float[np.ndarray, " n"],
        top: Float[np.ndarray, " n"],
        bottom: Float[np.ndarray, " n"],
    ) -> UInt8[np.ndarray, " n"]:
        """The OR of all blocks that rectangles (pixels) touch, as four overlapping squares of one level."""
        levels, height, width = self.squares.shape
        # Blocks are counted from 1 here, so that 0 and one past the last stand for all that is not stored.
        first_x, last_x = (self._block(pixel, 0, width) for pixel in (left, right))
        first_y, last_y = (self._block(pixel, 1, height) for pixel in (top, bottom))
        background = (last_x < 1) | (first_x > width) | (last_y < 1) | (first_y > height)
        x_0, y_0 = np.maximum(first_x, 1) - 1, np.maximum(first_y, 1) - 1
        x_1, y_1 = np.minimum(last_x, width) - 1, np.minimum(last_y, height) - 1
        side = np.maximum(np.maximum(x_1 - x_0, y_1 - y_0), 0) + 1
        largest = int(side.max(initial=1))
        level = _LEVEL_OF_SIDE.take(np.minimum(side, len(_LEVEL_OF_SIDE) - 1))
        too_large = level >= levels if largest > 1 << levels else None
        if too_large is not None:
            level = np.minimum(level, levels - 1)
        reach = (1 << level) - 1
        # A square wider than the rectangle starts further left or up: it then covers more, which is still
        # safe.
        x_0, y_0 = np.minimum(x_0, width - 1), np.minimum(y_0, height - 1)
        x_1 = np.maximum(x_1 - reach, 0)
        y_1 = np.maximum(y_1 - reach, 0)
        flat = self.squares.reshape(-1)
        level *= height
        upper = (level + y_0) * width
        lower = (level + y_1) * width
        answers = flat.take(upper + x_0)
        answers |= flat.take(upper + x_1)
        answers |= flat.take(lower + x_0)
        answers |= flat.take(lower + x_1)
        if too_large is not None:
            answers[too_large] = UNDECIDED
        # All that is not stored is background (or beyond the picture, which the caller adds).
        answers[background] = OUTSIDE
        return answers

    def _block(self, pixel: Float[np.ndarray, " n"], axis: int, n_blocks: int) -> Int[np.ndarray, " n"]:
        """The block a pixel lies in, counted from 1; 0 and n_blocks + 1 beyond the stored ones."""
        place = pixel * (1.0 / BLOCK_PX)
        place += 1.0 - self.origin[axis] / BLOCK_PX
        np.maximum(place, 0.0, out=place)
        np.minimum(place, n_blocks + 1.0, out=place)
        return place.astype(np.intp)


def _divided(
    u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"], depth: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], np.ndarray | None]:
    """Pixels, and which are in front of the camera; None: all of them."""
    if not len(depth) or depth.min() > 0.0:
        return u / depth, v / depth, None
    in_front = depth > 0.0
    safe_depth = np.where(in_front, depth, 1.0)
    return u / safe_depth, v / safe_depth, in_front


def prepare_tables(rig: Iterable[Camera], images: Sequence[np.ndarray | None]) -> tuple[SilhouetteTable, ...]:
    """One table for each camera that has a silhouette, in the rig's order.

    `images`: per camera a (h w) uint8 silhouette as the camera's pinhole sees it (255 person, 0 background,
    128 unknown) or None (no evidence). Raises HullError naming the camera when counts, sizes or types
    disagree.
    """
    cameras = tuple(rig)
    if len(cameras) != len(images):
        raise HullError(
            f"{len(cameras)} cameras but {len(images)} silhouettes; give one (or None) per camera, in order"
        )
    return tuple(
        prepare_table(camera, image, camera_idx)
        for camera_idx, (camera, image) in enumerate(zip(cameras, images, strict=True))
        if image is not None
    )


def prepare_table(camera: Camera, image: UInt8[np.ndarray, "h w"], camera_idx: int) -> SilhouetteTable:
    """The table of one silhouette. Only its surroundings are stored. Raises HullError as above."""
    width, height = camera.size
    if image.dtype != np.uint8 or image.shape != (height, width):
        raise HullError(
            f"camera {camera.name}: its silhouette is {image.dtype} of shape {image.shape}, expected "
            f"uint8 of shape ({height}, {width}) as the calibration says; "
            "were the pictures scaled, or the cameras mixed up?"
        )
    pixels, origin = _surroundings(image)
    codes = _codes(pixels)
    projection = np.asarray(camera.projection_matrix, dtype=np.float64)
    return SilhouetteTable(
        camera_idx=camera_idx,
        name=camera.name,
        projection=projection,
        centre=-np.linalg.solve(projection[:, :3], projection[:, 3]),
        lowest=(BORDER_PX, BORDER_PX),
        highest=(width - 2 - BORDER_PX, height - 2 - BORDER_PX),
        origin=origin,
        codes=codes,
        squares=_squares(_classes(codes)),
    )


def _surroundings(image: UInt8[np.ndarray, "h w"]) -> tuple[UInt8[np.ndarray, "h2 w2"], tuple[int, int]]:
    """The part of the picture around what is not background, one clear block wide, and its (column, row).

    Beyond the picture and in its border pixels it is UNKNOWN. One pixel more than whole blocks in both
    directions.
    """
    height, width = image.shape
    loops = mesh_loops()
    # OpenCV takes four times as long, which counts for pictures of several megapixels.
    x, y, w, h = cv2.boundingRect(image) if loops is None else loops.picture_box(np.ascontiguousarray(image))
    if w == 0:
        x, y, w, h = width // 2, height // 2, 1, 1
    x_0 = (x - 1) // BLOCK_PX * BLOCK_PX - BLOCK_PX
    y_0 = (y - 1) // BLOCK_PX * BLOCK_PX - BLOCK_PX
    x_1 = (x + w) // BLOCK_PX * BLOCK_PX + 2 * BLOCK_PX + 1
    y_1 = (y + h) // BLOCK_PX * BLOCK_PX + 2 * BLOCK_PX + 1
    pixels = np.full((y_1 - y_0, x_1 - x_0), UNKNOWN, dtype=np.uint8)
    from_x, to_x = max(x_0, BORDER_PX), min(x_1, width - BORDER_PX)
    from_y, to_y = max(y_0, BORDER_PX), min(y_1, height - BORDER_PX)
    if to_x > from_x and to_y > from_y:
        pixels[from_y - y_0 : to_y - y_0, from_x - x_0 : to_x - x_0] = image[from_y:to_y, from_x:to_x]
    return pixels, (x_0, y_0)


def _codes(pixels: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h-1 w-1"]:
    """(h w) pixels -> (h-1 w-1) codes of their 2 x 2 neighbourhoods."""
    person = (pixels > UNKNOWN).view(np.uint8)
    # Sums, because numpy adds bytes many at a time and shifts them one by one.
    rows = person[:, 1:] + person[:, 1:]
    rows += person[:, :-1]
    codes = rows[1:] + rows[1:]
    codes += codes
    codes += rows[:-1]
    unknown = pixels == UNKNOWN
    if unknown.any():
        flags = unknown.view(np.uint8) * np.uint8(_UNKNOWN_BIT)
        codes |= flags[:-1, :-1] | flags[:-1, 1:] | flags[1:, :-1] | flags[1:, 1:]
    return codes


def _classes(codes: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h/4 w/4"]:
    """(h w) codes -> (h/4 w/4) sets of the answers that occur in each block of 4 x 4 codes."""
    height, width = codes.shape
    rows = np.ascontiguousarray(codes).reshape(height // BLOCK_PX, BLOCK_PX, width)
    any_bits = rows[:, 0] | rows[:, 1] | rows[:, 2] | rows[:, 3]
    all_bits = rows[:, 0] & rows[:, 1] & rows[:, 2] & rows[:, 3]
    # Four neighbouring bytes are one 32-bit word: two shifts fold them, whatever the byte order.
    any_word, all_word = any_bits.view(np.uint32), all_bits.view(np.uint32)
    any_word = any_word | (any_word >> 16)
    all_word = all_word & (all_word >> 16)
    any_block = (any_word | (any_word >> 8)).astype(np.uint8)
    all_block = (all_word & (all_word >> 8)).astype(np.uint8)
    classes = np.full(any_block.shape, UNDECIDED, dtype=np.uint8)
    classes[any_block < _UNKNOWN_BIT] = INSIDE | OUTSIDE
    classes[any_block == 0] = OUTSIDE
    classes[(all_block == 15) & (any_block == 15)] = INSIDE
    classes[any_block == _UNKNOWN_BIT] = OUTSIDE | NO_EVIDENCE
    classes[all_block >= _UNKNOWN_BIT] = NO_EVIDENCE
    return classes


def _squares(classes: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "levels h w"]:
    """(h w) classes -> (levels h w): OR over the square of 2**level blocks from a block on."""
    n_levels = min(MAX_LEVEL, int(np.ceil(np.log2(max(classes.shape))))) + 1
    squares = np.empty((n_levels, *classes.shape), dtype=np.uint8)
    squares[0] = classes
    for level in range(1, n_levels):
        step = 1 << (level - 1)
        wide = squares[level - 1].copy()
        wide[:, :-step] |= squares[level - 1][:, step:]
        squares[level] = wide
        squares[level][:-step] |= wide[step:]
    return squares


def _level_of_side() -> np.ndarray:
    """Level whose squares, two by two, cover a rectangle of so many blocks a side; index 0 is not used."""
    sides = np.arange((2 << MAX_LEVEL) + 2)
    return np.maximum(np.ceil(np.log2(np.maximum(sides, 1))).astype(np.int64) - 1, 0)


_IS_MIXED = np.ones(UNDECIDED + 1, dtype=bool)
_IS_MIXED[[INSIDE, OUTSIDE, NO_EVIDENCE]] = False
_LEVEL_OF_SIDE = _level_of_side()
_ANSWER_OF_CODE = np.full(32, NO_EVIDENCE, dtype=np.uint8)
_ANSWER_OF_CODE[:16] = UNDECIDED
_ANSWER_OF_CODE[0] = OUTSIDE
_ANSWER_OF_CODE[15] = INSIDE
