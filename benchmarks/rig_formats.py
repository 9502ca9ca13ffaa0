"""Calibrations through every format and back: how far the pixels of points in view move, on random rigs.

python -m benchmarks.rig_formats [--rigs 20] [--seed 5000]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.hull import machine
from capture.errors import RecordingError
from capture.layouts import cage_layout, dome_layout, ring_layout
from capture.rig import Rig
from capture.rig_formats import FORMATS, METRES_PER_UNIT, largest_difference_px, read_rig_of, write_rig

LENS = np.array([-0.2, 0.06, 1e-3, -1e-3, 0.01, 0.02, -0.01, 0.003])


def random_rig(seed: int, n_terms: int, skew_px: float) -> Rig:
    """2 to 24 cameras of random layout, size, principal point, lens, and a world that is turned and moved."""
    rng = np.random.default_rng([seed, n_terms])
    layout = (dome_layout, ring_layout, cage_layout)[rng.integers(3)]
    rig = layout(int(rng.integers(2, 25)), tuple(int(n) for n in rng.integers(300, 4000, 2)))
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    world = np.eye(4)
    world[:3, :3] = q * np.sign(np.linalg.det(q))
    world[:3, 3] = rng.normal(0, 2, 3)
    cameras = []
    for camera in rig:
        matrix = camera.intrinsics * (1 + 0.02 * rng.normal(size=(3, 3)) * np.eye(3)[[0, 1, 2]] * [1, 1, 0])
        matrix[:2, 2] += rng.normal(0, 0.03, 2) * camera.size
        matrix[0, 1] = skew_px * rng.normal()
        matrix[2, 2] = 1
        cameras.append(
            replace(
                camera,
                intrinsics=matrix,
                camera_from_world=camera.camera_from_world @ world,
                distortion=LENS[:n_terms] * rng.uniform(0.3, 1.5, n_terms),
            )
        )
    return Rig(tuple(cameras))


def round_trip_px(rig: Rig, name: str, folder: Path) -> float | None:
    """The largest difference, or None where the format refuses the rig."""
    try:
        write_rig(rig, folder, name, overwrite=True)
    except RecordingError:
        return None
    found = read_rig_of(folder)
    sizes = dict(zip(found.names, [camera.size for camera in rig], strict=True))
    back = found.with_sizes(sizes.get).rig().with_world_scaled(METRES_PER_UNIT[found.unit or "m"])
    return largest_difference_px(rig, back)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=5000)
    arguments = parser.parse_args()
    print(f"{arguments.rigs} random rigs a cell, seeds from {arguments.seed}. {machine()}\n")
    print("Largest difference (px) after writing and reading.\n")
    kinds = [
        ("pinholes", 0, 0.0),
        ("skew", 0, 1.0),
        ("4 terms", 4, 0.0),
        ("5 terms", 5, 0.0),
        ("8 terms", 8, 0.0),
    ]
    print("| format | " + " | ".join(label for label, *_ in kinds) + " | ms a rig |")
    print("|---|" + "---|" * (len(kinds) + 1))
    for name in FORMATS:
        cells, started, n_done = [], time.perf_counter(), 0
        for _, n_terms, skew_px in kinds:
            found = []
            for k in range(arguments.rigs):
                with tempfile.TemporaryDirectory() as folder:
                    rig = random_rig(arguments.seed + k, n_terms, skew_px)
                    found.append(round_trip_px(rig, name, Path(folder)))
                    n_done += 1
            refused = sum(px is None for px in found)
            worst = max((px for px in found if px is not None), default=None)
            cells.append(
                "refused" if worst is None else f"{worst:.1e}" + (f" ({refused} refused)" if refused else "")
            )
        milliseconds = 1000 * (time.perf_counter() - started) / n_done
        print(f"| {name} | " + " | ".join(cells) + f" | {milliseconds:.0f} |")


if __name__ == "__main__":
    main()
