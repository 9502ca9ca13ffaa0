"""Cameras whose silhouette contradicts the others in one frame: found, named, and kept from cutting the hull.

A hull is an intersection, so one silhouette that lacks a leg takes the leg from everybody. Here every
silhouette must be explained by the hull (`hull.evidence`); a camera that stands against many lines of sight
of the others is left out, the frame is carved again without it, and its silhouette is compared with that
better hull: in a small rig, if a part is missing and the rest fits, only that region is made unknown and
the camera comes back; else it stays out. At most a quarter of the cameras is treated so, and never without a
word.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from capture.camera import Camera
from hull.bounds import Bounds, bounds_from_tables, meeting_point
from hull.culling import Culling
from hull.errors import EmptyHullError, HullError
from hull.evidence import MissedLines, missed_lines
from hull.fault_kinds import CameraFault, FaultAction, FaultKind, classified, kept_against, shows_too_much
from hull.pockets import false_holes
from hull.rays import RayScene
from hull.tables import INSIDE, NO_EVIDENCE, SilhouetteTable, prepare_table, prepare_tables
from hull.witnesses import WitnessRule, witness_rule

# With fewer cameras than this none can be spared: they are told of, not left out.
FEWEST_TO_JUDGE = 6
LARGEST_SHARE_OUT = 0.25
# With this many cameras a silhouette that lacks a part is not worth mending: the others leave no gap.
MENDED_BELOW = 24
# A camera is at fault when it forbids this share of the others' lines and so many times the typical camera's
# share, or this share deeply (far from its outline); two of the others at least must have such lines.
_SHARE, _FACTOR, _DEEP_SHARE, _N_ACCUSERS = 0.01, 5.0, 0.0005, 2
# A camera shows too much when two others refuse this share of its lines, and so many times the typical share.
_SURPLUS_SHARE = 0.1
_MOST_ROUNDS = 8
# A contradiction that stays is told from this share of all lines on (clean silhouettes leave none, nor do
# ragged ones, nor a pixel of calibration), and from the second on the hull itself is not to be trusted.
# Cameras that take part in nearly as much of it as the worst are named with it.
_CONTRADICTION, WRONG_HULL, _AS_BAD = 0.005, 0.01, 0.85
# Between three silhouettes nobody can judge.
_FEWEST_TO_NAME = 4
# If the hull explains so little, it may lie in the wrong place; nobody is larger than this around the middle.
_MOSTLY_MISSED, _PERSON_M = 0.3, 1.3


@dataclass(frozen=True, eq=False)
class Carved:
    """A frame's surface before it is described.

    Fields
    ------
    vertices (V 3), faces (F 3) : closed, world metres.
    cut_by : (V,) the table on whose cone a vertex lies, or -1.
    problems, marks : a sentence each; see `Hull`.
    culling : of the tables it was carved with.
    scene : the surface, ready for rays.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    cut_by: Int[np.ndarray, " v"]
    problems: tuple[str, ...]
    marks: tuple[str, ...]
    culling: Culling
    scene: RayScene


CarveWith = Callable[[Sequence[SilhouetteTable], WitnessRule, Bounds, bool], Carved]


@dataclass(frozen=True, eq=False)
class Settled:
    """A surface that the silhouettes agree on, and what had to be done for it.

    Fields
    ------
    carved : what `carve_with` made of `tables`.
    tables, rule, bounds : of the cameras that are left, some with unknown regions.
    n_lines (C,), missed : how the lines of sight of these tables fare with the surface they were judged by.
    faults : one for each camera that contradicts the others, in the rig's order.
    contradiction : share of the lines of sight that miss the surface because cameras contradict one another.
    marks : a sentence where that is much.
    """

    carved: Carved
    tables: tuple[SilhouetteTable, ...]
    rule: WitnessRule
    bounds: Bounds
    n_lines: Int[np.ndarray, " c"]
    missed: MissedLines
    faults: tuple[CameraFault, ...]
    contradiction: float
    marks: tuple[str, ...]


@dataclass
class _Cameras:
    """Who takes part. Cameras are counted as in the rig; `images` are the present ones, regions unknown."""

    rig: tuple[Camera, ...]
    images: list[UInt8[np.ndarray, "_h _w"] | None]
    tables: dict[int, SilhouetteTable]
    out: set[int] = field(default_factory=set)
    unjudged: set[int] = field(default_factory=set)
    faults: dict[int, CameraFault] = field(default_factory=dict)

    def present(self) -> tuple[SilhouetteTable, ...]:
        return tuple(table for idx, table in self.tables.items() if idx not in self.out)

    def room(self) -> int:
        """How many more may be found at fault."""
        n = len(self.tables)
        if n < FEWEST_TO_JUDGE:
            return 0
        return max(int(LARGEST_SHARE_OUT * n) - len(self.out | set(self.faults)), 0)


