"""The innermost loops of carving, compiled: what `hull.tables` answers, for many places and all cameras.

The plain definitions (`SilhouetteTable`, `carve`, `exits`, ...) stay as they are and are the reference: every
kernel does the same operations in the same order, so the answers are the same to the last bit. Compiled, a
place is taken through all its cameras before the next one is looked at; nothing is copied out and back in
between, and neighbouring places find the little of each picture that they need in the processor's cache.

What a kernel fills is allocated by numpy and handed in: numpy asks the system for large pages, which saves
most of the cost of fresh memory. Compiled on the first call and kept beside this file, or in the user's cache
where that cannot be written.
Everything that is called from here must be in this file: numba looks only at it to see whether what it kept
is stale.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

from hull.kernel import kernel

_BELOW_HALF = float(np.nextafter(0.5, 0.0))
_MOST_HALVINGS = 7
_N_FALSE_POSITIONS = 3

# Columns of a table's numbers, as `hull.stack` lays them out.
(
    INDEX,
    CODES,
    SQUARES,
    LEVELS,
    SQUARES_HEIGHT,
    SQUARES_WIDTH,
    LOWEST_X,
    LOWEST_Y,
    HIGHEST_X,
    HIGHEST_Y,
    ORIGIN_X,
    ORIGIN_Y,
    N_NUMBERS,
) = range(13)
# As in `hull.tables`; a test holds them together.
INSIDE, OUTSIDE, NO_EVIDENCE, UNDECIDED = 1, 2, 4, 7
FIRST_OUTLINE_BLOCK = 8
DEEP, HIGH = 1, 2


def _inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Written out where it is called: a call costs more than a look-up."""
    return njit(inline="always", error_model="numpy")(function)


@no_type_check
def _as_pointer(context, builder, signature, arguments):
    return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))


@intrinsic
@no_type_check
def _bytes_at(context, address):
    """An address as something to index: tables stay where they are, whichever are used together."""
    return types.CPointer(types.uint8)(types.int64), _as_pointer


@intrinsic
@no_type_check
def _numbers_at(context, address):
    """The same of numbers of four bytes."""
    return types.CPointer(types.int32)(types.int64), _as_pointer


@_inlined
@no_type_check
def _look_up(numbers, k, u, v):
    """`SilhouetteTable._looked_up` for one pixel in front of the camera: the answer and the value."""
    column, row = np.floor(u), np.floor(v)
    if (
        column < numbers[k, LOWEST_X]
        or column > numbers[k, HIGHEST_X]
        or row < numbers[k, LOWEST_Y]
        or row > numbers[k, HIGHEST_Y]
    ):
        return NO_EVIDENCE, 1.0
    width, height = numbers[k, SQUARES_WIDTH], numbers[k, SQUARES_HEIGHT]
    x = min(max(np.int64(column) - numbers[k, ORIGIN_X], 0), 4 * width - 1)
    y = min(max(np.int64(row) - numbers[k, ORIGIN_Y], 0), 4 * height - 1)
    block = _numbers_at(numbers[k, INDEX])[(y >> 2) * width + (x >> 2)]
    if block == OUTSIDE:
        return OUTSIDE, 0.0
    if block == INSIDE:
        return INSIDE, 1.0
    if block == NO_EVIDENCE:
        return NO_EVIDENCE, 1.0
    bits = _bytes_at(numbers[k, CODES])[((block - FIRST_OUTLINE_BLOCK) << 4) + ((y & 3) << 2) + (x & 3)]
    if bits == 0:
        return OUTSIDE, 0.0
    if bits == 15:
        return INSIDE, 1.0
    if bits >= 16:
        return NO_EVIDENCE, 1.0
    fx, fy = u - column, v - row
    upper = (bits & 1) * (1.0 - fx) + ((bits >> 1) & 1) * fx
    lower = ((bits >> 2) & 1) * (1.0 - fx) + ((bits >> 3) & 1) * fx
    return UNDECIDED, upper * (1.0 - fy) + lower * fy


