"""How fast hulls are carved, and how exactly, beside open3d's voxel carving. Prints a Markdown table.

    python -m benchmarks.hull                       # 16 cameras of 1 MP, a cube of 256^3 voxels (7.8 mm)
    python -m benchmarks.hull --cameras 68 --side-px 2048 --voxels 512

Every row runs in a process of its own, on one thread, and reports its processor time (the least of the
repetitions) and the peak of its memory. The subject is a figure of capsules, 1.75 m tall, in a cube of 2 m.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from capture.layouts import dome_layout
from capture.rig import Rig
from hull.bounds import Bounds, bounds_from_tables
from hull.carve import Grid, carve
from hull.diagnosis import inside_by_definition
from hull.quality import silhouette_agreement
from hull.rays import RayScene
from hull.tables import prepare_tables
from hull.visual_hull import build_hull
from hull.witnesses import witness_rule

CUBE_LOW, CUBE_M = np.array([-1.0, -1.0, -0.1]), 2.0

# Capsules: two ends and a radius, metres.
FIGURE = (
    ((0, 0, 1.62), (0, 0, 1.66), 0.10),
    ((0, 0, 1.38), (0, 0, 0.98), 0.15),
    ((-0.18, 0, 1.42), (-0.55, 0.1, 1.15), 0.05),
    ((0.18, 0, 1.42), (0.55, 0.1, 1.15), 0.05),
    ((-0.1, 0, 0.9), (-0.2, 0.05, 0.07), 0.07),
    ((0.1, 0, 0.9), (0.2, 0.05, 0.07), 0.07),
)


def figure(n_around: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the capsules (they overlap; rays do not mind), `n_around` corners around."""
    vertices, faces, n = [], [], 0
    m = n_around // 2 + 1
    polar, around = np.meshgrid(np.linspace(0, np.pi, m), np.linspace(0, 2 * np.pi, n_around + 1))
    ball = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    i, j = np.meshgrid(np.arange(n_around), np.arange(m - 1), indexing="ij")
    quad = [
        (i * m + j).ravel(),
        (i * m + j + 1).ravel(),
        ((i + 1) * m + j).ravel(),
        ((i + 1) * m + j + 1).ravel(),
    ]
    triangles = np.concatenate(
        [np.stack([quad[0], quad[1], quad[2]], 1), np.stack([quad[1], quad[3], quad[2]], 1)]
    )
    for start, end, radius in FIGURE:
        a, b = np.array(start, dtype=float), np.array(end, dtype=float)
        axis = (a - b) / np.linalg.norm(a - b)
        points = radius * ball.reshape(-1, 3)
        # A ball swept from b to a: the half that looks along the axis goes to a.
        vertices.append(points + np.where((points @ axis > 0)[:, None], a, b))
        faces.append(triangles + n)
        n += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def silhouettes(rig: Rig) -> list[np.ndarray]:
    scene = RayScene(*figure())
    return [np.where(scene.mask(camera), 255, 0).astype(np.uint8) for camera in rig]


class Case:
    """The recording that every row works on."""

    def __init__(self, n_cameras: int, side_px: int, n_voxels: int, images_at: Path) -> None:
        self.rig = dome_layout(n_cameras, (side_px, side_px))
        self.images = list(np.load(images_at))
        self.n_voxels = n_voxels
        self.grid = Grid(CUBE_LOW, CUBE_M / n_voxels, (n_voxels, n_voxels, n_voxels))


@contextmanager
def timed(seconds: list[float]) -> Iterator[None]:
    start = time.process_time()
    yield
    seconds.append(time.process_time() - start)


def row_tables(case: Case, seconds: list[float]) -> str:
    for _ in range(5):
        with timed(seconds):
            prepare_tables(case.rig, case.images)
    return ""


def row_bounds(case: Case, seconds: list[float]) -> str:
    tables = prepare_tables(case.rig, case.images)
    for _ in range(3):
        with timed(seconds):
            bounds = bounds_from_tables(tables)
    return "box " + " x ".join(f"{s:.2f}" for s in bounds.size_m) + " m"


def row_carve(case: Case, seconds: list[float]) -> str:
    for _ in range(5):
        with timed(seconds):
            tables = prepare_tables(case.rig, case.images)
            rule = witness_rule(tables, CUBE_LOW + CUBE_M / 2)
            blocks = carve(tables, rule, case.grid)
    return f"{blocks.n_voxels} voxels inside"


def row_exact(case: Case, seconds: list[float]) -> str:
    tables = prepare_tables(case.rig, case.images)
    rule = witness_rule(tables, CUBE_LOW + CUBE_M / 2)
    n = case.n_voxels
    found = carve(tables, rule, case.grid).dense(np.zeros(3, dtype=int), np.full(3, n))
    different = 0
    with timed(seconds):
        for i in range(0, n, 16):
            planes = np.arange(i, min(i + 16, n))
            cells = np.stack(np.meshgrid(planes, np.arange(n), np.arange(n), indexing="ij")).reshape(3, -1)
            expected = inside_by_definition(tables, rule, case.grid.centres(cells))
            different += int((found[planes].ravel() != expected).sum())
    return f"{different} voxels different from the adaptive carve"