def settle(
    rig: Sequence[Camera],
    images: Sequence[UInt8[np.ndarray, "_h _w"] | None],
    bounds: Bounds | None,
    carve_with: CarveWith,
    votes: int = 1,
    near: Bounds | None = None,
    mend: bool = True,
    finely: bool = False,
) -> Settled:
    """Carve, look for contradictions, carve again without the cameras at fault, until the rest agrees.

    `votes`: so many cameras must refuse a place to cut it. `mend`: silhouettes may get unknown regions, which
    `carve_with` must heed; else a camera at fault is left out altogether. `near`: as for
    `bounds_from_tables`.
    `carve_with` makes the surface of some tables and raises EmptyHullError where nothing is left; that is
    raised where nothing is left whatever few cameras are left out. `finely`: it has a last argument that asks
    for thin parts. Nobody is judged by those: what thin rests a wrong silhouette leaves explain lines by
    chance.
    """
    cameras = _Cameras(
        tuple(rig), list(images), {table.camera_idx: table for table in prepare_tables(rig, images)}
    )
    judging = not finely
    for _ in range(_MOST_ROUNDS + finely):
        box = bounds if bounds is not None else _bounds_without_blank(cameras, near)
        tables = cameras.present()
        rule = witness_rule(tables, box.centre)
        carved, error = None, None
        try:
            carved = carve_with(tables, rule, box, not judging)
        except EmptyHullError as empty:
            error = empty
        scene = None if carved is None else carved.scene
        n_lines, missed = missed_lines(tables, rule, box, scene, votes)
        blamed = _blamed(tables, n_lines, missed)
        if not blamed and missed.scale * len(missed.table) > _MOSTLY_MISSED * n_lines.sum():
            # Faults that agree with each other may have put the box anywhere.
            blamed = _blamed(tables, *missed_lines(tables, rule, _around(tables), scene, votes))
        if not blamed and carved is not None and votes == 1:
            blamed = false_holes(tables, rule, box, bool(cameras.out or cameras.faults))
        if (blamed or carved is None or cameras.unjudged) and not judging:
            judging = True
            continue
        room = cameras.room()
        again = [k for k in blamed if tables[k].camera_idx in cameras.faults]
        fresh = [k for k in blamed if tables[k].camera_idx not in cameras.faults]
        removed = again + fresh[:room]
        if removed:
            # One that was mended and still contradicts stays out, with what was found of it.
            for k in removed:
                idx = tables[k].camera_idx
                cameras.out.add(idx)
                if idx in cameras.faults:
                    cameras.faults[idx] = cameras.faults[idx].done(FaultAction.LEFT_OUT)
                else:
                    cameras.unjudged.add(idx)
            continue
        if carved is None:
            assert error is not None
            if _leave_out_blank(cameras):
                continue
            raise error
        if cameras.unjudged and _judge(cameras, carved.scene, mend):
            continue
        if finely and judging:
            carved = carve_with(tables, rule, box, True)
        return _settled(cameras, carved, tables, rule, box, n_lines, missed, fresh)
    raise HullError(
        f"the silhouettes contradict one another: {_names(cameras, cameras.out)} were left out, "
        "and the others still do not agree; look at the calibration"
    )


def _around(tables: Sequence[SilhouetteTable]) -> Bounds:
    """A person's surroundings, wherever most silhouettes see one."""
    middle = meeting_point(tables)
    return Bounds(middle - _PERSON_M, middle + _PERSON_M)


def _bounds_without_blank(cameras: _Cameras, near: Bounds | None) -> Bounds:
    """The box; where there is none, cameras that show nobody are left out first, as far as that may be."""
    try:
        return bounds_from_tables(cameras.present(), near)
    except HullError:
        if not _leave_out_blank(cameras):
            raise
        return bounds_from_tables(cameras.present(), near)


def _leave_out_blank(cameras: _Cameras) -> bool:
    """Leave out the cameras that show nobody, if there are any and that may be."""
    blank = [t.camera_idx for t in cameras.present() if _is_blank(t)]
    # Where three others see somebody, one that sees nobody is wrong even in a small rig.
    room = max(cameras.room(), int(len(cameras.tables) >= _FEWEST_TO_NAME and not cameras.out))
    if not 0 < len(blank) <= room:
        return False
    cameras.out.update(blank)
    cameras.unjudged.update(blank)
    return True


def _is_blank(table: SilhouetteTable) -> bool:
    return not (table.squares[0] & INSIDE).any() and not (table.squares[0] == NO_EVIDENCE).all()


