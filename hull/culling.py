"""Which cameras need not be asked about a place.

Near most of the hull's surface only few cameras have an outline; the others see the whole neighbourhood
inside (or not at all), and asking them point by point is what a plain hull spends most of its time on. Space
is cut into blocks of a few voxels; each block that a question falls into is asked once as a whole cell, by
every camera, and the answers hold for all the points in it. Nothing changes but the time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from hull.carve import Grid
from hull.stack import stacked
from hull.tables import INSIDE, NO_EVIDENCE, OUTSIDE, SilhouetteTable

# Voxels a block's side. Smaller blocks spare more questions about points and ask more about blocks.
BLOCK_VOXELS = 4
# In voxels: how far from the place that names the block a question may be asked.
REACH_VOXELS = 0.55


class Culling:
    """The answers of all cameras (tables) about blocks of a grid, asked when first needed."""

    def __init__(self, tables: Sequence[SilhouetteTable], grid: Grid) -> None:
        self.tables = tuple(tables)
        # A vertex lies up to a voxel beyond the voxels' centres, and ridges are raised a little further.
        nx, ny, nz = grid.shape
        self._blocks = Grid(
            grid.low - BLOCK_VOXELS * grid.voxel_m,
            BLOCK_VOXELS * grid.voxel_m,
            (nx // BLOCK_VOXELS + 3, ny // BLOCK_VOXELS + 3, nz // BLOCK_VOXELS + 3),
        )
        self._half_m = (0.5 * BLOCK_VOXELS + REACH_VOXELS) * grid.voxel_m
        self._number = np.full(int(np.prod(self._blocks.shape)), -1, dtype=np.int32)
        self._answers = np.zeros((len(self.tables), 0), dtype=np.uint8)
        self._may_refuse = np.zeros((len(self.tables), 0), dtype=bool)
        self._refusing = _lists_of(self._may_refuse)
        self.stack = stacked(self.tables)

    def blocks_of(self, places: Float[np.ndarray, "3 n"]) -> Int[np.ndarray, " n"]:
        """(N,) the block of each place (3 N), world metres: a number for `may_refuse` and `may_be_blind`."""
        low, shape = self._blocks.low, self._blocks.shape
        per_m = 1.0 / self._blocks.voxel_m
        if self.stack is not None:
            name = np.empty(places.shape[1], dtype=np.intp)
            self.stack.loops.name_blocks(places, low, per_m, shape, name)
        else:
            i, j, k = ((places[axis] - low[axis]) * per_m for axis in range(3))
            name = i.astype(np.intp)
            for axis, place in ((1, j), (2, k)):
                name *= shape[axis]
                name += place.astype(np.intp)
        number = self._number.take(name)
        if number.size and number.min() < 0:
            self._ask(np.unique(name[number < 0]))
            number = self._number.take(name)
        return number

    def may_refuse(self, table_idx: int, blocks: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
        """Which (M,) of the blocks (N,) this camera may see outside, in part at least."""
        return np.flatnonzero(self._may_refuse[table_idx].take(blocks))

    def evidence(
        self, table_idx: int, blocks: Int[np.ndarray, " n"]
    ) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, " m"]]:
        """(N,) whether this camera gives evidence about the blocks, and which (M,) of them are to be asked
        point by point, since it does so in part only."""
        answers = self._answers[table_idx].take(blocks)
        return answers & NO_EVIDENCE == 0, np.flatnonzero(answers > NO_EVIDENCE)

    def may_be_outlined(self, table_idx: int, blocks: Int[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
        """Which (M,) of the blocks (N,) this camera's outline may pass through."""
        mixed = INSIDE | OUTSIDE
        return np.flatnonzero((self._answers[table_idx] & mixed == mixed).take(blocks))

    def outlined(
        self,
    ) -> tuple[Int[np.ndarray, " b"], tuple[Int[np.ndarray, " b1"], Int[np.ndarray, " n"]]]:
        """For each block asked so far: how many tables see all of it inside or all of it outside; and those
        whose answer differs from place to place, listed as in `refusing`."""
        decided = (self._answers == INSIDE) | (self._answers == OUTSIDE)
        unsure = ~decided & (self._answers != NO_EVIDENCE)
        return np.count_nonzero(decided, axis=0), _lists_of(unsure)

    @property
    def answers(self) -> UInt8[np.ndarray, "c b"]:
        """What each table says of each block asked so far."""
        return self._answers

    @property
    def refusing(self) -> tuple[Int[np.ndarray, " b1"], Int[np.ndarray, " n"]]:
        """The tables that may see some of a block outside, block after block, and where those of each end:
        those of block b lie from `ends[b]` to `ends[b + 1]`."""
        return self._refusing

    def _ask(self, names: Int[np.ndarray, " n"]) -> None:
        self._number[names] = self._answers.shape[1] + np.arange(len(names), dtype=np.int32)
        cells = np.stack(np.unravel_index(names, self._blocks.shape))
        centres = self._blocks.centres(cells)
        if self.stack is not None:
            loops, numbers, projections = self.stack.loops, self.stack.numbers, self.stack.projections
            answers = np.empty((len(self.tables), len(names)), dtype=np.uint8)
            loops.ask_cells(numbers, projections, centres, self._half_m, answers)
        else:
            answers = np.stack([table.ask_cells(centres, self._half_m) for table in self.tables])
        self._answers = np.concatenate([self._answers, answers], axis=1)
        self._may_refuse = self._answers & OUTSIDE != 0
        ends, who = _lists_of(answers & OUTSIDE != 0)
        self._refusing = (
            np.concatenate([self._refusing[0], self._refusing[0][-1] + ends[1:]]),
            np.concatenate([self._refusing[1], who]),
        )


def _lists_of(flags: Bool[np.ndarray, "c n"]) -> tuple[Int[np.ndarray, " n1"], Int[np.ndarray, " m"]]:
    """The rows flagged in each column, column after column, and where those of each column begin and end."""
    who = np.nonzero(np.ascontiguousarray(flags.T))[1]
    return np.concatenate([[0], np.cumsum(np.count_nonzero(flags, axis=0))]), who
