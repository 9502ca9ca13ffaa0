"""Pockets: space inside a person that a single camera calls background and all the others call person.

A hole in the middle of a silhouette contradicts nobody's outline: no other camera looks along it. But what a
camera rightly cuts alone is thin, the more so the more cameras there are: slivers along the limbs, and what
hides in an armpit. A hole cuts a tunnel, as wide as itself, out of what all the others see as solid. So the
largest ball that fits into what one camera alone refuses tells a false hole, and so does a smaller one deep
below the surface that the others make. A bite at an outline leaves no more than an armpit does, and is told
only if it is large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hull.bounds import Bounds
from hull.carve import Grid, carve
from hull.diagnosis import answers_of_all
from hull.tables import INSIDE, OUTSIDE, SilhouetteTable
from hull.witnesses import WitnessRule

# With fewer cameras a true gap between limbs is as large as any false one.
FEWEST_CAMERAS = 8
# A ball in a rightful pocket is at most this large, metres, where one camera sees a place, and smaller by the
# square root of the number of cameras that see it. Measured in people who move in loose clothes: balls up to
# 54 mm with 8 cameras, 40 mm with 16, 18 mm with 32. Below the second figure pixels and calibration count.
_BALL_M, _SMALLEST_M = 0.19, 0.03
# A ball of this share of that size is false, too, where it lies deep (what the others see as person reaches
# so many times that size around it), or where it is so many times as large as any other camera's.
_DEEP_SHARE, _DEEP = 0.75, 2.0
_ODD_SHARE, _ODD = 0.7, 1.7
_OTHERS_WRONG = 1.3
_STEP_M = 0.02
# Balls grow by so much, up to so much.
_RUNG_M, _DEPTH_RUNG_M, _LARGEST_M = 0.0025, 0.01, 0.3
_N_TRIED = 3
_AROUND = np.array(list(np.ndindex(3, 3, 3)), dtype=np.float64).T - 1.0
_DIRECTIONS = np.delete(_AROUND, 13, axis=1) / np.linalg.norm(np.delete(_AROUND, 13, axis=1), axis=0)


@dataclass(frozen=True)
class Pocket:
    """The largest one of a camera.

    Fields
    ------
    table : number of the camera's table.
    ball_m : radius of the largest ball that this camera refuses alone, metres.
    depth_m : radius of the largest ball about the same place that no other camera refuses, metres.
    n_seeing : cameras that see the place, this one included.
    """

    table: int
    ball_m: float
    depth_m: float
    n_seeing: int

    @property
    def limit_m(self) -> float:
        """What a ball in a rightful pocket does not exceed."""
        return max(_BALL_M / float(np.sqrt(self.n_seeing)), _SMALLEST_M)


def false_holes(
    tables: Sequence[SilhouetteTable], rule: WitnessRule, bounds: Bounds, others_wrong: bool = False
) -> list[int]:
    """Numbers of the tables that have a pocket too large to be true, the largest first.

    `others_wrong`: cameras are left out already, or regions of theirs are unknown; where they are, another
    one cuts alone what they cut with it, and rightful pockets are larger.
    """
    found = sorted(pockets(tables, rule, bounds), key=lambda pocket: -pocket.ball_m)
    false: list[int] = []
    for pocket in found:
        limit_m = pocket.limit_m * (_OTHERS_WRONG if others_wrong else 1.0)
        share = pocket.ball_m / limit_m
        rest = [other.ball_m for other in found if other.table not in (pocket.table, *false)]
        if (
            share > 1.0
            or (share > _DEEP_SHARE and pocket.depth_m > _DEEP * limit_m)
            or (share > _ODD_SHARE and pocket.ball_m > _ODD * max(rest, default=0.0))
        ):
            false.append(pocket.table)
    return false


def pockets(tables: Sequence[SilhouetteTable], rule: WitnessRule, bounds: Bounds) -> list[Pocket]:
    """One for each table that refuses some thick place alone. With few cameras none is looked for."""
    if len(tables) < FEWEST_CAMERAS:
        return []
    shape = tuple(int(n) for n in np.ceil(bounds.size_m / _STEP_M))
    blocks = carve(tables, rule, Grid(bounds.low, _STEP_M, (shape[0], shape[1], shape[2])), votes=2)
    if not blocks.n_voxels:
        return []
    first, end = blocks.span()
    # One voxel around, for the neighbours.
    filled = blocks.dense(first - 1, end + 1)
    cells = np.stack(np.nonzero(filled))
    refused = answers_of_all(tables, blocks.grid.centres(cells + first[:, None] - 1)) == OUTSIDE
    alone = refused.sum(axis=0) == 1
    sole = np.full(filled.shape, -1, dtype=np.int16)
    sole[tuple(cells[:, alone])] = refused[:, alone].argmax(axis=0)
    thick = np.stack(np.nonzero(_like_all_neighbours(sole)))
    owner = sole[tuple(thick)]
    found = []
    for number in np.unique(owner).tolist():
        centres = blocks.grid.centres(thick[:, owner == number] + first[:, None] - 1)
        found.append(_largest(tables, number, centres))
    return [pocket for pocket in found if pocket is not None]


def _like_all_neighbours(sole: Int[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Voxels that belong to a camera, as all six around them do. Nothing lies in the outermost ones."""
    like = sole >= 0
    for axis in range(3):
        like &= (np.roll(sole, 1, axis) == sole) & (np.roll(sole, -1, axis) == sole)
    return like


