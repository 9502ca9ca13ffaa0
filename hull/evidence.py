"""Does the hull explain every silhouette? Lines of sight that miss it, and who stands against them.

Whatever a silhouette shows as person must be covered by the hull: the line of sight through such a pixel
meets the subject, and the subject lies inside the hull. So a line just inside an outline that misses the hull
is a contradiction between cameras, however the cameras stand; where nothing is wrong there are none. Along
such a line the places that the fewest cameras refuse tell who is to blame: where one single camera refuses,
either that one lacks something or the line's own camera shows too much (many lines of many cameras decide
between them); where two and more refuse everywhere, the line's own camera is the odd one.

Leaving a camera out and comparing volumes would not do: a camera that stands alone rightly cuts much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hull.bounds import Bounds
from hull.rays import RayScene
from hull.tables import BLOCK_PX, INSIDE, OUTSIDE, SilhouetteTable
from hull.witnesses import WORD_BITS, WitnessRule

# Lines of sight in all: an even share for each camera, but no fewer and no more than so many.
_N_LINES, _FEWEST, _MOST = 12_000, 120, 400
# Lines that miss the hull are looked into one by one, up to so many.
_N_EXAMINED = 800
_STEP_M = 0.01
# Beyond the box that was carved, people are looked for, not fingers.
_FAR_STEP_M = 0.04
# More refusals than this are not told apart.
_N_REFUSALS = 3
# A place that a camera refuses counts as deep where all around it, this far, is background too: at least so
# many pixels, so that ragged outlines and calibration do not reach it.
DEEP_M, _DEEP_PX = 0.015, 3.0


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of sight through person pixels. Tables are counted in the order they are given.

    Fields
    ------
    table : (N,) the table a line belongs to.
    origin : (N 3) that camera's centre, world metres.
    way : (N 3) unit direction.
    """

    table: Int[np.ndarray, " n"]
    origin: Float[np.ndarray, "n 3"]
    way: Float[np.ndarray, "n 3"]

    def chosen(self, which: np.ndarray) -> Lines:
        return Lines(self.table[which], self.origin[which], self.way[which])


@dataclass(frozen=True, eq=False)
class MissedLines:
    """Lines of sight that miss the hull, and what stands against them. M lines, C tables.

    Fields
    ------
    table : (M,) whose line it is.
    scale : so many missed lines each of these stands for.
    suspect : (M C) 1 where this table alone forbids some place on the line, 1/2 where it does so with one
        other and none does alone; 0 elsewhere.
    deep : (M C) whether it forbids such a place deeply.
    refused : (M,) two or more cameras refuse wherever enough could see.
    unseen : (M,) there is a place that nobody refuses and too few cameras see.
    elsewhere : (M,) there is a place outside the carved box that nobody refuses and enough cameras see.
    left : (M,) too few cameras refuse a place inside the box to cut it: it is thinner than the grid, or in a
        piece that was left out.
    place : (M 3) a place on the line that the fewest refuse, world metres.
    """

    table: Int[np.ndarray, " m"]
    scale: float
    suspect: Float[np.ndarray, "m c"]
    deep: Bool[np.ndarray, "m c"]
    refused: Bool[np.ndarray, " m"]
    unseen: Bool[np.ndarray, " m"]
    elsewhere: Bool[np.ndarray, " m"]
    left: Bool[np.ndarray, " m"]
    place: Float[np.ndarray, "m 3"]


