"""How fast hulls are carved, and how exactly, beside open3d's voxel carving. Prints Markdown tables.

    python -m benchmarks.hull            # all tables; half an hour on two cores
    python -m benchmarks.hull --quick    # 16 cameras of 1 MP in a cube of 256^3 voxels, open3d beside it

Every row runs in a process of its own, on one thread, and reports its processor time (the least of the
repetitions) and how much its memory rose above what the silhouettes and the loaded libraries take. The
subject is a figure of capsules, 1.75 m tall, in a cube of 2 m. What other programs do on the machine makes
every row slower, and large rows more than small ones.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path

import cv2
import numpy as np

from capture.layouts import dome_layout
from capture.recording import open_recording
from capture.rig import Rig
from hull.bounds import Bounds, bounds_from_tables
from hull.carve import Grid, carve
from hull.cleaning import is_closed, keep_what_matters, vertex_normals
from hull.culling import Culling
from hull.diagnosis import inside_by_definition
from hull.loops import mesh_loops, table_loops
from hull.marching import binary_surface
from hull.quality import silhouette_agreement
from hull.rays import RayScene
from hull.ridges import raise_ridges
from hull.surface import cross_exactly
from hull.tables import SilhouetteTable, prepare_tables
from hull.thin_parts import FINE_ENOUGH_M, with_thin_parts
from hull.visual_hull import HullOptions, build_hull, grid_over
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


@dataclass(frozen=True)
class Settings:
    """What a row works on; `images_at`: the silhouettes, made once for all rows."""

    n_cameras: int
    side_px: int
    n_voxels: int
    images_at: Path


class Case:
    """The recording that every row works on."""

    def __init__(self, settings: Settings) -> None:
        self.rig = dome_layout(settings.n_cameras, (settings.side_px, settings.side_px))
        self.images = list(np.load(settings.images_at))
        self.n_voxels = settings.n_voxels
        self.voxel_m = CUBE_M / settings.n_voxels
        self.grid = Grid(CUBE_LOW, self.voxel_m, (settings.n_voxels,) * 3)

    @property
    def repetitions(self) -> int:
        # The first one also pays for fresh memory, the more the finer the grid.
        return 3


Row = Callable[[Case, list[float]], str]


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


def row_bounds_near(case: Case, seconds: list[float]) -> str:
    tables = prepare_tables(case.rig, case.images)
    whole = bounds_from_tables(tables)
    for _ in range(3):
        with timed(seconds):
            bounds = bounds_from_tables(tables, near=whole)
    same = np.array_equal(bounds.low, whole.low) and np.array_equal(bounds.high, whole.high)
    return "the same box" if same else "ANOTHER BOX"


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


def refined_mesh(
    tables: Sequence[SilhouetteTable], voxel_m: float, bounds: Bounds | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces as `build_hull` makes them, without the search for faults and vertices' facts."""
    bounds = bounds_from_tables(tables) if bounds is None else bounds
    grid, rule = grid_over(bounds, voxel_m), witness_rule(tables, bounds.centre)
    culling, finely = Culling(tables, grid), voxel_m > FINE_ENOUGH_M
    surface = binary_surface(carve(tables, rule, grid))
    if finely:
        surface, grid = with_thin_parts(surface, grid, culling, rule)
    crossings = cross_exactly(surface, grid, tables, culling)
    normals = vertex_normals(crossings.vertices, surface.faces, n_rings=1)
    cell_m = grid.voxel_m * np.abs(surface.outer - surface.inner).sum(axis=1)
    crossings, faces = raise_ridges(
        crossings, surface.faces, normals, tables, cell_m, culling, valleys=finely
    )
    kept, faces, _ = keep_what_matters(crossings.vertices, faces, tables)
    vertices = crossings.vertices[kept]
    assert is_closed(faces, len(vertices))
    vertex_normals(vertices, faces)
    return vertices, faces


def row_mesh(case: Case, seconds: list[float]) -> str:
    for _ in range(case.repetitions):
        with timed(seconds):
            vertices, faces = refined_mesh(prepare_tables(case.rig, case.images), case.voxel_m)
    scores = silhouette_agreement(vertices, faces, case.rig, case.images)
    return f"{len(vertices)} vertices, agreement worst {scores.min():.4f}, mean {scores.mean():.4f}"