@_inlined
@no_type_check
def _projected(p, k, x, y, z):
    return (
        ((p[k, 0, 0] * x + p[k, 0, 1] * y) + p[k, 0, 2] * z) + p[k, 0, 3],
        ((p[k, 1, 0] * x + p[k, 1, 1] * y) + p[k, 1, 2] * z) + p[k, 1, 3],
        ((p[k, 2, 0] * x + p[k, 2, 1] * y) + p[k, 2, 2] * z) + p[k, 2, 3],
    )


@_inlined
@no_type_check
def _ask_point(numbers, p, k, x, y, z):
    """`SilhouetteTable.ask_points` for one point, UNDECIDED where it lies on an outline; and the value."""
    u, v, depth = _projected(p, k, x, y, z)
    if not depth > 0.0:
        return NO_EVIDENCE, 1.0
    return _look_up(numbers, k, u / depth, v / depth)


@_inlined
@no_type_check
def _refuses(numbers, p, k, x, y, z):
    answer, value = _ask_point(numbers, p, k, x, y, z)
    return answer == OUTSIDE or (answer == UNDECIDED and value < 0.5)


@_inlined
@no_type_check
def _value(numbers, k, u, v):
    return _look_up(numbers, k, u, v)[1]


@_inlined
@no_type_check
def _block(pixel, origin, n_blocks):
    place = pixel * 0.25
    place += 1.0 - origin / 4
    return np.int64(min(max(place, 0.0), n_blocks + 1.0))


@_inlined
@no_type_check
def _ask_cell(numbers, p, k, x, y, z, half_m):
    """`SilhouetteTable.ask_cells` for one cell."""
    u, v, depth = _projected(p, k, x, y, z)
    reach_depth = half_m * ((abs(p[k, 2, 0]) + abs(p[k, 2, 1])) + abs(p[k, 2, 2]))
    if not depth > reach_depth:
        return NO_EVIDENCE if depth + reach_depth <= 0.0 else UNDECIDED
    u /= depth
    v /= depth
    per_depth = half_m / (depth - reach_depth)
    reach_u = 1e-6 + per_depth * (
        abs(p[k, 0, 0] - u * p[k, 2, 0]) + abs(p[k, 0, 1] - u * p[k, 2, 1]) + abs(p[k, 0, 2] - u * p[k, 2, 2])
    )
    reach_v = 1e-6 + per_depth * (
        abs(p[k, 1, 0] - v * p[k, 2, 0]) + abs(p[k, 1, 1] - v * p[k, 2, 1]) + abs(p[k, 1, 2] - v * p[k, 2, 2])
    )
    left, right, top, bottom = u - reach_u, u + reach_u, v - reach_v, v + reach_v
    x_0, y_0 = numbers[k, LOWEST_X], numbers[k, LOWEST_Y]
    x_1, y_1 = numbers[k, HIGHEST_X] + 1, numbers[k, HIGHEST_Y] + 1
    if right < x_0 or left >= x_1 or bottom < y_0 or top >= y_1:
        return NO_EVIDENCE
    beyond = 0 if left >= x_0 and right < x_1 and top >= y_0 and bottom < y_1 else NO_EVIDENCE

    height, width = numbers[k, SQUARES_HEIGHT], numbers[k, SQUARES_WIDTH]
    first_x, last_x = _block(left, numbers[k, ORIGIN_X], width), _block(right, numbers[k, ORIGIN_X], width)
    first_y, last_y = _block(top, numbers[k, ORIGIN_Y], height), _block(bottom, numbers[k, ORIGIN_Y], height)
    if last_x < 1 or first_x > width or last_y < 1 or first_y > height:
        return OUTSIDE | beyond
    first_x, first_y = max(first_x, 1) - 1, max(first_y, 1) - 1
    last_x, last_y = min(last_x, width) - 1, min(last_y, height) - 1
    side = max(last_x - first_x, last_y - first_y, 0) + 1
    level = 0
    while (2 << level) < side:
        level += 1
    if level >= numbers[k, LEVELS]:
        return UNDECIDED
    reach = (1 << level) - 1
    last_x, last_y = max(last_x - reach, 0), max(last_y - reach, 0)
    upper = (level * height + first_y) * width
    lower = (level * height + last_y) * width
    squares = _bytes_at(numbers[k, SQUARES])
    return (
        squares[upper + first_x]
        | squares[upper + last_x]
        | squares[lower + first_x]
        | squares[lower + last_x]
        | beyond
    )


