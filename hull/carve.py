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

from hull.tables import INSIDE, NO_EVIDENCE, OUTSIDE, SilhouetteTable
from hull.witnesses import WORD_BITS, WitnessRule

# Cells start 2**COARSEST_LEVEL voxels wide: 26 cm at 8 mm, about a limb's length; starting wider saves
# nothing.
COARSEST_LEVEL = 5

_CHILDREN = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.int32).T


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

    Sets of cameras, as bits: `unasked` may still decide, `inside` see all of the cell inside, `hopeful` may
    see some of it inside (so they hold the `inside` ones).
    """

    cells: Int[np.ndarray, "3 n"]
    unasked: UInt64[np.ndarray, "w n"]
    inside: UInt64[np.ndarray, "w n"]
    hopeful: UInt64[np.ndarray, "w n"]
    n_outside: np.ndarray

    def kept(self, keep: np.ndarray) -> _Front:
        sets = (self.unasked[:, keep], self.inside[:, keep], self.hopeful[:, keep])
        return _Front(self.cells[:, keep], *sets, self.n_outside[keep])

    def children(self) -> _Front:
        cells = (2 * self.cells[:, :, None] + _CHILDREN[:, None, :]).reshape(3, -1)
        known = (self.unasked, self.inside, self.hopeful, self.n_outside)
        repeat = [np.repeat(a, 8, axis=-1) for a in known]
        return _Front(cells.astype(np.int32), *repeat)


def carve(tables: Sequence[SilhouetteTable], rule: WitnessRule, grid: Grid, votes: int = 1) -> Blocks:
    """All voxels whose centre fewer than `votes` cameras see outside and enough cameras (`rule`) see inside.

    Equal, voxel for voxel, to asking every centre in every camera.
    """
    coarsest = min(COARSEST_LEVEL, max(int(np.log2(max(grid.shape))), 0))
    front = _first_front(rule, [-(-n >> coarsest) for n in grid.shape])
    found: list[np.ndarray] = []
    order = list(range(len(tables)))
    for level in range(coarsest, -1, -1):
        side = 1 << level
        # Only voxel centres are asked for in the end, so a cell reaches from its first to its last centre.
        half_m = 0.5 * (side - 1) * grid.voxel_m
        within = np.asarray((front.cells * side < np.array(grid.shape)[:, None]).all(axis=0))
        front = _ask(
            tables, rule, front.kept(within), grid.centres(front.cells[:, within], side), half_m, votes, order
        )
        decided = np.asarray(~front.unasked.any(axis=0))
        sure = np.flatnonzero(decided)
        found.append(front.cells[:, sure[rule.enough(front.inside[:, sure])]])
        if level:
            front = front.kept(~decided).children()
    cells = found[::-1]
    _cut_at_the_grid(cells, grid)
    return Blocks(grid, tuple(cells))


def possible_witnesses(
    tables: Sequence[SilhouetteTable], rule: WitnessRule, grid: Grid, votes: int
) -> Int[np.ndarray, "x y z"]:
    """How many cameras may see each cell of the grid inside; 0 where it surely holds nothing of the hull.

    Conservative: cells are asked whole, down to the grid's own, and those that stay in question count. So
    everything that `carve` could find at any resolution lies in a cell that is not 0.
    """
    coarsest = int(np.log2(min(grid.shape)))
    front = _first_front(rule, [-(-n >> coarsest) for n in grid.shape])
    found = np.zeros([-(-n >> coarsest) << coarsest for n in grid.shape], dtype=np.int32)
    order = list(range(len(tables)))
    for level in range(coarsest, -1, -1):
        side = 1 << level
        centres = grid.centres(front.cells, side)
        front = _ask(tables, rule, front, centres, 0.5 * side * grid.voxel_m, votes, order)
        final = np.full(front.cells.shape[1], level == 0) | ~front.unasked.any(axis=0)
        count = np.bitwise_count(front.hopeful).sum(axis=0, dtype=np.int32)[final]
        i, j, k = front.cells[:, final]
        nx, ny, nz = (n // side for n in found.shape)
        found.reshape(nx, side, ny, side, nz, side)[i, :, j, :, k, :] = count[:, None, None, None]
        front = front.kept(~final).children()
    nx, ny, nz = grid.shape
    return found[:nx, :ny, :nz]


def _first_front(rule: WitnessRule, n: Sequence[int]) -> _Front:
    cells = np.stack(np.meshgrid(*[np.arange(k, dtype=np.int32) for k in n], indexing="ij")).reshape(3, -1)
    full = rule.full()
    return _Front(
        cells,
        np.repeat(full[:, None], cells.shape[1], axis=1),
        np.zeros((len(full), cells.shape[1]), dtype=np.uint64),
        np.repeat(full[:, None], cells.shape[1], axis=1),
        np.zeros(cells.shape[1], dtype=np.uint8),
    )


def _ask(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    front: _Front,
    centres: Float[np.ndarray, "3 n"],
    half_m: float,
    votes: int,
    order: list[int],
) -> _Front:
    """The front without the cells that are now known to be outside.

    Sorts `order`, so that the camera that rejects most is asked first on the next level.
    """
    alive = np.ones(centres.shape[1], dtype=bool)
    hopeless = False
    n_rejected = np.zeros(len(tables))
    n_asked = np.zeros(len(tables))
    for camera in order:
        word, bit = camera // WORD_BITS, np.uint64(1) << np.uint64(camera % WORD_BITS)
        selected = np.flatnonzero(alive & ((front.unasked[word] & bit) != 0))
        if not len(selected):
            continue
        points = centres[:, selected]
        answers = (
            tables[camera].ask_points(points) if half_m == 0 else tables[camera].ask_cells(points, half_m)
        )
        outside = selected[answers == OUTSIDE]
        if votes == 1:
            alive[outside] = False
        else:
            front.n_outside[outside] += 1
            alive[outside[front.n_outside[outside] >= votes]] = False
            front.unasked[word, outside] &= ~bit
        inside = selected[answers == INSIDE]
        front.inside[word, inside] |= bit
        front.unasked[word, inside] &= ~bit
        blind = selected[answers == NO_EVIDENCE]
        front.unasked[word, blind] &= ~bit
        never = selected[(answers & INSIDE) == 0]
        front.hopeful[word, never] &= ~bit
        hopeless = hopeless or len(never) > len(outside)
        n_asked[camera] = len(selected)
        n_rejected[camera] = len(outside)
    rejects = n_rejected / np.maximum(n_asked, 1)
    order.sort(key=lambda camera: -float(rejects[camera]))
    front = front.kept(alive)
    if hopeless or votes > 1:
        # Space that too few cameras can still vouch for is given up early, or it would be split to the end.
        front = front.kept(rule.enough(front.hopeful))
    return front


def _cut_at_the_grid(cells: list[np.ndarray], grid: Grid) -> None:
    """Cubes that reach over the grid's far sides are replaced by their voxels inside it (in place)."""
    shape = np.array(grid.shape)[:, None]
    for level in range(len(cells) - 1, 0, -1):
        over = (((cells[level] + 1) << level) > shape).any(axis=0)
        if over.any():
            halves = (2 * cells[level][:, over][:, :, None] + _CHILDREN[:, None, :]).reshape(3, -1)
            halves = halves[:, ((halves << (level - 1)) < shape).all(axis=0)]
            cells[level - 1] = np.concatenate([cells[level - 1], halves.astype(np.int32)], axis=1)
            cells[level] = cells[level][:, ~over]
