"""Rigs for filming a synthetic person: cameras on a dome, on a ring, or on the walls of a cage.

All aim at a standing person's volume, an upright cylinder on the floor around the world's origin, and each
camera's focal length is the longest that keeps the whole cylinder in its picture.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.rig import Rig

_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
_MARGIN = 0.03  # of the picture's half size, kept free on every side


def ring_layout(
    n_cameras: int,
    size: tuple[int, int] = (1024, 1024),
    *,
    distance_m: float = 4.0,
    camera_height_m: float = 1.3,
    radius_m: float = 1.0,
    height_m: float = 2.2,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Rig:
    """Equal angles around the subject, all at one height (metres above the floor).

    `size` (width, height) px; `radius_m`, `height_m`: the cylinder that every camera sees whole.
    """
    azimuth = 2 * np.pi * np.arange(n_cameras) / max(n_cameras, 1)
    positions = np.column_stack(
        [distance_m * np.cos(azimuth), distance_m * np.sin(azimuth), np.full(n_cameras, camera_height_m)]
    )
    return _aimed_rig(positions, size, radius_m, height_m, up)


def dome_layout(
    n_cameras: int,
    size: tuple[int, int] = (1024, 1024),
    *,
    distance_m: float = 4.0,
    lowest_deg: float = -8.0,
    highest_deg: float = 60.0,
    radius_m: float = 1.0,
    height_m: float = 2.2,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Rig:
    """A golden-angle spiral on a dome around the subject's middle, even in area between the two elevations.

    No camera stands straight above: its picture would have no upright direction. Other arguments as
    `ring_layout`.
    """
    low, high = np.sin(np.radians([lowest_deg, highest_deg]))
    rise = low + (high - low) * (np.arange(n_cameras) + 0.5) / max(n_cameras, 1)
    azimuth = _GOLDEN_ANGLE * np.arange(n_cameras)
    flat = np.sqrt(1 - rise**2)
    directions = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), rise])
    positions = distance_m * directions + [0, 0, height_m / 2]
    return _aimed_rig(positions, size, radius_m, height_m, up)


def cage_layout(
    n_cameras: int,
    size: tuple[int, int] = (1024, 1024),
    *,
    half_width_m: float = 3.4,
    heights_m: tuple[float, ...] = (0.5, 1.6, 2.8),
    radius_m: float = 1.0,
    height_m: float = 2.2,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Rig:
    """Cameras on the four walls of a square room, heights in turn, evenly spaced along the walls (3.4 to 4.9
    m away).

    Other arguments as `ring_layout`.
    """
    along = 8 * half_width_m * (np.arange(n_cameras) + 0.5) / max(n_cameras, 1)
    wall, offset = np.divmod(along, 2 * half_width_m)
    offset -= half_width_m
    x = np.choose(
        wall.astype(int),
        [np.full(n_cameras, half_width_m), -offset, np.full(n_cameras, -half_width_m), offset],
    )
    y = np.choose(
        wall.astype(int),
        [offset, np.full(n_cameras, half_width_m), -offset, np.full(n_cameras, -half_width_m)],
    )
    z = np.array(heights_m)[np.arange(n_cameras) % len(heights_m)]
    return _aimed_rig(np.column_stack([x, y, z]), size, radius_m, height_m, up)


def look_at(
    centre: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """camera_from_world (4 4) of a camera at `centre` that looks at `target`, `up` towards the top of its
    picture."""
    forward = target - centre
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    assert np.linalg.norm(right) > 1e-6, "a camera that looks along `up` has no upright picture"
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def _aimed_rig(
    positions: Float[np.ndarray, "c 3"],
    size: tuple[int, int],
    radius_m: float,
    height_m: float,
    up: tuple[float, float, float],
) -> Rig:
    """Cameras at these places (z-up, floor at 0), aimed and zoomed, then turned so that z becomes `up`."""
    volume = _cylinder(radius_m, height_m)
    world_from_upright = _rotation_from_z(np.array(up, dtype=np.float64))
    cameras = []
    for camera_idx, position in enumerate(positions):
        pose = look_at(position, np.array([0, 0, height_m / 2]), np.array([0.0, 0, 1]))
        seen = volume @ pose[:3, :3].T + pose[:3, 3]
        assert seen[:, 2].min() > 0, "the camera stands inside the subject's volume"
        spread = np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0)
        middle = (np.array(size, dtype=np.float64) - 1) / 2
        focal = float(((1 - _MARGIN) * middle / spread).min())
        intrinsics = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
        pose[:3, :3] = pose[:3, :3] @ world_from_upright.T
        cameras.append(Camera(f"cam-{camera_idx:03d}", size, intrinsics, pose, np.zeros(0)))
    return Rig(tuple(cameras))


def _cylinder(radius_m: float, height_m: float) -> Float[np.ndarray, "n 3"]:
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.vstack([np.column_stack([rim, np.full(64, z)]) for z in (0.0, height_m)])


def _rotation_from_z(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation that takes +z to the unit vector along `up`; the identity for z itself."""
    up = up / np.linalg.norm(up)
    axis = np.cross([0.0, 0, 1], up)
    sine, cosine = np.linalg.norm(axis), up[2]
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1, -1])
    axis /= sine
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