@kernel
@no_type_check
def ask_cells(numbers, projections, centres, half_m, answers):
    """`answers` (C N): what every table answers about every cell."""
    n_tables, n = len(numbers), centres.shape[1]
    for i in range(n):
        x, y, z = centres[0, i], centres[1, i], centres[2, i]
        for k in range(n_tables):
            answers[k, i] = _ask_cell(numbers, projections, k, x, y, z, half_m)


@kernel
@no_type_check
def ask_children(
    numbers,
    projections,
    order,
    unasked_of,
    without_of,
    n_outside_of,
    cells,
    alive,
    low,
    width_m,
    half_m,
    votes,
    unasked,
    without,
    n_outside,
):
    """The loop over cameras of `hull.carve._ask`: the sets of each cell from those of its parent (last
    arguments, written into, as is `alive`). How many cells each camera was asked about and how many it saw
    outside; and whether some camera can see nothing of a cell that it does not see outside."""
    n_words, n_cells = unasked_of.shape[0], cells.shape[1]
    family = n_cells // max(unasked_of.shape[1], 1)
    n_asked, n_rejected = np.zeros(len(numbers), dtype=np.int64), np.zeros(len(numbers), dtype=np.int64)
    blind = False
    for i in range(n_cells):
        parent = i // family
        for word in range(n_words):
            unasked[word, i] = unasked_of[word, parent]
            without[word, i] = without_of[word, parent]
        n_outside[i] = n_outside_of[parent]
        if not alive[i]:
            continue
        x = low[0] + (cells[0, i] + 0.5) * width_m
        y = low[1] + (cells[1, i] + 0.5) * width_m
        z = low[2] + (cells[2, i] + 0.5) * width_m
        for camera in order:
            word, bit = camera >> 6, np.uint64(1) << np.uint64(camera & 63)
            if not unasked_of[word, parent] & bit:
                continue
            answer = _ask_cell(numbers, projections, camera, x, y, z, half_m)
            n_asked[camera] += 1
            if answer == OUTSIDE:
                n_rejected[camera] += 1
                n_outside[i] += 1
                unasked[word, i] &= ~bit
                without[word, i] |= bit
                if n_outside[i] >= votes:
                    alive[i] = False
                    break
                continue
            if answer in (INSIDE, NO_EVIDENCE):
                unasked[word, i] &= ~bit
            if not answer & INSIDE:
                without[word, i] |= bit
                blind = True
    return n_asked, n_rejected, blind


@kernel
@no_type_check
def ask_voxels(
    numbers, projections, order, unasked_of, n_outside_of, cells, alive, low, voxel_m, votes, excepted
):
    """The loop over cameras of `hull.carve._ask_voxels`. `excepted` (W N, empty sets): gets the cameras that
    were asked about a voxel and do not see it inside; `alive` is written into too."""
    n_cells = cells.shape[1]
    family = n_cells // max(unasked_of.shape[1], 1)
    for i in range(n_cells):
        if not alive[i]:
            continue
        parent = i // family
        n_outside = n_outside_of[parent]
        x = low[0] + (cells[0, i] + 0.5) * voxel_m
        y = low[1] + (cells[1, i] + 0.5) * voxel_m
        z = low[2] + (cells[2, i] + 0.5) * voxel_m
        for camera in order:
            word, bit = camera >> 6, np.uint64(1) << np.uint64(camera & 63)
            if not unasked_of[word, parent] & bit:
                continue
            answer, value = _ask_point(numbers, projections, camera, x, y, z)
            if answer == INSIDE or (answer == UNDECIDED and value >= 0.5):
                continue
            excepted[word, i] |= bit
            if answer != NO_EVIDENCE:
                n_outside += 1
                if n_outside >= votes:
                    alive[i] = False
                    break


