"""Give back the ridges that flat triangles cut off.

A visual hull is a stack of cones that meet in sharp ridges, and each camera's outline runs along the narrow
strip that its own cone keeps between two of them. Marching cubes spans ridges and the tips of thin parts with
flat triangles, a little inside the hull, so every outline shrinks. Here the edges whose middle lies too deep
are split there, and the new vertex is moved out along the normal to where the hull ends. Neighbours split
their common edge alike, so the surface stays closed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from hull.culling import Culling
from hull.loops import mesh_loops
from hull.surface import AT_ONCE, Crossings, by_table, exits
from hull.tables import OUTSIDE, SilhouetteTable

# In voxels: edges whose middle is deeper than the first are split; nothing is moved further than the second.
_DEPTH_SPLIT = 0.08
_FARTHEST = 0.5
# The normals at an edge's ends must add up to more than this.
_LEAST_LENGTH = 0.5


def raise_ridges(
    crossings: Crossings,
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    tables: Sequence[SilhouetteTable],
    voxel_m: float,
    culling: Culling | None = None,
    votes: int = 1,
) -> tuple[Crossings, Int[np.ndarray, "f2 3"]]:
    """Vertices (the given ones first) and faces with the deep edges split. `normals`: outward, unit."""
    vertices, cut_by = crossings.vertices, crossings.cut_by
    loops = mesh_loops()
    middles = edge_middles_plainly if loops is None else _edge_middles_compiled
    parts = []
    for first in range(0, max(len(faces), 1), AT_ONCE):
        some = faces[first : first + AT_ONCE]
        *edges, places = middles(vertices, normals, some, voxel_m, _DEPTH_SPLIT, _LEAST_LENGTH)
        ends_cut_by = cut_by.take(edges[0]), cut_by.take(edges[1])
        deep = _still_inside(tables, places, *ends_cut_by, culling, votes)
        parts.append([each.take(deep, axis=-1) for each in edges])
    a, b, middle, way = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    way *= _FARTHEST
    exit_at, new_cut_by = exits(tables, middle, way, culling, votes)
    ends = new_cut_by >= 0
    a, b = a[ends], b[ends]
    new = (middle + way * exit_at)[:, ends].T
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
    split = np.full(len(start), -1)
    split[sought[found]] = len(vertices) + order[place[found]]
    return (
        Crossings(np.concatenate([vertices, new]), np.concatenate([cut_by, new_cut_by[ends]])),
        split_faces(faces, split.reshape(3, -1).T),
    )


def _edge_middles_compiled(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    *numbers: float,
) -> tuple[np.ndarray, ...]:
    loops, room = mesh_loops(), 3 * len(faces)
    assert loops is not None
    edges = [np.empty(room, dtype=np.int64) for _ in range(2)] + [np.empty((3, room)) for _ in range(3)]
    n = loops.edge_middles(vertices, normals, faces, *numbers, *edges)
    return tuple(np.ascontiguousarray(each[..., :n]) for each in edges)


def edge_middles_plainly(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    voxel_m: float,
    depth: float,
    least_length: float,
) -> tuple[
    Int[np.ndarray, " n"],
    Int[np.ndarray, " n"],
    Float[np.ndarray, "3 n"],
    Float[np.ndarray, "3 n"],
    Float[np.ndarray, "3 n"],
]:
    """The ends a < b of each edge where the surface does not fold back (the sum of their normals is so long);
    its middle, the way outward (a voxel long), and the place that far outside (`depth`, in voxels)."""
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    # On a closed surface every edge runs once in each direction: the rising ones name each edge once.
    a, b = start[start < end], end[start < end]
    columns, outward = np.ascontiguousarray(vertices.T), np.ascontiguousarray(normals.T)
    way = outward.take(a, axis=1) + outward.take(b, axis=1)
    length = np.sqrt((way**2).sum(axis=0))
    flat = np.flatnonzero(length > least_length)
    a, b = a.take(flat), b.take(flat)
    way = way.take(flat, axis=1) * (voxel_m / np.maximum(length.take(flat), 1e-30))
    middle = 0.5 * (columns.take(a, axis=1) + columns.take(b, axis=1))
    return a, b, middle, way, middle + depth * way


def _still_inside(
    tables: Sequence[SilhouetteTable],
    places: Float[np.ndarray, "3 n"],
    cut_by_1: Int[np.ndarray, " n"],
    cut_by_2: Int[np.ndarray, " n"],
    culling: Culling | None,
    votes: int,
) -> Int[np.ndarray, " k"]:
    """Which (K,) of the places (3 N) fewer than `votes` cameras see outside.

    The cameras that cut an edge's ends refuse almost all of its middle, so one alone is asked first.
    """
    if culling is not None and culling.stack is not None:
        stack, named = culling.stack, culling.blocks_of(places)
        refused = np.zeros(len(named), dtype=bool)
        stack.loops.refused(
            stack.numbers,
            stack.projections,
            places,
            cut_by_1,
            cut_by_2,
            named,
            *culling.refusing,
            votes,
            refused,
        )
        return np.flatnonzero(~refused)
    chosen = np.arange(places.shape[1])
    for cut_by in (cut_by_1, cut_by_2) if votes == 1 else ():
        still = np.ones(len(chosen), dtype=bool)
        for table_idx, asked in by_table(cut_by.take(chosen), len(tables)):
            answers = tables[table_idx].ask_points(places.take(chosen.take(asked), axis=1))
            still[asked] = answers != OUTSIDE
        chosen = chosen.take(np.flatnonzero(still))
    places = places.take(chosen, axis=1)
    blocks = None if culling is None else culling.blocks_of(places)
    votes_left = np.full(len(chosen), votes)
    for table_idx, table in enumerate(tables):
        if culling is None or blocks is None:
            asked = np.flatnonzero(votes_left)
        else:
            asked = culling.may_refuse(table_idx, blocks)
            asked = asked[votes_left[asked] > 0]
        votes_left[asked[table.ask_points(places.take(asked, axis=1)) == OUTSIDE]] -= 1
    return chosen[votes_left > 0]


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
