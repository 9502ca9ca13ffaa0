"""What `bodyhull calibrate refine` makes of a rig that is off. Prints Markdown tables.

    python -m benchmarks.calibration_refine                       # synthetic people and rigs, outlines alone
    python -m benchmarks.calibration_refine --people FOLDER       # the same errors on the rig of the people
    python -m benchmarks.calibration_refine --real FOLDER         # a recording with keypoints and no truth
    python -m benchmarks.calibration_refine --seeds 11 12 13 --mask-px 0 1 --rigs dome:16 ring:16

Every camera of a true rig is turned by 0.5 to 1 degree and shifted by 10 to 20 mm, in random directions, and
the rig is refined from the outlines of the frames. Turns and shifts are told after one similarity that lays
the rig on the true one (nothing in a recording says where the world's origin is, or how long a metre); volume
is that of the hull, as the user gets it, against the one carved with the true rig from the same silhouettes,
and once more after the similarity. Errors, and ragged outlines, come from seeds given with --seeds; seeds up
to 6 were used in the making (on other people).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.hull import machine
from capture.keypoints import chosen_detections, read_keypoints, triangulate_keypoints
from capture.recording import Recording, open_recording
from capture.rig import Rig
from hull.rig_refinement import Evidence, refine_pose
from hull.tangency import OuterTangency
from hull.touching_planes import OutlineFrame
from hull.visual_hull import HullOptions, build_hull
from render.spoil import displaced_rig, wandering_outline

TURN_DEG, SHIFT_M = (0.5, 1.0), (0.01, 0.02)
VOXEL_M = 0.012
N_CARVED = 2
PEOPLE = ("f11_lunge", "m11_mill", "m12_lunge", "f11_bare")
MOTIONS = ("tilt-twist", "walk", "shoulders-mill")


def laid_on(rig: Rig, truth: Rig) -> Rig:
    """The rig after the similarity that takes its cameras to the true ones."""
    turns = [
        t.camera_from_world[:3, :3].T @ c.camera_from_world[:3, :3] for c, t in zip(rig, truth, strict=True)
    ]
    turn = Rotation.from_matrix(np.array(turns)).mean().as_matrix()
    own, true = rig.centres @ turn.T, truth.centres
    own_middle, true_middle = own.mean(axis=0), true.mean(axis=0)
    scale = ((own - own_middle) * (true - true_middle)).sum() / ((own - own_middle) ** 2).sum()
    cameras = []
    for camera, centre in zip(rig, scale * (own - own_middle) + true_middle, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = camera.camera_from_world[:3, :3] @ turn.T
        pose[:3, 3] = -pose[:3, :3] @ centre
        cameras.append(replace(camera, camera_from_world=pose, projection=None))
    return Rig(tuple(cameras))


def errors(rig: Rig, truth: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Turns (C,) degrees and shifts (C,) mm from the true rig."""
    turns = [
        t.camera_from_world[:3, :3] @ c.camera_from_world[:3, :3].T for c, t in zip(rig, truth, strict=True)
    ]
    return (
        np.degrees(Rotation.from_matrix(np.array(turns)).magnitude()),
        1000 * np.linalg.norm(rig.centres - truth.centres, axis=1),
    )


def volume(rig: Rig, images: list) -> float:
    return build_hull(rig, images, VOXEL_M, options=HullOptions(find_faults=False)).volume_m3


