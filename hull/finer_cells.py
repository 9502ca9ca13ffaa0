"""Marching cubes with some cells halved: parts thinner than the grid appear, and the surface stays closed.

A finger that passes between the grid's points is not there at all; halving every cell would cost four times
as much. Here chosen cells are marched at half their side. Where a halved cell meets one that is not, both
must draw the same lines on their common face: the halved side's points there take values that make its lines
join the same edges, and the triangles of the other side are split along them. (Octrees without cracks, by one
line per face: Kazhdan, Klein, Dalal and Hoppe 2007.)
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Int

from hull.marching import GridSurface, _cases

Inside = Callable[[Int[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]

# The points of a halved cell: places 0, 1, 2 along each axis, the last axis fastest.
_PLACES = np.array([[x, y, z] for x in range(3) for y in range(3) for z in range(3)])
_STRIDE = np.array([9, 3, 1])
_HALVES = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_AXES = np.eye(3, dtype=np.int64)
# How often the halved cells are grown.
_MOST_GROWN = 6
# Places are named by one number; so many along each axis, and some below zero.
_SPAN, _BELOW = 1 << 19, 64


def with_finer_cells(
    surface: GridSurface,
    cells: Int[np.ndarray, "n 3"],
    inside: Inside,
    allowed: Int[np.ndarray, " a"] | None = None,
) -> tuple[GridSurface, Int[np.ndarray, "m 3"]] | None:
    """The surface with these cells halved, counted in half units: all its numbers are twice as large. And the
    cells (M 3) that were halved. None where `inside` contradicts the surface.

    surface : closed, marched in units of one; around `cells` of that size throughout.
    cells : (N 3) lowest points of the cells to be halved. Where something crosses their border that whole
        cells do not show, their neighbours are halved too.
    inside : of places (M 3) counted in halves, whether they are inside; must agree with the surface at whole
        ones.
    allowed : names (A,), rising, of the cells that may be; None: all.
    """
    names = np.unique(named(cells))
    point_names, value = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool)
    for grown in range(_MOST_GROWN + 1):
        if allowed is not None:
            names = names[_among(names, allowed)]
        cells = placed(names)
        wanted, which = np.unique(named((2 * cells[:, None] + _PLACES).reshape(-1, 3)), return_inverse=True)
        which = which.reshape(len(cells), 27)
        known = _among(wanted, point_names)
        found = np.zeros(len(wanted), dtype=bool)
        found[known] = value[np.searchsorted(point_names, wanted[known])]
        found[~known] = inside(placed(wanted[~known]))
        point_names, value = wanted, found
        calm = value.copy()
        more = _calm_the_border(calm, which, cells, names)
        more = np.setdiff1d(named(more), names)
        if allowed is not None:
            more = more[_among(more, allowed)]
        if grown == _MOST_GROWN or not len(more):
            break
        names = np.union1d(names, more)
    value = calm
    inner, outer, vertex_names, fine = _marched(value, which, cells)

    # Edges that halved and other cells share: the half that crosses takes over.
    near = np.ones(len(surface.inner), dtype=bool)
    for k, (first, last) in enumerate(zip(cells.min(axis=0), cells.max(axis=0), strict=True)):
        along = surface.inner[:, k]
        near &= (along >= first - 2) & (along <= last + 2)
    shared = np.flatnonzero(near)
    one, other = surface.inner.take(shared, axis=0), surface.outer.take(shared, axis=0)
    # Both ends doubled, the middle of an edge is their sum: halved cells know it.
    half = named(one + other)
    at = np.minimum(np.searchsorted(point_names, half), len(point_names) - 1)
    known = np.flatnonzero(point_names[at] == half)
    shared, at, one, other = shared[known], at[known], one[known], other[known]
    axis = np.argmax(one != other, axis=1)
    low = np.minimum(one, other)
    low_is_inside = (one == low).all(axis=1)
    crossing = 2 * low + _AXES[axis] * (value[at] == low_is_inside)[:, None]
    number = np.full(len(surface.inner), -1)
    wanted = 4 * named(crossing) + axis
    if not _among(wanted, vertex_names).all():
        return None
    number[shared] = np.searchsorted(vertex_names, wanted)

    # A face lies in the cell that holds the middle of its three edges.
    halved = number >= 0
    a, b, c = surface.faces.T
    within = np.flatnonzero(halved.take(a) & halved.take(b) & halved.take(c))
    middle = (surface.inner + surface.outer)[surface.faces[within]].sum(axis=1) // 6
    keep = np.ones(len(surface.faces), dtype=bool)
    keep[within[_among(named(middle), names)]] = False
    coarse = surface.faces[keep]
    used = np.zeros(len(number), dtype=bool)
    used[coarse] = True
    used[shared] = False
    own = np.flatnonzero(used)
    number[own] = len(inner) + np.arange(len(own))
    inner = np.concatenate([inner, 2 * surface.inner[own]])
    outer = np.concatenate([outer, 2 * surface.outer[own]])
    faces = _stitched(number[coarse], fine, inner + outer)
    return None if faces is None else (GridSurface(inner, outer, faces), cells)


def named(places: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    x, y, z = places.T.astype(np.int64) + _BELOW
    return (x * _SPAN + y) * _SPAN + z


def placed(names: Int[np.ndarray, " n"]) -> Int[np.ndarray, "n 3"]:
    return np.stack([names // _SPAN**2, names // _SPAN % _SPAN, names % _SPAN], axis=1) - _BELOW


def interior(cells: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, " m"]:
    """(M,) names, rising, of the halves of these cells that lie wholly among halves."""
    left = np.unique(named((2 * cells[:, None] + _HALVES).reshape(-1, 3)))
    for axis in range(3):
        places = placed(left)
        left = left[_among(named(places - _AXES[axis]), left) & _among(named(places + _AXES[axis]), left)]
    return left


def _among(names: Int[np.ndarray, " n"], known: Int[np.ndarray, " m"]) -> Bool[np.ndarray, " n"]:
    if not len(known):
        return np.zeros(len(names), dtype=bool)
    return known[np.minimum(np.searchsorted(known, names), len(known) - 1)] == names


def _calm_the_border(
    value: Bool[np.ndarray, " m"],
    which: Int[np.ndarray, "n 27"],
    cells: Int[np.ndarray, "n 3"],
    names: Int[np.ndarray, " n"],
) -> Int[np.ndarray, "k 3"]:
    """Faces towards cells that are not halved get one line for each line that whole cells draw: writes into
    `value`. (K 3) the cells beyond faces where that changed something."""
    before, beyond = value.copy(), []
    for axis in range(3):
        u, v = (_STRIDE[k] for k in range(3) if k != axis)
        # The corners in their order around the face, and what lies between each and the next.
        around = np.array([0, 2 * u, 2 * u + 2 * v, 2 * v])
        between = np.array([u, 2 * u + v, u + 2 * v, v])
        for side in (0, 1):
            neighbours = cells + (2 * side - 1) * _AXES[axis]
            border = ~_among(named(neighbours), names)
            face = which[border]
            first = 2 * side * _STRIDE[axis]
            corners = value[face[:, first + around]]
            for k in range(4):
                one, other, half = corners[:, k], corners[:, (k + 1) % 4], face[:, first + between[k]]
                value[half[one & other]] = True
                value[half[~one & ~other]] = False
            count, middle = corners.sum(axis=1), face[:, first + u + v]
            across = (count == 2) & (corners[:, 0] == corners[:, 2])
            value[middle[(count >= 3) | across]] = True
            value[middle[count <= 1]] = False
            points = face[:, first + np.concatenate([around, between, [u + v]])]
            beyond.append(neighbours[border][(value[points] != before[points]).any(axis=1)])
    return np.concatenate(beyond)


def _marched(
    value: Bool[np.ndarray, " m"], which: Int[np.ndarray, "n 27"], cells: Int[np.ndarray, "n 3"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """inner (V 3), outer (V 3), names (V,) rising, faces (F 3) of the halved cells' surface."""
    n_faces, case_edges = _cases()
    corner = (_HALVES[:, None] + _HALVES) @ _STRIDE
    case = (value[which[:, corner]] << np.arange(8)).sum(axis=2)
    cell, half = np.nonzero(n_faces[case])
    case = case[cell, half]
    nth = np.arange(case_edges.shape[1])
    row, column = np.nonzero(nth < n_faces[case][:, None])
    edges = case_edges[case[row], column].astype(np.int64)
    axis = edges >> 3
    low = (2 * cells[cell] + _HALVES[half])[row][:, None] + _HALVES[edges & 7]
    local = (_HALVES[half][row][:, None] + _HALVES[edges & 7]) @ _STRIDE
    low_inside = value[which[cell[row][:, None], local]]
    names, first, faces = np.unique(
        4 * named(low.reshape(-1, 3)) + axis.ravel(), return_index=True, return_inverse=True
    )
    low, step = low.reshape(-1, 3)[first], _AXES[axis.ravel()[first]]
    inside = low_inside.ravel()[first][:, None]
    return low + step * ~inside, low + step * inside, names, faces.reshape(-1, 3)