def row_surface(case: Case, seconds: list[float]) -> str:
    """What depends on the voxels: no tables, no search for the box."""
    tables = prepare_tables(case.rig, case.images)
    bounds = bounds_from_tables(tables)
    for _ in range(case.repetitions):
        with timed(seconds):
            vertices, _ = refined_mesh(tables, case.voxel_m, bounds)
    return f"{len(vertices)} vertices"


def row_plain(case: Case, seconds: list[float]) -> str:
    """Without numba: the plain definitions, which the compiled loops repeat."""
    sys.modules["numba"] = None  # type: ignore[assignment]  # that is how an import is made to fail
    assert table_loops() is None and mesh_loops() is None
    return row_faults(case, seconds)


def row_first_call(case: Case, seconds: list[float]) -> str:
    """Compiling, and loading what was compiled: both beside the time that a hull takes."""
    with tempfile.TemporaryDirectory() as name:
        os.environ["NUMBA_CACHE_DIR"] = name
        with timed(seconds):
            _small_hull()
        size = sum(path.stat().st_size for path in Path(name).rglob("*"))
        return f"compiled anew, once after every installation; {size / 1e6:.1f} MB kept"


def row_loading(case: Case, seconds: list[float]) -> str:
    with timed(seconds):
        _small_hull()
    return "numba and the compiled loops loaded, open3d too: once a process"


def _small_hull() -> None:
    rig = dome_layout(4, (96, 96))
    build_hull(rig, silhouettes(rig), 0.05)


def row_faults(case: Case, seconds: list[float]) -> str:
    for _ in range(case.repetitions):
        with timed(seconds):
            hull = build_hull(case.rig, case.images, case.voxel_m)
    return f"{len(hull.faults)} faults"


def row_facts(case: Case, seconds: list[float]) -> str:
    options = HullOptions(find_faults=False)
    for _ in range(case.repetitions):
        with timed(seconds):
            hull = build_hull(case.rig, case.images, case.voxel_m, options=options)
    return f"median slack {1000 * float(np.median(hull.slack_m)):.0f} mm"


def row_agreement(case: Case, seconds: list[float]) -> str:
    vertices, faces = refined_mesh(prepare_tables(case.rig, case.images), case.voxel_m)
    for _ in range(2):
        with timed(seconds):
            silhouette_agreement(vertices, faces, case.rig, case.images)
    return "told for every frame of a run"


def row_read(case: Case, seconds: list[float]) -> str:
    return _from_files(case, seconds, lambda _rig, _images: None)


def row_from_files(case: Case, seconds: list[float]) -> str:
    return _from_files(
        case, seconds, lambda rig, images: refined_mesh(prepare_tables(rig, images), case.voxel_m)
    )


def row_all_from_files(case: Case, seconds: list[float]) -> str:
    return _from_files(case, seconds, lambda rig, images: build_hull(rig, images, case.voxel_m))


def _from_files(case: Case, seconds: list[float], then: Callable[[Rig, Sequence], object]) -> str:
    with tempfile.TemporaryDirectory() as name:
        root, size = Path(name), 0
        case.rig.save(root / "rig.json")
        for camera, image in zip(case.rig, case.images, strict=True):
            path = root / "SilhouettesPictures" / camera.name / "silh_000000.png"
            path.parent.mkdir(parents=True)
            cv2.imwrite(str(path), image)
            size += path.stat().st_size
        case.images = []
        recording = open_recording(root, calibration=root / "rig.json", units="m", up="z")
        for _ in range(case.repetitions):
            with timed(seconds):
                silhouettes = recording.silhouettes(0)
                then(recording.rig, silhouettes.images)
    assert not silhouettes.problems
    return f"{size / len(case.rig.cameras) / 1000:.0f} kB a file, 8 bits"


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


def _measure(row: Row, settings: Settings, queue: Queue[tuple[float, float, str]]) -> None:
    cv2.setNumThreads(1)
    case = Case(settings)
    seconds: list[float] = []
    if row not in (row_plain, row_first_call, row_loading):
        # What is loaded once a process has rows of its own.
        _small_hull()
    before = _reset_peak_mb()
    remark = row(case, seconds)
    queue.put((min(seconds), status_mb("VmHWM") - before, remark))


def _reset_peak_mb() -> float:
    """Forget the peak of this process's memory, where the system lets one (Linux); what it holds now, MB."""
    clear = Path("/proc/self/clear_refs")
    if not clear.exists():
        return float("nan")
    clear.write_text("5")
    return status_mb("VmRSS")


