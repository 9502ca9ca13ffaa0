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
from hull.surface import AT_ONCE, Crossings, by_table, exits
from hull.tables import OUTSIDE, SilhouetteTable

# In voxels: edges whose middle is deeper than the first are split; nothing is moved further than the second.
_DEPTH_SPLIT = 0.08
_FARTHEST = 0.5


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
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    # On a closed surface every edge runs once in each direction: the rising ones name each edge once.
    a, b = start[start < end], end[start < end]
    columns, outward = np.ascontiguousarray(vertices.T), np.ascontiguousarray(normals.T)
    way = outward.take(a, axis=1) + outward.take(b, axis=1)
    length = np.sqrt((way**2).sum(axis=0))
    way *= voxel_m / np.maximum(length, 1e-30)
    middle = 0.5 * (columns.take(a, axis=1) + columns.take(b, axis=1))
    places = middle + _DEPTH_SPLIT * way
    deep = np.flatnonzero(length > 0.5)
    ends_cut_by = cut_by.take(a), cut_by.take(b)
    deep = np.concatenate(
        [
            _still_inside(tables, places, deep[start : start + AT_ONCE], *ends_cut_by, culling, votes)
            for start in range(0, max(len(deep), 1), AT_ONCE)
        ]
    )
    middle, way = middle.take(deep, axis=1), _FARTHEST * way.take(deep, axis=1)
    exit_at, new_cut_by = exits(tables, middle, way, culling, votes)
    ends = new_cut_by >= 0
    deep = deep[ends]
    new = (middle + way * exit_at)[:, ends].T
    # Both faces at an edge look its new vertex up by the edge's name.
    order = np.argsort(a[deep] * len(vertices) + b[deep])
    names = (a[deep] * len(vertices) + b[deep])[order]
    touched = np.zeros(len(vertices), dtype=bool)
    touched[a[deep]] = touched[b[deep]] = True
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


def _still_inside(
    tables: Sequence[SilhouetteTable],
    places: Float[np.ndarray, "3 n"],
    chosen: Int[np.ndarray, " m"],
    cut_by_1: Int[np.ndarray, " n"],
    cut_by_2: Int[np.ndarray, " n"],
    culling: Culling | None,
    votes: int,
) -> Int[np.ndarray, " k"]:
    """Which (K,) of the places (3 N) chosen (M,) fewer than `votes` cameras see outside.

    The cameras that cut an edge's ends refuse almost all of its middle, so one alone is asked first.
    """
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