def lines_of_sight(tables: Sequence[SilhouetteTable]) -> Lines:
    """Lines through blocks of pixels that are person throughout: most along the outline, some further in."""
    n_each = int(np.clip(_N_LINES // max(len(tables), 1), _FEWEST, _MOST))
    owners, ways = [], []
    for number, table in enumerate(tables):
        solid = table.squares[0] == INSIDE
        core = solid.copy()
        core[1:] &= solid[:-1]
        core[:-1] &= solid[1:]
        core[:, 1:] &= solid[:, :-1]
        core[:, :-1] &= solid[:, 1:]
        rim, inner = np.flatnonzero(solid & ~core), np.flatnonzero(core)
        chosen = np.concatenate([_spread(rim, (3 * n_each) // 4), _spread(inner, n_each // 4)])
        ways.append(ways_through(table, chosen))
        owners.append(np.full(len(chosen), number))
    owner = np.concatenate(owners)
    return Lines(owner, np.array([table.centre for table in tables])[owner], np.concatenate(ways))


def ways_through(table: SilhouetteTable, blocks: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """(N 3) unit directions through the middles of blocks, which are counted along `table.squares[0]`."""
    row, column = np.divmod(blocks, table.squares.shape[2])
    # A block holds four codes, and a code reaches one pixel further.
    pixels = (np.stack([column, row]) + 0.5) * BLOCK_PX + np.array(table.origin)[:, None]
    way = np.linalg.solve(table.projection[:, :3], np.vstack([pixels, np.ones(len(blocks))])).T
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def missed_lines(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    bounds: Bounds,
    scene: RayScene | None,
    votes: int = 1,
) -> tuple[Int[np.ndarray, " c"], MissedLines]:
    """(C,) how many lines each table has, and those that miss the surface. `scene` None: nothing is left.

    `votes` : so many cameras had to refuse a place to cut it; one fewer contradicts nobody.
    """
    lines = lines_of_sight(tables)
    n_lines = np.bincount(lines.table, minlength=len(tables))
    missed = np.arange(len(lines.table))
    if scene is not None:
        missed = np.flatnonzero(~scene.meets(lines.origin, lines.way))
    return n_lines, _examined(lines.chosen(missed), tables, rule, bounds, votes)


def _examined(
    lines: Lines, tables: Sequence[SilhouetteTable], rule: WitnessRule, bounds: Bounds, votes: int
) -> MissedLines:
    n_missed = len(lines.table)
    lines = lines.chosen(_spread(np.arange(n_missed), _N_EXAMINED))
    n = len(lines.table)
    enter, leave = within_box(lines, bounds.low, bounds.high)
    line, points = _steps(lines, enter, leave, _STEP_M)
    near = _refusals(points, tables, rule)
    least = np.full(n, _N_REFUSALS + 1)
    np.minimum.at(least, line, near.count)
    unseen = np.zeros(n, dtype=bool)
    unseen[line[near.unseen]] = True

    suspect = np.zeros((n, len(tables)))
    deep = np.zeros((n, len(tables)), dtype=bool)
    best = np.flatnonzero(near.count == least[line])
    place = np.zeros((n, 3))
    place[line[best]] = points[:, best].T
    for count, weight in ((1, 1.0), (2, 0.5)):
        accused = best[least[line[best]] == count]
        for k in range(count):
            suspect[line[accused], near.who[k, accused]] = weight
        if count == 1:
            for number in np.unique(near.who[0, accused]):
                mine = accused[near.who[0, accused] == number]
                solid = _deep_outside(tables[number], points[:, mine])
                deep[line[mine[solid]], number] = True
    elsewhere = np.zeros(n, dtype=bool)
    open_ = np.flatnonzero((least >= votes) & ~unseen)
    if len(open_):
        elsewhere[open_], far = _explained_outside(lines.chosen(open_), tables, rule, bounds)
        place[open_[elsewhere[open_]]] = far[elsewhere[open_]]
    told = (least >= votes) & ~unseen & ~elsewhere
    suspect[~told], deep[~told] = 0.0, False
    return MissedLines(
        table=lines.table,
        scale=n_missed / max(n, 1),
        suspect=suspect,
        deep=deep,
        refused=told & (least >= 2),
        unseen=unseen & (least >= votes),
        elsewhere=elsewhere,
        left=least < votes,
        place=place,
    )


@dataclass(frozen=True, eq=False)
class _Refusals:
    """count (N,) cameras that refuse a place, _N_REFUSALS for more, one more where too few see it; who (2 N)
    the first two of them; unseen (N,): none refuses, too few see it."""

    count: Int[np.ndarray, " n"]
    who: Int[np.ndarray, "2 n"]
    unseen: Bool[np.ndarray, " n"]


def _refusals(
    points: Float[np.ndarray, "3 n"], tables: Sequence[SilhouetteTable], rule: WitnessRule
) -> _Refusals:
    count = np.zeros(points.shape[1], dtype=np.int64)
    who = np.full((2, points.shape[1]), -1)
    sets = np.zeros((len(rule.full()), points.shape[1]), dtype=np.uint64)
    alive = np.arange(points.shape[1])
    # Neighbouring cameras refuse the same places: by strides, most places are decided sooner.
    for number in np.argsort(np.arange(len(tables)) * 0.618034 % 1.0):
        if not len(alive):
            break
        answers = tables[number].ask_points(points[:, alive])
        refused = alive[answers == OUTSIDE]
        for k in range(2):
            who[k, refused[count[refused] == k]] = number
        count[refused] += 1
        sets[number // WORD_BITS, alive[answers == INSIDE]] |= np.uint64(1) << np.uint64(number % WORD_BITS)
        alive = alive[count[alive] < _N_REFUSALS]
    enough = rule.enough(sets)
    return _Refusals(
        np.where(enough | (count == _N_REFUSALS), count, _N_REFUSALS + 1), who, (count == 0) & ~enough
    )


def _explained_outside(
    lines: Lines, tables: Sequence[SilhouetteTable], rule: WitnessRule, bounds: Bounds
) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """(N,) whether a line passes a place beyond the box that all who see it call inside, and (N 3) where."""
    reach = float(np.median(np.linalg.norm([t.centre - bounds.centre for t in tables], axis=1)))
    enter, leave = within_box(lines, bounds.centre - reach, bounds.centre + reach)
    line, points = _steps(lines, np.maximum(enter, 0.1 * reach), leave, _FAR_STEP_M)
    beyond = ((points < bounds.low[:, None]) | (points > bounds.high[:, None])).any(axis=0)
    line, points = line[beyond], points[:, beyond]
    free = np.flatnonzero(_refusals(points, tables, rule).count == 0)
    found = np.zeros(len(lines.table), dtype=bool)
    found[line[free]] = True
    place = np.zeros((len(lines.table), 3))
    place[line[free]] = points[:, free].T
    return found, place


def _deep_outside(table: SilhouetteTable, points: Float[np.ndarray, "3 n"]) -> Bool[np.ndarray, " n"]:
    depth = table.projection[2, :3] @ points + table.projection[2, 3]
    focal = np.linalg.norm(table.projection[0, :3])
    half_m = max(DEEP_M, _DEEP_PX * float(np.median(depth)) / float(focal))
    return table.ask_cells(points, half_m) == OUTSIDE


def within_box(
    lines: Lines, low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """(N,) metres along each line where it enters and leaves a box; the second is smaller where it misses."""
    way = np.where(np.abs(lines.way) < 1e-12, 1e-12, lines.way)
    one, other = (low - lines.origin) / way, (high - lines.origin) / way
    return np.maximum(np.minimum(one, other).max(axis=1), 0.0), np.maximum(one, other).min(axis=1)


def _steps(
    lines: Lines, enter: Float[np.ndarray, " n"], leave: Float[np.ndarray, " n"], step_m: float
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "3 k"]]:
    """Points every `step_m` along each line: the line's number (K,) and the points (3 K)."""
    n = np.maximum(np.ceil((leave - enter) / step_m), 0).astype(np.int64)
    line = np.repeat(np.arange(len(n)), n)
    along = enter[line] + step_m * (np.arange(len(line)) - np.repeat(np.cumsum(n) - n, n) + 0.5)
    return line, (lines.origin[line] + lines.way[line] * along[:, None]).T


def _spread(numbers: Int[np.ndarray, " n"], n: int) -> Int[np.ndarray, " m"]:
    """At most `n` of the numbers, evenly picked."""
    if len(numbers) <= n:
        return numbers
    return numbers[(np.arange(n) * len(numbers)) // n]