def _largest(
    tables: Sequence[SilhouetteTable], number: int, centres: Float[np.ndarray, "3 n"]
) -> Pocket | None:
    """The pocket in which these centres (3 N) lie, unless it is small."""
    radius = _balls(tables, number, centres, alone=True, rung_m=0.5 * _STEP_M)
    best = np.argsort(-radius, kind="stable")[:_N_TRIED]
    centre, ball_m = centres[:, best], float(radius.max())
    for share in (0.5, 0.25, 0.125):
        around = (centre[:, :, None] + share * _STEP_M * _AROUND[:, None]).reshape(3, -1)
        radius = _balls(tables, number, around, alone=True, rung_m=_RUNG_M, known_m=ball_m)
        if radius.max() > ball_m:
            best = np.argsort(-radius, kind="stable")[:_N_TRIED]
            centre, ball_m = around[:, best], float(radius.max())
        # The best centre is within one more step along each axis, and no ball grows faster than that.
        if ball_m + np.sqrt(3.0) * share * _STEP_M < _ODD_SHARE * _SMALLEST_M:
            return None
    centre = centre[:, :1]
    depth = _balls(tables, number, centre, alone=False, rung_m=_DEPTH_RUNG_M)
    seeing = [table.ask_points(centre)[0] == INSIDE for table in tables]
    return Pocket(number, ball_m, float(depth[0]), 1 + int(np.sum(seeing)))


def _balls(
    tables: Sequence[SilhouetteTable],
    number: int,
    centres: Float[np.ndarray, "3 n"],
    alone: bool,
    rung_m: float,
    known_m: float = 0.0,
) -> Float[np.ndarray, " n"]:
    """(N,) radius of the largest ball around each centre (3 N) that no other table refuses, and, if `alone`,
    that this one refuses, metres. Balls grow by `rung_m`, from `known_m` on."""
    asked = [(table, False) for k, table in enumerate(tables) if k != number]
    if alone:
        asked.insert(0, (tables[number], True))
    radius = np.full(centres.shape[1], known_m)
    open_ = np.arange(centres.shape[1])
    for rung in range(1, int((_LARGEST_M - known_m) / rung_m) + 1):
        points = centres[:, open_, None] + (known_m + rung * rung_m) * _DIRECTIONS[:, None]
        for table, refusing in asked:
            refused = table.ask_points(points.reshape(3, -1)) == OUTSIDE
            fits = (refused == refusing).reshape(len(open_), len(_DIRECTIONS[0])).all(axis=1)
            open_, points = open_[fits], points[:, fits]
            if not len(open_):
                return radius
        radius[open_] = known_m + rung * rung_m
    return radius
