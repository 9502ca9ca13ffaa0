"""From inside cells to a closed surface whose vertices lie on the silhouettes' cones.

Marching cubes gives the topology on the binary grid; then every vertex is moved along its grid edge to where
the edge leaves the hull, found by bisection in the pictures (marching intersections, Tarini et al. 2002).
That makes the surface four times as accurate as the grid, without distance transforms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hull.carve import Blocks, Grid
from hull.tables import OUTSIDE, SilhouetteTable

# A level below one half makes marching cubes join voxels that touch at an edge, always alike: with exactly
# one half the tables' ties are broken at random and edges with four faces appear.
_LEVEL = 0.4
# One 128th of a voxel: far below a pixel.
_N_HALVINGS = 7
# Crossings keep this share of the edge from its ends, so that no triangle collapses onto a grid point.
_KEEP_OFF = 0.02
# Volumes are turned into surfaces in slabs of at most so many voxels.
SLAB_VOXELS = 24_000_000


@dataclass(frozen=True, eq=False)
class GridSurface:
    """A closed surface on the grid: each vertex is the edge between an inside and an outside voxel.

    Fields
    ------
    inner, outer : (V 3) the two neighbouring voxels.
    faces : (F 3) vertex indices, outward.
    """

    inner: Int[np.ndarray, "v 3"]
    outer: Int[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def binary_surface(blocks: Blocks, slab_voxels: int = SLAB_VOXELS) -> GridSurface:
    """The surface between inside and outside voxels: closed, every edge with two faces.

    Large volumes are done in slabs of about `slab_voxels`: an edge has the same whole-number name in both of
    two neighbouring slabs, so they join exactly.
    """
    first, end = blocks.span()
    first, end = first - 1, end + 1
    n_layers = max(int(slab_voxels // np.prod((end - first)[1:])), 2)
    parts = []
    for start in range(first[0], end[0] - 1, n_layers):
        low, high = first.copy(), end.copy()
        low[0], high[0] = start, min(start + n_layers + 1, end[0])
        parts.append(_marched(blocks, low, high))
    return parts[0] if len(parts) == 1 else _joined(parts)


def _joined(parts: Sequence[GridSurface]) -> GridSurface:
    offsets = np.cumsum([0] + [len(part.inner) for part in parts[:-1]])
    inner = np.concatenate([part.inner for part in parts])
    outer = np.concatenate([part.outer for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    doubled = inner + outer
    doubled -= doubled.min(axis=0)
    names = np.ravel_multi_index(tuple(doubled.T), tuple((doubled.max(axis=0) + 1).tolist()))
    _, kept, place = np.unique(names, return_index=True, return_inverse=True)
    return GridSurface(inner[kept], outer[kept], place.ravel()[faces])


def _marched(blocks: Blocks, low: Int[np.ndarray, " 3"], high: Int[np.ndarray, " 3"]) -> GridSurface:
    from skimage.measure import marching_cubes

    volume = blocks.dense(low, high)
    if not volume.any() or volume.all():
        nothing = np.zeros((0, 3), dtype=np.int64)
        return GridSurface(nothing, nothing, nothing)
    vertices, faces, _, _ = marching_cubes(volume.astype(np.float32), _LEVEL, gradient_direction="ascent")
    whole = np.round(vertices)
    on_edge = np.abs(vertices - whole) > 1e-3
    assert (on_edge.sum(axis=1) == 1).all(), "marching cubes put a vertex off the grid's edges"
    near = np.where(on_edge, np.floor(vertices), whole).astype(np.int64)
    far = near + on_edge
    near_is_inner = volume[tuple(near.T)][:, None]
    return GridSurface(
        np.where(near_is_inner, near, far) + low,
        np.where(near_is_inner, far, near) + low,
        faces.astype(np.int64),
    )


def cross_exactly(
    surface: GridSurface, grid: Grid, tables: Sequence[SilhouetteTable]
) -> Float[np.ndarray, "v 3"]:
    """(V 3) world points, metres, where each grid edge leaves the hull."""
    origin = grid.centres(surface.inner.T)
    along = (surface.outer - surface.inner).T * grid.voxel_m
    exit_at, cut = exits(tables, origin, along)
    # Where no camera refuses the far end, it was given up for want of witnesses: nobody knows better than
    # half way.
    exit_at[~cut] = 0.5
    return (origin + along * np.clip(exit_at, _KEEP_OFF, 1.0 - _KEEP_OFF)).T


def exits(
    tables: Sequence[SilhouetteTable], origin: Float[np.ndarray, "3 n"], along: Float[np.ndarray, "3 n"]
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """(N,) where on the way `along` (3 N, metres) from `origin` (inside) the hull ends; whether it does.

    Each camera in turn is asked at the present exit; only where it says "outside" does it shorten the way, by
    bisection. The exit is thus the first one of all cameras, found with little more than one question per
    camera.
    """
    exit_at = np.ones(origin.shape[1])
    cut = np.zeros(origin.shape[1], dtype=bool)
    for table in tables:
        refused = np.flatnonzero(table.ask_points(origin + along * exit_at) == OUTSIDE)
        if not len(refused):
            continue
        cut[refused] = True
        inner, outer = np.zeros(len(refused)), exit_at[refused]
        base, way = origin[:, refused], along[:, refused]
        for _ in range(_N_HALVINGS):
            middle = 0.5 * (inner + outer)
            outside = table.ask_points(base + way * middle) == OUTSIDE
            outer = np.where(outside, middle, outer)
            inner = np.where(outside, inner, middle)
        exit_at[refused] = 0.5 * (inner + outer)
    return exit_at, cut
