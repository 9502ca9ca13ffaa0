"""From inside cells to a closed surface whose vertices lie on the silhouettes' cones.

Marching cubes gives the topology on the binary grid; then every vertex is moved along its grid edge to where
the edge leaves the hull, found in the pictures (marching intersections, Tarini et al. 2002).
That makes the surface four times as accurate as the grid, without distance transforms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hull.carve import Blocks, Grid
from hull.culling import Culling
from hull.tables import SilhouetteTable

# A level below one half makes marching cubes join voxels that touch at an edge, always alike: with exactly
# one half the tables' ties are broken at random and edges with four faces appear.
_LEVEL = 0.4
# A way this many pixels long is halved until a pixel is left; longer ones stay that much coarser.
_MOST_HALVED = 128.0
# Then to a hundredth of a pixel.
_N_FALSE_POSITIONS = 3
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


@dataclass(frozen=True, eq=False)
class Crossings:
    """Where the surface's grid edges leave the hull.

    Fields
    ------
    vertices : (V 3) world points, metres.
    cut_by : (V,) the table (its place in the sequence) of the camera whose cone ends the hull there;
        -1: none, the far end was given up for want of witnesses.
    """

    vertices: Float[np.ndarray, "v 3"]
    cut_by: Int[np.ndarray, " v"]


def cross_exactly(
    surface: GridSurface, grid: Grid, tables: Sequence[SilhouetteTable], culling: Culling | None = None
) -> Crossings:
    """The surface's vertices on the silhouettes' cones. `culling`: of these tables and this grid."""
    origin = grid.centres(surface.inner.T)
    along = (surface.outer - surface.inner).T * grid.voxel_m
    exit_at, cut_by = exits(tables, origin, along, culling)
    # Where no camera refuses the far end, it was given up for want of witnesses: nobody knows better than
    # half way.
    exit_at[cut_by < 0] = 0.5
    return Crossings((origin + along * np.clip(exit_at, _KEEP_OFF, 1.0 - _KEEP_OFF)).T, cut_by)


def exits(
    tables: Sequence[SilhouetteTable],
    origin: Float[np.ndarray, "3 n"],
    along: Float[np.ndarray, "3 n"],
    culling: Culling | None = None,
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """(N,) where on the way `along` (3 N, metres) from `origin` (inside) the hull ends; (N,) the table that
    ends it, or -1.

    Each camera in turn is asked at the present exit; only where it says "outside" does it shorten the way.
    The exit is thus the first one of all cameras, found with little more than one question per camera.
    Cameras that cannot refuse any of it are not asked where `culling` is given.
    """
    exit_at = np.ones(origin.shape[1])
    cut_by = np.full(origin.shape[1], -1, dtype=np.int16)
    blocks = None if culling is None else culling.blocks_of(origin + 0.5 * along)
    for table_idx, table in enumerate(tables):
        if culling is None or blocks is None:
            asked = np.arange(origin.shape[1])
        else:
            asked = culling.may_refuse(table_idx, blocks)
        base, way = table.projected(origin[:, asked]), table.projected_way(along[:, asked])
        share = exit_at[asked]
        value = table.ask_along(base, way, share)
        refused = np.flatnonzero(value < 0.5)
        if not len(refused):
            continue
        cut_by[asked[refused]] = table_idx
        exit_at[asked[refused]] = _way_out(
            table, base[:, refused], way[:, refused], share[refused], value[refused]
        )
    return exit_at, cut_by


def _way_out(
    table: SilhouetteTable,
    base: Float[np.ndarray, "3 n"],
    way: Float[np.ndarray, "3 n"],
    outer: Float[np.ndarray, " n"],
    outer_value: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """(N,) where the silhouette's value falls to one half, between 0 (inside) and `outer` (outside).

    Halvings until a pixel is left, where the value begins to tell how far the outline is; then false
    position (Illinois), which keeps its bracket.
    """
    inner = np.zeros(len(outer))
    inner_value = np.ones(len(outer))
    end = base + way * outer
    length = np.abs(end[:2] / end[2] - base[:2] / base[2]).max(axis=0)
    n_halvings = int(np.ceil(np.log2(np.clip(length.max(), 1.0, _MOST_HALVED))))
    halved = np.zeros(len(outer), dtype=np.int8)
    for step in range(n_halvings + _N_FALSE_POSITIONS):
        if step < n_halvings:
            place = 0.5 * (inner + outer)
        else:
            span = inner_value - outer_value
            place = inner + (outer - inner) * ((inner_value - 0.5) / np.maximum(span, 1e-9))
        value = table.ask_along(base, way, place)
        outside = value < 0.5
        if step >= n_halvings:
            # The end that stays twice counts half: false position would creep from one side otherwise.
            stays_outer = ~outside & (halved == 1)
            stays_inner = outside & (halved == 2)
            outer_value = np.where(stays_outer, 0.5 - 0.5 * (0.5 - outer_value), outer_value)
            inner_value = np.where(stays_inner, 0.5 + 0.5 * (inner_value - 0.5), inner_value)
            halved = np.where(outside, 2, 1).astype(np.int8)
        outer, outer_value = np.where(outside, place, outer), np.where(outside, value, outer_value)
        inner, inner_value = np.where(outside, inner, place), np.where(outside, inner_value, value)
    span = np.maximum(inner_value - outer_value, 1e-9)
    return inner + (outer - inner) * ((inner_value - 0.5) / span)
