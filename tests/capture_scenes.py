"""Small recordings for the tests of capture: a person made of balls, filmed by a synthetic rig."""

from functools import lru_cache
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


@lru_cache(maxsize=16)
def _rays(camera: Camera) -> np.ndarray:
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    return camera.rays(pixels)[1].reshape(height, width, 3)


def _hit(camera: Camera, ball: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray]:
    """A box around the ball in the picture, and where in it a ray through the pixel's centre hits (exact,
    lens too)."""
    (u, v), depth = camera.project(ball[None, :3].copy())[0][0], camera.project(ball[None, :3].copy())[1][0]
    reach = 1.3 * ball[3] * camera.intrinsics[0, 0] / depth + 3
    box = (
        slice(max(0, int(v - reach)), max(0, int(v + reach))),
        slice(max(0, int(u - reach)), max(0, int(u + reach))),
    )
    to_ball = ball[:3] - camera.centre
    return box, to_ball @ to_ball - (_rays(camera)[box] @ to_ball) ** 2 < ball[3] ** 2


def ball_mask(camera: Camera, balls: np.ndarray) -> np.ndarray:
    """255 where a ray through the pixel's centre hits a ball, else 0."""
    mask = np.zeros(camera.size[::-1], np.uint8)
    for ball in balls:
        box, hit = _hit(camera, ball)
        mask[box][hit] = 255
    return mask


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


def ball_picture(camera: Camera, balls: np.ndarray, background: np.ndarray) -> np.ndarray:
    """RGB (h w 3): skin-coloured balls, black ones between 0.75 and 1.05 m height (shorts), before a
    background."""
    picture = background.copy()
    order = np.argsort(-np.linalg.norm(balls[:, :3] - camera.centre, axis=1))
    for ball in balls[order]:
        box, hit = _hit(camera, ball)
        colour = np.array([25, 25, 30]) if 0.75 < ball[2] < 1.05 else np.array([205, 150, 125])
        picture[box][hit] = colour + np.random.default_rng(0).integers(-6, 6, (int(hit.sum()), 3))
    return picture


def room(camera_idx: int, size: tuple[int, int]) -> np.ndarray:
    """RGB (h w 3): a cluttered wall, another one for each camera."""
    rng = np.random.default_rng(camera_idx)
    width, height = size
    wall = cv2.resize(rng.integers(90, 200, (6, 5, 3)).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    for _ in range(12):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        colour = tuple(int(value) for value in rng.integers(20, 235, 3))
        cv2.rectangle(wall, (x, y), (x + int(rng.integers(5, 40)), y + int(rng.integers(5, 40))), colour, -1)
    return wall


def write_videos(
    root: Path, rig: Rig, *, n_frames: int = 24, ghost: np.ndarray | None = None
) -> dict[tuple[int, int], np.ndarray]:
    """A folder of videos with plates and rig.json; the person walks along x. Truth: (camera, frame) -> mask
    as filmed.

    ghost : balls of somebody who stands on the plates, but is gone in the videos.
    """
    (root / "videos").mkdir(parents=True)
    (root / "background").mkdir()
    truth = {}
    for camera_idx, camera in enumerate(rig):
        wall = room(camera_idx, camera.size)
        plate = wall if ghost is None else ball_picture(camera, ghost, wall)
        # The plate was taken under a slightly different exposure.
        plate = cv2.convertScaleAbs(plate, alpha=1.03, beta=3)
        cv2.imwrite(str(root / "background" / f"{camera.name}.png"), plate[..., ::-1])
        path = str(root / "videos" / f"{camera.name}.mp4")
        writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"mp4v"), 30, camera.size)
        noise = np.random.default_rng(camera_idx)
        for frame in range(n_frames):
            balls = PERSON + np.array([0.05 * (frame - n_frames / 2), 0, 0, 0])
            truth[camera_idx, frame] = ball_mask(camera, balls)
            picture = ball_picture(camera, balls, wall).astype(int) + noise.integers(
                -2, 3, (*camera.size[::-1], 3)
            )
            writer.write(np.clip(picture, 0, 255).astype(np.uint8)[..., ::-1].copy())
        writer.release()
    rig.save(root / "rig.json")
    return truth