def _stitched(
    coarse: Int[np.ndarray, "f 3"], fine: Int[np.ndarray, "g 3"], doubled: Int[np.ndarray, "v 3"]
) -> Int[np.ndarray, "h 3"] | None:
    """All faces, the coarse ones split along the fine ones' border; None where lines do not meet. `doubled`:
    twice the vertices' places.
    """
    n_fine = int(fine.max(initial=-1)) + 1
    a, b, c = (column < n_fine for column in coarse.T)
    near = np.flatnonzero((a & b) | (b & c) | (c & a))
    fine_edges, coarse_edges = _open_edges(fine), _open_edges(coarse[near])
    coarse_edges = coarse_edges[(coarse_edges < n_fine).all(axis=1)]
    way = {
        (key, start): end
        for key, (start, end) in zip(_faces_of(fine_edges, doubled), fine_edges.tolist(), strict=True)
    }
    open_ = {(start, end) for start, end in fine_edges.tolist()}
    chains: dict[tuple[int, int], list[int]] = {}
    for key, (start, end) in zip(_faces_of(coarse_edges, doubled), coarse_edges.tolist(), strict=True):
        if (end, start) in open_:
            continue
        chain, at = [], end
        while (at := way.get((key, at), start)) != start:
            chain.append(at)
        chains[start, end] = chain[::-1]
    split = np.zeros(len(coarse), dtype=bool)
    parts = []
    for idx in near.tolist():
        pieces = [coarse[idx].tolist()]
        for k in range(3):
            edge = (int(coarse[idx, k]), int(coarse[idx, (k + 1) % 3]))
            if edge in chains:
                pieces = _split_along(pieces, edge, chains[edge])
        if len(pieces) > 1:
            split[idx] = True
            parts += pieces
    extra = np.array(parts, dtype=fine.dtype).reshape(-1, 3)
    edges = _open_edges(np.concatenate([coarse[near[~split[near]]], extra, fine]))
    if (edges < n_fine).all(axis=1).any():
        return None
    return np.concatenate([coarse[~split], extra, fine])


def _split_along(pieces: list[list[int]], edge: tuple[int, int], chain: list[int]) -> list[list[int]]:
    result = []
    for piece in pieces:
        for k in range(3):
            a, b, c = piece[k], piece[(k + 1) % 3], piece[(k + 2) % 3]
            if (a, b) == edge:
                line = [a, *chain, b]
                result += [[one, two, c] for one, two in pairwise(line)]
                break
        else:
            result.append(piece)
    return result


def _open_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """(E 2) the directed edges whose opposite no face has."""
    edges = np.stack([faces.ravel(), faces[:, [1, 2, 0]].ravel()], axis=1)
    n = int(faces.max(initial=0)) + 1
    forth, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
    return edges[~_among(back, np.sort(forth))] if len(edges) else edges


def _faces_of(edges: Int[np.ndarray, "e 2"], doubled: Int[np.ndarray, "v 3"]) -> list[tuple[int, ...]]:
    """Which whole cell's face each edge runs on: its axis, and the middle's cell."""
    one, other = doubled[edges[:, 0]], doubled[edges[:, 1]]
    axis = np.argmax((one == other) & (one % 4 == 0), axis=1)
    cell = (one + other) // 8
    return [tuple(row) for row in np.column_stack([axis, cell]).tolist()]
