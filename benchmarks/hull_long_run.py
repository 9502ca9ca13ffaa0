"""Does a long run keep a flat memory line? A small recording of many frames, carved as `bodyhull carve` does.

    python -m benchmarks.hull_long_run [--frames 300]

The figure of `benchmarks.hull` moves to and fro before 12 cameras of 320 x 320 pixels. Printed: what the
process holds after every so many frames.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import threading
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.hull import figure, machine, status_mb
from bodyhull.carving import carve_stage
from bodyhull.config import RunConfig
from bodyhull.folder import RunFolder
from capture.layouts import dome_layout
from hull.rays import RayScene

_N_POSES = 24


def film(root: Path, n_frames: int) -> None:
    """Write the recording; its poses repeat."""
    rig = dome_layout(12, (320, 320))
    rig.save(root / "rig.json")
    vertices, faces = figure()
    for pose in range(min(_N_POSES, n_frames)):
        scene = RayScene(vertices + np.array([0.2 * np.sin(2 * np.pi * pose / _N_POSES), 0, 0]), faces)
        for camera in rig:
            path = root / "SilhouettesPictures" / camera.name / f"silh_{pose:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.where(scene.mask(camera), 255, 0).astype(np.uint8))
            for frame in range(pose + _N_POSES, n_frames, _N_POSES):
                shutil.copyfile(path, path.with_name(f"silh_{frame:06d}.png"))


def long_run(folder: Path, n_frames: int = 300) -> None:
    """Carve, and print the memory held along the way."""
    root, out = folder / "long", folder / "long_run"
    root.mkdir()
    film(root, n_frames)
    held: dict[int, float] = {}
    over = threading.Event()

    def watch() -> None:
        while not over.wait(0.1):
            n_done = len(list((out / "hull").glob("*.ply")))
            held.setdefault(n_done, status_mb("VmRSS"))

    watcher = threading.Thread(target=watch)
    watcher.start()
    start = time.process_time()
    try:
        carve_stage(
            RunConfig(
                recording=root, out=out, calibration=root / "rig.json", voxel_mm=16.0, units="m", up="z"
            )
        )
    finally:
        over.set()
        watcher.join()
    seconds = time.process_time() - start
    frames = RunFolder(out).stage("hull")["frames"]
    n_ok = sum(entry["status"] == "ok" for entry in frames.values())
    print(f"\n{n_frames} frames of 12 x 320 x 320 at 16 mm, carved one after another; {n_ok} of them ok\n")
    print("| frames done | memory held, MB |\n| --- | --- |")
    for n_done in sorted({max(n_frames * k // 10, 1) for k in range(11)}):
        nearest = min(held, key=lambda n: abs(n - n_done))
        print(f"| {nearest} | {held[nearest]:.0f} |")
    done = np.array([n for n in held if n > n_frames // 10])
    slope = np.polyfit(done, [held[n] for n in done], 1)[0]
    print(f"\n{slope * 1000:+.1f} MB in a thousand frames; {seconds / n_frames:.2f} s a frame", flush=True)


def main() -> None:
    os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=300)
    options = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as name:
        long_run(Path(name), options.frames)


if __name__ == "__main__":
    main()
