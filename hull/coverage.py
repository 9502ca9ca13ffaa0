"""Which pixels a closed surface covers, from its contour alone.

Seen from a camera, the faces that look at it are bounded by the edges whose other face looks away. Drawn as a
signed outline, that boundary winds once around a pixel's centre for every layer of the surface that covers
it; so a picture costs a few thousand edges and a running sum along its rows, where casting a ray through
every pixel costs millions of rays.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Integer
from scipy.sparse import coo_array

from capture.camera import Camera


class NotClosedError(ValueError):
    """The surface has an edge that is not used once in each direction, so it has no inside."""


class Coverage:
    """A closed surface (vertices (V 3) metres, faces (F 3)), ready to be seen. Raises NotClosedError."""

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Integer[np.ndarray, "f 3"]) -> None:
        self._columns = np.array(np.asarray(vertices, dtype=np.float64).T, order="C")
        n = self._columns.shape[1]
        face = np.repeat(np.arange(1, len(faces) + 1, dtype=np.int32), 3)
        ends = (faces.ravel().astype(np.int32), faces[:, [1, 2, 0]].ravel().astype(np.int32))
        # Rows and columns sorted: the k-th entry of one is the k-th edge forth, of the other the same edge
        # back.
        forth, back = (
            coo_array((face, ends), shape=(n, n)).tocsr(),
            coo_array((face, ends[::-1]), (n, n)).tocsr(),
        )
        forth.sort_indices()
        back.sort_indices()
        if forth.nnz != faces.size or not (
            np.array_equal(forth.indptr, back.indptr) and np.array_equal(forth.indices, back.indices)
        ):
            raise NotClosedError("the surface is not closed")
        start = np.repeat(np.arange(n), np.diff(forth.indptr))
        once = np.flatnonzero(start < forth.indices)
        self._edges = np.stack([start.take(once), forth.indices.take(once)])
        self._left, self._right = forth.data.take(once) - 1, back.data.take(once) - 1
        # From the middle: far from the origin the planes' distances would lose digits.
        self._middle = self._columns.mean(axis=1)
        a, b, c = ((self._columns - self._middle[:, None]).take(faces[:, k], axis=1) for k in range(3))
        (ax, ay, az), (bx, by, bz) = b - a, c - a
        self._normals = (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
        self._offsets = sum(self._normals[k] * a[k] for k in range(3))

    def mask(self, camera: Camera) -> Bool[np.ndarray, "h w"] | None:
        """Which pixels' centres the surface covers, seen through the camera's pinhole; None where part of it
        is behind the camera and has no picture."""
        found = self.in_box(camera)
        if found is None:
            return None
        x, y, within = found
        covered = np.zeros(camera.size[::-1], dtype=bool)
        covered[y : y + within.shape[0], x : x + within.shape[1]] = within
        return covered

    def share_in_picture(self, camera: Camera) -> float:
        """The share of the surface's vertices that the camera's picture shows, hidden ones counted."""
        p = np.asarray(camera.projection_matrix, dtype=np.float64)
        u, v, depth = p[:, :3] @ self._columns + p[:, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = u / depth, v / depth
        width, height = camera.size
        return float(
            (
                (depth > 0)
                & (np.abs(u - (width - 1) / 2) < width / 2)
                & (np.abs(v - (height - 1) / 2) < height / 2)
            ).mean()
        )

    def in_box(self, camera: Camera) -> tuple[int, int, Bool[np.ndarray, "h2 w2"]] | None:
        """`mask` within the surface's own box in the picture, whose first column and row come first."""
        width, height = camera.size
        p = np.asarray(camera.projection_matrix, dtype=np.float64)
        u, v, depth = p[:, :3] @ self._columns + p[:, 3:]
        if not (depth > 0).all():
            return None
        u, v = u / depth, v / depth
        x_0, x_1 = np.clip([np.ceil(u.min()), np.floor(u.max()) + 1], 0, width).astype(int)
        y_0, y_1 = np.clip([np.ceil(v.min()), np.floor(v.max()) + 1], 0, height).astype(int)
        if x_1 <= x_0 or y_1 <= y_0:
            return 0, 0, np.zeros((0, 0), dtype=bool)
        centre = -np.linalg.solve(p[:, :3], p[:, 3]) - self._middle
        faces_us = sum(self._normals[k] * centre[k] for k in range(3)) > self._offsets
        left = faces_us.take(self._left)
        contour = np.flatnonzero(left != faces_us.take(self._right))
        a, b = self._edges.take(contour, axis=1)
        # Along the face that looks at us.
        forth = left.take(contour)
        a, b = np.where(forth, a, b), np.where(forth, b, a)
        # An edge crosses the rows whose centres lie between its ends, the upper end's own included.
        first, end = (np.clip(np.ceil(f(v[a], v[b])), y_0, y_1).astype(int) for f in (np.minimum, np.maximum))
        n_rows = end - first
        edge = np.repeat(np.arange(len(a)), n_rows)
        row = np.arange(len(edge)) - np.repeat(np.cumsum(n_rows) - n_rows, n_rows) + first[edge]
        a, b = a[edge], b[edge]
        column = u[a] + (row - v[a]) * ((u[b] - u[a]) / (v[b] - v[a]))
        column = np.clip(np.ceil(column), x_0, x_1).astype(int)
        winding = np.zeros((y_1 - y_0, x_1 - x_0 + 1), dtype=np.int16)
        np.add.at(winding, (row - y_0, column - x_0), np.where(v[b] > v[a], 1, -1).astype(np.int16))
        np.cumsum(winding, axis=1, out=winding)
        return int(x_0), int(y_0), winding[:, :-1] != 0
