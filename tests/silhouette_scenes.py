"""Films of a person before a background, with everything that makes silhouettes hard, and the true masks.

Noise, a shadow on the floor, light that drifts, a passer-by, a screen of one colour that reflects on legs.
People come from a source: balls here, rendered ones in `benchmarks.silhouettes`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from capture.camera import Camera
from capture.rig import Rig
from tests.capture_scenes import PERSON, ball_mask, ball_picture, room

GREEN = np.array([20, 170, 70])
KINDS = ("studio", "room", "shadow", "drift", "passer-by", "green")


@dataclass(frozen=True)
class Seen:
    """One camera's view of the people in one frame, the farthest first and the subject last: pictures (h w 3)
    and masks; ground (N 3): points of the subject from which its shadow falls, m."""

    people: list[tuple[np.ndarray, np.ndarray]]
    ground: np.ndarray


Source = Callable[[Camera, int], Seen]


@dataclass
class Scene:
    """root: a recording's folder; truth: (camera, frame) -> the subject's mask."""

    root: Path
    rig: Rig
    n_frames: int
    truth: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)


def balls(n_frames: int, passer_by: bool = False) -> Source:
    """The ball person walking along x, and another one behind who walks the other way."""

    def seen(camera: Camera, frame: int) -> Seen:
        here = PERSON + np.array([1.3 * (frame / max(1, n_frames - 1) - 0.5), 0, 0, 0])
        people = []
        if passer_by:
            there = PERSON * np.array([-1, 1, 1, 1]) + np.array([0.8 - 1.2 * frame / n_frames, 1.3, 0, 0])
            people.append((ball_picture(camera, there, _blank(camera)), ball_mask(camera, there)))
        people.append((ball_picture(camera, here, _blank(camera)), ball_mask(camera, here)))
        return Seen(people, here[:, :3])

    return seen


def _blank(camera: Camera) -> np.ndarray:
    return np.zeros((*camera.size[::-1], 3), np.uint8)


def write_scene(
    root: Path,
    rig: Rig,
    source: Source,
    kind: str,
    *,
    n_frames: int = 12,
    n_empty: int = 12,
    seed: int = 0,
    noise: float = 3.0,
) -> Scene:
    """A recording in the INRIA layout with pictures only, and `n_empty` empty pictures a camera."""
    rng = np.random.default_rng(seed)
    scene = Scene(root, rig, n_frames)
    (root / "setup").mkdir(parents=True)
    for camera_idx, camera in enumerate(rig):
        np.savetxt(root / "setup" / f"cam{camera_idx:02d}.txt", camera.projection_matrix, fmt="%.17g")
        behind = _background(camera_idx, camera.size, kind, seed).astype(float)
        empty = root / "background" / f"cam-{camera_idx:03d}"
        folder = root / "Pictures" / f"cam-{camera_idx:03d}"
        folder.mkdir(parents=True)
        for frame in range(n_empty):
            empty.mkdir(parents=True, exist_ok=True)
            _write(empty / f"{frame:03d}.png", behind, noise, rng)
        for frame in range(n_frames):
            seen = source(camera, frame)
            picture = behind.copy()
            if kind in ("shadow", "drift"):
                picture *= 1 - 0.4 * _shadow(camera, seen.ground)[..., None]
            for rgb, mask in seen.people:
                if kind == "green":
                    rgb = _lit_by_screen(rgb, mask)
                cover = cv2.GaussianBlur(mask.astype(np.float32) / 255, (0, 0), 0.5)[..., None]
                picture = picture * (1 - cover) + rgb.astype(float) * cover
            if kind == "drift":
                gain = 1 + 0.15 * np.sin(2 * np.pi * frame / n_frames)
                picture = picture * gain * np.array([1.0, 1.0, 1 - 0.1 * (gain - 1)])
            _write(folder / f"img_{frame:06d}.png", picture, noise, rng)
            scene.truth[camera_idx, frame] = seen.people[-1][1]
    return scene


def _background(camera_idx: int, size: tuple[int, int], kind: str, seed: int) -> np.ndarray:
    rng = np.random.default_rng(1000 * seed + camera_idx)
    width, height = size
    if kind == "room":
        return room(camera_idx + 100 * seed, size)
    if kind == "green":
        light = cv2.resize(
            rng.uniform(0.75, 1.15, (4, 4)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC
        )
        return GREEN * light[..., None]
    grey = np.linspace(150, 190, height)[:, None, None] * np.array([0.98, 1.0, 1.02])
    picture = np.broadcast_to(grey, (height, width, 3)).copy()
    for _ in range(4):
        x = int(rng.integers(0, width))
        cv2.rectangle(picture, (x, 0), (x + width // 30, height // 3), tuple(rng.uniform(60, 220, 3)), -1)
    return picture


def _shadow(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Where the light from above and the side does not reach the floor, 0 to 1 (h w), soft at its edge."""
    on_floor = points.copy()
    on_floor[:, 0] += 0.5 * points[:, 2]
    on_floor[:, 1] += 0.25 * points[:, 2]
    on_floor[:, 2] = 0.0
    pixels, depth = camera.project(on_floor)
    shade = np.zeros(camera.size[::-1], np.uint8)
    for (u, v), far in zip(pixels, depth, strict=True):
        if far > 0 and abs(u) < 1e5 and abs(v) < 1e5:
            radius = max(1, round(0.09 * camera.intrinsics[0, 0] / far))
            cv2.circle(shade, (round(u), round(v)), radius, 255, -1)
    return cv2.GaussianBlur(shade.astype(float) / 255, (0, 0), max(1.0, max(camera.size) / 200))


def _lit_by_screen(rgb: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Green light on the rim, and more on the lower legs."""
    rows = np.flatnonzero(mask.any(axis=1))
    share = np.full(mask.shape, 0.06)
    if rows.size:
        share[int(rows[0] + 0.75 * (rows[-1] - rows[0])) :] = 0.22
    rim = cv2.erode(mask, np.ones((5, 5), np.uint8)) == 0
    share[rim] += 0.1
    return rgb * (1 - share[..., None]) + GREEN * share[..., None]


def _write(path: Path, picture: np.ndarray, noise: float, rng: np.random.Generator) -> None:
    noisy = picture + rng.normal(0, noise, picture.shape)
    image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    assert cv2.imwrite(str(path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])


def iou(found: np.ndarray | None, true: np.ndarray) -> float:
    """Intersection over union of the person's pixels; what is unknown in `found` is left out."""
    if found is None:
        return 0.0
    known = found != 128
    a, b = (found == 255) & known, (true > 0) & known
    return float((a & b).sum() / max(1, (a | b).sum()))
