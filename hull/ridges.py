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

from hull.surface import exits
from hull.tables import OUTSIDE, SilhouetteTable

# In voxels: edges whose middle is deeper than the first are split; nothing is moved further than the second.
_DEPTH_SPLIT = 0.08
_FARTHEST = 0.5


def raise_ridges(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    tables: Sequence[SilhouetteTable],
    voxel_m: float,
) -> tuple[Float[np.ndarray, "v2 3"], Int[np.ndarray, "f2 3"]]:
    """Vertices (the given ones first) and faces with the deep edges split. `normals`: outward, unit."""
    start, end = faces.T, faces[:, [1, 2, 0]].T
    # On a closed surface every edge runs once in each direction: the rising ones name each edge once.
    forth = (start < end).ravel()
    names = np.minimum(start, end).ravel() * len(vertices) + np.maximum(start, end).ravel()
    edges = np.sort(names[forth])
    a, b = edges // len(vertices), edges % len(vertices)
    way = normals.T[:, a] + normals.T[:, b]
    length = np.sqrt((way**2).sum(axis=0))
    deep = np.flatnonzero(length > 0.5)
    middle = 0.5 * (vertices.T[:, a[deep]] + vertices.T[:, b[deep]])
    way = way[:, deep] / length[deep] * voxel_m
    for table in tables:
        still = table.ask_points(middle + _DEPTH_SPLIT * way) != OUTSIDE
        deep, middle, way = deep[still], middle[:, still], way[:, still]
    exit_at, cut = exits(tables, middle, _FARTHEST * way)
    deep = deep[cut]
    new = (middle + _FARTHEST * way * exit_at)[:, cut].T
    number = np.full(len(edges), -1)
    number[deep] = len(vertices) + np.arange(len(deep))
    split = number[np.searchsorted(edges, names)].reshape(3, -1).T
    return np.concatenate([vertices, new]), split_faces(faces, split)


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
