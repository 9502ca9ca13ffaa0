"""What is wrong with a calibration, camera by camera, with what to do about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from capture.board_calibration import BoardCalibration
from capture.board_mirror import shared_when_flipped
from capture.board_sync import Delay, find_delay

_FEW_VIEWS = 8
_LITTLE_COVERAGE = 0.4
_BLURRED_PX = 5.0  # edges as wide as that may be a near board out of focus, which does no harm
_SURELY_BLURRED_PX = 10.0
_LARGE_RMS_PX = 0.5
_UNSURE_FOCAL = 0.01  # standard deviation of the focal length, of itself
_STANDS_OUT = 3.0  # times the usual residual
_LARGE_PX = 1.0
_POOR_AGREEMENT_PX = 0.25  # beyond, hulls lose volume
_ONE_PLACE_M = 0.01


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong. camera: its name, "" for the whole rig; kind: a word for programs; sentence:
    for people; grave: the calibration should not be used for this camera.
    """

    camera: str
    kind: str
    sentence: str
    grave: bool = False


def find_delays(result: BoardCalibration) -> dict[str, Delay]:
    """Cameras whose views fit when their frame numbers are shifted: outside the rig, or standing out in
    it."""
    solution = result.solution
    if solution is None:
        return {}
    suspects = [c for c in range(result.sightings.n_cameras) if c not in result.placed]
    usual = float(np.nanmedian(result.rms_px)) if np.isfinite(result.rms_px).any() else np.nan
    suspects += [
        c
        for c in result.placed
        if result.rms_px[c] > max(_STANDS_OUT * usual, _LARGE_PX) and len(result.placed) > 2
    ]
    out: dict[str, Delay] = {}
    for c in suspects:
        lens = result.intrinsics[c]
        if lens is None:
            continue
        # Only boards that another camera saw say where this one should have seen it.
        poses = {
            m: pose
            for m, pose in solution.rig_from_board.items()
            if any(m in result.sightings.views[k] for k in result.placed if k != c)
        }
        delay = find_delay(result.sightings.views[c], result.board, lens, poses)
        if delay is not None:
            out[result.sightings.names[c]] = delay
    return out


def find_faults(
    result: BoardCalibration, delays: dict[str, Delay], *, extrinsics: bool = True
) -> tuple[Finding, ...]:
    """All findings, the gravest first."""
    found: list[Finding] = []
    for c, name in enumerate(result.sightings.names):
        found += _of_lens(result, c, name)
    if extrinsics:
        found += _of_rig(result, delays)
    return tuple(sorted(found, key=lambda one: not one.grave))


def _of_lens(result: BoardCalibration, c: int, name: str) -> list[Finding]:
    lens = result.intrinsics[c]
    n_views = len(result.sightings.of(c))
    if lens is None:
        return [
            Finding(
                name,
                "too few views",
                f"{name}: the board was found {n_views} times, too few or too alike to calibrate its "
                "lens; film the whole "
                "board nearer to it, tilted to every side, at least 10 times",
                True,
            )
        ]
    found = []
    if lens.n_views < _FEW_VIEWS and np.isfinite(lens.focal_sd_px):
        found.append(
            Finding(
                name,
                "few views",
                f"{name}: {lens.n_views} usable views of the board; take at least 10, tilted in turn",
            )
        )
    for note in lens.notes:
        found.append(
            Finding(name, "assumed", f"{name}: {note}; tilt the board more and show it in all corners")
        )
    if lens.coverage < _LITTLE_COVERAGE:
        found.append(
            Finding(
                name,
                "little coverage",
                f"{name}: corners cover {100 * lens.coverage:.0f} % of the picture; its lens is "
                "guessed elsewhere: show the "
                "board near the picture's borders and corners",
            )
        )
    if lens.edge_px > (_BLURRED_PX if lens.rms_px > _LARGE_RMS_PX else _SURELY_BLURRED_PX):
        found.append(
            Finding(
                name,
                "blurred",
                f"{name}: edges are {lens.edge_px:.0f} px wide; focus it, hold the board still, or "
                "shorten the exposure",
            )
        )
    if np.isfinite(lens.focal_sd_px) and lens.focal_sd_px > _UNSURE_FOCAL * lens.focal_px:
        found.append(
            Finding(
                name,
                "focal length unsure",
                f"{name}: focal length known to {100 * lens.focal_sd_px / lens.focal_px:.1f} % only; "
                "tilt the board by 30 "
                "to 45 degrees and come nearer",
            )
        )
    return found


