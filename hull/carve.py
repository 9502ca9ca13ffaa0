"""Adaptive carving: which cells of a grid lie inside every silhouette.

Coarse to fine, as in Szeliski 1993: a cell is asked camera by camera; a cell wholly outside one silhouette is
gone, a cell wholly inside a silhouette never needs that camera again and passes this on to its children, and
only cells that some camera cannot decide are split. Memory and time go with the surface, not with the volume.
The result equals asking every cell's centre in every camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

from hull.stack import stacked
from hull.tables import INSIDE, NO_EVIDENCE, OUTSIDE, SilhouetteTable
from hull.witnesses import WORD_BITS, WitnessRule

# Cells start 2**COARSEST_LEVEL voxels wide: 26 cm at 8 mm, about a limb's length; starting wider saves
# nothing.
COARSEST_LEVEL = 5

# So many cells are split together.
_AT_ONCE = 64_000
# How often the space searched for a person is halved at once.
_FIRST_HALVINGS = 3

_CHILDREN = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.int32).T


def eighths(cells: Int[np.ndarray, "3 n"]) -> Int[np.ndarray, "3 m"]:
    """The eight cells of half the side that fill each cell (3 N), counted in their own size: (3 8N)."""
    return (2 * cells[:, :, None] + _CHILDREN[:, None, :]).reshape(3, -1)


@dataclass(frozen=True, eq=False)
class Grid:
    """Cubic voxels. Voxel (i, j, k) has its centre at low + (i + 1/2, j + 1/2, k + 1/2) * voxel_m, world."""

    low: Float[np.ndarray, " 3"]
    voxel_m: float
    shape: tuple[int, int, int]

    def centres(self, cells: Int[np.ndarray, "3 n"], side: int = 1) -> Float[np.ndarray, "3 n"]:
        """(3 N) world centres of cells (3 N) that are `side` voxels wide and counted in their own size."""
        return self.low[:, None] + (cells + 0.5) * (side * self.voxel_m)


@dataclass(frozen=True, eq=False)
class Blocks:
    """Cubes of cells that are wholly inside: `cells[level]` (3 n) counts in cubes of 2**level voxels."""

    grid: Grid
    cells: tuple[Int[np.ndarray, "3 _"], ...]

    @property
    def n_voxels(self) -> int:
        return sum(cells.shape[1] << (3 * level) for level, cells in enumerate(self.cells))

    def span(self) -> tuple[Int[np.ndarray, " 3"], Int[np.ndarray, " 3"]]:
        """First voxel and one past the last, per axis. There must be some."""
        filled = [(level, cells) for level, cells in enumerate(self.cells) if cells.shape[1]]
        first = np.min([cells.min(axis=1) << level for level, cells in filled], axis=0)
        end = np.max([(cells.max(axis=1) + 1) << level for level, cells in filled], axis=0)
        return first, end

    def dense(self, first: Int[np.ndarray, " 3"], end: Int[np.ndarray, " 3"]) -> Bool[np.ndarray, "x y z"]:
        """The voxels from `first` up to `end` as a bool volume; beyond the grid all is outside."""
        coarsest = 1 << (len(self.cells) - 1)
        # Whole coarsest cubes, so that cubes of every size can be written through a reshaped view.
        low = first // coarsest
        n_coarse = -(-end // coarsest) - low
        volume = np.zeros(n_coarse * coarsest, dtype=bool)
        for level, cells in enumerate(self.cells):
            side = 1 << level
            place = cells - (low * (coarsest >> level))[:, None]
            n = n_coarse * (coarsest >> level)
            keep = ((place >= 0) & (place < n[:, None])).all(axis=0)
            i, j, k = place[:, keep]
            view = volume.reshape(n[0], side, n[1], side, n[2], side)
            view[i, :, j, :, k, :] = True
        a, b = first - low * coarsest, end - low * coarsest
        return volume[a[0] : b[0], a[1] : b[1], a[2] : b[2]]


@dataclass
class _Front:
    """The cells still in question at one level, and what is known of them. Columns are cells.

    Sets of cameras, as bits: `unasked` may still decide, `without` see no part of the cell inside. What is in
    neither sees all of it inside.
    """

    cells: Int[np.ndarray, "3 n"]
    unasked: UInt64[np.ndarray, "w n"]
    without: UInt64[np.ndarray, "w n"]
    n_outside: np.ndarray

    def kept(self, keep: Bool[np.ndarray, " n"]) -> _Front:
        # Three times as fast as picking with the flags themselves.
        chosen = np.flatnonzero(keep)
        known = (self.cells, self.unasked, self.without, self.n_outside)
        return _Front(*(each.take(chosen, axis=-1) for each in known))

    def inside(self, rule: WitnessRule) -> UInt64[np.ndarray, "w n"]:
        return rule.full()[:, None] & ~(self.unasked | self.without)

    def hopeful(self, rule: WitnessRule) -> UInt64[np.ndarray, "w n"]:
        """Who may see some of the cell inside."""
        return rule.full()[:, None] & ~self.without

    def parts(self) -> list[_Front]:
        """In parts that fit into the processor's cache with their children; one at least."""
        known = (self.cells, self.unasked, self.without, self.n_outside)
        starts = range(0, max(self.cells.shape[1], 1), _AT_ONCE)
        return [_Front(*(each[..., start : start + _AT_ONCE] for each in known)) for start in starts]

    @staticmethod
    def of_parts(parts: Sequence[_Front]) -> _Front:
        if len(parts) == 1:
            return parts[0]
        columns = zip(
            *((part.cells, part.unasked, part.without, part.n_outside) for part in parts), strict=True
        )
        return _Front(*(np.concatenate(each, axis=-1) for each in columns))

    def halved(self) -> Int[np.ndarray, "3 m"]:
        """Each cell's eight children, next to each other."""
        return eighths(self.cells)


