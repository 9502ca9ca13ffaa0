"""Plane sections of a mesh, the way a tape sees them: the convex outline of the points where a plane cuts
edges.

A girth is a convex perimeter because a tape bridges hollows. Every point of a section keeps the mesh edge it
lies on, so that a girth found once can be read again on the same mesh in any shape and pose.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, QhullError

Keep = Callable[[Int[np.ndarray, "n 2"], Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]]
"""Which points of a section count: from the end vertices of their edges and their places (metres)."""


def unique_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Every edge of the mesh once, lower vertex first."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(edges, 1), axis=0)


@dataclass(frozen=True)
class GirthLine:
    """A closed tape on a mesh: the corners of a convex outline, in order around, each on an edge of the
    mesh.
    """

    edges: Int[np.ndarray, "n 2"]
    shares: Float[np.ndarray, "n"]
    """How far from the edge's first vertex to its second."""

    def points(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "n 3"]:
        """Where the corners lie on this body (metres, its frame)."""
        first, second = vertices[self.edges[:, 0]], vertices[self.edges[:, 1]]
        return first + self.shares[:, None] * (second - first)

    def length_m(self, vertices: Float[np.ndarray, "v 3"]) -> float:
        """Length of the closed line on this body (metres)."""
        p = self.points(vertices)
        return float(np.linalg.norm(np.roll(p, -1, 0) - p, axis=1).sum())


@dataclass(frozen=True)
class Cutter:
    """A mesh ready to be cut many times."""

    vertices: Float[np.ndarray, "v 3"]
    edges: Int[np.ndarray, "e 2"]

    def points(
        self, point: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], keep: Keep
    ) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
        """Edges cut by the plane through `point` across `normal`, shares along them, and the points there."""
        height = (self.vertices - point) @ (normal / np.linalg.norm(normal))
        a, b = height[self.edges[:, 0]], height[self.edges[:, 1]]
        cut = np.flatnonzero((a > 0) != (b > 0))
        edges, share = self.edges[cut], a[cut] / (a[cut] - b[cut])
        p = self.vertices[edges[:, 0]] * (1 - share)[:, None] + self.vertices[edges[:, 1]] * share[:, None]
        kept = keep(edges, p)
        return edges[kept], share[kept], p[kept]

    def girth_line(
        self, point: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], keep: Keep
    ) -> GirthLine:
        """The convex outline of the section.

        Raises ValueError where the plane misses the mesh, or `keep` leaves no outline.
        """
        edges, share, p = self.points(point, normal, keep)
        in_plane = np.linalg.svd(normal[None])[2][1:]
        try:
            corners = ConvexHull(p @ in_plane.T).vertices
        except (QhullError, ValueError):
            raise ValueError(
                "girth: the plane does not cut the part of the body that was asked for."
            ) from None
        return GirthLine(edges[corners], share[corners])

    def girth(self, point: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], keep: Keep) -> float:
        """Convex perimeter of the section (metres); fails as `girth_line` does."""
        return self.girth_line(point, normal, keep).length_m(self.vertices)


def volume_m3(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Enclosed volume of a closed mesh with outward faces."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ia,ia->", a, np.cross(b, c)) / 6)
