"""How exact a rig is that was calibrated from a board's corners. Prints a Markdown table and the machine.

    python -m benchmarks.calibration_boards                          # 16 and 68 cameras, 60 boards, seeds 11
    12 13 python -m benchmarks.calibration_boards --cameras 16 --boards 40 --seeds 1 --noise-px 0.2

The rig is a dome of 4 MP cameras whose focal lengths, principal points and lenses differ; the board (12x8
squares of 60 mm, printed on one side) is held anywhere in the volume, towards one of the cameras, and
tilted. Corners scatter by 0.2 px in u and in v. Everything from corners to the rig is timed. Two measures of
the error, both without noise in what is compared: "volume": random points of the volume through the true and
through the found cameras, after one rigid motion of the whole world that fits best; "boards": new boards,
exact corners, from the poses that the found cameras give them. RMS distances in px over all cameras, and of
the worst camera. "told" is what the calibration itself says, from boards that it held out.
"""

from __future__ import annotations

import argparse
import time

import cv2
import numpy as np
from scipy.optimize import least_squares

from benchmarks.hull import machine
from capture.board import Board
from capture.board_agreement import locate_board
from capture.board_calibration import BoardCalibration, calibrate
from capture.board_view import BoardView, Sightings
from capture.camera import Camera
from capture.layouts import dome_layout, look_at
from capture.rig import Rig

BOARD = Board("checkerboard", 12, 8, 0.06)
SIZE = (2048, 2048)


def true_rig(n_cameras: int, rng: np.random.Generator) -> Rig:
    """A dome of cameras, each with its own lens."""
    cameras = []
    for camera in dome_layout(n_cameras, SIZE):
        intrinsics = camera.intrinsics.copy()
        intrinsics[0, 0] *= 1 + 0.02 * rng.standard_normal()
        intrinsics[1, 1] = intrinsics[0, 0] * (1 + 5e-4 * rng.standard_normal())
        intrinsics[:2, 2] += rng.normal(0, 12, 2)
        lens = np.array([-0.1, 0.08, 0, 0]) + [0.02, 0.02, 3e-4, 3e-4] * rng.standard_normal(4)
        cameras.append(Camera(camera.name, camera.size, intrinsics, camera.camera_from_world, lens))
    return Rig(tuple(cameras))


