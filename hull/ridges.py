"""Give back the ridges that flat triangles cut off, and the valleys that they bridge.

A visual hull is a stack of cones that meet in sharp ridges, and each camera's outline runs along the narrow
strip that its own cone keeps between two of them. Marching cubes spans ridges and the tips of thin parts with
flat triangles, a little inside the hull, so every outline shrinks; valleys they bridge. Here the edges whose
middle lies too deep, or too high, are split there, and the new vertex is moved along the normal to where the
hull ends. Neighbours split their common edge alike, so the surface stays closed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from hull.culling import Culling
from hull.loops import mesh_loops
from hull.surface import AT_ONCE, Crossings, by_table, exits
from hull.tables import OUTSIDE, SilhouetteTable

# Edges whose middle is deeper than this are split, in cells (marching cubes' own) and in pixels, whichever is
# less; nothing is moved further than so many of the largest cells.
_DEEP_CELLS, _DEEP_PX = 0.08, 0.23
_FARTHEST = 0.5
# An edge less high over a valley than so many pixels crosses a step of the pictures.
_HIGH_PX = 0.23
# What an edge may be; as in `hull.compiled`.
DEEP, HIGH = 1, 2
# The normals at an edge's ends must add up to more than this.
_LEAST_LENGTH = 0.5


def raise_ridges(
    crossings: Crossings,
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    tables: Sequence[SilhouetteTable],
    cell_m: Float[np.ndarray, " v"],
    culling: Culling | None = None,
    votes: int = 1,
    valleys: bool = True,
) -> tuple[Crossings, Int[np.ndarray, "f2 3"]]:
    """Vertices (the given ones first) and faces with the deep and the high edges split.

    normals : outward, unit.
    cell_m : side of the cells that each vertex comes from, metres.
    valleys : whether high edges are looked for.
    """
    vertices, cut_by = crossings.vertices, crossings.cut_by
    subject = vertices.mean(axis=0)
    pixel_m = np.median([pixel_at(table, subject) for table in tables])
    far_m = _FARTHEST * float(cell_m.max(initial=0.0))
    middles = edge_middles_plainly if mesh_loops() is None else _edge_middles_compiled
    parts = []
    for first in range(0, max(len(faces), 1), AT_ONCE):
        some = faces[first : first + AT_ONCE]
        *ends_idx, middle, outward = middles(vertices, normals, some, _LEAST_LENGTH)
        cell = np.minimum(cell_m.take(ends_idx[0]), cell_m.take(ends_idx[1]))
        up_m = np.minimum(_DEEP_CELLS * cell, _DEEP_PX * pixel_m)
        down_m = np.clip(_HIGH_PX * pixel_m, up_m, far_m)
        ends_cut_by = cut_by.take(ends_idx[0]), cut_by.take(ends_idx[1])
        depths_m = (up_m, down_m, far_m)
        kind = edge_kinds(tables, middle, outward, *depths_m, *ends_cut_by, culling, votes, valleys)
        split = np.flatnonzero(kind)
        far = far_m * outward.take(split, axis=1)
        # Out of valleys the way begins below and ends in the middle, which lies outside.
        origin = middle.take(split, axis=1) - np.where(kind[split] == HIGH, far, 0.0)
        parts.append([ends_idx[0].take(split), ends_idx[1].take(split), origin, far])
    a, b, origin, way = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    exit_at, new_cut_by = exits(tables, origin, way, culling, votes)
    ends = new_cut_by >= 0
    a, b = a[ends], b[ends]
    new = (origin + way * exit_at)[:, ends].T
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    # Both faces at an edge look its new vertex up by the edge's name.
    order = np.argsort(a * len(vertices) + b)
    names = (a * len(vertices) + b)[order]
    touched = np.zeros(len(vertices), dtype=bool)
    touched[a] = touched[b] = True
    sought = np.flatnonzero(touched[start] & touched[end])
    wanted = np.minimum(start[sought], end[sought]) * len(vertices) + np.maximum(start[sought], end[sought])
    place = np.minimum(np.searchsorted(names, wanted), max(len(names) - 1, 0))
    found = names[place] == wanted if len(names) else np.zeros(0, dtype=bool)
    split_by = np.full(len(start), -1)
    split_by[sought[found]] = len(vertices) + order[place[found]]
    return (
        Crossings(np.concatenate([vertices, new]), np.concatenate([cut_by, new_cut_by[ends]])),
        split_faces(faces, split_by.reshape(3, -1).T),
    )


def _edge_middles_compiled(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    least_length: float,
) -> tuple[np.ndarray, ...]:
    loops, room = mesh_loops(), 3 * len(faces)
    assert loops is not None
    edges = [np.empty(room, dtype=np.int64) for _ in range(2)] + [np.empty((3, room)) for _ in range(2)]
    n = loops.edge_middles(vertices, normals, faces, least_length, *edges)
    return tuple(np.ascontiguousarray(each[..., :n]) for each in edges)


def edge_middles_plainly(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    least_length: float,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, "3 n"], Float[np.ndarray, "3 n"]]:
    """The ends a < b of each edge where the surface does not fold back (the sum of their normals is so long);
    its middle, and the unit way outward."""
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    # On a closed surface every edge runs once in each direction: the rising ones name each edge once.
    a, b = start[start < end], end[start < end]
    columns, outward = np.ascontiguousarray(vertices.T), np.ascontiguousarray(normals.T)
    way = outward.take(a, axis=1) + outward.take(b, axis=1)
    length = np.sqrt((way**2).sum(axis=0))
    flat = np.flatnonzero(length > least_length)
    a, b = a.take(flat), b.take(flat)
    way = way.take(flat, axis=1) * (1.0 / np.maximum(length.take(flat), 1e-30))
    middle = 0.5 * (columns.take(a, axis=1) + columns.take(b, axis=1))
    return a, b, middle, way


def edge_kinds(
    tables: Sequence[SilhouetteTable],
    middle: Float[np.ndarray, "3 n"],
    outward: Float[np.ndarray, "3 n"],
    up_m: Float[np.ndarray, " n"],
    down_m: Float[np.ndarray, " n"],
    far_m: float,
    cut_by_1: Int[np.ndarray, " n"],
    cut_by_2: Int[np.ndarray, " n"],
    culling: Culling | None,
    votes: int,
    valleys: bool,
) -> UInt8[np.ndarray, " n"]:
    """(N,) DEEP: the edge's middle stays inside the hull when it goes up; HIGH (`valleys`): it stays outside
    when it goes down, and is inside when it goes down far; else 0.

    The cameras that cut an edge's ends refuse almost all of its middle, so with one vote they are asked
    first; and only they, or who refuses it higher up, may refuse it further down.
    """
    # All these places are so near to the middle that the answers about its block hold.
    blocks = None if culling is None else culling.blocks_of(middle)
    kind = np.zeros(middle.shape[1], dtype=np.uint8)
    if culling is not None and culling.stack is not None:
        stack = culling.stack
        stack.loops.edge_kinds(
            stack.numbers,
            stack.projections,
            middle,
            outward,
            up_m,
            down_m,
            far_m,
            cut_by_1,
            cut_by_2,
            blocks,
            *culling.refusing,
            votes,
            valleys,
            kind,
        )
        return kind
    first = np.stack([cut_by_1, cut_by_2]) if votes == 1 else np.zeros((0, len(kind)), dtype=np.int16)
    by = _refused_by(tables, middle + up_m * outward, first, culling, blocks, votes)
    kind[by < 0] = DEEP
    open_ = np.flatnonzero(by >= 0) if valleys else np.zeros(0, dtype=np.intp)
    inner = (middle - down_m * outward).take(open_, axis=1)
    where = None if blocks is None else blocks.take(open_)
    if votes == 1:
        above = np.zeros(len(open_), dtype=bool)
        for each in (*first, by):
            for table_idx, some in by_table(each.take(open_), len(tables)):
                above[some] |= tables[table_idx].ask_points(inner.take(some, axis=1)) == OUTSIDE
    else:
        above = _refused_by(tables, inner, first.take(open_, axis=1), culling, where, votes) >= 0
    open_ = open_[above]
    where = None if blocks is None else blocks.take(open_)
    below = (middle - far_m * outward).take(open_, axis=1)
    kind[open_[_refused_by(tables, below, first.take(open_, axis=1), culling, where, votes) < 0]] = HIGH
    return kind


def _refused_by(
    tables: Sequence[SilhouetteTable],
    places: Float[np.ndarray, "3 n"],
    first: Int[np.ndarray, "k n"],
    culling: Culling | None,
    blocks: Int[np.ndarray, " n"] | None,
    votes: int,
) -> Int[np.ndarray, " n"]:
    """(N,) the table that is the `votes`-th to see a place (3 N) outside; -1: fewer do. `first`: tables (or
    -1) that are asked before the others; one vote must be enough then."""
    refused_by = np.full(places.shape[1], -1, dtype=np.int16)
    for each in first:
        open_ = np.flatnonzero(refused_by < 0)
        for table_idx, asked in by_table(each.take(open_), len(tables)):
            some = open_.take(asked)
            refused_by[some[tables[table_idx].ask_points(places.take(some, axis=1)) == OUTSIDE]] = table_idx
    votes_left = np.where(refused_by < 0, votes, 0)
    for table_idx, table in enumerate(tables):
        if culling is None or blocks is None:
            asked = np.flatnonzero(votes_left)
        else:
            asked = culling.may_refuse(table_idx, blocks)
            asked = asked[votes_left[asked] > 0]
        refused = asked[table.ask_points(places.take(asked, axis=1)) == OUTSIDE]
        votes_left[refused] -= 1
        refused_by[refused[votes_left[refused] == 0]] = table_idx
    return refused_by


def pixel_at(table: SilhouetteTable, point: Float[np.ndarray, " 3"]) -> float:
    """About what a pixel covers at a point (3,), metres."""
    turned = table.projection[:, :3]
    # The rows of P minus the picture's middle times its third row; only a scale is wanted, so the area will
    # do.
    focal_px = np.sqrt(abs(np.linalg.det(turned)) / max(float(np.linalg.norm(turned[2])) ** 3, 1e-12))
    depth = table.projection[2, :3] @ point + table.projection[2, 3]
    return float(max(depth, 1e-6) / focal_px)


def split_faces(faces: Int[np.ndarray, "f 3"], middle: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f2 3"]:
    """Faces with some edges split. middle[f, k]: the vertex that splits edge (k, k + 1) of face f, or -1."""
    n_split = (middle >= 0).sum(axis=1)
    parts = [faces[n_split == 0]]
    for count in (1, 2, 3):
        chosen = np.flatnonzero(n_split == count)
        if not len(chosen):
            continue
        # Turn each face so that its split edges come first.
        flags = middle[chosen] >= 0
        turn = np.argmax(flags, axis=1) if count == 1 else (np.argmin(flags, axis=1) + 1) % 3
        order = (turn[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[chosen], order, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[chosen], order, axis=1).T
        if count == 1:
            pieces = [(a, ab, c), (ab, b, c)]
        elif count == 2:
            pieces = [(ab, b, bc), (a, ab, bc), (a, bc, c)]
        else:
            pieces = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        parts += [np.column_stack(piece) for piece in pieces]
    return np.concatenate(parts)
