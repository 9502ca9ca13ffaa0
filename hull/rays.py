"""Rays against a closed surface: which pixels show it, what hides behind it, what lies inside it.

One ray through the centre of every pixel gives the exact projection; filling projected polygons would widen
it by up to a pixel. Rays are single precision, so everything is told relative to the surface's own middle.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Integer

from capture.camera import Camera


class RayScene:
    """A surface (vertices (V 3) metres, faces (F 3)) to cast rays at. `n_threads` 0: one a core."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "v 3"],
        faces: Integer[np.ndarray, "f 3"],
        n_threads: int = 0,
    ) -> None:
        # Imported here because open3d takes long to load.
        import open3d as o3d

        self._vertices = np.asarray(vertices, dtype=np.float64)
        self._middle = 0.5 * (self._vertices.min(axis=0) + self._vertices.max(axis=0))
        self._scene: Any = o3d.t.geometry.RaycastingScene(nthreads=n_threads)
        self._scene.add_triangles(
            as_tensor((self._vertices - self._middle).astype(np.float32)),
            as_tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
        )
        self._n_threads = n_threads

    def mask(self, camera: Camera) -> Bool[np.ndarray, "h w"]:
        """Which pixels' centres the surface covers, seen through the camera's pinhole."""
        width, height = camera.size
        covered = np.zeros((height, width), dtype=bool)
        p = np.asarray(camera.projection_matrix, dtype=np.float64)
        u, v, depth = p[:, :3] @ self._vertices.T + p[:, 3:]
        if (depth > 0).all():
            u, v = u / depth, v / depth
            x_0, x_1 = max(int(np.floor(u.min())), 0), min(int(np.ceil(u.max())), width - 1)
            y_0, y_1 = max(int(np.floor(v.min())), 0), min(int(np.ceil(v.max())), height - 1)
        else:
            # Partly behind the camera: its projection has no box.
            x_0, x_1, y_0, y_1 = 0, width - 1, 0, height - 1
        if x_1 < x_0 or y_1 < y_0:
            return covered
        inverse = np.linalg.inv(p[:, :3])
        columns, rows = np.meshgrid(np.arange(x_0, x_1 + 1.0), np.arange(y_0, y_1 + 1.0))
        ways = columns[..., None] * inverse[:, 0] + rows[..., None] * inverse[:, 1] + inverse[:, 2]
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        rays = self._rays(-inverse @ p[:, 3], ways)
        hit = self._scene.test_occlusions(as_tensor(rays), nthreads=self._n_threads).numpy()
        covered[y_0 : y_1 + 1, x_0 : x_1 + 1] = hit
        return covered

    def covers(
        self, origin: Float[np.ndarray, " 3"], points: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """(N,) whether the line from `origin` through each point meets the surface, before or behind it."""
        rays = self._rays(origin, points - origin)
        return self._scene.test_occlusions(as_tensor(rays), nthreads=self._n_threads).numpy()

    def hides(
        self, starts: Float[np.ndarray, "n 3"], ways: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """(N,) whether the surface stands between each start (N 3) and the end of its way (N 3, metres)."""
        rays = as_tensor(self._rays(starts, ways))
        # The way's length is the unit, so that nothing beyond its end counts.
        return self._scene.test_occlusions(rays, tnear=0.0, tfar=1.0, nthreads=self._n_threads).numpy()

    def first_hits(
        self, starts: Float[np.ndarray, "n 3"], ways: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, " n"]:
        """(N,) metres along each unit way (N 3) from its start (N 3) to the surface; inf where it misses."""
        rays = as_tensor(self._rays(starts, ways))
        hits = self._scene.cast_rays(rays, nthreads=self._n_threads)
        return hits["t_hit"].numpy().astype(np.float64)

    def n_crossings(
        self, starts: Float[np.ndarray, "n 3"], ways: Float[np.ndarray, "n 3"]
    ) -> Int[np.ndarray, " n"]:
        """(N,) how often each half line from a start (N 3) along a way (N 3) crosses the surface."""
        rays = as_tensor(self._rays(starts, ways))
        return self._scene.count_intersections(rays, nthreads=self._n_threads).numpy().astype(np.int64)

    def meets(
        self, origins: Float[np.ndarray, "n 3"], ways: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """(N,) whether the half line from each origin (N 3) along its way (N 3) meets the surface."""
        rays = as_tensor(self._rays(origins, ways))
        return self._scene.test_occlusions(rays, nthreads=self._n_threads).numpy()

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """(N,) metres from the surface, negative inside, to about a micrometre."""
        query = as_tensor((points - self._middle).astype(np.float32))
        distance = self._scene.compute_distance(query, nthreads=self._n_threads).numpy().astype(np.float64)
        # Three rays vote, because one that grazes an edge may miscount.
        occupied = self._scene.compute_occupancy(query, nthreads=self._n_threads, nsamples=3).numpy()
        return np.where(occupied > 0.5, -distance, distance)

    def _rays(
        self, origin: Float[np.ndarray, "*m 3"], ways: Float[np.ndarray, "*n 3"]
    ) -> Float[np.ndarray, "*n 6"]:
        rays = np.empty((*ways.shape[:-1], 6), dtype=np.float32)
        rays[..., :3] = origin - self._middle
        rays[..., 3:] = ways
        return rays


def as_tensor(array: np.ndarray) -> Any:
    """The array as open3d wants it."""
    import open3d as o3d

    return o3d.core.Tensor(array)  # type: ignore[call-overload]  # the stubs do not know arrays