def status_mb(name: str) -> float:
    """A figure of this process from /proc (VmRSS: held now, VmHWM: the most), MB."""
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


def measured(name: str, row: Row, settings: Settings) -> tuple[float, float]:
    """Run a row in a process of its own and print its line; its seconds and MB."""
    spawn = multiprocessing.get_context("spawn")
    queue = spawn.Queue()
    process = spawn.Process(target=_measure, args=(row, settings, queue))
    process.start()
    process.join()
    if process.exitcode:
        print(f"| {name} | failed | | |", flush=True)
        return float("nan"), float("nan")
    seconds, memory, remark = queue.get()
    print(f"| {name} | {seconds:.3f} | {memory:.0f} | {remark} |", flush=True)
    return seconds, memory


def table(title: str) -> None:
    print(f"\n{title}\n\n| what | processor s | memory MB | |\n| --- | --- | --- | --- |", flush=True)


def made(folder: Path, n_cameras: int, side_px: int, n_voxels: int) -> Settings:
    """Settings whose silhouettes lie in `folder`."""
    images_at = folder / f"{n_cameras}_{side_px}.npy"
    if not images_at.exists():
        np.save(images_at, np.stack(silhouettes(dome_layout(n_cameras, (side_px, side_px)))))
    return Settings(n_cameras, side_px, n_voxels, images_at)


def beside_open3d(folder: Path) -> None:
    """256^3 voxels, 16 x 1 MP: the ratio, the memory, and equality with the plain definition."""
    settings = made(folder, 16, 1024, 256)
    table("16 cameras of 1024 x 1024, 7.8 mm; first rows: a cube of 256^3 voxels")
    ours, memory = measured("tables + adaptive carve", row_carve, settings)
    measured("every centre in every camera", row_exact, settings)
    dense, _ = measured("open3d create_dense", row_open3d_grid, settings)
    theirs, _ = measured("open3d carve_silhouette", row_open3d_carve, settings)
    ratio = (dense + theirs) / ours
    print(f"| open3d over ours | {ratio:.0f} times | {memory:.0f} MB for ours | bar: 100 times, 300 MB |")
    phases(settings)


def phases(settings: Settings) -> None:
    """One frame, from masks and from files."""
    measured("once: compiling", row_first_call, settings)
    measured("once a process: loading", row_loading, settings)
    measured("tables", row_tables, settings)
    measured("bounds, all of space searched", row_bounds, settings)
    measured("bounds, near the last frame's", row_bounds_near, settings)
    mesh, _ = measured("masks to refined mesh", row_mesh, settings)
    facts, _ = measured("the same with the vertices' facts", row_facts, settings)
    faults, _ = measured("build_hull: the same with the search for faults", row_faults, settings)
    measured("the same without numba", row_plain, settings)
    measured("reading the PNG files", row_read, settings)
    measured("PNG files to refined mesh", row_from_files, settings)
    measured("PNG files to all of build_hull", row_all_from_files, settings)
    measured("agreement with the silhouettes", row_agreement, settings)
    print(f"\nmesh {mesh:.2f} s, facts {facts - mesh:+.2f} s, faults {faults - facts:+.2f} s", flush=True)


def by_voxel(folder: Path) -> None:
    """Halving the voxel: surface, not volume."""
    table("68 cameras of 2048 x 2048, halving the voxel: carve and surface, tables and box given")
    last = None
    for n_voxels in (125, 250, 500, 1000):
        settings = made(folder, 68, 2048, n_voxels)
        found = measured(f"{2000 / n_voxels:g} mm", row_surface, settings)
        if last is not None:
            print(
                f"| &nbsp; ratio | {found[0] / last[0]:.2f} | {found[1] / last[1]:.2f} | bar: 4.5 |",
                flush=True,
            )
        last = found


def main() -> None:
    # The rows' processes inherit this.
    os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="16 cameras of 1 MP only")
    options = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        beside_open3d(folder)
        if options.quick:
            return
        table("68 cameras of 2048 x 2048, 3.9 mm")
        phases(made(folder, 68, 2048, 512))
        by_voxel(folder)
        from benchmarks.hull_long_run import long_run

        long_run(folder)


if __name__ == "__main__":
    main()
