"""`bodyhull calibrate refine` on the command line: a rig refined from the recording itself."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from bodyhull.errors import OK, UserError
from bodyhull.recording_choice import RecordingChoice

if TYPE_CHECKING:
    from jaxtyping import Float

    from capture.recording import Recording
    from capture.rig import Rig
    from hull.rig_refinement import Evidence, Refinement, RigScore

#: Where a recording keeps its keypoints, if it has any.
KEYPOINTS = "keypoints"
# So many silhouettes of all cameras are looked at, in so many frames at least and at most; and keypoints.
_N_SILHOUETTES, _FEWEST_FRAMES, _MOST_FRAMES, _MOST_KEYPOINT_FRAMES = 400, 8, 24, 200
# Time is cut into so many parts, of which some are held out: frames next to each other are nearly the same.
_PARTS, _HELD_OUT_PARTS = 8, (2, 6)
# The hulls of the others are carved in so many held-out frames, in fewer for large rigs, and no finer.
_MOST_CARVED, _MOST_HULLS, _VOXEL_M = 3, 72, 0.016


@dataclass(frozen=True, kw_only=True)
class Refine(RecordingChoice):
    """Refine where the cameras stand from what the recording shows: the person's outlines, and keypoints if
    there are any. No board is needed."""

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Rig file (.json) to write; --calibration takes it. Not written where it would not be better."""
    keypoints: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of keypoints, OpenPose's or COCO's; RECORDING/keypoints if that exists."""
    focal: bool = False
    """Refine focal lengths too."""


@dataclass(frozen=True)
class Looked:
    """What was seen: evidence to refine with and to judge by, and held-out frames to carve (frame number and
    silhouettes)."""

    used: Evidence
    held_out: Evidence
    carved: tuple[tuple[int, tuple[np.ndarray | None, ...]], ...]
    n_used: int
    n_held_out: int


def perform_refine(command: Refine) -> int:
    """Refine, print the table, write the rig if it is better on frames that were held out."""
    from hull.rig_refinement import refine_pose

    if command.out.suffix.lower() != ".json":
        raise UserError(f"--out {command.out}: give the name of a .json file; --calibration knows it by that")
    if command.keypoints is not None and not command.keypoints.is_dir():
        raise UserError(f"--keypoints {command.keypoints}: no such folder")
    started = time.perf_counter()
    recording = command.opened()
    if len(recording.frame_ids) < 2:
        raise UserError(
            f"{command.recording}: 1 frame chosen; refining needs 2 at least, since some are held out to "
            "judge the result by: choose more with --frames"
        )
    beside = command.recording / KEYPOINTS
    keypoints = command.keypoints or (beside if beside.is_dir() else None)
    looked = look(recording, keypoints)
    refinement = refine_pose(recording.rig, looked.used, focal=command.focal)
    before, after = scores(recording, refinement, looked)
    print(table(recording.rig, refinement, before, after))
    for camera_idx, why in sorted(refinement.left.items()):
        print(f"bodyhull: camera {recording.rig[camera_idx].name} {why}", file=sys.stderr)
    source = "keypoints and outlines" if looked.used.people else "outlines"
    print(f"\nfrom {source} of {looked.n_used} frames, judged on {looked.n_held_out} others")
    if not after.better_than(before):
        raise UserError(
            f"{command.out}: not written, since on the frames held out the refined rig is no better than the "
            f"given one ({told(before)} before, {told(after)} after); keep the given calibration"
        )
    refined = refinement.pose.in_rig(recording.calibration, refinement.moved)
    command.out.parent.mkdir(parents=True, exist_ok=True)
    refined.save(command.out)
    print(f"held-out frames: {told(before)} before, {told(after)} after")
    print(f"rig: {command.out}   ({time.perf_counter() - started:.0f} s)")
    return OK


def told(score: RigScore) -> str:
    """The numbers that a rig is judged by, in words."""
    parts = []
    if np.isfinite(score.keypoints_px):
        parts.append(f"keypoints {score.keypoints_px:.2f} px")
    if np.isfinite(score.outlines_px):
        parts.append(f"outlines {score.outlines_px:.2f} px")
    if np.isfinite(score.mean_iou):
        parts.append(f"IoU {score.mean_iou:.4f}")
    return ", ".join(parts)


def held_out_frames(n_frames: int) -> set[int]:
    """Which places in time (0 to n - 1) are held out: whole stretches, a quarter of all, one at least."""
    chosen = {place for place in range(n_frames) if place * _PARTS // n_frames in _HELD_OUT_PARTS}
    return chosen or {n_frames - 1}


def spread(places: list[int], most: int) -> list[int]:
    """At most so many of the places, evenly."""
    if len(places) <= most:
        return places
    return [places[i] for i in np.unique(np.linspace(0, len(places) - 1, most).round().astype(int))]


def look(recording: Recording, keypoints: Path | None) -> Looked:
    """Read silhouettes and keypoints of frames spread over the recording; no silhouettes are kept but those
    to be carved."""
    from tqdm import tqdm

    from capture.keypoints import chosen_detections, read_keypoints
    from hull.rig_refinement import Evidence
    from hull.touching_planes import OutlineFrame

    n_frames, n_cameras = len(recording.frame_ids), len(recording.rig)
    held_out = held_out_frames(n_frames)
    sides = ([p for p in range(n_frames) if p not in held_out], sorted(held_out))
    n_looked = int(np.clip(_N_SILHOUETTES // n_cameras, _FEWEST_FRAMES, _MOST_FRAMES))
    shares = (n_looked - n_looked // 4, n_looked // 4)
    outlines: tuple[list[OutlineFrame], list[OutlineFrame]] = ([], [])
    people: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    carved = []
    n_carved = int(np.clip(_MOST_HULLS // n_cameras, 1, _MOST_CARVED))
    total = [spread(side, share) for side, share in zip(sides, shares, strict=True)]
    to_carve = set(spread(total[1], n_carved))
    progress = tqdm(total=sum(map(len, total)), desc="silhouettes", unit="frame", file=sys.stderr)
    for side, places in enumerate(total):
        for place in places:
            frame_id = recording.frame_ids[place]
            silhouettes = recording.silhouettes(frame_id)
            for problem in silhouettes.problems:
                tqdm.write(f"warning: {problem}", file=sys.stderr)
            outlines[side].append(OutlineFrame.of(silhouettes.images))
            if place in to_carve and side == 1:
                carved.append((frame_id, silhouettes.images))
            progress.update()
    progress.close()
    if keypoints is not None:
        for side, places in enumerate(sides):
            most = _MOST_KEYPOINT_FRAMES if side == 0 else _MOST_KEYPOINT_FRAMES // 3
            for place in spread(places, most):
                found = read_keypoints(keypoints, recording.rig.names, recording.frame_ids[place])
                people[side].append(chosen_detections(recording.calibration, found, None))
        if not any((each[..., 2] > 0).any() for each in people[0]):
            raise UserError(
                f"{keypoints}: in no frame do two cameras' keypoints agree on a person; are they of this "
                "recording? Give others with --keypoints"
            )
    evidence = [Evidence(tuple(outlines[side]), tuple(people[side])) for side in (0, 1)]
    return Looked(evidence[0], evidence[1], tuple(carved), len(total[0]), len(total[1]))


def scores(recording: Recording, refinement: Refinement, looked: Looked) -> tuple[RigScore, RigScore]:
    """The given rig's score on the frames held out, and the refined one's."""
    from capture.rig_adjustment import RigPose
    from hull.rig_consistency import agreement_with_others
    from hull.rig_refinement import score_pose

    result = []
    for pose in (RigPose.of(recording.rig), refinement.pose):
        rig = pose.in_rig(recording.rig)
        each = [agreement_with_others(rig, images, refinement.moved, _VOXEL_M) for _, images in looked.carved]
        iou = _mean_known(np.array(each).reshape(-1, len(rig)))
        result.append(score_pose(recording.rig, pose, looked.held_out, refinement.moved, iou))
    return result[0], result[1]


def _mean_known(values: Float[np.ndarray, "n c"]) -> Float[np.ndarray, " c"]:
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def table(rig: Rig, refinement: Refinement, before: RigScore, after: RigScore) -> str:
    """A line a camera: what moved, and the numbers before and after, on the frames held out."""
    from capture.rig_adjustment import N_POSE, RigPose

    step = refinement.pose.step_from(RigPose.of(rig), N_POSE + 1)
    turned = np.degrees(np.linalg.norm(step[:, :3], axis=1))
    shifted = 1000 * np.linalg.norm(step[:, 3:N_POSE], axis=1)
    with_keypoints = np.isfinite(before.keypoint_px).any()
    with_focal = bool(np.abs(step[:, N_POSE]).max(initial=0.0) > 0)
    header = ["camera", "turned, deg", "moved, mm"]
    header += ["focal, %"] if with_focal else []
    header += ["keypoints, px"] if with_keypoints else []
    header += ["outlines, px", "IoU with the others' hull"]
    rows = [header]
    for k, name in enumerate(rig.names):
        row = [name, f"{turned[k]:.3f}", f"{shifted[k]:.1f}"]
        row += [f"{100 * np.expm1(step[k, N_POSE]):+.2f}"] if with_focal else []
        row += [_change(before.keypoint_px[k], after.keypoint_px[k], 2)] if with_keypoints else []
        row += [
            _change(before.outline_px[k], after.outline_px[k], 2),
            _change(before.iou[k], after.iou[k], 3),
        ]
        rows.append(row)
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _change(before: float, after: float, digits: int) -> str:
    shown = ["-" if np.isnan(value) else f"{value:.{digits}f}" for value in (before, after)]
    return " -> ".join(shown)
