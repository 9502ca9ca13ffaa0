"""Gauss-Newton normal equations of point-to-surface residuals, accumulated on the mesh.

Each residual touches the three corners of one triangle, so its contribution to J^T J lives on vertices and
mesh edges: once summed, nothing depends on the number of scan points any more. The sparsity pattern belongs
to the topology and is built once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix

from fit.closest import ClosestPoints

#: Share of the isotropic (point-to-point) part beside the point-to-plane part: keeps the tangential
#: directions tame.
TANGENTIAL_SHARE = 0.05

_PAIRS = [(p, q) for p in range(3) for q in range(p, 3)]
_AXES = [(r, c) for r in range(3) for c in range(r, 3)]


@dataclass(frozen=True)
class MeshPattern:
    """Sparsity of a (3V, 3V) matrix with 3x3 blocks on the vertices and edges of a mesh.

    indptr, indices: CSR structure; slot (F 81): where entry (corner p, axis r; corner q, axis c) of a
    triangle's 9x9 block is stored; diagonal (9V): where the entries of the vertices' own blocks are.
    """

    n_vertices: int
    indptr: Int[np.ndarray, "_"]
    indices: Int[np.ndarray, "nnz"]
    slot: Int[np.ndarray, "f 81"]
    diagonal: Int[np.ndarray, "_"]

    @staticmethod
    def of(faces: Int[np.ndarray, "f 3"], n_vertices: int) -> MeshPattern:
        """Pattern of a triangle mesh."""
        dof = (3 * faces[:, :, None] + np.arange(3)).reshape(len(faces), 9)
        row = np.repeat(dof, 9, axis=1).ravel()
        col = np.tile(dof, (1, 9)).ravel()
        size = 3 * n_vertices
        key = row.astype(np.int64) * size + col
        unique, slot = np.unique(key, return_inverse=True)
        rows, indices = unique // size, unique % size
        indptr = np.searchsorted(rows, np.arange(size + 1))
        own = 3 * np.arange(n_vertices)[:, None] + np.arange(3)
        diagonal = np.searchsorted(unique, (own[:, :, None] * size + own[:, None, :]).ravel())
        return MeshPattern(
            n_vertices,
            indptr.astype(np.int32),
            indices.astype(np.int32),
            slot.reshape(-1, 81).astype(np.int64),
            diagonal,
        )

    def with_vertex_blocks(self, matrix: csr_matrix, blocks: Float[np.ndarray, "v 3 3"]) -> csr_matrix:
        """The matrix with a 3x3 block added on every vertex's diagonal."""
        data = matrix.data.copy()
        data[self.diagonal] += blocks.reshape(-1)
        return self.matrix(data)

    def matrix(self, data: Float[np.ndarray, "nnz"]) -> csr_matrix:
        """The CSR matrix with these values."""
        size = 3 * self.n_vertices
        return csr_matrix((data, self.indices, self.indptr), shape=(size, size))


def accumulate(
    pattern: MeshPattern,
    faces: Int[np.ndarray, "f 3"],
    closest: ClosestPoints,
    weight: Float[np.ndarray, "n"],
) -> tuple[csr_matrix, Float[np.ndarray, "v 3"]]:
    """Sum the residuals r_k = weight_k d_k over the points.

    Returns H (3V, 3V), the sum of weight_k b_p b_q [(1 - a) n n^T + a I], and the descent right-hand side (V
    3), the sum of weight_k b_p d_k n_k: moving the vertices by the solution of H u = g brings the surface to
    the points.
    """
    order = np.argsort(closest.triangle_idx, kind="stable")
    order = order[weight[order] > 0]
    triangle = closest.triangle_idx[order]
    w, bary, normal = weight[order], closest.barycentric[order], closest.direction[order]
    a = TANGENTIAL_SHARE
    metric = np.stack([w * ((1 - a) * normal[:, r] * normal[:, c] + a * (r == c)) for r, c in _AXES], axis=1)
    products = np.stack([bary[:, p] * bary[:, q] for p, q in _PAIRS], axis=1)
    per_point = (products[:, :, None] * metric[:, None, :]).reshape(len(order), 36)
    first = np.flatnonzero(np.r_[True, triangle[1:] != triangle[:-1]]) if len(order) else np.zeros(0, int)
    per_triangle = np.add.reduceat(per_point, first, axis=0) if len(order) else np.zeros((0, 36))
    used = triangle[first]
    full = np.empty((len(used), 3, 3, 3, 3))  # corner p, axis r, corner q, axis c
    compact = per_triangle.reshape(len(used), 6, 6)
    for pair, (p, q) in enumerate(_PAIRS):
        for axes, (r, c) in enumerate(_AXES):
            value = compact[:, pair, axes]
            full[:, p, r, q, c] = value
            full[:, p, c, q, r] = value
            full[:, q, r, p, c] = value
            full[:, q, c, p, r] = value
    data = np.bincount(
        pattern.slot[used].ravel(), full.reshape(len(used), 81).ravel(), minlength=len(pattern.indices)
    )
    pull = (w * closest.distance[order])[:, None] * normal
    corners = faces[triangle].ravel()
    rhs = np.stack(
        [
            np.bincount(corners, (bary * pull[:, axis, None]).ravel(), minlength=pattern.n_vertices)
            for axis in range(3)
        ],
        axis=1,
    )
    return pattern.matrix(data), rhs


def edge_laplacian(
    faces: Int[np.ndarray, "f 3"], n_vertices: int, vertex_weight: Float[np.ndarray, "v"]
) -> csr_matrix:
    """L = E^T diag(w_e^2) E over the undirected mesh edges: E_cpl's quadratic form per axis.

    vertex_weight holds the paper's per-part coupling strengths w; an edge takes the mean of its ends.
    """
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges = np.unique(edges, axis=0)
    strength = (0.5 * (vertex_weight[edges[:, 0]] + vertex_weight[edges[:, 1]])) ** 2
    i, j = edges.T
    rows = np.concatenate([i, j, i, j])
    cols = np.concatenate([i, j, j, i])
    vals = np.concatenate([strength, strength, -strength, -strength])
    return coo_matrix((vals, (rows, cols)), shape=(n_vertices, n_vertices)).tocsr()
