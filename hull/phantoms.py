"""Which parts of a hull no silhouette needs.

A visual hull is the largest shape that fits the silhouettes, so where limbs hide what lies behind or between
them it holds parts with nothing in them. A ray on which a camera sees the person and which meets the hull in
one stretch only must hold something of the person just there: it is *safe* (Miller and Hilton 2006). A part
of the surface that no safe ray passes through could be taken away without a silhouette noticing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hull.rays import RayScene
from hull.tables import INSIDE, SilhouetteTable

# Only places with more room than this are asked: a part whose viewing edges are shorter is thinner than a
# wrist.
LEAST_SLACK_M = 0.04
# Smaller patches are not worth a word (square metres): a hand's palm has 80 cm^2.
LEAST_AREA_M2 = 0.002
# Rays pass this far inside of the surface (metres): along a flat part they would meet its every unevenness,
# so what is thick enough is asked again deeper.
_DEPTHS_M = (0.002, 0.015)
_LEAST_M = 0.0005


def find_phantoms(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    slack_m: Float[np.ndarray, " v"],
    scene: RayScene,
    tables: Sequence[SilhouetteTable],
) -> Bool[np.ndarray, " v"]:
    """(V,) true on connected patches of the surface that no safe ray passes through. `scene`: this mesh."""
    phantom = np.zeros(len(vertices), dtype=bool)
    unsafe = np.flatnonzero(slack_m > LEAST_SLACK_M)
    for depth_m in _DEPTHS_M:
        room = scene.first_hits(vertices[unsafe] - _LEAST_M * normals[unsafe], -normals[unsafe])
        deep = (room > 2 * depth_m) | (depth_m == _DEPTHS_M[0])
        asked = unsafe[deep]
        # Each camera spares the next ones the places that it finds safe.
        for table in tables:
            points = vertices[asked] - depth_m * normals[asked]
            seen = np.flatnonzero(table.ask_points(points.T) == INSIDE)
            starts = np.broadcast_to(table.centre, (len(seen), 3))
            once = scene.n_crossings(starts, points[seen] - table.centre) <= 2
            asked = np.delete(asked, seen[once])
        unsafe = np.concatenate([unsafe[~deep], asked])
    phantom[unsafe] = True
    return _large_patches(phantom, vertices, faces)


def _large_patches(
    chosen: Bool[np.ndarray, " v"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " v"]:
    """`chosen` (V,) without the patches whose area is too small."""
    within = faces[chosen[faces].all(axis=1)]
    if not len(within):
        return np.zeros_like(chosen)
    ends = np.concatenate([within[:, [0, 1]], within[:, [1, 2]]])
    n = len(vertices)
    graph = coo_array((np.ones(len(ends), dtype=bool), (ends[:, 0], ends[:, 1])), shape=(n, n))
    _, patch = connected_components(graph.tocsr(), directed=False)
    a, b, c = (vertices[within[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    large = np.bincount(patch[within[:, 0]], area, minlength=patch.max() + 1) >= LEAST_AREA_M2
    kept = np.zeros_like(chosen)
    kept[within.ravel()] = True
    return kept & large[patch]
