"""Distances along the surface of a mesh, for the g of the skin term (paper section 4.1, figure 3)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra


def edge_lengths(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> csr_matrix:
    """(V V) lengths of a mesh's edges, m; besides them, of the way across each pair of triangles with a
    common edge, without which paths along edges are a tenth too long."""
    corners = np.concatenate([faces, faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
    low, high = corners[:, :2].min(1), corners[:, :2].max(1)
    order = np.lexsort([high, low])
    low, high, tip = low[order], high[order], corners[order, 2]
    twin = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    first = np.concatenate([low, tip[twin]])
    second = np.concatenate([high, tip[twin + 1]])
    # The two triangles unfolded into a plane: the way across is straight where it meets the common edge.
    a, b = vertices[low[twin]], vertices[high[twin]]
    along = b - a
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    along = along / length
    reach = []
    for end in (tip[twin], tip[twin + 1]):
        way = vertices[end] - a
        x = (way * along).sum(1)
        reach.append((x, np.sqrt(np.maximum((way**2).sum(1) - x**2, 0.0))))
    (x0, y0), (x1, y1) = reach
    crossing = (x0 * y1 + x1 * y0) / np.maximum(y0 + y1, 1e-12)
    inside = (crossing > 0.0) & (crossing < length[:, 0])
    across = np.where(inside, np.hypot(x1 - x0, y1 + y0), np.inf)
    lengths = np.concatenate([np.linalg.norm(vertices[low] - vertices[high], axis=1), across])
    real = np.isfinite(lengths) & (first != second)
    n = len(vertices)
    keys, unique = np.unique(first[real] * n + second[real], return_index=True)
    value = np.maximum(lengths[real][unique], 1e-12)
    return coo_matrix((value, (keys // n, keys % n)), shape=(n, n)).tocsr()


def distance_from(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], sources: Bool[np.ndarray, "v"]
) -> Float[np.ndarray, "v"]:
    """(V,) geodesic distance of every vertex to the nearest source, m; infinite where no way leads to one."""
    if not sources.any():
        return np.full(len(vertices), np.inf)
    return dijkstra(
        edge_lengths(vertices, faces), directed=False, indices=np.flatnonzero(sources), min_only=True
    )