@kernel
@no_type_check
def name_blocks(places, low, per_m, shape, name):
    """`name` (N,): of the block of a culling's grid that each place lies in."""
    for i in range(len(name)):
        a = np.int64((places[0, i] - low[0]) * per_m)
        b = np.int64((places[1, i] - low[1]) * per_m)
        c = np.int64((places[2, i] - low[2]) * per_m)
        name[i] = (a * shape[1] + b) * shape[2] + c


@kernel
@no_type_check
def _way_out(numbers, k, base_u, base_v, base_depth, end_u, end_v, end_depth, outer):
    """`hull.surface.way_out` for one way."""
    if not base_depth > 0.0:
        return 0.5 * outer
    u, v = base_u / base_depth, base_v / base_depth
    du, dv = end_u / end_depth - u, end_v / end_depth - v
    length = max(abs(du), abs(dv))
    n_halvings, span = 0, 1.0
    while span < length and n_halvings < _MOST_HALVINGS:
        span *= 2.0
        n_halvings += 1
    near, far = 0.0, 1.0
    near_value = max(_value(numbers, k, u, v), 0.5)
    far_value = min(_value(numbers, k, u + du, v + dv), _BELOW_HALF)
    moved = False
    for step in range(n_halvings + _N_FALSE_POSITIONS):
        if step < n_halvings:
            place = 0.5 * (near + far)
        else:
            place = near + (far - near) * ((near_value - 0.5) / max(near_value - far_value, 1e-9))
        value = _value(numbers, k, u + du * place, v + dv * place)
        outside = value < 0.5
        if step > n_halvings and outside == moved:
            if outside:
                near_value = 0.25 + 0.5 * near_value
            else:
                far_value = 0.25 + 0.5 * far_value
        moved = outside
        if outside:
            far, far_value = place, value
        else:
            near, near_value = place, value
    place = near + (far - near) * ((near_value - 0.5) / max(near_value - far_value, 1e-9))
    return outer * place * base_depth / (place * base_depth + (1.0 - place) * end_depth)


@kernel
@no_type_check
def exits(numbers, projections, origin, along, block, ends, who, exit_at, cut_by):
    """`hull.surface.exits` with one vote: `exit_at`, `cut_by` (N,). The tables that may
    refuse `block` (N,) b are `who` from `ends[b]` to `ends[b + 1]`."""
    for i in range(origin.shape[1]):
        x_0, y_0, z_0 = origin[0, i], origin[1, i], origin[2, i]
        dx, dy, dz = along[0, i], along[1, i], along[2, i]
        x, y, z = x_0 + dx, y_0 + dy, z_0 + dz
        share, last = 1.0, -1
        for j in range(ends[block[i]], ends[block[i] + 1]):
            k = who[j]
            if not _refuses(numbers, projections, k, x, y, z):
                continue
            base_u, base_v, base_depth = _projected(projections, k, x_0, y_0, z_0)
            way_u = (projections[k, 0, 0] * dx + projections[k, 0, 1] * dy) + projections[k, 0, 2] * dz
            way_v = (projections[k, 1, 0] * dx + projections[k, 1, 1] * dy) + projections[k, 1, 2] * dz
            way_depth = (projections[k, 2, 0] * dx + projections[k, 2, 1] * dy) + projections[k, 2, 2] * dz
            share = _way_out(
                numbers,
                k,
                base_u,
                base_v,
                base_depth,
                base_u + way_u * share,
                base_v + way_v * share,
                base_depth + way_depth * share,
                share,
            )
            last = k
            x, y, z = x_0 + dx * share, y_0 + dy * share, z_0 + dz * share
        exit_at[i], cut_by[i] = share, last


@kernel
@no_type_check
def refuser(numbers, projections, x, y, z, first, second, from_, to, who, votes):
    """The table that is the `votes`-th to see a place outside, or -1. `first`, `second`: tables (or -1) that
    are asked before `who` from `from_` to `to`, where one vote is enough."""
    if votes == 1:
        if first >= 0 and _refuses(numbers, projections, first, x, y, z):
            return first
        if second >= 0 and second != first and _refuses(numbers, projections, second, x, y, z):
            return second
    left = votes
    for j in range(from_, to):
        if _refuses(numbers, projections, who[j], x, y, z):
            left -= 1
            if left == 0:
                return who[j]
    return -1


