"""What smoothing poses over time would gain: how much of the pose error is fast enough to be smoothed away.

    python -m benchmarks.pose_in_time

Fits people whose body is known (40 frames of one period of a motion), follows the markers of the accuracy
benchmark through all frames, and splits their errors, as vectors, into what a local quadratic over seven
frames keeps (slow; a filter that does not lag leaves it) and the rest (fast). Then it smooths the poses
themselves with that filter, and measures the markers again.
"""

from __future__ import annotations

import argparse

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from benchmarks.accuracy_cells import Cell, _fit, _seen, _tools, markers_of
from benchmarks.accuracy_protocol import tied_frames
from benchmarks.accuracy_subjects import SCANS
from benchmarks.hull import machine
from fit.settings import FitSettings
from fit.state import BodyState

#: Frames and degree of the filter: an even polynomial has no lag.
WINDOW, DEGREE = 7, 2
CELLS = (
    (8901, "tshirt-trousers", "tilt-twist"),
    (8902, "tshirt-trousers", "hips"),
    (8903, "tshirt-shorts", "shoulders-mill"),
    (8904, "loose", "tilt-twist"),
)


def smoothed_poses(poses: Float[np.ndarray, "t j 3"]) -> Float[np.ndarray, "t j 3"]:
    """Rotation vectors filtered over time as matrices, put back onto the rotations."""
    n, joints = poses.shape[:2]
    turns = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(n, joints, 3, 3)
    turns = savgol_filter(turns, WINDOW, DEGREE, axis=0, mode="interp")
    u, _, vt = np.linalg.svd(turns)
    return Rotation.from_matrix((u @ vt).reshape(-1, 3, 3)).as_rotvec().reshape(n, joints, 3)


def _vectors(
    true: Float[np.ndarray, "t m 3"], posed: Float[np.ndarray, "t v 3"]
) -> Float[np.ndarray, "s t m 3"]:
    """Errors of the markers (mm), for every set of ties (s), as vectors."""
    out = []
    for frame in tied_frames(len(true)):
        tie = np.linalg.norm(posed[frame][None] - true[frame][:, None], axis=2).argmin(axis=1)
        out.append(1e3 * (posed[:, tie] - true))
    return np.stack(out)


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(-1).mean()))


def measure(seed: int, outfit: str, motion: str, n_frames: int) -> list[float]:
    """Marker error (mm RMS): all of it, its slow and its fast part, and all with poses smoothed."""
    cell = Cell(seed, outfit, motion, SCANS, n_frames)
    recorded, scans, _ = _seen(seed, outfit, motion, n_frames, SCANS, cell.frame_ids)
    fitted = _fit(scans, lambda _: None, FitSettings())
    good = [f for f in fitted.track if f.status != "failed"]
    fitter = _tools()[0]
    markers = markers_of(recorded.subject.template, recorded.subject.joints)
    true = np.stack([recorded.truth(f.frame_id)[list(markers.values())] for f in good])

    def posed(poses: np.ndarray, moves: np.ndarray) -> np.ndarray:
        return np.stack(
            [
                fitter.posed(
                    BodyState(f.state.template, pose, move, fitted.fusion.betas), fitted.fusion.joints
                )
                for f, pose, move in zip(good, poses, moves, strict=True)
            ]
        )

    poses = np.stack([f.state.pose for f in good])
    moves = np.stack([f.state.translation for f in good])
    errors = _vectors(true, posed(poses, moves))
    slow = savgol_filter(errors, WINDOW, DEGREE, axis=1, mode="interp")
    smooth = posed(smoothed_poses(poses), savgol_filter(moves, WINDOW, DEGREE, axis=0, mode="interp"))
    return [_rms(errors), _rms(slow), _rms(errors - slow), _rms(_vectors(true, smooth))]


def main() -> None:
    """Print the table and the machine."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=40, help="frames of one period (default 40)")
    args = parser.parse_args()
    print(machine())
    print("\nMarker error, mm RMS, labelled scans\n")
    print("| seed | outfit | motion | all | slow | fast | all, poses smoothed |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for seed, outfit, motion in CELLS:
        values = " | ".join(f"{v:.2f}" for v in measure(seed, outfit, motion, args.frames))
        print(f"| {seed} | {outfit} | {motion} | {values} |", flush=True)


if __name__ == "__main__":
    main()