def _of_rig(result: BoardCalibration, delays: dict[str, Delay]) -> list[Finding]:
    found: list[Finding] = []
    names = result.sightings.names
    solution = result.solution
    for name, delay in delays.items():
        late = "late" if delay.frames > 0 else "early"
        found.append(
            Finding(
                name,
                "not synchronised",
                f"{name}: its frames run {abs(delay.frames):g} {late} (misfit {delay.before_px:.1f} "
                "px, shifted "
                f"{delay.after_px:.1f} px); synchronise it, or shift its video by that much everywhere",
                True,
            )
        )
    if solution is None:
        return found
    groups = [tuple(names[c] for c in group) for group in solution.groups[1:]]
    for group in groups:
        if len(group) > 1:
            found.append(
                Finding(
                    group[0],
                    "separate group",
                    f"{', '.join(group)} agree with each other but share no board with "
                    f"{names[result.placed[0]]} and the "
                    "rest; show the board where cameras of both groups see it at once",
                    True,
                )
            )
            continue
        if group[0] in delays or result.intrinsics[names.index(group[0])] is None:
            continue
        c = names.index(group[0])
        n_shared = max((n for pair, (_, n) in solution.pairs.items() if c in pair), default=0)
        if n_shared == 0:
            text = f"{group[0]}: shares no board with another camera; show the board where one sees it too"
            found.append(Finding(group[0], "unconnected", text, True))
            continue
        flipped = shared_when_flipped(result.sightings, result.board, result.intrinsics, c, result.placed)
        if flipped is not None:
            text = (
                f"{group[0]}: its pictures are mirrored (flipped, {flipped[0]} of {flipped[1]} boards "
                "agree with "
                "another camera's); switch mirroring off, or flip them, and calibrate again"
            )
            found.append(Finding(group[0], "mirrored", text, True))
        else:
            text = (
                f"{group[0]}: its boards contradict the other cameras' (no common pose in up to "
                f"{n_shared} shared boards): "
                "not synchronised, moved, or same names for different moments"
            )
            found.append(Finding(group[0], "contradicts", text, True))
    usual = float(np.nanmedian(result.rms_px))
    for c in result.placed:
        if result.rms_px[c] > max(_STANDS_OUT * usual, _LARGE_PX) and names[c] not in delays:
            found.append(
                Finding(
                    names[c],
                    "residual",
                    f"{names[c]}: residual {result.rms_px[c]:.2f} px, the others' {usual:.2f}; was it "
                    "moved, is it not "
                    "synchronised, does its lens change focus? Film the board again",
                    True,
                )
            )
        if result.agreement is not None and result.agreement.boards_px[c] > max(
            _STANDS_OUT * result.agreement.overall_px / 2, _POOR_AGREEMENT_PX
        ):
            found.append(
                Finding(
                    names[c],
                    "agreement",
                    f"{names[c]}: off by {result.agreement.boards_px[c]:.2f} px on held-out boards; "
                    "show it the board more "
                    "often together with the others, in the middle of the volume",
                )
            )
    found += _same_place(result)
    return found


def _same_place(result: BoardCalibration) -> list[Finding]:
    """Two cameras in one place: usually the same pictures twice."""
    solution = result.solution
    assert solution is not None
    centres = {c: np.linalg.inv(solution.camera_from_rig[c])[:3, 3] for c in result.placed}
    names = result.sightings.names
    found = []
    for k, c in enumerate(result.placed):
        for other in result.placed[k + 1 :]:
            if np.linalg.norm(centres[c] - centres[other]) < _ONE_PLACE_M:
                found.append(
                    Finding(
                        names[other],
                        "same place",
                        f"{names[other]} and {names[c]} stand in one place: are these the same "
                        "pictures twice?",
                        True,
                    )
                )
    return found