@kernel
@no_type_check
def edge_kinds(
    numbers, projections, middle, way, up_m, down_m, far_m, first, second, block, ends, who, votes, high, kind
):
    """`hull.ridges.edge_kinds`: `kind` (N, all 0). `high`: whether those are looked for."""
    for i in range(len(kind)):
        a, b, from_, to = np.int64(first[i]), np.int64(second[i]), ends[block[i]], ends[block[i] + 1]
        x_0, y_0, z_0 = middle[0, i], middle[1, i], middle[2, i]
        dx, dy, dz = way[0, i], way[1, i], way[2, i]
        up, down = up_m[i], down_m[i]
        x, y, z = x_0 + up * dx, y_0 + up * dy, z_0 + up * dz
        by = refuser(numbers, projections, x, y, z, a, b, from_, to, who, votes)
        if by < 0:
            kind[i] = DEEP
            continue
        if not high:
            continue
        x, y, z = x_0 - down * dx, y_0 - down * dy, z_0 - down * dz
        if votes > 1:
            above = refuser(numbers, projections, x, y, z, a, b, from_, to, who, votes) >= 0
        else:
            above = (
                _refuses(numbers, projections, by, x, y, z)
                or (a >= 0 and a != by and _refuses(numbers, projections, a, x, y, z))
                or (b >= 0 and b != by and _refuses(numbers, projections, b, x, y, z))
            )
        if above:
            x, y, z = x_0 - far_m * dx, y_0 - far_m * dy, z_0 - far_m * dz
            if refuser(numbers, projections, x, y, z, a, b, from_, to, who, votes) < 0:
                kind[i] = HIGH


@kernel
@no_type_check
def witnesses(numbers, projections, places, block, answers, votes, sets, alive):
    """For `hull.thin_parts`: `alive` (N, all true) gets false where at least `votes` tables see a place
    outside; `sets` (W N, empty) the tables that see one inside, where alive. answers (C B): what every table
    says of every block."""
    for i in range(len(alive)):
        x, y, z = places[0, i], places[1, i], places[2, i]
        left = votes
        for k in range(len(numbers)):
            answer = answers[k, block[i]]
            if answer == NO_EVIDENCE:
                continue
            if answer != INSIDE and answer != OUTSIDE:
                answer, value = _ask_point(numbers, projections, k, x, y, z)
                if answer == UNDECIDED:
                    answer = INSIDE if value >= 0.5 else OUTSIDE
            if answer == INSIDE:
                sets[k >> 6, i] |= np.uint64(1) << np.uint64(k & 63)
            elif answer == OUTSIDE:
                left -= 1
                if left == 0:
                    alive[i] = False
                    break


@kernel
@no_type_check
def outlines(
    numbers, projections, places, block, n_seen, ends, who, first, n_witnesses, n_bounding, point, table
):
    """`hull.slack.outlines_at`, from place `first` on as far as `point` and `table` have room: `n_witnesses`
    and `n_bounding` (N,), and the pairs of places and tables that bound them. How many pairs there are, and
    the place to go on at. Of each block: `n_seen` (B,) tables that give evidence on all of it without an
    outline; `ends` (B + 1) and `who`: those to be asked, as in `exits`."""
    n, n_tables = places.shape[1], len(numbers)
    n_found = 0
    for i in range(first, n):
        if n_found + n_tables > len(point):
            return n_found, i
        seen, bounding = n_seen[block[i]], 0
        x, y, z = places[0, i], places[1, i], places[2, i]
        for j in range(ends[block[i]], ends[block[i] + 1]):
            k = who[j]
            answer, _ = _ask_point(numbers, projections, k, x, y, z)
            if answer != NO_EVIDENCE:
                seen += 1
            if answer == UNDECIDED:
                point[n_found], table[n_found] = i, k
                bounding += 1
                n_found += 1
        n_witnesses[i], n_bounding[i] = seen, bounding
    return n_found, n
