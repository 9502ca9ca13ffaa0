"""Closest points of a scan on a moving body mesh, with the side on which each point lies.

The paper's `dist(s, M)` (section 4.1): the closest primitive, triangle, edge or vertex. The search runs in
open3d's ray-casting scene (Embree, float32); the closest point on the found triangle is then computed again
in float64, so that residuals and their derivatives agree to full precision.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from fit.surface import vertex_normals

#: Below this distance the direction (s - c) / d is noise; the interpolated surface normal is used instead.
CONTACT_M = 1e-4


@dataclass(frozen=True)
class ClosestPoints:
    """Where each of N points meets a mesh.

    triangle_idx: the face; barycentric: weights of its three corners; points: the closest points, m;
    normals: unit surface normals there (interpolated vertex normals); distance: m, negative for a point
    inside the mesh; direction: unit vectors along which the distance is measured, pointing outwards.
    """

    triangle_idx: Int[np.ndarray, "n"]
    barycentric: Float[np.ndarray, "n 3"]
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    distance: Float[np.ndarray, "n"]
    direction: Float[np.ndarray, "n 3"]


def search_scene(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Any:
    """open3d's search structure over a mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, dtype=np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(faces, dtype=np.uint32)),
    )
    return scene


def nearest_triangles(scene: Any, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Index of the face nearest to each point."""
    import open3d as o3d

    found = scene.compute_closest_points(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
    )
    return found["primitive_ids"].numpy().astype(np.int64)


def barycentric_of_closest(
    corners: Float[np.ndarray, "n 3 3"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Barycentric coordinates of the closest point of each triangle to its point.

    corners: (point, corner, axis). The point is projected on the plane; where that falls outside the
    triangle, the nearest of the three edges decides (clamped to its ends), which covers edges and vertices
    alike.
    """
    a = corners[:, 0]
    ab, ac, ap = corners[:, 1] - a, corners[:, 2] - a, points - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    det = np.maximum(d00 * d11 - d01 * d01, 1e-30)
    v = (d11 * d20 - d01 * d21) / det
    w = (d00 * d21 - d01 * d20) / det
    bary = np.stack([1.0 - v - w, v, w], axis=1)
    outside = np.flatnonzero((bary < 0).any(axis=1))
    if len(outside) == 0:
        return bary
    best = np.full(len(outside), np.inf)
    chosen = np.zeros((len(outside), 3))
    p = points[outside]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, edge = corners[outside, i], corners[outside, j] - corners[outside, i]
        s = ((p - start) * edge).sum(1) / np.maximum((edge * edge).sum(1), 1e-30)
        s = np.clip(s, 0.0, 1.0)
        squared = ((start + s[:, None] * edge - p) ** 2).sum(1)
        nearer = squared < best
        best = np.where(nearer, squared, best)
        candidate = np.zeros((len(outside), 3))
        candidate[:, i], candidate[:, j] = 1.0 - s, s
        chosen[nearer] = candidate[nearer]
    bary[outside] = chosen
    return bary


@dataclass(frozen=True)
class Container:
    """A mesh that stays as it is, ready for many searches: vertices (V 3) m, faces (F 3), unit normals (V
    3)."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    scene: Any

    @staticmethod
    def of(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Container:
        """Build the search structure."""
        return Container(vertices, faces, vertex_normals(vertices, faces), search_scene(vertices, faces))

    def closest(self, points: Float[np.ndarray, "n 3"]) -> ClosestPoints:
        """Closest point of the closed, outward oriented mesh for every point.

        The paper's indicator delta (inside or outside) comes from the angle between the surface normal and
        the vector from the mesh to the point; interpolated vertex normals make it reliable at edges and
        vertices.
        """
        triangle_idx = nearest_triangles(self.scene, points)
        triangles = self.faces[triangle_idx]
        corners = self.vertices[triangles]
        bary = barycentric_of_closest(corners, points)
        foot = np.einsum("nc,nca->na", bary, corners)
        normals = np.einsum("nc,nca->na", bary, self.normals[triangles])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        gap = points - foot
        distance = np.linalg.norm(gap, axis=1)
        along = (gap * normals).sum(1)
        sign = np.where(along < 0, -1.0, 1.0)
        contact = distance < CONTACT_M
        direction = np.where(
            contact[:, None], normals, sign[:, None] * gap / np.maximum(distance, 1e-30)[:, None]
        )
        # In contact the signed distance is the component along the normal.
        return ClosestPoints(
            triangle_idx, bary, foot, normals, np.where(contact, along, sign * distance), direction
        )


@dataclass(frozen=True)
class Depths:
    """How far vertices stand out of a container, step after step: only those are looked up that may.

    A distance changes no faster than its vertex moves, so one that was deep inside needs no search until it
    has come as far. distance (V): signed, m, positive outside; for a vertex that cannot be near, a bound from
    above. closest: where each vertex was looked up last, at looked_up (V 3).
    """

    container: Container
    looked_up: Float[np.ndarray, "v 3"]
    closest: ClosestPoints
    distance: Float[np.ndarray, "v"]

    @staticmethod
    def of(container: Container, vertices: Float[np.ndarray, "v 3"]) -> Depths:
        """Look up all."""
        closest = container.closest(vertices)
        return Depths(container, vertices, closest, closest.distance)

    def after(self, vertices: Float[np.ndarray, "v 3"], margin_m: float) -> Depths:
        """The depths of moved vertices, exact for all that are not deeper than the margin."""
        bound = self.closest.distance + np.linalg.norm(vertices - self.looked_up, axis=1)
        near = np.flatnonzero(bound > -margin_m)
        found = self.container.closest(vertices[near])
        merged = {}
        for field in fields(ClosestPoints):
            merged[field.name] = getattr(self.closest, field.name).copy()
            merged[field.name][near] = getattr(found, field.name)
        looked_up, distance = self.looked_up.copy(), bound
        looked_up[near], distance[near] = vertices[near], found.distance
        return Depths(self.container, looked_up, ClosestPoints(**merged), distance)


def closest_points(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], points: Float[np.ndarray, "n 3"]
) -> ClosestPoints:
    """Closest point of a mesh that is searched once, as `Container.closest`."""
    return Container.of(vertices, faces).closest(points)
