"""`bodyhull check`: everything a recording says about itself, gathered: numbers per camera and a verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyhull.errors import UserError
from capture.camera import Camera
from capture.errors import RecordingError
from capture.finding import Finding, FindingKind
from capture.frame_facts import FrameFacts, frames_to_read, read_frame_facts
from capture.preflight import Opened, open_for_check
from capture.rig import Rig
from capture.world import METRES_PER_UNIT, find_subject, settle_world, subject_extent
from hull.errors import HullError
from hull.preflight import Examination, examine
from hull.reference import Moment, moment_of
from hull.residual import residuals
from hull.visual_hull import HullOptions, build_hull

# Outlines that lie so many pixels (and this share of the picture's longer side) outside the others' hull,
# and so many times the typical camera's, are not the silhouettes' doing.
RESIDUAL_PX, RESIDUAL_SHARE, RESIDUAL_FACTOR = 6.0, 0.006, 2.5
# A camera that forbids this share of what the others show lacks a part.
FORBIDDEN = 0.04
_N_FULL, _N_FULL_LARGE, _LARGE_MP = 4, 2, 100.0
_VOXEL_M = 0.015
_PERSON_M = (0.6, 3.5)


@dataclass(frozen=True)
class CameraNumbers:
    """What is known of one camera. None: cannot be told.

    size : px. field_of_view_deg : across and down. distance_m, height_m : from the person's middle, and of
    the camera above the floor (the lowest point of the hull). residual_px : see `hull.residual`. agreement,
    missing, surplus : with the hull of the other cameras. offset_frames : see `hull.time_offsets`.
    area : mean share of the picture that is person; area_low, area_high: least and most. shown, cropped :
    shares of the frames with a person, and of those in which the person touches the picture's border.
    """

    name: str
    size: tuple[int, int]
    field_of_view_deg: tuple[float, float]
    distance_m: float | None
    height_m: float | None
    residual_px: float | None
    agreement: float | None
    missing: float | None
    surplus: float | None
    offset_frames: float | None
    area: float
    area_low: float
    area_high: float
    shown: float
    cropped: float


@dataclass(frozen=True)
class RigNumbers:
    """Of the hull in the middle frame, by the cameras that agree. None: there was none.

    unit, metres_per_unit : of the calibration, as far as told. up : world axis, (3,) or None.
    """

    n_cameras: int
    n_frames: int
    n_frames_read: int
    unit: str
    metres_per_unit: float
    up: tuple[float, ...] | None
    person_height_m: float | None
    volume_l: float | None
    witnesses: float | None
    lowest_camera_m: float | None
    highest_camera_m: float | None
    agreeing: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Check:
    """A recording's numbers and its verdict. `facts`: what was read, for plots."""

    recording: str
    name: str
    cameras: tuple[CameraNumbers, ...]
    rig: RigNumbers
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    facts: FrameFacts
    examination: Examination
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready: the same numbers as on the page."""
        facts = self.facts
        curves = self.examination.offsets
        names = facts.rig.names
        return {
            "recording": self.recording,
            "sequence": self.name,
            "sound": not self.findings,
            "findings": [finding.as_dict() for finding in self.findings],
            "notes": list(self.notes),
            "rig": asdict(self.rig),
            "cameras": [asdict(camera) for camera in self.cameras],
            "frame_ids": list(facts.frame_ids),
            "area": {name: np.round(facts.area[i], 6).tolist() for i, name in enumerate(names)},
            "offset_curves": {names[i]: [list(p) for p in o.curve] for i, o in curves.items()},
            "seconds": round(self.seconds, 1),
        }


def check_recording(
    path: Path,
    *,
    sequence: str | None = None,
    calibration: Path | None = None,
    frames: str | None = None,
    units: str = "auto",
    up: str = "auto",
    background: Path | None = None,
    at_most: int | None = None,
    report: Callable[[int, int], object] | None = None,
) -> Check:
    """Look at a recording. Raises RecordingError where there is nothing to look at.

    at_most : how many frames to read. report : called with frames done and in all.
    """
    started = time.perf_counter()
    if at_most is not None and at_most < 3:
        raise UserError(f"--sample {at_most}: give 3 frames or more; about 20 tell time offsets")
    opened = open_for_check(
        path,
        sequence=sequence,
        calibration=calibration,
        frames=frames,
        units=units,
        up=up,
        background=background,
    )
    recording = opened.recording
    ids = frames_to_read(recording, opened.is_video, at_most)
    facts = read_frame_facts(recording, ids, None if report is None else lambda done: report(done, len(ids)))
    found = examine(facts)
    rig, per_unit, unit, unit_findings = _metric_rig(opened, facts, found)
    moments = _full_moments(opened, facts, found, rig)
    axis, trouble = _world(opened, rig, found, moments, up)
    numbers = _rig_numbers(opened, facts, found, rig, moments, unit, per_unit, axis)
    outside = residuals(moments, found.members) if found.members else {}
    cameras = _camera_numbers(facts, found, rig, outside, moments, axis, numbers)
    findings = [*opened.findings, *unit_findings, *found.findings]
    findings += _lacking(found, facts)
    findings += _loose(cameras, findings, facts)
    if trouble is not None and not findings:
        findings.append(
            Finding(
                FindingKind.UNREADABLE,
                rig.names,
                trouble,
                "see what `bodyhull run` says of it",
                whole_rig=True,
            )
        )
    return Check(
        str(path),
        recording.name,
        tuple(cameras),
        numbers,
        tuple(_without_repeats(findings)),
        tuple(recording.notes),
        facts,
        found,
        time.perf_counter() - started,
    )


def _without_repeats(findings: Sequence[Finding]) -> list[Finding]:
    """One finding a kind and camera; what the whole rig has no camera has."""
    whole = {finding.kind for finding in findings if finding.whole_rig}
    seen: set[tuple[FindingKind, tuple[str, ...]]] = set()
    kept = []
    for finding in findings:
        key = finding.kind, finding.cameras
        if key in seen or (finding.kind in whole and not finding.whole_rig):
            continue
        seen.add(key)
        kept.append(finding)
    return kept


def _metric_rig(
    opened: Opened, facts: FrameFacts, found: Examination
) -> tuple[Rig, float, str, list[Finding]]:
    """The rig in metres with its own mistake as a whole undone, metres a unit of it, the unit's name, and
    what is to be said of it."""
    rig = opened.recording.rig
    small = facts.rig
    if found.rig_repair is not None and found.rig_repair.change is not None:
        rig = Rig(tuple(found.rig_repair.change(camera) for camera in rig))
        small = Rig(tuple(found.rig_repair.change(camera) for camera in small))
    extents = []
    for moment in found.moments:
        masks = [
            None if view is None or (found.members and i not in found.members) else view.mask
            for i, view in enumerate(moment.views)
        ]
        extent = subject_extent(small, masks, find_subject(small, masks)[0])
        if extent is not None and np.isfinite(extent) and extent > 0:
            extents.append(extent)
    unit = opened.declared or "m"
    if not extents:
        return rig, opened.recording.metres_per_unit, unit, []
    extent = float(np.median(extents))
    nearest = min(METRES_PER_UNIT, key=lambda name: abs(np.log(extent * METRES_PER_UNIT[name] / 1.7)))
    fits = _PERSON_M[0] < extent * METRES_PER_UNIT[nearest] < _PERSON_M[1]
    names = rig.names
    if opened.declared is None:
        if fits and nearest == "m":
            return rig, 1.0, "m", []
        if fits:
            factor = METRES_PER_UNIT[nearest]
            finding = Finding(
                FindingKind.UNITS,
                names,
                f"the calibration does not say its unit, which is {nearest} by the person's size "
                f"({extent * factor:.2f} m)",
                f"say so with --units {nearest} if that is right (it is what `run` assumes)",
                whole_rig=True,
                numbers={"unit": nearest, "ratio": factor},
            )
            return rig.with_world_scaled(factor), factor, nearest, [finding]
        finding = Finding(
            FindingKind.UNITS,
            names,
            f"the person is {extent:.3g} units tall, which is no person in m, cm or mm",
            f"multiply all translations by about {1.7 / extent:.3g}, or calibrate again",
            whole_rig=True,
            numbers={"ratio": 1.7 / extent},
        )
        return rig.with_world_scaled(1.7 / extent), 1.7 / extent, "unknown", [finding]
    if _PERSON_M[0] < extent < _PERSON_M[1]:
        return rig, opened.recording.metres_per_unit, unit, []
    # The extent is in metres if the declared unit is right.
    own = extent / METRES_PER_UNIT[unit]
    better = min(METRES_PER_UNIT, key=lambda name: abs(np.log(own * METRES_PER_UNIT[name] / 1.7)))
    right = _PERSON_M[0] < own * METRES_PER_UNIT[better] < _PERSON_M[1]
    finding = Finding(
        FindingKind.UNITS,
        names,
        f"with the unit {unit}, which {'was asked for' if opened.asked else 'its format means'}, the person "
        f"is {extent:.3g} m tall" + (f"; its numbers are {better}" if right else ""),
        f"give --units {better}, or convert the calibration"
        if right
        else f"multiply all translations by about {1.7 / extent:.3g}, or calibrate again",
        whole_rig=True,
        numbers={"unit": better if right else None, "ratio": 1.7 / extent},
    )
    factor = METRES_PER_UNIT[better] / METRES_PER_UNIT[unit] if right else 1.7 / extent
    return (
        rig.with_world_scaled(factor),
        opened.recording.metres_per_unit * factor,
        better if right else "unknown",
        [finding],
    )


def _full_moments(opened: Opened, facts: FrameFacts, found: Examination, rig: Rig) -> list[Moment]:
    """Some of the moments again, with whole pictures and the rig in metres."""
    if max(facts.shrink) == 1:
        return _in_metres(found.moments, rig)
    megapixels = sum(camera.size[0] * camera.size[1] for camera in rig) / 1e6
    n = _N_FULL if megapixels < _LARGE_MP else _N_FULL_LARGE
    places = [moment.k for moment in found.moments]
    chosen = sorted({places[k] for k in np.linspace(0, len(places) - 1, min(n, len(places))).astype(int)})
    turn = None if found.rig_repair is None else found.rig_repair.turn
    made = []
    for k in chosen:
        shown = {moment.k: moment.views for moment in found.moments}[k]
        images = opened.recording.silhouettes(facts.frame_ids[k]).images
        # Frozen pictures were left out before.
        masks = [
            None if view is None or image is None else _turned(image, turn)
            for view, image in zip(shown, images, strict=True)
        ]
        moment = moment_of(k, rig.cameras, masks)
        if moment is not None:
            made.append(moment)
    return made


def _in_metres(moments: Sequence[Moment], rig: Rig) -> list[Moment]:
    """The moments as they are, where they were looked at with whole pictures and in metres already."""
    made = []
    for moment in moments:
        ours = zip(moment.cameras, rig, strict=True)
        if all(np.allclose(one.centre, other.centre, rtol=0, atol=1e-6) for one, other in ours):
            made.append(moment)
            continue
        again = moment_of(moment.k, rig.cameras, [None if v is None else v.mask for v in moment.views])
        if again is not None:
            made.append(again)
    return made


def _turned(image: np.ndarray, turn: str | None) -> np.ndarray:
    if turn is None:
        return image
    steps = {"left-right": (1, -1), "upside down": (-1, 1), "by 180 degrees": (-1, -1)}[turn]
    return np.ascontiguousarray(image[:: steps[0], :: steps[1]])


def _world(
    opened: Opened, rig: Rig, found: Examination, moments: Sequence[Moment], up: str
) -> tuple[np.ndarray | None, str | None]:
    """The up axis by the cameras that agree, and why a run would refuse them all the same."""
    good = found.members or tuple(range(len(rig)))
    cameras, masks = rig, None
    if moments:
        cameras = Rig(moments[0].cameras)
        masks = [None if (view := moments[0].views[i]) is None else view.mask for i in good]
    try:
        world = settle_world(
            Rig(tuple(cameras[i] for i in good)), masks, declared_unit="m", up=up, where=opened.where
        )
    except RecordingError as error:
        return None, str(error)
    return world.up, None


def _rig_numbers(
    opened: Opened,
    facts: FrameFacts,
    found: Examination,
    rig: Rig,
    moments: Sequence[Moment],
    unit: str,
    per_unit: float,
    axis: np.ndarray | None,
) -> RigNumbers:
    height = volume = witnesses = lowest = highest = None
    if moments and len(found.members) >= 2:
        middle = moments[len(moments) // 2]
        images = [
            view.mask if view is not None and i in found.members else None
            for i, view in enumerate(middle.views)
        ]
        try:
            hull = build_hull(rig, images, _VOXEL_M, options=HullOptions(find_faults=False))
        except HullError:
            hull = None
        if hull is not None:
            volume = 1000 * hull.volume_m3
            witnesses = float(hull.n_witnesses.mean())
            if axis is not None:
                along = hull.vertices @ axis
                floor = float(along.min())
                height = float(along.max()) - floor
                above = rig.centres[list(found.members)] @ axis - floor
                lowest, highest = float(above.min()), float(above.max())
    return RigNumbers(
        len(rig),
        len(opened.recording.frame_ids),
        len(facts.frame_ids),
        unit,
        per_unit,
        None if axis is None else tuple(float(v) for v in axis),
        height,
        volume,
        witnesses,
        lowest,
        highest,
        tuple(rig.names[i] for i in found.members),
    )


def _camera_numbers(
    facts: FrameFacts,
    found: Examination,
    rig: Rig,
    outside: dict[int, float],
    moments: Sequence[Moment],
    axis: np.ndarray | None,
    numbers: RigNumbers,
) -> list[CameraNumbers]:
    centre = np.median([moment.bounds.centre for moment in moments], axis=0) if moments else None
    floor = None
    if axis is not None and centre is not None and numbers.person_height_m is not None:
        floor = float(centre @ axis) - 0.5 * numbers.person_height_m
    made = []
    for i, camera in enumerate(rig):
        fit, offset = found.fits.get(i), found.offsets.get(i)
        shown = facts.present[i]
        area = facts.area[i][shown]
        offset_frames = None
        if offset is not None and offset.frames is not None:
            offset_frames = offset.frames * facts.usual_step
        made.append(
            CameraNumbers(
                camera.name,
                camera.size,
                field_of_view_deg(camera),
                None if centre is None else float(np.linalg.norm(camera.centre - centre)),
                None if floor is None or axis is None else float(camera.centre @ axis) - floor,
                outside.get(i),
                None if fit is None else fit.iou,
                None if fit is None else fit.missing,
                None if fit is None else fit.surplus,
                offset_frames,
                float(area.mean()) if len(area) else 0.0,
                float(area.min()) if len(area) else 0.0,
                float(area.max()) if len(area) else 0.0,
                float(shown.mean()),
                float(facts.border[i][shown].mean()) if shown.any() else 0.0,
            )
        )
    return made


def field_of_view_deg(camera: Camera) -> tuple[float, float]:
    """(across, down) degrees between the picture's edges."""
    width, height = camera.size
    K = camera.intrinsics
    across = np.arctan((K[0, 2] + 0.5) / K[0, 0]) + np.arctan((width - 0.5 - K[0, 2]) / K[0, 0])
    down = np.arctan((K[1, 2] + 0.5) / K[1, 1]) + np.arctan((height - 0.5 - K[1, 2]) / K[1, 1])
    return float(np.degrees(across)), float(np.degrees(down))