def held(rig: Rig, rng: np.random.Generator) -> np.ndarray:
    """world_from_board (4 4): somewhere in the volume, roughly towards one of the cameras, tilted."""
    centre = rng.uniform([-0.7, -0.7, 0.3], [0.7, 0.7, 1.7])
    towards = rig[int(rng.integers(len(rig)))].centre
    facing = np.linalg.inv(look_at(np.zeros(3), centre - towards, np.array([0.0, 0, 1])))[:3, :3]
    rotation = facing @ cv2.Rodrigues(np.radians(rng.uniform(-35, 35, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = centre - rotation @ BOARD.corners.mean(axis=0)
    return pose


def corners(rig: Rig, poses: list[np.ndarray], noise_px: float, rng: np.random.Generator) -> Sightings:
    """What the cameras see: whole boards, from their front, not steeper than 70 degrees."""
    views: list[dict[int, BoardView]] = [{} for _ in rig]
    for moment, pose in enumerate(poses):
        points = BOARD.corners @ pose[:3, :3].T + pose[:3, 3]
        for c, camera in enumerate(rig):
            ray = points.mean(axis=0) - camera.centre
            pixels, _ = camera.project(points)
            inside = (pixels > 4).all() and (pixels < np.array(SIZE) - 5).all()
            if inside and pose[:3, 2] @ ray > np.cos(np.radians(70)) * np.linalg.norm(ray):
                seen = pixels + rng.normal(0, noise_px, pixels.shape)
                views[c][moment] = BoardView(np.arange(len(seen)), seen, 1.2)
    return Sightings(rig.names, tuple(camera.size for camera in rig), tuple(views))


def projected(
    result: BoardCalibration, c: int, camera_from_points: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Points (N 3) through a found camera (N 2)."""
    lens = result.intrinsics[c]
    assert lens is not None
    turn = cv2.Rodrigues(camera_from_points[:3, :3])[0]
    return cv2.projectPoints(points, turn, camera_from_points[:3, 3], lens.matrix, lens.distortion)[
        0
    ].reshape(-1, 2)


def off_in_volume(result: BoardCalibration, truth: Rig, rng: np.random.Generator) -> tuple[float, float]:
    """RMS distance over all cameras, and of the worst one, px."""
    assert result.solution is not None
    found = result.solution.camera_from_rig
    points = rng.uniform([-0.7, -0.7, 0.1], [0.7, 0.7, 1.9], (200, 3))
    expected = np.array([truth[c].project(points)[0] for c in result.placed])
    first = result.placed[0]
    start = np.linalg.inv(found[first]) @ truth[first].camera_from_world

    def off(step: np.ndarray) -> np.ndarray:
        moved = points @ cv2.Rodrigues(step[:3])[0].T + step[3:]
        seen = [projected(result, c, found[c] @ start, moved) for c in result.placed]
        return (np.array(seen) - expected).ravel()

    error = least_squares(off, np.zeros(6), x_scale=1e-3).fun.reshape(len(result.placed), -1, 2)
    square = np.sum(error**2, axis=2)
    return float(np.sqrt(square.mean())), float(np.sqrt(square.mean(axis=1).max()))


def off_on_boards(
    result: BoardCalibration, truth: Rig, poses: list[np.ndarray], rng: np.random.Generator
) -> tuple[float, float]:
    """The same on new boards with exact corners."""
    assert result.solution is not None
    found = result.solution.camera_from_rig
    exact = corners(truth, poses, 0.0, rng)
    square: list[list[float]] = [[] for _ in truth]
    for moment in exact.shared_moments():
        seen = {c: exact.views[c][moment] for c in exact.seen_at(moment) if c in found}
        pose = locate_board(seen, BOARD, result.intrinsics, found)
        assert pose is not None
        for c, view in seen.items():
            off = projected(result, c, found[c] @ pose, BOARD.corners) - view.pixels
            square[c] += np.sum(off**2, axis=1).tolist()
    every = np.concatenate([np.array(s) for s in square])
    return float(np.sqrt(every.mean())), float(np.sqrt(max(np.mean(s) for s in square if s)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cameras", type=int, nargs="+", default=[16, 68])
    parser.add_argument("--boards", type=int, default=60)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13])
    parser.add_argument("--noise-px", type=float, default=0.2)
    options = parser.parse_args()
    print(f"{machine()}\n{options.boards} boards, corners scatter by {options.noise_px} px\n")
    print("| cameras | seed | corners | volume px | worst | boards px | worst | told px | wall s | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for n_cameras in options.cameras:
        for seed in options.seeds:
            rng = np.random.default_rng(seed)
            truth = true_rig(n_cameras, rng)
            seen = corners(truth, [held(truth, rng) for _ in range(options.boards)], options.noise_px, rng)
            wall, cpu = time.perf_counter(), time.process_time()
            result = calibrate(seen, BOARD)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            if len(result.placed) < n_cameras:
                print(
                    f"| {n_cameras} | {seed} | only {len(result.placed)} cameras placed | | | | | | | |",
                    flush=True,
                )
                continue
            volume, worst = off_in_volume(result, truth, rng)
            boards, worst_boards = off_on_boards(result, truth, [held(truth, rng) for _ in range(20)], rng)
            told = float("nan") if result.agreement is None else result.agreement.overall_px
            n_corners = sum(len(view) for views in seen.views for view in views.values())
            print(
                f"| {n_cameras} | {seed} | {n_corners} | {volume:.3f} | {worst:.3f} | {boards:.3f} | "
                f"{worst_boards:.3f} | {told:.3f} | {wall:.1f} | {cpu:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
