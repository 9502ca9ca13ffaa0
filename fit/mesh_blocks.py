"""The data term's Gauss-Newton matrix as 3x3 blocks on vertices and edges, and E_cpl on the same edges.

What `normal_equations.accumulate` puts into a sparse matrix, stored once a vertex and once an edge (blocks of
point-to-surface residuals are symmetric), so that filling it and multiplying by it are short loops.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csr_matrix

from fit.closest import ClosestPoints
from fit.normal_equations import TANGENTIAL_SHARE

#: Where the entries of a symmetric block (xx, xy, xz, yy, yz, zz) stand in a 3x3 matrix.
_ENTRY = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True)
class MeshEdges:
    """edges (E 2), each once; face_edges (F 3): edge from corner c to the next; strength (E): the squared
    weights of E_cpl."""

    n_vertices: int
    faces: Int[np.ndarray, "f 3"]
    edges: Int[np.ndarray, "e 2"]
    face_edges: Int[np.ndarray, "f 3"]
    strength: Float[np.ndarray, "e"]

    @staticmethod
    def of(
        faces: Int[np.ndarray, "f 3"], n_vertices: int, vertex_weight: Float[np.ndarray, "v"]
    ) -> MeshEdges:
        """Edges of a triangle mesh; vertex_weight as `normal_equations.edge_laplacian` takes it."""
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
        edges, face_edges = np.unique(sides, axis=0, return_inverse=True)
        strength = (0.5 * vertex_weight[edges].sum(1)) ** 2
        return MeshEdges(n_vertices, faces, edges, face_edges.reshape(-1, 3), strength)


@dataclass(frozen=True)
class MeshMatrix:
    """A symmetric (3V, 3V) matrix: blocks of the vertices own (V 6) and of the edges between (E 6).

    lumped (V 6): its block-diagonal upper bound, every edge counted on both its ends; equal to it for moves
    that are the same at neighbours.
    """

    mesh: MeshEdges
    own: Float[np.ndarray, "v 6"]
    between: Float[np.ndarray, "e 6"]
    lumped: Float[np.ndarray, "v 6"]

    def __matmul__(self, moves: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
        from fit import compiled_skin

        out = np.empty_like(moves)
        compiled_skin.times_mesh_matrix(self.mesh.edges, self.own, self.between, moves, out)
        return out

    @property
    def mean_diagonal(self) -> Float[np.ndarray, "v"]:
        """A third of the trace of every vertex's block."""
        return (self.own[:, 0] + self.own[:, 3] + self.own[:, 5]) / 3.0

    def with_vertex_blocks(
        self, weight: Float[np.ndarray, "v"], direction: Float[np.ndarray, "v 3"]
    ) -> MeshMatrix:
        """With weight * direction direction^T added on every vertex's block."""
        row, column = np.triu_indices(3)
        block = weight[:, None] * direction[:, row] * direction[:, column]
        return MeshMatrix(self.mesh, self.own + block, self.between, self.lumped + block)

    @cached_property
    def sparse(self) -> csr_matrix:
        """The whole matrix."""
        vertex = np.arange(self.mesh.n_vertices)
        i, j = self.mesh.edges.T
        rows, columns = np.concatenate([vertex, i, j]), np.concatenate([vertex, j, i])
        blocks = np.concatenate([self.own, self.between, self.between])[:, _ENTRY]
        axis = np.arange(3)
        at = np.broadcast_to(3 * rows[:, None, None] + axis[:, None], blocks.shape)
        to = np.broadcast_to(3 * columns[:, None, None] + axis[None, :], blocks.shape)
        size = 3 * self.mesh.n_vertices
        return coo_matrix((blocks.ravel(), (at.ravel(), to.ravel())), shape=(size, size)).tocsr()


def sum_over_points(
    mesh: MeshEdges, closest: ClosestPoints, weight: Float[np.ndarray, "n"]
) -> tuple[MeshMatrix, Float[np.ndarray, "v 3"]]:
    """Matrix and right-hand side of `normal_equations.accumulate`, where the terms are defined."""
    from fit import compiled

    own, lumped = np.zeros((mesh.n_vertices, 6)), np.zeros((mesh.n_vertices, 6))
    between, rhs = np.zeros((len(mesh.edges), 6)), np.zeros((mesh.n_vertices, 3))
    compiled.sum_normal_equations(
        mesh.faces,
        mesh.face_edges,
        closest.triangle_idx,
        closest.barycentric,
        closest.distance,
        closest.direction,
        np.ascontiguousarray(weight, dtype=np.float64),
        TANGENTIAL_SHARE,
        own,
        between,
        lumped,
        rhs,
    )
    return MeshMatrix(mesh, own, between, lumped), rhs
