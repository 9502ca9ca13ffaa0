"""Where a grid is too coarse: fingers between its points, and gaps that it bridges.

What is thin in space is thin in some picture. There the lines of sight are followed through the grid, and the
cells they pass are asked at their halves: where an edge, a face or a whole cell is otherwise in its middle
than at all its corners, the cell is to be halved.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt64
from scipy.spatial import cKDTree

from hull.carve import Grid, cells_in_question
from hull.culling import Culling
from hull.evidence import Lines, ways_through, within_box
from hull.finer_cells import Inside, interior, named, placed, with_finer_cells
from hull.marching import GridSurface
from hull.ridges import pixel_at
from hull.surface import AT_ONCE, Crossings
from hull.tables import BLOCK_PX, INSIDE, OUTSIDE, SilhouetteTable
from hull.witnesses import WORD_BITS, WitnessRule

# Of a person nothing falls between the points of a grid as fine as this: a finger is three voxels thick.
FINE_ENOUGH_M = 0.005
# What is narrower than this in a picture may fall between the grid's points.
_THIN_VOXELS = 4.0
# Lines of sight for all cameras together, and the cells followed along them, in voxels, each in the last.
_N_LINES, _MOST_TABLES, _SIDES = 6000, 16, (16, 4, 1)
# How often the cells in question are halved.
_N_HALVINGS = 2

_PLACES = np.array([[x, y, z] for x in range(3) for y in range(3) for z in range(3)])
_AROUND = _PLACES - 1


def _between() -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Each place of a halved cell that is no corner, with the corners of the edge, face or cell it halves."""
    corners = [k for k in range(27) if (_PLACES[k] != 1).all()]
    return tuple(
        (k, tuple(c for c in corners if ((_PLACES[c] == _PLACES[k]) | (_PLACES[k] == 1)).all()))
        for k in range(27)
        if k not in corners
    )


_BETWEEN = _between()


def with_thin_parts(
    surface: GridSurface, grid: Grid, culling: Culling, rule: WitnessRule, votes: int = 1
) -> tuple[GridSurface, Grid]:
    """The surface of a grid's voxels with the cells halved that need it, and the grid it then counts in."""
    cells, allowed = thin_cells(culling.tables, rule, grid, votes), None
    grids: tuple[Grid, ...] = (grid,)
    for _ in range(_N_HALVINGS):
        finer = (*grids, halved(grids[-1]))

        def inside(at: np.ndarray, finer: tuple[Grid, ...] = finer) -> np.ndarray:
            return _inside(at, finer, culling, rule, votes)

        cells = cells[_misjudged(cells, inside)]
        if not len(cells):
            break
        around = np.unique((cells[:, None] + _AROUND).reshape(-1, 3), axis=0)
        found = with_finer_cells(surface, around, inside, allowed)
        if found is None:
            break
        # A cell may be halved again where all around it are halved.
        (surface, around), grids = found, finer
        allowed = interior(around)
        cells = np.unique((2 * cells[:, None] + _HALVES).reshape(-1, 3), axis=0)
    return surface, grids[-1]


_HALVES = _PLACES[(_PLACES < 2).all(axis=1)]


def with_cameras(
    crossings: Crossings,
    surface: GridSurface,
    grid: Grid,
    culling: Culling,
    rule: WitnessRule,
    votes: int = 1,
) -> Crossings:
    """The crossings, those on calmed borders with the camera of their nearest neighbour: they are inside at
    both ends, so no camera cuts there.
    """
    nobody = np.flatnonzero(crossings.cut_by < 0)
    nobody = nobody[_inside(surface.outer[nobody], (grid,), culling, rule, votes)]
    known = np.flatnonzero(crossings.cut_by >= 0)
    if not len(nobody) or not len(known):
        return crossings
    cut_by = crossings.cut_by.copy()
    _, nearest = cKDTree(crossings.vertices[known]).query(crossings.vertices[nobody])
    cut_by[nobody] = cut_by[known[nearest]]
    return Crossings(crossings.vertices, cut_by)


def halved(grid: Grid) -> Grid:
    """Voxels half as wide; centre (2 i, 2 j, 2 k) is where (i, j, k) was, and none lies beyond the last."""
    half = 0.5 * grid.voxel_m
    nx, ny, nz = (2 * n - 1 for n in grid.shape)
    return Grid(grid.low + 0.5 * half, half, (nx, ny, nz))


