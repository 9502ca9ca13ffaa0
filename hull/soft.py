"""Carving with doubts instead of verdicts: the hull of soft silhouettes (see `hull.soft_tables`).

What is in is decided by the sum of all cameras' doubts. Where exactly the surface lies is told by the one
half of a camera that is sure of the place beyond it, if there is one, since that is where a matte puts its
outline; else by where the sum passes the limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

from hull.carve import COARSEST_LEVEL, Blocks, Grid, cut_at_the_grid, eighths
from hull.culling import Culling
from hull.marching import GridSurface
from hull.soft_tables import LIMIT, SoftTable
from hull.surface import KEEP_OFF, Crossings, way_out
from hull.tables import INSIDE, NO_EVIDENCE
from hull.witnesses import WORD_BITS, WitnessRule

# A thousandth of a voxel.
_N_HALVINGS = 10


def carve_soft(tables: Sequence[SoftTable], rule: WitnessRule, grid: Grid) -> Blocks:
    """All voxels at whose centre the doubts sum up to no more than LIMIT and enough cameras see the person.

    Coarse to fine as `hull.carve`: bounds of the sum decide whole cells.
    """
    coarsest = min(COARSEST_LEVEL, max(int(np.log2(max(grid.shape))), 0))
    n = [-(-size >> coarsest) for size in grid.shape]
    cells = np.stack(np.meshgrid(*[np.arange(k, dtype=np.int32) for k in n], indexing="ij")).reshape(3, -1)
    # (C N): who may still have something to say about a cell, and who sees the person all over it.
    unasked = np.ones((len(tables), cells.shape[1]), dtype=bool)
    seen = np.zeros_like(unasked)
    found: list[np.ndarray] = []
    order = list(range(len(tables)))
    for level in range(coarsest, -1, -1):
        side = 1 << level
        within = (cells * side < np.array(grid.shape)[:, None]).all(axis=0)
        cells, unasked, seen = cells[:, within], unasked[:, within], seen[:, within]
        centres = grid.centres(cells, side)
        half_m = 0.5 * (side - 1) * grid.voxel_m
        low, high = np.zeros(cells.shape[1]), np.zeros(cells.shape[1])
        alive = np.ones(cells.shape[1], dtype=bool)
        rejects = np.zeros(len(tables))
        for k in order:
            asked = np.flatnonzero(alive & unasked[k])
            if not len(asked):
                continue
            points = centres.take(asked, axis=1)
            if level == 0:
                doubts, person = tables[k].doubts(points)
                low[asked] += doubts
                high[asked] += doubts
                seen[k, asked] = person
                unasked[k, asked] = False
            else:
                least, most, answers = tables[k].doubts_in_cells(points, half_m)
                low[asked] += least
                high[asked] += most
                unasked[k, asked[(most == 0) & ((answers == INSIDE) | (answers == NO_EVIDENCE))]] = False
                seen[k, asked[(most == 0) & (answers == INSIDE)]] = True
            gone = low[asked] > LIMIT
            alive[asked[gone]] = False
            rejects[k] = gone.mean()
        order.sort(key=lambda k: -float(rejects[k]))
        enough = rule.enough(_packed(seen))
        sure = alive & (high <= LIMIT) & enough
        found.append(cells[:, sure])
        hopeful = rule.enough(_packed(seen | unasked))
        split = np.flatnonzero(alive & ~sure & hopeful & unasked.any(axis=0))
        cells = eighths(cells[:, split]).astype(np.int32)
        unasked, seen = np.repeat(unasked[:, split], 8, axis=1), np.repeat(seen[:, split], 8, axis=1)
    found = found[::-1]
    cut_at_the_grid(found, grid)
    return Blocks(grid, tuple(found))


def inside_softly(
    tables: Sequence[SoftTable], rule: WitnessRule, points: Float[np.ndarray, "3 n"]
) -> Bool[np.ndarray, " n"]:
    """(N,) the soft hull's definition at points (3 N), without any shortcut; slow."""
    answers = [table.doubts(points) for table in tables]
    total = np.sum([doubts for doubts, _ in answers], axis=0)
    return (total <= LIMIT) & rule.enough(_packed(np.array([person for _, person in answers])))


def cross_softly(
    surface: GridSurface, grid: Grid, tables: Sequence[SoftTable], culling: Culling
) -> Crossings:
    """The surface's vertices where their grid edges leave the soft hull. `culling`: of these tables."""
    origin = np.ascontiguousarray(grid.centres(surface.inner.T))
    along = np.ascontiguousarray((surface.outer - surface.inner).T * grid.voxel_m)
    blocks = culling.blocks_of(origin + 0.5 * along)
    exit_at = np.full(origin.shape[1], np.inf)
    cut_by = np.full(origin.shape[1], -1, dtype=np.int16)
    total = np.zeros(origin.shape[1])
    for table_idx, table in enumerate(tables):
        asked = culling.may_refuse(table_idx, blocks)
        start, way = origin.take(asked, axis=1), along.take(asked, axis=1)
        doubts, _ = table.doubts(start + way)
        total[asked] += doubts
        sure = np.flatnonzero(doubts > LIMIT)
        base, step = table.projected(start[:, sure]), table.projected_way(way[:, sure])
        at = way_out(table, base, step, np.ones(len(sure)))
        first = at < exit_at[asked[sure]]
        exit_at[asked[sure[first]]] = at[first]
        cut_by[asked[sure[first]]] = table_idx
    unsure = np.flatnonzero((cut_by < 0) & (total > LIMIT))
    if len(unsure):
        exit_at[unsure], cut_by[unsure] = _halved(
            origin[:, unsure], along[:, unsure], tables, culling, blocks[unsure]
        )
    # The rest was given up for want of witnesses: nobody knows better than half way.
    exit_at[cut_by < 0] = 0.5
    return Crossings((origin + along * np.clip(exit_at, KEEP_OFF, 1.0 - KEEP_OFF)).T, cut_by)


def _halved(
    origin: Float[np.ndarray, "3 n"],
    along: Float[np.ndarray, "3 n"],
    tables: Sequence[SoftTable],
    culling: Culling,
    blocks: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """(N,) where the sum of the doubts passes the limit, and (N,) the table that doubts most there."""
    inner, outer = np.zeros(origin.shape[1]), np.ones(origin.shape[1])
    asked_by = [culling.may_refuse(table_idx, blocks) for table_idx in range(len(tables))]
    most_by = np.full(len(inner), -1, dtype=np.int16)
    for _ in range(_N_HALVINGS):
        middle = 0.5 * (inner + outer)
        places = origin + along * middle
        total, most = np.zeros(len(inner)), np.zeros(len(inner))
        for table_idx, (table, asked) in enumerate(zip(tables, asked_by, strict=True)):
            doubts, _ = table.doubts(places.take(asked, axis=1))
            total[asked] += doubts
            larger = asked[doubts > most[asked]]
            most_by[larger] = table_idx
            most[larger] = doubts[doubts > most[asked]]
        over = total > LIMIT
        outer, inner = np.where(over, middle, outer), np.where(over, inner, middle)
    return 0.5 * (inner + outer), most_by


def _packed(members: Bool[np.ndarray, "c n"]) -> UInt64[np.ndarray, "w n"]:
    words = np.zeros((-(-len(members) // WORD_BITS), members.shape[1]), dtype=np.uint64)
    for k, row in enumerate(members):
        words[k // WORD_BITS] |= row.astype(np.uint64) << np.uint64(k % WORD_BITS)
    return words
