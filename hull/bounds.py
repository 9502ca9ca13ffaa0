"""Where to carve: a box around the person, found from the cameras and silhouettes alone.

A coarse carve of all space that the cameras could mean, in which (from four silhouettes on) a place is given
up only when two cameras see background there, so that one bad silhouette cannot cut the box short. Far from
the person, where few pictures overlap, such a carve leaves phantoms; the person is the connected piece that
most cameras vouch for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import find_objects, label

from capture.camera import Camera
from hull.carve import Grid, possible_witnesses
from hull.diagnosis import why_empty
from hull.errors import HullError
from hull.tables import BLOCK_PX, INSIDE, SilhouetteTable, prepare_tables
from hull.witnesses import witness_rule

# The space searched, a cube as wide as twice the cameras' distance, has so many cells a side (6 cm at 4 m).
_N_CELLS = 128
# How far somebody gets between two frames, metres; more only costs the search of all space.
_STEP_M = 0.3


@dataclass(frozen=True, eq=False)
class Bounds:
    """An axis-aligned box: `low` (3,) and `high` (3,), world metres."""

    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "low", np.array(self.low, dtype=np.float64))
        object.__setattr__(self, "high", np.array(self.high, dtype=np.float64))
        if self.low.shape != (3,) or self.high.shape != (3,) or not (self.high > self.low).all():
            raise HullError(f"bounds from {self.low.tolist()} to {self.high.tolist()} m enclose no space")

    @property
    def centre(self) -> Float[np.ndarray, " 3"]:
        return 0.5 * (self.low + self.high)

    @property
    def size_m(self) -> Float[np.ndarray, " 3"]:
        return self.high - self.low


def find_bounds(rig: Iterable[Camera], images: Sequence[np.ndarray | None]) -> Bounds:
    """The box around the hull of these silhouettes (per camera (h w) uint8 or None), world metres.

    Raises HullError when no space fits the silhouettes, naming the camera that empties it if it is one alone.
    """
    return bounds_from_tables(prepare_tables(rig, images))


def bounds_from_tables(tables: Sequence[SilhouetteTable], near: Bounds | None = None) -> Bounds:
    """`find_bounds` for silhouettes that are prepared already.

    `near`: where the person was a moment before. The same cells are asked, but only around there; the answer
    counts if the piece found lies wholly inside what was searched and where the silhouettes' centroids meet,
    and is then that piece of the whole search. Else all of space is searched.
    """
    subject = meeting_point(tables)
    rule = witness_rule(tables, subject)
    # The person is nearer to the meeting point than the cameras are; a few cameras far off do not matter.
    reach = float(np.median([np.linalg.norm(table.centre - subject) for table in tables]))
    grid = Grid(subject - reach, 2 * reach / _N_CELLS, (_N_CELLS, _N_CELLS, _N_CELLS))
    votes = 2 if len(tables) >= 4 else 1
    # With fewer votes what is given up early depends on all the cells that are asked.
    if near is not None and votes > 1:
        low = np.maximum(np.floor((near.low - _STEP_M - grid.low) / grid.voxel_m).astype(int), 0)
        high = np.minimum(np.ceil((near.high + _STEP_M - grid.low) / grid.voxel_m).astype(int), _N_CELLS)
        if (high > low + 2).all():
            found = _largest_piece(possible_witnesses(tables, rule, grid, votes, (low, high)))
            if found is not None and (found[0] > low).all() and (found[1] < high).all():
                box = _around(grid, *found)
                if (box.low < subject).all() and (subject < box.high).all():
                    return box
    found = _largest_piece(possible_witnesses(tables, rule, grid, votes))
    if found is None:
        raise HullError(why_empty(tables, rule, subject - reach, subject + reach))
    return _around(grid, *found)


def _largest_piece(
    count: Int[np.ndarray, "x y z"],
) -> tuple[Int[np.ndarray, " 3"], Int[np.ndarray, " 3"]] | None:
    """First cell and one past the last of the connected piece that the most cameras vouch for, if there is
    any."""
    filled = count > 0
    spans = [np.flatnonzero(filled.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    if not len(spans[0]):
        return None
    low = np.array([span[0] for span in spans])
    within = tuple(slice(span[0], span[-1] + 1) for span in spans)
    piece, _ = label(filled[within], structure=np.ones((3, 3, 3), dtype=bool))
    vouched = np.bincount(piece.ravel(), count[within].ravel())
    person = find_objects(piece)[int(np.argmax(vouched[1:]))]
    first, end = np.array([[s.start, s.stop] for s in person]).T
    return low + first, low + end


def _around(grid: Grid, first: Int[np.ndarray, " 3"], end: Int[np.ndarray, " 3"]) -> Bounds:
    # Whole cells were asked, so the box lies around the hull at any resolution and needs no padding beyond
    # one cell.
    return Bounds(grid.low + (first - 1) * grid.voxel_m, grid.low + (end + 1) * grid.voxel_m)


def meeting_point(tables: Sequence[SilhouetteTable]) -> Float[np.ndarray, " 3"]:
    """The point (3,) nearest to the rays through the silhouettes' centroids; a few stray rays do not move it.

    Least absolute distances by reweighting. Raises HullError when fewer than two silhouettes show anything.
    """
    origins, directions = [], []
    for table in tables:
        if (ray := _central_ray(table)) is not None:
            origins.append(table.centre)
            directions.append(ray)
    if len(tables) < 2:
        which = f"only camera {tables[0].name}" if tables else "no camera"
        raise HullError(f"{which} gave a silhouette that could be read; a hull needs at least 2")
    if len(origins) < 2:
        empty = [table.name for table in tables if _central_ray(table) is None]
        which = f" (empty: {', '.join(empty)})" if empty else ""
        raise HullError(
            f"{len(origins)} of {len(tables)} silhouettes show anything{which}; a hull needs at least 2"
        )
    origin, direction = np.array(origins), np.array(directions)
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    weight = np.ones(len(origin))
    point = origin.mean(axis=0)
    for _ in range(20):
        normal = np.einsum("c,cij->ij", weight, across)
        point = np.linalg.lstsq(normal, np.einsum("c,cij,cj->i", weight, across, origin), rcond=None)[0]
        distance = np.linalg.norm(np.einsum("cij,cj->ci", across, point - origin), axis=1)
        weight = 1.0 / np.maximum(distance, 0.02)
    return point


def _central_ray(table: SilhouetteTable) -> Float[np.ndarray, " 3"] | None:
    """Unit direction (3,) through the middle of the silhouette's solid part, or of any part if it is thin."""
    classes = table.squares[0]
    rows, columns = np.nonzero(classes == INSIDE)
    if not len(rows):
        rows, columns = np.nonzero((classes & INSIDE != 0) & (classes < 4))
    if not len(rows):
        return None
    pixel = (np.array([columns.mean(), rows.mean()]) + 0.5) * BLOCK_PX + np.array(table.origin)
    direction = np.linalg.solve(table.projection[:, :3], np.append(pixel, 1.0))
    return direction / np.linalg.norm(direction)