def thin_cells(
    tables: Sequence[SilhouetteTable], rule: WitnessRule, grid: Grid, votes: int = 1
) -> Int[np.ndarray, "n 3"]:
    """(N 3) cells between eight voxels' centres, named by the lowest, that thin lines of sight pass near and
    the hull's surface may run through."""
    middle = grid.low + 0.5 * grid.voxel_m * np.array(grid.shape)
    owners, ways = [], []
    # What is thin is so in many pictures.
    tables_used = range(0, len(tables), -(-len(tables) // _MOST_TABLES))
    for number in tables_used:
        table = tables[number]
        blocks = _thin_blocks(table, grid.voxel_m / pixel_at(table, middle))
        stride = -(-len(blocks) * len(tables_used) // _N_LINES)
        blocks = blocks[:: max(stride, 1)]
        ways.append(ways_through(table, blocks))
        owners.append(np.full(len(blocks), number))
    owner = np.concatenate(owners)
    lines = Lines(owner, np.array([table.centre for table in tables])[owner], np.concatenate(ways))
    # Cells reach from centre to centre.
    nx, ny, nz = (n - 1 for n in grid.shape)
    cells = Grid(grid.low + 0.5 * grid.voxel_m, grid.voxel_m, (nx, ny, nz))
    if not len(owner) or min(cells.shape) < 1:
        return np.zeros((0, 3), dtype=np.int64)
    high = cells.low + np.array(cells.shape) * cells.voxel_m
    enter, leave = within_box(lines, cells.low, high)
    length = _SIDES[0] * cells.voxel_m
    line, nth = _counted(np.maximum(np.ceil((leave - enter) / length), 0).astype(np.int64))
    start = enter[line] + length * nth
    for side in _SIDES:
        n = round(length / (side * cells.voxel_m))
        length /= n
        line, start = np.repeat(line, n), (start[:, None] + length * np.arange(n)).ravel()
        points = lines.origin[line] + (start + 0.5 * length)[:, None] * lines.way[line]
        places = np.floor((points - cells.low) / (side * cells.voxel_m)).astype(np.int64)
        names, which = np.unique(named(places), return_inverse=True)
        within = placed(names)
        open_ = cells_in_question(tables, rule, cells, within.T, side, votes)
        line, start = line[open_[which]], start[open_[which]]
    return within[open_]


def _counted(n: Int[np.ndarray, " k"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """0, 1, ... n[k] - 1 for every k: the k, and the number."""
    which = np.repeat(np.arange(len(n)), n)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(n) - n, n)


def _thin_blocks(table: SilhouetteTable, voxel_px: float) -> Int[np.ndarray, " n"]:
    """Blocks, counted along `table.squares[0]`, in parts or gaps of the silhouette that are thin."""
    person: UInt8[np.ndarray, "h w"] = table.squares[0] & np.uint8(INSIDE)
    # Odd, or the squares would lie off their middles.
    half = int(np.ceil(0.5 * _THIN_VOXELS * voxel_px / BLOCK_PX))
    square = np.ones((2 * half + 1, 2 * half + 1), dtype=np.uint8)
    height, width = person.shape
    person = cv2.copyMakeBorder(person, half, half, half, half, cv2.BORDER_CONSTANT, value=0)
    opened = cv2.morphologyEx(person, cv2.MORPH_OPEN, square)
    closed = cv2.morphologyEx(person, cv2.MORPH_CLOSE, square)
    return np.flatnonzero((opened != closed)[half : half + height, half : half + width])


def _misjudged(cells: Int[np.ndarray, "n 3"], inside: Inside) -> Bool[np.ndarray, " n"]:
    """(N,) whether halving a cell would show something that its corners do not."""
    names, which = np.unique(named((2 * cells[:, None] + _PLACES).reshape(-1, 3)), return_inverse=True)
    value = inside(placed(names))[which.reshape(-1, 27)]
    odd = np.zeros(len(cells), dtype=bool)
    for at, corners in _BETWEEN:
        ends = value[:, corners]
        odd |= (value[:, [at]] != ends).all(axis=1)
    return odd


def _inside(
    voxels: Int[np.ndarray, "n 3"], grids: tuple[Grid, ...], culling: Culling, rule: WitnessRule, votes: int
) -> Bool[np.ndarray, " n"]:
    """(N,) which voxels of the last grid belong to the hull, by its definition; beyond the grid none does.

    `grids`: each the half of the one before. A voxel is asked where the first of them that has it puts it,
    to the last bit: an outline may pass through it.
    """
    within = np.flatnonzero(((voxels >= 0) & (voxels < np.array(grids[-1].shape))).all(axis=1))
    result = np.zeros(len(voxels), dtype=bool)
    for start in range(0, len(within), AT_ONCE):
        part = within[start : start + AT_ONCE]
        at = voxels[part]
        points = grids[-1].centres(at.T)
        for times, grid in enumerate(grids[-2::-1], start=1):
            whole = (at % (1 << times) == 0).all(axis=1)
            points[:, whole] = grid.centres((at[whole] >> times).T)
        result[part] = _asked(culling, rule, np.ascontiguousarray(points), votes)
    return result


def _asked(
    culling: Culling, rule: WitnessRule, points: Float[np.ndarray, "3 n"], votes: int
) -> Bool[np.ndarray, " n"]:
    n, blocks = points.shape[1], culling.blocks_of(points)
    sets, inside = np.zeros((len(rule.full()), n), dtype=np.uint64), np.ones(n, dtype=bool)
    if culling.stack is not None:
        numbers, projections = culling.stack.numbers, culling.stack.projections
        culling.stack.loops.witnesses(
            numbers, projections, points, blocks, culling.answers, votes, sets, inside
        )
    else:
        inside = _asked_plainly(culling, points, blocks, votes, sets)
    alive = np.flatnonzero(inside)
    inside[alive] = rule.enough(sets.take(alive, axis=1))
    return inside


def _asked_plainly(
    culling: Culling,
    points: Float[np.ndarray, "3 n"],
    blocks: Int[np.ndarray, " n"],
    votes: int,
    sets: UInt64[np.ndarray, "w n"],
) -> Bool[np.ndarray, " n"]:
    """(N,) where fewer than `votes` tables see the points outside. `sets`: gets who sees them inside."""
    left = np.full(points.shape[1], votes)
    for number, table in enumerate(culling.tables):
        seen, unsure = culling.evidence(number, blocks)
        asked = culling.may_refuse(number, blocks)
        asked = np.union1d(asked, unsure) if len(unsure) else asked
        seen[asked] = False
        asked = asked[left[asked] > 0]
        answers = table.ask_points(points.take(asked, axis=1))
        seen[asked] = answers == INSIDE
        sets[number // WORD_BITS, seen] |= np.uint64(1) << np.uint64(number % WORD_BITS)
        left[asked[answers == OUTSIDE]] -= 1
    return left > 0
