"""A part of the body cut out of the skin and closed, so that its own volume can be told.

The whole body hides a pinch at a joint; the segment around the joint does not. Every open end is closed by a
fan about the centre of its rim, a vertex added behind the mesh's own.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .sections import volume_m3


@dataclass(frozen=True)
class Segment:
    """faces: of the closed segment, into the mesh's vertices and behind them one centre a rim. rims: the
    vertices of each.
    """

    faces: Int[np.ndarray, "f 3"]
    rims: tuple[Int[np.ndarray, "_"], ...]

    @staticmethod
    def of(faces: Int[np.ndarray, "g 3"], inside: Bool[np.ndarray, "v"]) -> "Segment":
        """What lies between these vertices of a closed mesh; all of it where every vertex is inside."""
        own = faces[inside[faces].all(1)]
        edges = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]])
        n = len(inside)
        code, reverse = edges @ [n, 1], edges @ [1, n]
        rim = edges[~np.isin(code, reverse)]
        joined = coo_matrix((np.ones(len(rim)), (rim[:, 0], rim[:, 1])), (n, n))
        label = connected_components(joined, directed=False)[1][rim[:, 0]]
        names = np.unique(label)
        fans = [
            np.concatenate([rim[label == k][:, ::-1], np.full((np.sum(label == k), 1), n + i)], 1)
            for i, k in enumerate(names)
        ]
        return Segment(np.concatenate([own, *fans]), tuple(rim[label == k, 0] for k in names))

    def closed(self, vertices: Float[np.ndarray, "v *k"]) -> Float[np.ndarray, "_ *k"]:
        """The vertices (or anything linear in them, their moves) and behind them the centres of the rims."""
        return np.concatenate([vertices, *(vertices[rim].mean(0)[None] for rim in self.rims)])

    def volume_m3(self, vertices: Float[np.ndarray, "v 3"]) -> float:
        """Signed volume: what overlaps counts twice."""
        return float(volume_m3(self.closed(vertices), self.faces))
