"""How far places lie from a dressed person: the truth that a visual hull is measured against.

Body and clothes are a solid together only: a garment is an outer sheet with rims that end under the skin. So
a place is inside if the closed body holds it, or if a way out that misses the body leaves more sheets than it
enters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hull.rays import as_tensor

from .scene import Surface

_N_WAYS = 24


class DressedTruth:
    """A dressed person (`Subject.dressed`: the closed body, then what it wears), asked for distances."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        body, worn = surfaces[0], surfaces[1:]
        # Rays are single precision, so everything is told relative to the person's own middle.
        self._middle = body.vertices.mean(axis=0)
        self._body = self._scene([body])
        self._worn = self._scene(worn) if worn else None
        self._all = self._scene(surfaces)
        self._normals_of_worn = [_face_normals(surface) for surface in worn]

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(N,) metres to the nearest surface, negative inside the person. Inside, a layer that is covered by
        another one may be the nearest, so depths there are too small.
        """
        query = (points - self._middle).astype(np.float32)
        nearest = self._all.compute_closest_points(as_tensor(query))
        offset = query - nearest["points"].numpy()
        distance = np.linalg.norm(offset, axis=1).astype(np.float64)
        inside = self._body.compute_occupancy(as_tensor(query), nsamples=3).numpy() > 0.5
        # Before the front of the nearest sheet is outside; behind it, a way out has to be looked for.
        behind = (offset * nearest["primitive_normals"].numpy()).sum(axis=1) < 0
        asked = np.flatnonzero(behind & ~inside)
        if len(asked) and self._worn is not None:
            inside[asked] = self._under_cloth(query[asked])
        return np.where(inside, -distance, distance)

    def _under_cloth(self, query: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """(N,) for places outside the body: most ways out that miss it leave a garment once more than they
        enter one.
        """
        assert self._worn is not None
        ways = _even_directions(_N_WAYS)
        rays = np.empty((len(query), _N_WAYS, 6), dtype=np.float32)
        rays[..., :3] = query[:, None]
        rays[..., 3:] = ways
        free = ~self._body.test_occlusions(as_tensor(rays)).numpy()
        of_point, of_way = np.nonzero(free)
        if not len(of_point):
            return np.ones(len(query), dtype=bool)
        hits = self._worn.list_intersections(as_tensor(rays[of_point, of_way]))
        ray, sheet, triangle = (
            hits[name].numpy().astype(np.int64) for name in ("ray_ids", "geometry_ids", "primitive_ids")
        )
        leaves = np.empty(len(ray))
        for k, normals in enumerate(self._normals_of_worn):
            of_sheet = sheet == k
            out = (normals[triangle[of_sheet]] * ways[of_way[ray[of_sheet]]]).sum(axis=1)
            leaves[of_sheet] = np.sign(out)
        net = np.bincount(ray, leaves, minlength=len(of_point))
        under = np.bincount(of_point, net > 0.5, minlength=len(query))
        free_ways = np.bincount(of_point, minlength=len(query))
        # A place from which every way meets the body is a deep fold: the nearest sheet's word stands.
        return np.where(free_ways > 0, under > 0.5 * free_ways, True)

    def _scene(self, surfaces: Sequence[Surface]) -> Any:  # open3d ships no types
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        for surface in surfaces:
            scene.add_triangles(
                as_tensor((surface.vertices - self._middle).astype(np.float32)),
                as_tensor(np.ascontiguousarray(surface.faces, dtype=np.uint32)),
            )
        return scene


def _face_normals(surface: Surface) -> Float[np.ndarray, "f 3"]:
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _even_directions(n: int) -> Float[np.ndarray, "n 3"]:
    """Unit vectors (N 3) spread evenly over the sphere (a golden-angle spiral)."""
    height = (2 * np.arange(n) + 1) / n - 1
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    flat = np.sqrt(1 - height**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
