"""`bodyhull check`: everything a recording says about itself, gathered: numbers per camera and a verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyhull.check_numbers import CameraNumbers, RigNumbers, camera_numbers, rig_numbers
from bodyhull.check_units import metric_rig
from bodyhull.errors import UserError
from capture.errors import RecordingError
from capture.finding import Finding, FindingKind
from capture.frame_facts import FrameFacts, frames_to_read, read_frame_facts
from capture.preflight import Opened, open_for_check
from capture.rig import Rig
from capture.world import settle_world
from hull.preflight import Examination, examine
from hull.reference import Moment, moment_of, turned
from hull.residual import residuals

# Outlines that lie so many pixels (and this share of the picture's longer side) outside the others' hull,
# and so many times the typical camera's, are not the silhouettes' doing.
RESIDUAL_PX, RESIDUAL_SHARE, RESIDUAL_FACTOR = 6.0, 0.006, 2.5
# What is left of that in a late camera at its own moment, px.
LATE_PX = 3.0
# Where fewer of the cameras agree, and one is off, nobody can tell which: the whole rig is to be refined.
MOST = 0.75
# A camera that forbids this share of what the others show lacks a part.
FORBIDDEN = 0.04
_N_FULL, _N_FULL_LARGE, _LARGE_MP = 4, 2, 100.0


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
    rig, per_unit, unit, unit_findings = metric_rig(opened, facts, found)
    moments = _full_moments(opened, facts, found, rig)
    axis, trouble = _world(opened, rig, found, moments, up)
    numbers = rig_numbers(opened, facts, found, rig, moments, unit, per_unit, axis)
    outside = residuals(moments, found.members) if found.members else {}
    cameras = camera_numbers(facts, found, rig, outside, moments, axis, numbers)
    findings = [*opened.findings, *unit_findings, *_without_loose_late(opened, facts, found, moments)]
    findings += _lacking(found, facts)
    loose = _loose(cameras, findings, facts, found)
    if any(finding.whole_rig for finding in loose):
        # In a rig that is off another moment may fit better by chance: refined first, it can be asked again.
        findings = [f for f in findings if f.kind is not FindingKind.UNSYNCHRONISED]
    findings += loose
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


def _without_loose_late(
    opened: Opened, facts: FrameFacts, found: Examination, moments: Sequence[Moment]
) -> list[Finding]:
    """The findings but for late cameras whose outline sticks out at their own moment too, or among cameras of
    which too few agree: the calibration is off, and another moment fits better by chance."""
    late = {
        facts.rig.names.index(finding.cameras[0]): round(finding.numbers["offset_frames"] / facts.usual_step)
        for finding in found.findings
        if finding.kind is FindingKind.UNSYNCHRONISED and "offset_frames" in finding.numbers
    }
    if not late or not found.members:
        return list(found.findings)
    asked = {i for moment in found.moments for i, view in enumerate(moment.views) if view is not None}
    told = {facts.rig.names.index(name) for f in found.findings if not f.whole_rig for name in f.cameras}
    if len(asked & (told | set(found.members))) < MOST * len(asked):
        return [f for f in found.findings if f.kind is not FindingKind.UNSYNCHRONISED]
    turn = None if found.rig_repair is None else found.rig_repair.turn
    shifted = []
    for moment in moments:
        masks = [None if view is None else view.mask for view in moment.views]
        for i, n in late.items():
            k = moment.k + n
            image = None
            if 0 <= k < len(facts.frame_ids):
                image = opened.recording.silhouettes(facts.frame_ids[k]).images[i]
            masks[i] = turned(image, turn) if image is not None and turn is not None else image
        again = moment_of(moment.k, moment.cameras, masks)
        if again is not None:
            shifted.append(again)
    outside = residuals(shifted, found.members)
    # Ragged outlines stick out everywhere.
    usual = float(np.median([outside[i] for i in found.members if i in outside] or [0.0]))
    sizes = opened.recording.rig
    limits = {i: max(LATE_PX, RESIDUAL_SHARE * max(sizes[i].size), 2 * usual) for i in late}
    names = {facts.rig.names[i] for i in late if outside.get(i, 0.0) > limits[i]}
    return [
        f
        for f in found.findings
        if f.kind is not FindingKind.UNSYNCHRONISED or not names.intersection(f.cameras)
    ]


def _limit_px(size: tuple[int, int]) -> float:
    """How far the outline of a right camera may lie outside the hull of the others."""
    return max(RESIDUAL_PX, RESIDUAL_SHARE * max(size))


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
            None if view is None or image is None else image if turn is None else turned(image, turn)
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


def _loose(
    cameras: Sequence[CameraNumbers], findings: Sequence[Finding], facts: FrameFacts, found: Examination
) -> list[Finding]:
    """Cameras, or a whole rig, whose outlines stick out though no known mistake explains it."""
    named = {name for finding in findings if not finding.whole_rig for name in finding.cameras}
    told = {c.name: c.residual_px for c in cameras if c.residual_px is not None and c.name not in named}
    if not told:
        return []
    limits = {c.name: _limit_px(c.size) for c in cameras}
    typical = float(np.median(list(told.values())))
    loose = [name for name, value in told.items() if value > limits[name]]
    refine = "refine the calibration: bodyhull calibrate refine"
    few_agree = len({facts.rig.names[i] for i in found.trust.members} | named) < MOST * len(cameras)
    if len(loose) > 0.5 * len(told) or (loose and (few_agree or len(told) < 5)):
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