def carve(tables: Sequence[SilhouetteTable], rule: WitnessRule, grid: Grid, votes: int = 1) -> Blocks:
    """All voxels whose centre fewer than `votes` cameras see outside and enough cameras (`rule`) see inside.

    Equal, voxel for voxel, to asking every centre in every camera.
    """
    coarsest = min(COARSEST_LEVEL, max(int(np.log2(max(grid.shape))), 0))
    front = _first_front(rule, [-(-n >> coarsest) for n in grid.shape])
    found: list[np.ndarray] = []
    order = list(range(len(tables)))
    for level in range(coarsest, 0, -1):
        side = 1 << level
        # Only voxel centres are asked for in the end, so a cell reaches from its first to its last centre.
        half_m = 0.5 * (side - 1) * grid.voxel_m
        sure_cells, open_fronts = [], []
        for part in front.parts():
            cells = part.cells if level == coarsest else part.halved()
            within = np.asarray((cells * side < np.array(grid.shape)[:, None]).all(axis=0))
            asked = _ask(tables, rule, part, cells, within, grid, side, half_m, votes, order)
            decided = np.asarray(~asked.unasked.any(axis=0))
            sure = asked.kept(decided)
            sure_cells.append(sure.cells[:, rule.enough(sure.inside(rule))])
            open_fronts.append(asked.kept(~decided))
        found.append(np.concatenate(sure_cells, axis=1))
        front = _Front.of_parts(open_fronts)
    voxels = []
    for part in front.parts():
        cells = part.halved() if coarsest else part.cells
        within = np.asarray((cells < np.array(grid.shape)[:, None]).all(axis=0))
        chosen = _ask_voxels(tables, rule, part, cells, within, grid, votes, order)
        voxels.append(cells.take(chosen, axis=1))
    found.append(np.concatenate(voxels, axis=1))
    found = found[::-1]
    cut_at_the_grid(found, grid)
    return Blocks(grid, tuple(found))


