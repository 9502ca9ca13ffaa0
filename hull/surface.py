"""Move the vertices of a surface on the grid to where their edges leave the hull.

Marching cubes gives the topology on the binary grid; then every vertex is moved along its grid edge to where
the edge leaves the hull, found in the pictures (marching intersections, Tarini et al. 2002). That makes the
surface four times as accurate as the grid, without distance transforms.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hull.carve import Grid
from hull.culling import Culling
from hull.marching import GridSurface
from hull.tables import OUTSIDE, SilhouetteTable

# An end that rounding puts on the outline's other side counts as just on its own.
_BELOW_HALF = float(np.nextafter(0.5, 0.0))
# The way is halved until a pixel is left of it; one of more than 128 stays that much coarser.
_MOST_HALVINGS = 7
# Then to a hundredth of a pixel, nearly always to far less.
_N_FALSE_POSITIONS = 3
# More places are asked in parts: what is looked at together should fit into the processor's cache.
AT_ONCE = 200_000
# Crossings keep this share of the edge from its ends, so that no triangle collapses onto a grid point.
KEEP_OFF = 0.02


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
    surface: GridSurface,
    grid: Grid,
    tables: Sequence[SilhouetteTable],
    culling: Culling | None = None,
    votes: int = 1,
) -> Crossings:
    """The surface's vertices on the silhouettes' cones. `culling`: of these tables and this grid.

    `votes`: so many cameras must refuse a place before the hull ends there.
    """
    origin = grid.centres(surface.inner.T)
    along = (surface.outer - surface.inner).T * grid.voxel_m
    exit_at, cut_by = exits(tables, origin, along, culling, votes)
    # Where no camera refuses the far end, it was given up for want of witnesses: nobody knows better than
    # half way.
    exit_at[cut_by < 0] = 0.5
    return Crossings((origin + along * np.clip(exit_at, KEEP_OFF, 1.0 - KEEP_OFF)).T, cut_by)


def exits(
    tables: Sequence[SilhouetteTable],
    origin: Float[np.ndarray, "3 n"],
    along: Float[np.ndarray, "3 n"],
    culling: Culling | None = None,
    votes: int = 1,
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """(N,) where on the way `along` (3 N, metres) from `origin` (inside) the hull ends; (N,) the table that
    ends it, or -1.

    Each camera in turn is asked at the present exit; only where it says "outside" does it shorten the way.
    The exit is thus the first one of all cameras, found with little more than one question per camera.
    Cameras that cannot refuse any of it are not asked where `culling` is given.
    """
    if (n := origin.shape[1]) > AT_ONCE:
        parts = [slice(start, start + AT_ONCE) for start in range(0, n, AT_ONCE)]
        found = [exits(tables, origin[:, part], along[:, part], culling, votes) for part in parts]
        return np.concatenate([at for at, _ in found]), np.concatenate([by for _, by in found])
    if votes > 1:
        return _exits_by_votes(tables, origin, along, culling, votes)
    # `take` gathers columns five times as fast as an index does, if each row lies in one piece.
    origin, along = np.ascontiguousarray(origin), np.ascontiguousarray(along)
    if culling is not None and culling.stack is not None:
        stack, blocks = culling.stack, culling.blocks_of(origin + 0.5 * along)
        exit_at, cut_by = np.empty(len(blocks)), np.empty(len(blocks), dtype=np.int16)
        numbers, projections, lists = stack.numbers, stack.projections, culling.refusing
        stack.loops.exits(numbers, projections, origin, along, blocks, *lists, exit_at, cut_by)
        return exit_at, cut_by
    exit_at = np.ones(origin.shape[1])
    place = origin + along
    cut_by = np.full(origin.shape[1], -1, dtype=np.int16)
    near = None if culling is None else culling.blocks_of(origin + 0.5 * along)
    for table_idx, table in enumerate(tables):
        if culling is None or near is None:
            asked = np.arange(origin.shape[1])
        else:
            asked = culling.may_refuse(table_idx, near)
        answers = table.ask_points(place.take(asked, axis=1))
        refused = asked.take(np.flatnonzero(answers == OUTSIDE))
        if not len(refused):
            continue
        start, way = origin.take(refused, axis=1), along.take(refused, axis=1)
        share = way_out(table, table.projected(start), table.projected_way(way), exit_at[refused])
        cut_by[refused] = table_idx
        exit_at[refused] = share
        place[:, refused] = start + way * share
    return exit_at, cut_by


def by_table(of_each: Int[np.ndarray, " n"], n_tables: int) -> Iterator[tuple[int, Int[np.ndarray, " m"]]]:
    """Each table with the places (M,) in `of_each` (N,) that name it; -1 names none."""
    order = np.argsort(of_each, kind="stable")
    limits = np.searchsorted(of_each.take(order), np.arange(n_tables + 1))
    for table_idx in range(n_tables):
        if limits[table_idx] < limits[table_idx + 1]:
            yield table_idx, order[limits[table_idx] : limits[table_idx + 1]]


def _exits_by_votes(
    tables: Sequence[SilhouetteTable],
    origin: Float[np.ndarray, "3 n"],
    along: Float[np.ndarray, "3 n"],
    culling: Culling | None,
    votes: int,
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """`exits` where the hull ends only with the `votes`-th camera to refuse.

    The first so many refusals on each way are kept in order; a camera is asked where the last of them is.
    """
    n = origin.shape[1]
    refused_at, refused_by = np.ones((votes, n)), np.full((votes, n), -1, dtype=np.int16)
    blocks = None if culling is None else culling.blocks_of(origin + 0.5 * along)
    for table_idx, table in enumerate(tables):
        if culling is None or blocks is None:
            asked = np.arange(n)
        else:
            asked = culling.may_refuse(table_idx, blocks)
        ends = origin[:, asked] + along[:, asked] * refused_at[-1, asked]
        refused = asked[table.ask_points(ends) == OUTSIDE]
        if not len(refused):
            continue
        start, way = origin[:, refused], along[:, refused]
        at = way_out(table, table.projected(start), table.projected_way(way), refused_at[-1, refused])
        # One of the votes may be cast at the start already.
        at[table.ask_points(start) == OUTSIDE] = 0.0
        all_at = np.vstack([refused_at[:, refused], at])
        all_by = np.vstack([refused_by[:, refused], np.full(len(refused), table_idx, dtype=np.int16)])
        first = np.argsort(all_at, axis=0, kind="stable")[:votes]
        refused_at[:, refused] = np.take_along_axis(all_at, first, axis=0)
        refused_by[:, refused] = np.take_along_axis(all_by, first, axis=0)
    return refused_at[-1], refused_by[-1]


def way_out(
    table: SilhouetteTable,
    base: Float[np.ndarray, "3 n"],
    way: Float[np.ndarray, "3 n"],
    outer: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """(N,) where the silhouette's value falls to one half, between 0 (inside) and `outer` (outside).

    Halvings until a pixel or so is left, where the value begins to tell how far the outline is; then false
    position (Illinois), which keeps its bracket.
    """
    end = base + way * outer
    if not base[2].min(initial=1.0) > 0.0:
        # The camera stands inside the hull, within a voxel of its end: nobody knows better than half way.
        behind = base[2] <= 0.0
        result = 0.5 * outer
        result[~behind] = way_out(table, base[:, ~behind], way[:, ~behind], outer[~behind])
        return result
    # In the picture the way is a straight line: the search goes along that, and needs no division.
    u, v = base[:2] / base[2]
    du, dv = end[:2] / end[2] - (u, v)
    length = np.maximum(np.abs(du), np.abs(dv))
    n_halvings = sum((length > 2.0**k).astype(np.int64) for k in range(_MOST_HALVINGS))
    near, near_value = np.zeros(len(outer)), np.maximum(table.ask_pixels(u, v), 0.5)
    far, far_value = np.ones(len(outer)), np.minimum(table.ask_pixels(u + du, v + dv), _BELOW_HALF)
    moved = np.zeros(len(outer), dtype=bool)
    for step in range(int(np.max(n_halvings, initial=0)) + _N_FALSE_POSITIONS):
        even = near + (far - near) * ((near_value - 0.5) / np.maximum(near_value - far_value, 1e-9))
        place = np.where(step < n_halvings, 0.5 * (near + far), even)
        value = table.ask_pixels(u + du * place, v + dv * place)
        outside = value < 0.5
        # The end that stays twice counts half: false position would creep from one side otherwise.
        again = (step > n_halvings) & (outside == moved)
        moved = outside
        going_on = step < n_halvings + _N_FALSE_POSITIONS
        to_far, to_near = going_on & outside, going_on & ~outside
        near_value = np.where(again & to_far, 0.25 + 0.5 * near_value, near_value)
        far_value = np.where(again & to_near, 0.25 + 0.5 * far_value, far_value)
        far, far_value = np.where(to_far, place, far), np.where(to_far, value, far_value)
        near, near_value = np.where(to_near, place, near), np.where(to_near, value, near_value)
    place = near + (far - near) * ((near_value - 0.5) / np.maximum(near_value - far_value, 1e-9))
    # Back from the share of the picture's line to the share of the way, which recedes from the camera.
    return outer * place * base[2] / (place * base[2] + (1.0 - place) * end[2])