def row_hull(case: Case, seconds: list[float]) -> str:
    for _ in range(3):
        with timed(seconds):
            hull = build_hull(case.rig, case.images, CUBE_M / case.n_voxels)
    scores = silhouette_agreement(hull.vertices, hull.faces, case.rig, case.images)
    return f"{len(hull.vertices)} vertices, agreement worst {scores.min():.4f}, mean {scores.mean():.4f}"


def row_hull_in_cube(case: Case, seconds: list[float]) -> str:
    for _ in range(3):
        with timed(seconds):
            hull = build_hull(
                case.rig, case.images, CUBE_M / case.n_voxels, Bounds(CUBE_LOW, CUBE_LOW + CUBE_M)
            )
    return f"{len(hull.vertices)} vertices"


def row_open3d_grid(case: Case, seconds: list[float]) -> str:
    with timed(seconds):
        _open3d_dense(case)
    return ""


def row_open3d_carve(case: Case, seconds: list[float]) -> str:
    import open3d as o3d

    grid = _open3d_dense(case)
    images = [o3d.geometry.Image((image > 128).astype(np.float32)) for image in case.images]
    with timed(seconds):
        for camera, image in zip(case.rig, images, strict=True):
            parameters = o3d.camera.PinholeCameraParameters()
            parameters.intrinsic = o3d.camera.PinholeCameraIntrinsic(
                *camera.size, np.array(camera.intrinsics)
            )
            parameters.extrinsic = np.array(camera.camera_from_world)
            grid.carve_silhouette(image, parameters)
    return f"{len(grid.get_voxels())} voxels left (a voxel stays if any corner is inside)"


def _open3d_dense(case: Case):  # type: ignore[no-untyped-def]  # open3d ships no usable types
    import open3d as o3d

    return o3d.geometry.VoxelGrid.create_dense(
        origin=CUBE_LOW,
        color=np.zeros(3),
        voxel_size=CUBE_M / case.n_voxels,
        width=CUBE_M,
        height=CUBE_M,
        depth=CUBE_M,
    )


def _measure(row: Callable[[Case, list[float]], str], settings: tuple, queue) -> None:  # type: ignore[no-untyped-def,type-arg]
    case = Case(*settings)
    seconds: list[float] = []
    before = _reset_peak_mb()
    remark = row(case, seconds)
    queue.put((min(seconds), _status_mb("VmHWM") - before, remark))


def _reset_peak_mb() -> float:
    """Forget the peak of this process's memory, where the system lets one (Linux); what it holds now, MB."""
    clear = Path("/proc/self/clear_refs")
    if not clear.exists():
        return float("nan")
    clear.write_text("5")
    return _status_mb("VmRSS")


def _status_mb(name: str) -> float:
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    return (
        next(float(line.split()[1]) for line in status.read_text().splitlines() if line.startswith(name))
        / 1024
    )


def machine() -> str:
    """Processor, cores and versions, in a line."""
    import open3d

    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{model}, {os.cpu_count()} cores{load}; numpy {np.__version__}, open3d {open3d.__version__}"


def main() -> None:
    # The rows' processes inherit this.
    os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cameras", type=int, default=16)
    parser.add_argument("--side-px", type=int, default=1024)
    parser.add_argument("--voxels", type=int, default=256)
    parser.add_argument("--no-open3d", action="store_true")
    options = parser.parse_args()

    import tempfile

    rows: list[tuple[str, Callable[[Case, list[float]], str]]] = [
        ("tables", row_tables),
        ("tables + adaptive carve", row_carve),
        ("bounds", row_bounds),
        ("whole hull in the cube, from masks", row_hull_in_cube),
        ("whole hull, bounds found, from masks", row_hull),
    ]
    if options.voxels <= 256:
        rows.append(("every centre in every camera", row_exact))
        if not options.no_open3d:
            rows += [("open3d create_dense", row_open3d_grid), ("open3d carve_silhouette", row_open3d_carve)]
    rig = dome_layout(options.cameras, (options.side_px, options.side_px))
    size = f"{options.side_px} x {options.side_px}"
    print(f"{options.cameras} cameras of {size}, {options.voxels}^3 voxels\n{machine()}\n")
    print("| what | processor s | memory MB | |\n| --- | --- | --- | --- |")
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        images_at = Path(folder) / "silhouettes.npy"
        np.save(images_at, np.stack(silhouettes(rig)))
        settings = (options.cameras, options.side_px, options.voxels, images_at)
        for name, row in rows:
            queue = spawn.Queue()
            process = spawn.Process(target=_measure, args=(row, settings, queue))
            process.start()
            process.join()
            if process.exitcode:
                print(f"| {name} | failed | | |")
                continue
            seconds, memory, remark = queue.get()
            print(f"| {name} | {seconds:.3f} | {memory:.0f} | {remark} |", flush=True)


if __name__ == "__main__":
    main()