def _lacking(found: Examination, facts: FrameFacts) -> list[Finding]:
    """Cameras that forbid what the others show, though no known mistake explains it, and lie inside them."""
    return [
        Finding(
            FindingKind.SILHOUETTES,
            (facts.rig.names[i],),
            f"its silhouettes lack a part: they forbid {share:.0%} of what the other cameras show",
            "look at them, and repair or leave out what is wrong",
            numbers={"forbidden": share},
        )
        for i, share in found.doubtful.items()
        if share > FORBIDDEN and i in found.fits and found.fits[i].surplus < FORBIDDEN
    ]


def _loose(cameras: Sequence[CameraNumbers], findings: Sequence[Finding], facts: FrameFacts) -> list[Finding]:
    """Cameras, or a whole rig, whose outlines stick out though no known mistake explains it."""
    named = {name for finding in findings if not finding.whole_rig for name in finding.cameras}
    told = {c.name: c.residual_px for c in cameras if c.residual_px is not None and c.name not in named}
    if not told:
        return []
    limits = {c.name: max(RESIDUAL_PX, RESIDUAL_SHARE * max(c.size)) for c in cameras}
    typical = float(np.median(list(told.values())))
    loose = [name for name, value in told.items() if value > limits[name]]
    refine = "refine the calibration: bodyhull calibrate refine"
    if len(loose) > 0.5 * len(told) or (loose and len(told) < 5):
        return [
            Finding(
                FindingKind.CALIBRATION,
                facts.rig.names,
                f"outlines lie up to {max(told.values()):.0f} px outside the hull of the other cameras "
                f"(median {typical:.1f} px; worst {max(told, key=lambda n: told[n])})",
                refine,
                whole_rig=True,
                numbers={"residual_px": typical},
            )
        ]
    return [
        Finding(
            FindingKind.CALIBRATION,
            (name,),
            f"its outline lies {told[name]:.0f} px outside the hull of the other cameras "
            f"(typical: {typical:.1f} px)",
            f"look at its silhouettes; if they are right, {refine}",
            numbers={"residual_px": told[name]},
        )
        for name in loose
        if told[name] > RESIDUAL_FACTOR * typical
    ]
