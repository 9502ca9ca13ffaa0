"""How often the pixel convention of 3x4 matrices is told from silhouettes: random rigs, picture sizes and
postures, one convention planted in each, on masks as they are and with wandering outlines and cameras that
are a little off.

    python -m benchmarks.convention [--trials 60] [--seed 1000]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from benchmarks.hull import machine
from capture.camera import Camera
from capture.convention import Convention, settle_convention
from capture.layouts import cage_layout, dome_layout, ring_layout
from capture.projection_split import camera_from_projection
from capture.rig import Rig
from render.spoil import misplaced_rig, wandering_outline
from tests.capture_scenes import PERSON, ball_mask

SIZES = ((240, 320), (512, 512), (640, 480), (800, 600), (1024, 1024))
AXES = (
    "as given",
    "rows counted from the bottom",
    "columns counted from the right",
    "rows from the bottom and columns from the right",
    "rows and columns swapped",
)
FACTORS = (1.0, 0.5, 0.25, 2.0)
NOISES = (
    ("clean", 0.0, 0.0),
    ("0.3 px cameras, 1 px outlines", 0.3, 1.0),
    ("1 px cameras, 2 px outlines", 1.0, 2.0),
)


def planted(rig: Rig, convention: Convention) -> Rig:
    """The rig as matrices in another convention."""

    def one(camera: Camera) -> Camera:
        matrix = np.linalg.inv(convention.ours_from_file(camera.size)) @ camera.projection_matrix
        return camera_from_projection(camera.name, camera.size, matrix)

    return Rig(tuple(one(camera) for camera in rig))


def trial(seed: int, camera_px: float, outline_px: float) -> tuple[Convention, Convention, float]:
    """What was planted, what was found, seconds."""
    rng = np.random.default_rng(seed)
    n_cameras = int(rng.integers(4, 17))
    size = SIZES[rng.integers(len(SIZES))]
    layout = (dome_layout, ring_layout, cage_layout)[rng.integers(3)]
    rig = layout(n_cameras, size)
    # Upright pictures turned on their sides, principal points off the middle: what real rigs have.
    rig = Rig(
        tuple(
            replace(c, intrinsics=c.intrinsics + np.array([[0, 0, u], [0, 0, v], [0, 0, 0]]))
            for c, (u, v) in zip(rig, rng.normal(0, 0.01, (n_cameras, 2)) * size, strict=True)
        )
    )
    told = Convention(
        AXES[rng.integers(len(AXES))] if rng.random() < 0.6 else AXES[0],
        FACTORS[rng.integers(len(FACTORS))] if rng.random() < 0.5 else 1.0,
        float(rng.choice([0.0, 0.5])),
    )
    turn = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    frames = []
    for frame in range(2):
        balls = PERSON.copy()
        balls[:, :2] = balls[:, :2] @ np.array([[c, -s], [s, c]]).T + rng.uniform(-0.2, 0.2, 2) + 0.1 * frame
        frames.append(
            [
                wandering_outline(
                    ball_mask(camera, balls), outline_px, np.random.default_rng([seed, frame, k])
                )
                for k, camera in enumerate(rig)
            ]
        )
    given = planted(misplaced_rig(rig, camera_px, seed), told)
    started = time.perf_counter()
    found = settle_convention(given, frames).convention
    return told, found, time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1000)
    arguments = parser.parse_args()
    print(f"{arguments.trials} trials a row, seeds from {arguments.seed}. {machine()}\n")
    print(
        "| data | axes | scale | half pixel, sizes equal | half pixel made up | sound ones changed | "
        "median s | worst s |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for label, camera_px, outline_px in NOISES:
        results = [trial(arguments.seed + k, camera_px, outline_px) for k in range(arguments.trials)]
        n = len(results)
        axes = sum(told.axes == found.axes for told, found, _ in results)
        scale = sum(told.factor == found.factor for told, found, _ in results)
        same_size = [(told, found) for told, found, _ in results if told.factor == 1]
        half = sum(told.first_px == found.first_px for told, found in same_size)
        wrong = sum(told.first_px == 0 and found.first_px == 0.5 for told, found, _ in results)
        sound = [(told, found) for told, found, _ in results if told == Convention()]
        changed = sum(told != found for told, found in sound)
        seconds = np.array([s for *_, s in results])
        print(
            f"| {label} | {axes}/{n} | {scale}/{n} | {half}/{len(same_size)} | {wrong}/{n} | "
            f"{changed}/{len(sound)} | {np.median(seconds):.2f} | {seconds.max():.2f} |"
        )
        for k, (told, found, _) in enumerate(results):
            if (told.axes, told.factor) != (found.axes, found.factor):
                print(f"<!-- seed {arguments.seed + k}: {told} found {found} -->")


if __name__ == "__main__":
    main()
