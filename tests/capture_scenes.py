"""Small recordings for the tests of capture: a person made of balls, filmed by a synthetic rig."""

from pathlib import Path

import cv2
import numpy as np

from capture.camera import Camera
from capture.layouts import ring_layout
from capture.rig import Rig

# Centre (x, y, z) and radius of the balls, metres, z up: legs, trunk, head, one raised arm.
PERSON = np.array(
    [[0.1, 0, z, 0.09] for z in np.arange(0.09, 0.9, 0.08)]
    + [[-0.1, 0, z, 0.09] for z in np.arange(0.09, 0.9, 0.08)]
    + [[0, 0, z, 0.17] for z in np.arange(0.9, 1.45, 0.08)]
    + [[0, 0, 1.62, 0.12]]
    + [[0.2 + d, 0, 1.4 + d, 0.05] for d in np.arange(0, 0.45, 0.05)]
)


def ball_mask(camera: Camera, balls: np.ndarray) -> np.ndarray:
    """255 where a ray through the pixel's centre hits a ball (exact, lens included), else 0."""
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    origin, directions = camera.rays(pixels)
    hit = np.zeros(len(pixels), bool)
    for ball in balls:
        to_ball = ball[:3] - origin
        along = directions @ to_ball
        hit |= (along > 0) & (to_ball @ to_ball - along**2 < ball[3] ** 2)
    return np.where(hit, 255, 0).astype(np.uint8).reshape(height, width)


def small_rig(n_cameras: int = 4, size: tuple[int, int] = (120, 160)) -> Rig:
    return ring_layout(n_cameras, size, camera_height_m=1.5)


def write_inria(
    root: Path,
    rig: Rig,
    *,
    n_frames: int = 3,
    sequence: str = "",
    unit_m: float = 1.0,
    world_change: np.ndarray | None = None,
) -> Path:
    """An INRIA recording of the ball person. world_change (4 4): new world from old; unit_m: metres per file
    unit."""
    (root / "setup").mkdir(parents=True, exist_ok=True)
    change = np.eye(4) if world_change is None else world_change
    for camera_idx, camera in enumerate(rig):
        matrix = camera.projection_matrix @ np.linalg.inv(change)
        matrix = matrix @ np.diag([unit_m, unit_m, unit_m, 1.0])
        np.savetxt(root / "setup" / f"cam{camera_idx:02d}.txt", matrix, fmt="%.17g")
        folder = root / sequence / "SilhouettesPictures" / f"cam-{camera_idx:03d}"
        folder.mkdir(parents=True, exist_ok=True)
        for frame in range(n_frames):
            moved = PERSON + np.array([0.05 * frame, 0, 0, 0])
            cv2.imwrite(str(folder / f"silh_{frame:06d}.png"), ball_mask(camera, moved))
    return root


def silhouette_path(root: Path, camera_idx: int, frame: int) -> Path:
    return root / "SilhouettesPictures" / f"cam-{camera_idx:03d}" / f"silh_{frame:06d}.png"
