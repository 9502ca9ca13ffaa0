"""A figure of balls that moves, as several cameras outline it: for the tests of what refines a rig."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.layouts import dome_layout
from capture.rig import Rig
from tests.hull_subjects import Balls, figure


def moments(n_frames: int) -> list[Balls]:
    """The figure turning, leaning and stepping aside."""
    found = []
    for k in range(n_frames):
        turn = Rotation.from_euler("zx", [0.7 * k, 0.25 * np.sin(1.3 * k)]).as_matrix()
        moved = figure().centres @ turn.T + [0.12 * np.cos(2 * k), 0.12 * np.sin(2 * k), 0.05]
        found.append(Balls(moved, figure().radii))
    return found


@lru_cache(maxsize=4)
def filmed(n_cameras: int, n_frames: int, side_px: int) -> tuple[Rig, list[list[np.ndarray]]]:
    """A dome of cameras and its silhouettes, by frame and camera."""
    rig = dome_layout(n_cameras, (side_px, side_px))
    return rig, [subject.silhouettes(rig) for subject in moments(n_frames)]


def displaced(camera: Camera, turn_deg: np.ndarray, shift_m: np.ndarray) -> Camera:
    """The camera turned about its own axes and shifted, world."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix() @ camera.camera_from_world[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ (camera.centre + shift_m)
    return replace(camera, camera_from_world=pose, projection=None)


def pixels_apart(rig: Rig, truth: Rig) -> np.ndarray:
    """(C,) how far points around the person move in each camera, px, after the similarity that fits best."""
    points = np.random.default_rng(0).uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 1.7], (300, 3))
    from_rig = np.concatenate([_triangulated(rig, truth, point) for point in points])
    middle, other = from_rig.mean(axis=0), points.mean(axis=0)
    u, s, v = np.linalg.svd((from_rig - middle).T @ (points - other))
    turn = (u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v).T
    scale = s.sum() / ((from_rig - middle) ** 2).sum()
    # A point of the true world, where the rig has it.
    there = (points - other) @ turn / scale + middle
    return np.array(
        [
            np.sqrt(((c.project(there)[0] - t.project(points)[0]) ** 2).sum(axis=1).mean())
            for c, t in zip(rig, truth, strict=True)
        ]
    )


def _triangulated(rig: Rig, truth: Rig, point: np.ndarray) -> np.ndarray:
    """Where the rig has a point that the true cameras see: where its rays meet, (1 3)."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for camera, true in zip(rig, truth, strict=True):
        centre, ray = camera.rays(true.project(point[None])[0])
        across = np.eye(3) - ray.T @ ray
        matrix += across
        right += across @ centre
    return np.linalg.solve(matrix, right)[None]