def _blamed(
    tables: Sequence[SilhouetteTable], n_lines: Int[np.ndarray, " c"], missed: MissedLines
) -> list[int]:
    """Tables that forbid what others show, worst first: each explains lines that those before it leave."""
    others = np.maximum(n_lines.sum() - n_lines, 1)
    foreign = missed.table[:, None] != np.arange(len(tables))
    weight = np.where(foreign, missed.suspect, 0.0) * missed.scale
    deep = missed.deep & foreign
    typical = float(np.median(weight.sum(axis=0) / others))
    open_ = np.ones(len(weight), dtype=bool)
    found: list[int] = []
    while open_.any():
        share = weight[open_].sum(axis=0) / others
        deep_share = missed.scale * deep[open_].sum(axis=0) / others
        accusers = np.array(
            [len(np.unique(missed.table[open_ & (weight[:, k] > 0)])) for k in range(len(tables))]
        )
        at_fault = (share > max(_SHARE, _FACTOR * typical)) | (deep_share > max(_DEEP_SHARE, typical))
        at_fault &= accusers >= _N_ACCUSERS
        if not at_fault.any():
            break
        worst = int(np.argmax(np.where(at_fault, share, 0.0)))
        found.append(worst)
        # Its own lines are worth nothing now, and those that it alone forbids are explained.
        open_ &= (missed.table != worst) & (weight[:, worst] == 0)
    return found


def _judge(cameras: _Cameras, scene: RayScene, mend: bool) -> bool:
    """Say what is wrong with each camera left out; True where one comes back with a region unknown."""
    returned = False
    for idx in sorted(cameras.unjudged):
        image = cameras.images[idx]
        assert image is not None
        fault, mended = classified(cameras.rig[idx], idx, image, scene)
        cameras.faults[idx] = fault
        if mend and mended is not None and len(cameras.tables) < MENDED_BELOW:
            cameras.faults[idx] = fault.done(FaultAction.REGION_UNKNOWN)
            cameras.images[idx] = mended
            cameras.tables[idx] = prepare_table(cameras.rig[idx], mended, idx)
            cameras.out.discard(idx)
            returned = True
    cameras.unjudged.clear()
    return returned


def _settled(
    cameras: _Cameras,
    carved: Carved,
    tables: tuple[SilhouetteTable, ...],
    rule: WitnessRule,
    bounds: Bounds,
    n_lines: Int[np.ndarray, " c"],
    missed: MissedLines,
    unsettled: list[int],
) -> Settled:
    faults = dict(cameras.faults)
    too_much = _share_of_lines(missed, missed.refused, n_lines)
    limit = max(_SURPLUS_SHARE, _FACTOR * float(np.median(too_much)))
    generous = np.flatnonzero(too_much > limit)
    # Lines of a camera that shows too much miss the hull, and rightly so.
    counted = (missed.suspect.any(axis=1) | missed.refused) & ~np.isin(missed.table, generous)
    per_line = missed.scale / max(int(n_lines.sum()), 1)
    contradiction = per_line * float(counted.sum())
    forbids = missed.suspect[counted].sum(axis=0)
    part = forbids + np.bincount(missed.table[counted], minlength=len(tables))
    if len(cameras.tables) >= FEWEST_TO_JUDGE:
        shares = {k: per_line * float(missed.suspect[:, k].sum()) for k in unsettled}
    elif contradiction > _CONTRADICTION and len(tables) >= _FEWEST_TO_NAME:
        # Which of two it is that contradict each other is told by the others, if there are any.
        worst = np.flatnonzero(part + forbids >= _AS_BAD * (part + forbids).max())
        shares = {k: per_line * float(part[k]) for k in worst.tolist()}
    else:
        shares = {}
    for k, share in shares.items():
        faults[tables[k].camera_idx] = kept_against(tables[k], share)
    for k in generous.tolist():
        if tables[k].camera_idx not in faults:
            faults[tables[k].camera_idx] = shows_too_much(
                tables[k], cameras.images[tables[k].camera_idx], float(too_much[k])
            )
    marks: tuple[str, ...] = ()
    if contradiction > (_CONTRADICTION if not faults else WRONG_HULL):
        marks = (_contradiction_mark(cameras, contradiction, set(faults)),)
    listed = tuple(faults[idx] for idx in sorted(faults))
    return Settled(carved, tables, rule, bounds, n_lines, missed, listed, contradiction, marks)


def _contradiction_mark(cameras: _Cameras, share: float, named: set[int]) -> str:
    told = (
        f"the silhouettes contradict one another: {share:.1%} of the lines of sight through them miss "
        "the hull, which lacks a part or stands in the wrong place"
    )
    if named:
        return f"{told}; look at {_names(cameras, named)} first"
    few = len(cameras.tables) < _FEWEST_TO_NAME
    why = (
        f"{len(cameras.tables)} are too few to tell whose is wrong"
        if few
        else "look at the calibration, and whether all show the same moment"
    )
    return f"{told}; {why}"


def _share_of_lines(
    missed: MissedLines, which: Bool[np.ndarray, " m"], n_lines: Int[np.ndarray, " c"]
) -> Float[np.ndarray, " c"]:
    count = np.bincount(missed.table[which], minlength=len(n_lines))
    return missed.scale * count / np.maximum(n_lines, 1)


def _names(cameras: _Cameras, indices: set[int]) -> str:
    return ", ".join(f"camera {cameras.rig[idx].name}" for idx in sorted(indices))


__all__ = ["CameraFault", "FaultAction", "FaultKind", "Settled", "settle"]
