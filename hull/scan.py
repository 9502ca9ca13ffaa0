"""A scan: what the body is fitted to.

The paper fits to 3D scans whose points are labelled skin or cloth (section 4.1); a visual hull is a scan that
is all cloth. Points are spread evenly over the surface, so that energies summed over points are integrals
over area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from hull.slack import expected_excess
from hull.visual_hull import Hull

# Median slack (metres) up to which all places count alike, and from which they count by their slack.
_TIGHT_M, _LOOSE_M = 0.03, 0.08
_TRUST_LIMITS = (0.2, 1.5)


@dataclass(frozen=True, eq=False)
class Scan:
    """Points on the outside of a clothed person, world metres.

    Fields
    ------
    points : (N 3).
    normals : (N 3), unit, outward.
    faces : (F 3) point indices where the points are the vertices of a mesh, else None.
    is_skin : (N,) true where the point is bare skin, false where it is cloth (or hair, or a shoe).
    weight : (N,) how much the point counts; 1 is an ordinary one.
    colours : (N 3) RGB, or None where nobody took a picture.
    skin_share : (N,) g of the paper: 0 for cloth, near 1 deep inside a bare region; None: `is_skin` as it is.
    excess_m : (N,) how far the points may be expected to stand off what was seen (`hull.slack`); None: not.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "f 3"] | None
    is_skin: Bool[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    colours: UInt8[np.ndarray, "n 3"] | None = None
    skin_share: Float[np.ndarray, " n"] | None = None
    excess_m: Float[np.ndarray, " n"] | None = None

    @staticmethod
    def from_hull(
        hull: Hull, n_points: int | None, seed: int = 0, is_skin: Bool[np.ndarray, " v"] | None = None
    ) -> Scan:
        """A scan of `n_points` points, even in area; None: the hull's own vertices and faces. All cloth,
        unless
        `is_skin` labels the hull's vertices.

        The same hull, number and seed give the same points. Normals are the vertices', interpolated; weights
        are `trust`, one on average.
        """
        trusted, excess = trust(hull.slack_m), expected_excess(hull.slack_m)
        if n_points is None:
            n = len(hull.vertices)
            bare = np.zeros(n, dtype=bool) if is_skin is None else is_skin
            return Scan(hull.vertices, hull.normals, hull.faces, bare, trusted, hull.colours, excess_m=excess)
        face_idx, barycentric = even_samples(hull.vertices, hull.faces, n_points, seed)
        corners = hull.faces[face_idx]
        points = np.einsum("nk,nki->ni", barycentric, hull.vertices[corners])
        normals = np.einsum("nk,nki->ni", barycentric, hull.normals[corners])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        flat = _face_normals(hull.vertices, hull.faces)[face_idx]
        # On a fold thinner than the grid the vertices' normals may cancel; the face knows better there.
        normals = np.where(length > 0.1, normals / np.maximum(length, 1e-30), flat)
        weight = np.einsum("nk,nk->n", barycentric, trusted[corners])
        # Where all places count alike they do so exactly.
        weight = np.ones(n_points) if (trusted == 1.0).all() else weight / weight.mean()
        bare = np.zeros(n_points, dtype=bool)
        if is_skin is not None:
            bare = np.einsum("nk,nk->n", barycentric, is_skin[corners].astype(float)) > 0.5
        colours = None
        if hull.colours is not None:
            mixed = np.einsum("nk,nkc->nc", barycentric, hull.colours[corners].astype(float))
            colours = np.round(mixed).astype(np.uint8)
        stand_off = np.einsum("nk,nk->n", barycentric, excess[corners])
        return Scan(points, normals, None, bare, weight, colours, excess_m=stand_off)


def trust(slack_m: Float[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
    """(V,) weights that trust the tight places of a hull more than the loose ones, where few cameras saw it.

    The median slack over the slack, to a power that grows with the median: nought up to 3 cm, so that a hull
    from many cameras counts evenly (weights bring nothing there), one from 8 cm on. With four cameras it
    takes 28 % off the body's error in one of the people's recordings and 5 % in another.
    """
    middle = float(np.median(slack_m))
    power = float(np.clip((middle - _TIGHT_M) / (_LOOSE_M - _TIGHT_M), 0.0, 1.0))
    return np.clip(middle / np.maximum(slack_m, 1e-4), *_TRUST_LIMITS) ** power


def even_samples(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], n_points: int, seed: int
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Faces (N,) and barycentric coordinates (N 3) of points that are even in area.

    Stratified along the faces' running area: each n-th of the area gets one point, so that neighbouring faces
    (which marching cubes numbers one after another) share them out with less clumping than independent draws.
    """
    assert n_points > 0, "a scan without points"
    random = np.random.default_rng(seed)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    running = np.cumsum(area)
    place = (np.arange(n_points) + random.random(n_points)) / n_points * running[-1]
    face_idx = np.minimum(np.searchsorted(running, place, side="right"), len(faces) - 1)
    root = np.sqrt(random.random(n_points))
    other = random.random(n_points)
    barycentric = np.column_stack([1.0 - root, root * (1.0 - other), root * other])
    return face_idx, barycentric


def _face_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "f 3"]:
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
