"""What wrong silhouettes do to a hull, and what is done about them. Prints Markdown tables.

    python -m benchmarks.hull_faults              # every fault in one camera of 4, 8, 16 and 68 of 1 MP, 8 mm
    python -m benchmarks.hull_faults --soft       # noisy probabilities: cut at one half, voted, and summed

The subject is the figure of capsules of `benchmarks.hull`. Each fault is put into three cameras in turn; the
volume is told against the clean hull's, the worst of the three; "told" counts the three that are named or
marked, or whose frame fails with a word.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np

from benchmarks.hull import FIGURE, figure, machine, silhouettes
from capture.camera import Camera
from capture.layouts import dome_layout
from capture.rig import Rig
from hull.rays import RayScene
from hull.visual_hull import Hull, HullOptions, build_hull

PLAIN = HullOptions(find_faults=False)
Spoil = Callable[[Camera, np.ndarray], np.ndarray]


def _extent(image: np.ndarray) -> tuple[int, int]:
    rows = np.flatnonzero(image.any(axis=1))
    return int(rows[0]), len(rows)


def no_leg(image: np.ndarray) -> np.ndarray:
    top, n = _extent(image)
    start = top + int(0.58 * n)
    columns = np.flatnonzero(image[start:].any(axis=0))
    image[start:, : int(np.median(columns))] = 0
    return image


def lower_part(image: np.ndarray) -> np.ndarray:
    top, n = _extent(image)
    image[top + int(0.7 * n) :] = 0
    return image


def hole(place: tuple[float, float, float], aside_m: float = 0.0) -> Spoil:
    """A round hole of 12 cm where the camera sees a place in the body, or so far to the right of it."""

    def spoil(camera: Camera, image: np.ndarray) -> np.ndarray:
        pixels, depth = camera.project(np.array([place]))
        px_per_m = camera.intrinsics[0, 0] / float(depth[0])
        centre = (round(float(pixels[0, 0]) + aside_m * px_per_m), round(float(pixels[0, 1])))
        return cv2.circle(image, centre, round(0.06 * px_per_m), 0, -1)

    return spoil


def no_head(image: np.ndarray) -> np.ndarray:
    top, n = _extent(image)
    image[: top + int(0.14 * n)] = 0
    return image


def no_hand(image: np.ndarray) -> np.ndarray:
    columns = np.flatnonzero(image.any(axis=0))
    image[:, : int(columns[0]) + int(0.1 * len(columns))] = 0
    return image


def as_seen(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return lambda camera, image: change(image)


# In the figure: the middle of the trunk (15 cm thick to each side), and of a thigh (7 cm).
TRUNK, THIGH = (0.0, 0.0, 1.2), (-0.13, 0.015, 0.65)

FAULTS: dict[str, Spoil] = {
    "a leg missing": as_seen(no_leg),
    "lower 30 % missing": as_seen(lower_part),
    "the head missing": as_seen(no_head),
    "a hand missing": as_seen(no_hand),
    "a hole of 12 cm in the trunk": hole(TRUNK),
    "a hole of 12 cm in a thigh": hole(THIGH),
    "a bite of 12 cm out of the trunk's side": hole(TRUNK, 0.15),
    "a bite of 12 cm out of a thigh's side": hole(THIGH, -0.07),
    "inverted": as_seen(lambda image: 255 - image),
    "of another frame": as_seen(lambda image: np.roll(image[:, ::-1], int(0.06 * image.shape[1]), axis=1)),
    "moved by 10 px": as_seen(lambda image: np.roll(image, 10, axis=1)),
    "moved down by 10 px": as_seen(lambda image: np.roll(image, 10, axis=0)),
    "empty": as_seen(np.zeros_like),
    "full": as_seen(lambda image: np.full_like(image, 255)),
}


def faults_table(n_cameras: int, side_px: int, voxel_m: float) -> None:
    rig = dome_layout(n_cameras, (side_px, side_px))
    images = silhouettes(rig)
    build_hull(rig, images, voxel_m)
    seconds = []
    for options in (PLAIN, HullOptions()):
        start = time.process_time()
        clean = build_hull(rig, images, voxel_m, options=options)
        seconds.append(time.process_time() - start)
    print(f"\n{n_cameras} cameras of {side_px} x {side_px}, {1000 * voxel_m:g} mm: clean hull ", end="")
    print(f"{1000 * clean.volume_m3:.2f} L, {len(clean.faults)} faults found, ", end="")
    print(f"{seconds[0]:.2f} s without looking, {seconds[1]:.2f} s with\n")
    print("| fault in one camera | volume, not looked for | looked for | named | told | done |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, spoil in FAULTS.items():
        without, with_, named, told, done = [], [], 0, 0, set()
        for culprit in sorted({n_cameras // 5, n_cameras // 2, n_cameras - 1}):
            wrong = list(images)
            wrong[culprit] = spoil(rig[culprit], images[culprit].copy())
            try:
                hull = build_hull(rig, wrong, voxel_m, options=PLAIN)
                without.append(hull.volume_m3 / clean.volume_m3 - 1)
            except ValueError:
                without.append(-1.0)
            try:
                hull = build_hull(rig, wrong, voxel_m)
            except ValueError:
                told += 1
                continue
            with_.append(hull.volume_m3 / clean.volume_m3 - 1)
            named += [fault.camera_idx for fault in hull.faults] == [culprit]
            told += bool(hull.faults or hull.marks)
            done |= {fault.action.value for fault in hull.faults}
        worst = [f"{max(changes, key=abs):+.1%}" if changes else "none" for changes in (without, with_)]
        how = ", ".join(sorted(done)) or "-"
        print(f"| {name} | {worst[0]} | {worst[1]} | {named} of 3 | {told} of 3 | {how} |", flush=True)


def figure_distance(points: np.ndarray) -> np.ndarray:
    """(N,) signed metres from the capsules, positive outside."""
    nearest = np.full(len(points), np.inf)
    for start, end, radius in FIGURE:
        a, b = np.array(start, dtype=float), np.array(end, dtype=float)
        along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(points - a - along[:, None] * (b - a), axis=1) - radius)
    return nearest


def mattes(rig: Rig) -> list[np.ndarray]:
    """(h w) from 0 to 1: the share of each pixel that the figure covers, from 4 x 4 places in it."""
    scene = RayScene(*figure())
    found = []
    for camera in rig:
        total = np.zeros(camera.size[::-1], dtype=np.float32)
        for right in (-0.375, -0.125, 0.125, 0.375):
            for down in (-0.375, -0.125, 0.125, 0.375):
                shift = np.array([[1, 0, right], [0, 1, down], [0, 0, 1.0]])
                total += scene.mask(
                    Camera("", camera.size, shift @ camera.intrinsics, camera.camera_from_world, np.zeros(0))
                )
        found.append(total / 16)
    return found


def spoilt(
    matte: np.ndarray, random: np.random.Generator, blur_px: float, n_inside: int, n_outside: int
) -> np.ndarray:
    """Blurred, with patches of wrong confidence: 0.25 to 0.6 inside the person, 0.4 to 0.8 around it."""
    image = cv2.GaussianBlur(matte, (0, 0), blur_px) if blur_px else matte.copy()
    rows, columns = np.nonzero(matte > 0.5)
    height = np.ptp(rows)
    for inside in [True] * n_inside + [False] * n_outside:
        k = random.integers(len(rows))
        away = np.zeros(2) if inside else 0.05 * height * random.normal(size=2)
        radius = int(random.uniform(0.01, 0.03) * height)
        patch = np.zeros_like(image)
        cv2.circle(patch, (int(columns[k] + away[0]), int(rows[k] + away[1])), radius, 1.0, -1)
        patch = cv2.GaussianBlur(patch, (0, 0), 2.0)
        level = random.uniform(0.25, 0.6) if inside else random.uniform(0.4, 0.8)
        wrong = np.minimum(image, level) if inside else np.maximum(image, level)
        image = image * (1 - patch) + patch * wrong
    return np.round(255 * np.clip(image + 0.02 * random.normal(size=image.shape), 0, 1)).astype(np.uint8)


def soft_table(n_cameras: int, side_px: int, voxel_m: float) -> None:
    rig = dome_layout(n_cameras, (side_px, side_px))
    shares = mattes(rig)
    random = np.random.default_rng(0)
    clean = build_hull(rig, [np.where(m >= 0.5, 255, 0).astype(np.uint8) for m in shares], voxel_m)
    print(f"\n{n_cameras} cameras of {side_px} x {side_px}, {1000 * voxel_m:g} mm; clean masks: ", end="")
    print(f"{1000 * clean.volume_m3:.2f} L, {_errors(clean)}\n")
    print("| probabilities | way | volume | median of distances, mean, rms (mm) | s |")
    print("| --- | --- | --- | --- | --- |")
    for name, noise in (
        ("anti-aliased", None),
        ("blurred by 2 px", (2.0, 0, 0)),
        ("3 doubtful patches a picture inside", (0.0, 3, 0)),
        ("3 inside, 3 around, blurred", (2.0, 3, 3)),
        ("10 inside, 6 around, blurred", (2.0, 10, 6)),
    ):
        grey = [
            np.round(255 * m).astype(np.uint8) if noise is None else spoilt(m, random, *noise) for m in shares
        ]
        cut = [np.where(image > 127, 255, 0).astype(np.uint8) for image in grey]
        for way, images, options in (
            ("cut at one half", cut, PLAIN),
            ("cut, 2 votes", cut, HullOptions(votes=2, find_faults=False)),
            ("summed (`--soft`)", grey, HullOptions(soft=True)),
        ):
            start = time.process_time()
            hull = build_hull(rig, images, voxel_m, options=options)
            seconds = time.process_time() - start
            change = hull.volume_m3 / clean.volume_m3 - 1
            print(f"| {name} | {way} | {change:+.1%} | {_errors(hull)} | {seconds:.2f} |", flush=True)


def _errors(hull: Hull) -> str:
    distance = 1000 * figure_distance(hull.vertices)
    rms = float(np.sqrt((distance**2).mean()))
    return f"{np.median(np.abs(distance)):.2f}, {distance.mean():+.2f}, {rms:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--soft", action="store_true", help="probabilities instead of faults")
    parser.add_argument("--voxel-mm", type=float, default=8.0)
    parser.add_argument("--side-px", type=int, default=1024)
    options = parser.parse_args()
    print(machine())
    for n_cameras in (16, 68) if options.soft else (4, 8, 16, 68):
        table = soft_table if options.soft else faults_table
        table(n_cameras, options.side_px, options.voxel_mm / 1000)


if __name__ == "__main__":
    main()