def possible_witnesses(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    grid: Grid,
    votes: int,
    within: tuple[Int[np.ndarray, " 3"], Int[np.ndarray, " 3"]] | None = None,
) -> Int[np.ndarray, "x y z"]:
    """How many cameras may see each cell of the grid inside; 0 where it surely holds nothing of the hull.

    Conservative: cells are asked whole, down to the grid's own, and those that stay in question count. So
    everything that `carve` could find at any resolution lies in a cell that is not 0. `within`: first cell
    and one past the last of the part to be looked at; the rest stays 0.
    """
    # From so few cells a side on, some can be decided: larger ones fill whole pictures.
    coarsest = max(int(np.log2(min(grid.shape))) - _FIRST_HALVINGS, 0)
    front = _first_front(rule, [-(-n >> coarsest) for n in grid.shape])
    cells = front.cells
    found = np.zeros([-(-n >> coarsest) << coarsest for n in grid.shape], dtype=np.int32)
    order = list(range(len(tables)))
    for level in range(coarsest, -1, -1):
        side = 1 << level
        alive = np.ones(cells.shape[1], dtype=bool)
        if within is not None:
            low, high = within
            alive &= ((cells + 1) * side > low[:, None]).all(axis=0)
            alive &= (cells * side < high[:, None]).all(axis=0)
        half_m = 0.5 * side * grid.voxel_m
        front = _ask(tables, rule, front, cells, alive, grid, side, half_m, votes, order)
        final = np.full(front.cells.shape[1], level == 0) | ~front.unasked.any(axis=0)
        count = np.bitwise_count(front.hopeful(rule)).sum(axis=0, dtype=np.int32)[final]
        i, j, k = front.cells[:, final]
        nx, ny, nz = (n // side for n in found.shape)
        found.reshape(nx, side, ny, side, nz, side)[i, :, j, :, k, :] = count[:, None, None, None]
        front = front.kept(~final)
        cells = front.halved()
    nx, ny, nz = grid.shape
    return found[:nx, :ny, :nz]


def cells_in_question(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    grid: Grid,
    cells: Int[np.ndarray, "3 n"],
    side: int,
    votes: int,
) -> Bool[np.ndarray, " n"]:
    """(N,) which cells, `side` voxels wide and counted in their own size, cameras that are asked about the
    whole of them leave in question: nothing of the hull's surface lies in the others."""
    n, full = cells.shape[1], rule.full()
    front = _Front(
        np.ascontiguousarray(cells, dtype=np.int32),
        np.repeat(full[:, None], n, axis=1),
        np.zeros((len(full), n), dtype=np.uint64),
        np.zeros(n, dtype=np.uint8),
    )
    alive, half_m, order = np.ones(n, dtype=bool), 0.5 * side * grid.voxel_m, list(range(len(tables)))
    asked = _ask(tables, rule, front, front.cells, alive, grid, side, half_m, votes, order)
    left = asked.cells[:, asked.unasked.any(axis=0)]
    if not left.shape[1]:
        return np.zeros(n, dtype=bool)
    low = cells.min(axis=1)[:, None]
    shape = np.ptp(cells, axis=1) + 1
    return np.isin(*(np.ravel_multi_index(tuple(each - low), shape) for each in (cells, left)))


def _first_front(rule: WitnessRule, n: Sequence[int]) -> _Front:
    cells = np.stack(np.meshgrid(*[np.arange(k, dtype=np.int32) for k in n], indexing="ij")).reshape(3, -1)
    full = rule.full()
    return _Front(
        cells,
        np.repeat(full[:, None], cells.shape[1], axis=1),
        np.zeros((len(full), cells.shape[1]), dtype=np.uint64),
        np.zeros(cells.shape[1], dtype=np.uint8),
    )


def _asked(front: _Front, camera: int, alive: Bool[np.ndarray, " m"]) -> Int[np.ndarray, " k"]:
    """Which of the cells a camera is to be asked about: those alive whose parents (the front) it has not
    decided. Parents are looked through instead of their eight times as many children."""
    family = len(alive) // max(front.cells.shape[1], 1)
    bit = np.uint64(1) << np.uint64(camera % WORD_BITS)
    parents = np.flatnonzero(front.unasked[camera // WORD_BITS] & bit)
    chosen = (parents[:, None] * family + np.arange(family)).ravel()
    return chosen.take(np.flatnonzero(alive.take(chosen)))


def _ask(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    parents: _Front,
    cells: Int[np.ndarray, "3 n"],
    alive: Bool[np.ndarray, " n"],
    grid: Grid,
    side: int,
    half_m: float,
    votes: int,
    order: list[int],
) -> _Front:
    """The front of those cells (the parents' own, or their children) that are not known to be outside.

    Cells are `side` voxels wide; what reaches `half_m` around their centres is asked about. `alive` is
    written into. Sorts `order`, so that the camera that rejects most is asked first on the next level.
    """
    stack = stacked(tables)
    known = (parents.unasked, parents.without, parents.n_outside)
    if stack is not None:
        known_now = [np.empty((*each.shape[:-1], cells.shape[1]), dtype=each.dtype) for each in known]
        n_asked, n_rejected, blind = stack.loops.ask_children(
            stack.numbers,
            stack.projections,
            np.array(order),
            *known,
            cells,
            alive,
            grid.low,
            side * grid.voxel_m,
            half_m,
            votes,
            *known_now,
        )
        front = _Front(cells.astype(np.int32, copy=False), *known_now)
        rejects = n_rejected / np.maximum(n_asked, 1)
        hopeless = votes > 1 or blind
    else:
        front, rejects, hopeless = _ask_plainly(
            tables, parents, cells, alive, grid.centres(cells, side), half_m, votes, order
        )
    order.sort(key=lambda camera: -float(rejects[camera]))
    front = front.kept(alive)
    if hopeless:
        # Space that too few cameras can still vouch for is given up early, or it would be split to the end.
        front = front.kept(rule.enough(front.hopeful(rule)))
    return front


def _ask_plainly(
    tables: Sequence[SilhouetteTable],
    parents: _Front,
    cells: Int[np.ndarray, "3 n"],
    alive: Bool[np.ndarray, " n"],
    centres: Float[np.ndarray, "3 n"],
    half_m: float,
    votes: int,
    order: Sequence[int],
) -> tuple[_Front, Float[np.ndarray, " c"], bool]:
    """What is known of the cells when all have been asked about them; the share that each camera saw outside;
    and whether some camera can see nothing of one that it does not see outside."""
    family = cells.shape[1] // max(parents.cells.shape[1], 1)
    front = _Front(
        cells.astype(np.int32, copy=False),
        *(
            np.repeat(known, family, axis=-1)
            for known in (parents.unasked, parents.without, parents.n_outside)
        ),
    )
    hopeless = votes > 1
    rejects = np.zeros(len(tables))
    for camera in order:
        word, bit = camera // WORD_BITS, np.uint64(1) << np.uint64(camera % WORD_BITS)
        asked = _asked(parents, camera, alive)
        if not len(asked):
            continue
        answers = tables[camera].ask_cells(centres.take(asked, axis=1), half_m)
        outside = asked[answers == OUTSIDE]
        front.unasked[word, asked[answers == INSIDE]] &= ~bit
        if votes == 1:
            alive[outside] = False
        else:
            front.n_outside[outside] += 1
            alive[outside[front.n_outside[outside] >= votes]] = False
            front.unasked[word, outside] &= ~bit
            front.without[word, outside] |= bit
        if (answers & NO_EVIDENCE).any():
            front.unasked[word, asked[answers == NO_EVIDENCE]] &= ~bit
            never = asked[(answers & INSIDE) == 0]
            front.without[word, never] |= bit
            hopeless = hopeless or len(never) > len(outside)
        rejects[camera] = len(outside) / len(asked)
    return front, rejects, hopeless


def _ask_voxels(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    parents: _Front,
    cells: Int[np.ndarray, "3 n"],
    alive: Bool[np.ndarray, " n"],
    grid: Grid,
    votes: int,
    order: Sequence[int],
) -> Int[np.ndarray, " k"]:
    """Which (K,) of the parents' voxels (`cells`) belong to the hull. `alive` is written into."""
    stack = stacked(tables)
    if stack is not None:
        excepted = np.zeros((len(parents.unasked), cells.shape[1]), dtype=np.uint64)
        stack.loops.ask_voxels(
            stack.numbers,
            stack.projections,
            np.array(order),
            parents.unasked,
            parents.n_outside,
            cells,
            alive,
            grid.low,
            grid.voxel_m,
            votes,
            excepted,
        )
    else:
        excepted = _ask_voxels_plainly(tables, parents, alive, grid.centres(cells), votes, order)
    family = len(alive) // max(parents.cells.shape[1], 1)
    # Whoever has been asked and has not refused sees a voxel inside, with few exceptions; so whether there
    # are enough witnesses is a question about the parents.
    settled = _Front(parents.cells, np.zeros_like(parents.unasked), parents.without, parents.n_outside)
    inside = settled.inside(rule)
    alive &= np.repeat(rule.enough(inside), family)
    odd = np.flatnonzero(alive & (excepted != 0).any(axis=0))
    if len(odd):
        alive[odd] = rule.enough(inside[:, odd // family] & ~excepted[:, odd])
    return np.flatnonzero(alive)


def _ask_voxels_plainly(
    tables: Sequence[SilhouetteTable],
    parents: _Front,
    alive: Bool[np.ndarray, " n"],
    centres: Float[np.ndarray, "3 n"],
    votes: int,
    order: Sequence[int],
) -> UInt64[np.ndarray, "w n"]:
    """For each voxel the set of cameras that were asked and do not see it inside. `alive` is written into."""
    family = len(alive) // max(parents.cells.shape[1], 1)
    excepted = np.zeros((len(parents.unasked), len(alive)), dtype=np.uint64)
    n_outside = np.repeat(parents.n_outside, family)
    for camera in order:
        asked = _asked(parents, camera, alive)
        if not len(asked):
            continue
        answers = tables[camera].ask_points(centres.take(asked, axis=1))
        outside = asked[answers == OUTSIDE]
        n_outside[outside] += 1
        alive[outside[n_outside[outside] >= votes]] = False
        word, bit = camera // WORD_BITS, np.uint64(1) << np.uint64(camera % WORD_BITS)
        excepted[word, asked[answers != INSIDE]] |= bit
    return excepted


def cut_at_the_grid(cells: list[np.ndarray], grid: Grid) -> None:
    """Cubes that reach over the grid's far sides are replaced by their voxels inside it (in place)."""
    shape = np.array(grid.shape)[:, None]
    for level in range(len(cells) - 1, 0, -1):
        over = (((cells[level] + 1) << level) > shape).any(axis=0)
        if over.any():
            halves = eighths(cells[level][:, over])
            halves = halves[:, ((halves << (level - 1)) < shape).all(axis=0)]
            cells[level - 1] = np.concatenate([cells[level - 1], halves.astype(np.int32)], axis=1)
            cells[level] = cells[level][:, ~over]
