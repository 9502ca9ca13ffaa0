"""A smoother surface inside the hull, with the same silhouettes.

The hull has ridges and flats where cameras happen to look from; people have not. The true surface touches
every ray of every outline somewhere along its viewing edge, and is smooth between: here vertices move inwards
along their normals so that the surface bends as little as it can (a thin plate), held by their slack: much
where it is tight, hardly where there is room. Then every outline ray that lost the surface calls back the
vertex of its viewing edge that is nearest to where it was, and the plate is bent again (visual shapes,
Franco, Lapierre and Boyer 2006; the silhouette force of Hernandez and Schmitt 2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, diags_array, eye_array, vstack
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from hull.culling import Culling
from hull.rays import RayScene
from hull.slack import outlines_at
from hull.tables import SilhouetteTable

# The plate is held by this at a slack of one centimetre, and by the square of the slack's inverse.
_HOLD, _HOLD_AT_M = 1e-3, 0.01
# A vertex that is called back is held at least by this, and each time so many times more, up to the last.
_CALLED_BACK, _CALLED_AGAIN, _HELD_FAST = 5.0, 30.0, 1e8
# Rounds of bending, then rounds in which what is still called goes back all the way.
_N_BENDINGS, _N_RETURNS = 6, 3
# Solved no better than this: it is bent again anyway, and far-off places need not hear of each other.
_N_STEPS, _TOLERANCE = 150, 1e-4
# Pixels around an outline ray in which vertices of its viewing edge are looked for, and how many of them.
_REACH_PX, _N_NEAR = 6.0, 8
# Nothing moves farther than its slack, nor than this share of the way to the other side.
_SHARE_OF_THICKNESS = 0.4
# Slack is not known better than this (metres).
_LEAST_SLACK_M = 0.002
_PERSON, _RIGHT, _BELOW, _UNKNOWN = 1, 2, 4, 16


@dataclass(frozen=True, eq=False)
class _Rim:
    """One camera's outline: rays (M 3, unit) just inside of it, from `centre`, and what bounds them.

    vertex_idx (R,), tree: the vertices that the outline passes through, by their pixel; pixels (M 2).
    """

    centre: Float[np.ndarray, " 3"]
    ways: Float[np.ndarray, "m 3"]
    pixels: Float[np.ndarray, "m 2"]
    vertex_idx: Int[np.ndarray, " r"]
    tree: cKDTree

    def lost(self, scene: RayScene) -> Bool[np.ndarray, " m"]:
        """Which rays do not meet the surface."""
        starts = np.broadcast_to(self.centre, self.ways.shape)
        return ~np.isfinite(scene.first_hits(starts, self.ways))

    def called(
        self, lost: Bool[np.ndarray, " m"], moved: Float[np.ndarray, " v"], all_of_them: bool
    ) -> Int[np.ndarray, " k"]:
        """The vertices (K,) that bring the lost rays back: of those near a ray the one that moved least."""
        distance, near = self.tree.query(self.pixels[lost], k=_N_NEAR, distance_upper_bound=_REACH_PX)
        found = np.isfinite(distance)
        vertex = self.vertex_idx[np.minimum(near, len(self.vertex_idx) - 1)]
        if all_of_them:
            return np.unique(vertex[found])
        best = np.where(found, moved[vertex], np.inf).argmin(axis=1)
        return np.unique(vertex[np.arange(len(vertex)), best][found.any(axis=1)])


def refined(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    slack_m: Float[np.ndarray, " v"],
    culling: Culling,
    scene: RayScene,
) -> Float[np.ndarray, "v 3"]:
    """(V 3) the vertices of a closed hull (metres) moved inwards. `culling`: of its tables, `scene`: this
    mesh.
    """
    bend = _bending(vertices, faces, normals)
    plate, push = (bend.T @ bend).tocsr(), bend.T @ _laplacian(faces, len(vertices)).dot(vertices).T.ravel()
    slack = np.maximum(slack_m, _LEAST_SLACK_M)
    hold = _HOLD * (_HOLD_AT_M / slack) ** 2
    thickness = scene.first_hits(vertices - 1e-3 * normals, -normals)
    farthest = np.minimum(slack, _SHARE_OF_THICKNESS * np.where(np.isfinite(thickness), thickness, 0.0))
    rims = _rims(vertices, culling)
    moved = np.zeros(len(vertices))
    for step in range(_N_BENDINGS + _N_RETURNS):
        bending = step < _N_BENDINGS
        if bending:
            moved, _ = cg(plate + diags_array(hold), push, x0=moved, maxiter=_N_STEPS, rtol=_TOLERANCE)
            moved = np.clip(moved, 0.0, farthest)
        now = RayScene(vertices - moved[:, None] * normals, faces, n_threads=1)
        last = step == _N_BENDINGS + _N_RETURNS - 1
        lost = [rim.lost(now) for rim in rims]
        called = [rim.called(gone, moved, last) for rim, gone in zip(rims, lost, strict=True) if gone.any()]
        if called:
            back = np.unique(np.concatenate(called))
            if bending:
                hold[back] = np.clip(_CALLED_AGAIN * hold[back], _CALLED_BACK, _HELD_FAST)
            else:
                moved[back] = 0.0
        elif not bending:
            break
    return vertices - moved[:, None] * normals


def _laplacian(faces: Int[np.ndarray, "f 3"], n_vertices: int) -> csr_array:
    """(V V): each vertex minus the mean of its neighbours."""
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    # A closed surface has every edge once in each direction.
    beside = csr_array((np.ones(len(start)), (start, end)), shape=(n_vertices, n_vertices))
    share = 1.0 / np.maximum(np.bincount(start, minlength=n_vertices), 1)
    return (eye_array(n_vertices) - diags_array(share) @ beside).tocsr()


def _bending(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], normals: Float[np.ndarray, "v 3"]
) -> csr_array:
    """(3V V): how the Laplacian of the places changes as vertices move along their normals."""
    laplacian = _laplacian(faces, len(vertices))
    return vstack([laplacian @ diags_array(normals[:, axis]) for axis in range(3)]).tocsr()


def _rims(vertices: Float[np.ndarray, "v 3"], culling: Culling) -> list[_Rim]:
    outlines = outlines_at(vertices, culling)
    rims = []
    for k, table in enumerate(culling.tables):
        vertex_idx = outlines.point_idx[outlines.table_idx == k]
        pixels = inner_outline(table)
        if len(vertex_idx) and len(pixels):
            rims.append(_rim(table, pixels, vertex_idx, vertices[vertex_idx]))
    return rims


def _rim(
    table: SilhouetteTable,
    pixels: Float[np.ndarray, "m 2"],
    vertex_idx: Int[np.ndarray, " r"],
    places: Float[np.ndarray, "r 3"],
) -> _Rim:
    ways = np.linalg.solve(table.projection[:, :3], np.column_stack([pixels, np.ones(len(pixels))]).T).T
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    u, v, depth = table.projection[:, :3] @ places.T + table.projection[:, 3:]
    return _Rim(table.centre, ways, pixels, vertex_idx, cKDTree(np.column_stack([u, v]) / depth[:, None]))


def inner_outline(table: SilhouetteTable) -> Float[np.ndarray, "m 2"]:
    """(M 2) the person's pixels (column, row) with background right beside, above or below."""
    codes = table.codes
    here, left, above = codes[1:, 1:], codes[1:, :-1], codes[:-1, 1:]
    alone = (here & _RIGHT == 0) | (here & _BELOW == 0) | (left & _PERSON == 0) | (above & _PERSON == 0)
    known = (here | left | above) < _UNKNOWN
    row, column = np.nonzero((here & _PERSON != 0) & alone & known)
    return np.column_stack([column, row]) + 1.0 + np.array(table.origin)