def row(title: str, recording: Recording, seed: int, mask_px: float, n_frames: int) -> None:
    """Plant, refine, compare; one line."""
    truth = recording.rig
    rng = np.random.default_rng([seed, 13])
    places = np.unique(np.linspace(0, len(recording.frame_ids) - 1, n_frames).round().astype(int))
    carved = set(places[[0, len(places) // 2]].tolist()[:N_CARVED])
    frames, kept = [], []
    for place in places.tolist():
        masks = recording.silhouettes(recording.frame_ids[place]).images
        images = [None if m is None else wandering_outline(m, mask_px, rng) for m in masks]
        frames.append(OutlineFrame.of(images))
        if place in carved:
            kept.append(images)
    given = displaced_rig(truth, TURN_DEG, SHIFT_M, seed)
    start = time.perf_counter()
    refinement = refine_pose(given, Evidence(tuple(frames), ()))
    seconds = time.perf_counter() - start
    refined = refinement.pose.in_rig(given, refinement.moved)
    true_volume = [volume(truth, images) for images in kept]
    cells = [title, str(len(truth)), str(seed), f"{mask_px:g}"]
    outer = OuterTangency(frames, refinement.moved)
    for rig in (given, refined):
        turns, shifts = errors(laid_on(rig, truth), truth)
        loss = [volume(rig, i) / v - 1 for i, v in zip(kept, true_volume, strict=True)]
        residual = float(np.median(np.abs(outer.residuals(type(refinement.pose).of(rig))[0])))
        cells += [f"{residual:.2f}", f"{turns.mean():.3f}", f"{turns.max():.3f}", f"{shifts.mean():.1f}"]
        cells += [f"{100 * np.mean(loss):+.2f}"]
    loss = [volume(laid_on(refined, truth), i) / v - 1 for i, v in zip(kept, true_volume, strict=True)]
    cells += [f"{100 * np.mean(loss):+.2f}", str(len(refinement.left)), f"{seconds:.0f}"]
    print("| " + " | ".join(cells) + " |", flush=True)


def head() -> None:
    names = ["rig", "cameras", "seed", "mask noise px"]
    for when in ("before", "after"):
        names += [f"{when}: outlines px", "turned deg, mean", "worst", "shifted mm", "volume %"]
    names += ["volume % on the true scale", "left out", "s"]
    print("| " + " | ".join(names) + " |\n|" + " --- |" * len(names))


def keypoint_residual(recording: Recording, rig: Rig, folder: Path, least_score: float) -> float:
    """Median pixels as filmed from the subject's detections of that score to its triangulated joints."""
    found = []
    for frame_id in recording.frame_ids:
        chosen = chosen_detections(rig, read_keypoints(folder, rig.names, frame_id), None)
        pixels = np.array([camera.distort(each[:, :2]) for camera, each in zip(rig, chosen, strict=True)])
        scores = np.where(chosen[..., 2] >= least_score, chosen[..., 2], 0.0)
        joints = triangulate_keypoints(rig, list(np.dstack([pixels, scores])[:, None]), None)
        known = np.isfinite(joints[:, 0])
        for camera_idx, camera in enumerate(rig):
            seen = known & (scores[camera_idx] > 0)
            apart = camera.project(joints[seen, :3])[0] - pixels[camera_idx, seen]
            found.append(np.linalg.norm(apart, axis=1))
    return float(np.median(np.concatenate(found)))


def real(folder: Path) -> None:
    """The residual of the keypoints of every fourth frame, which refining does not see: of detections of at
    least some scores, joints triangulated from those."""
    recording, judged = open_recording(folder), open_recording(folder, frames="3::4")
    keypoints = folder / "keypoints"
    given = recording.calibration
    people = [
        chosen_detections(given, read_keypoints(keypoints, given.names, frame_id), None)
        for place, frame_id in enumerate(recording.frame_ids)
        if place % 4 != 3
    ]
    least = (0.1, 0.3, 0.5)
    print("\n| median px, detections of score at least | " + " | ".join(map(str, least)) + " |")
    print("|" + " --- |" * (len(least) + 1))
    rigs = {"the file's rig": given}
    for name, focal in (("refined from keypoints", False), ("focal lengths too", True)):
        refinement = refine_pose(recording.rig, Evidence((), tuple(people)), focal=focal)
        rigs[name] = refinement.pose.in_rig(given, refinement.moved)
    for name, rig in rigs.items():
        cells = [f"{keypoint_residual(judged, rig, keypoints, score):.2f}" for score in least]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--mask-px", type=float, nargs="+", default=[0.0, 1.0])
    parser.add_argument("--rigs", nargs="+", default=["dome:16", "ring:16", "cage:16", "dome:8", "cage:32"])
    parser.add_argument("--frames", type=int, default=18)
    parser.add_argument("--people", type=Path)
    parser.add_argument("--real", type=Path)
    options = parser.parse_args()
    print(machine())
    if options.real is not None:
        real(options.real)
        return
    print()
    head()
    for k, seed in enumerate(options.seeds):
        if options.people is not None:
            for name in PEOPLE:
                recording = open_recording(options.people, sequence=name)
                for mask_px in options.mask_px:
                    row(name, recording, seed, mask_px, options.frames)
            continue
        from fit.body import load_body
        from render.synthetic import film

        for rig in options.rigs:
            layout, n_cameras = rig.split(":")
            with tempfile.TemporaryDirectory() as folder:
                motion = MOTIONS[k % len(MOTIONS)]
                film(
                    folder, body=load_body("free:neutral"), n_cameras=int(n_cameras), layout=layout,
                    n_frames=options.frames, motion=motion, seed=100 + seed, pictures=False, progress=False,
                )  # fmt: skip
                recording = open_recording(folder, units="m", up="z")
                for mask_px in options.mask_px:
                    row(f"{layout}, {motion}", recording, seed, mask_px, options.frames)


if __name__ == "__main__":
    main()
