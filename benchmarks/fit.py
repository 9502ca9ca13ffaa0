"""What the fit costs, stage by stage, and beside Adam on the same energy. Prints Markdown tables.

    python -m benchmarks.fit            # 50 000 points a scan; a quarter of an hour on two cores
    python -m benchmarks.fit --quick    # 12 000 points, 6 frames, one setting of the peer; two minutes

A drawn person that the model does not know exactly, in loose wrinkled clothes, moving; every frame a scan
with even points and a closed mesh of 220 000 faces that the body has to stay inside of, as hulls are. One
thread; processor seconds, and seconds by the clock, which other programs on the machine make longer.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

THREADS = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")} | {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
}
PARTS = ("start", "stages", "peer")


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    print(f"\n{title}\n\n| {' | '.join(header)} |\n|{'---|' * len(header)}")
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


class Clock:
    """Processor and wall seconds since it was made."""

    def __init__(self) -> None:
        self.processor, self.wall = time.process_time(), time.perf_counter()

    def row(self, name: str, share: int = 1, bar: str = "") -> tuple[str, str, str, str]:
        processor = (time.process_time() - self.processor) / share
        wall = (time.perf_counter() - self.wall) / share
        return name, f"{processor:.2f}", f"{wall:.2f}", bar


class Scene:
    """A person, what a fit needs, and its scans."""

    def __init__(self, n_frames: int, n_points: int) -> None:
        import open3d as o3d

        from fit.body.model import load_body
        from fit.body.pose_prior import PosePrior
        from fit.closest import Container
        from fit.initialise import PoseFinder
        from fit.settings import FitSettings
        from fit.solver import Fitter
        from fit.state import BodyState
        from fit.surface import vertex_normals
        from hull.scan import Scan, even_samples

        model = load_body("free:neutral", show_progress=False)
        self.fitter, self.finder = Fitter.of(model), PoseFinder.of(model, PosePrior.standard())
        self.settings = FitSettings(n_points=n_points)
        random = np.random.default_rng(11)
        betas = np.zeros(model.n_betas)
        betas[:10] = random.normal(size=10)
        template = self.fitter.shaped(betas)
        belly = np.exp(-(((template - [0.0, 0.1, 0.13]) / 0.09) ** 2).sum(1))
        template = template + 0.008 * belly[:, None] * vertex_normals(template, model.faces)
        covered = (np.abs(template[:, 0]) < 0.5) & (template[:, 1] < 0.4) & (template[:, 1] > -0.8)
        self.scans: list[Scan] = []
        self.containers: list[tuple[np.ndarray, np.ndarray]] = []
        for k in range(n_frames):
            pose = self.finder.mean_pose()
            swing = np.sin(2 * np.pi * k / 12)
            pose[0] = [0.0, 0.5 * swing, 0.0]
            pose[16] += [0.0, -0.3 * swing, 0.4 * swing]
            pose[17] += [0.0, -0.3 * swing, -0.2 * swing]
            pose[4] += [0.3 + 0.3 * swing, 0.0, 0.0]
            pose[1] += [-0.2 - 0.2 * swing, 0.0, 0.0]
            body = self.fitter.posed(
                BodyState(template, pose, np.array([0.02 * k, 0.9, 0.0]), betas), self.fitter.joints(betas)
            )
            folds = 0.012 + 0.006 * np.sin(40 * template[:, 1] + 9 * template[:, 0] + k)
            clothed = body + (folds * covered)[:, None] * vertex_normals(body, model.faces)
            fine = o3d.geometry.TriangleMesh(
                o3d.utility.Vector3dVector(clothed), o3d.utility.Vector3iVector(model.faces)
            ).subdivide_midpoint(2)
            vertices, faces = np.asarray(fine.vertices), np.asarray(fine.triangles)
            self.containers.append((vertices, faces))
            triangle, barycentric = even_samples(vertices, faces, n_points, seed=k)
            corners = faces[triangle]
            normals = vertex_normals(vertices, faces)
            self.scans.append(
                Scan(
                    np.einsum("nk,nki->ni", barycentric, vertices[corners]),
                    np.einsum("nk,nki->ni", barycentric, normals[corners]),
                    None,
                    np.zeros(n_points, dtype=bool),
                    np.ones(n_points),
                )
            )
        self._container = Container.of

    def container(self, frame_id: int) -> object:
        return self._container(*self.containers[frame_id])


def start() -> None:
    """Everything up to the first step, in a process that finds all caches filled."""
    clock = Clock()
    clock.processor, clock.wall = 0.0, clock.wall - time.process_time()
    from fit.align import as_scan_points
    from fit.body.model import load_body
    from fit.body.pose_prior import PosePrior
    from fit.initialise import PoseFinder
    from fit.settings import FitSettings
    from fit.solver import Fitter, Objective, Unknowns, minimise
    from fit.state import BodyState
    from fit.surface import vertex_normals
    from hull.scan import Scan

    model = load_body("free:neutral", show_progress=False)
    fitter, finder = Fitter.of(model), PoseFinder.of(model, PosePrior.standard())
    n = len(model.template)
    normals = vertex_normals(model.template, model.faces)
    scan = Scan(model.template + 0.01 * normals, normals, model.faces, np.zeros(n, dtype=bool), np.ones(n))
    state = BodyState(model.template, np.zeros((24, 3)), np.zeros(3), np.zeros(model.n_betas))
    for weights, template in (
        (FitSettings().align_pose[0], False),
        (FitSettings().align_joint[0], True),
    ):
        objective = Objective(
            fitter,
            as_scan_points(scan),
            weights,
            Unknowns(template=template),
            finder.prior.mean,
            finder.prior.precision,
        )
        minimise(objective, state, max_iterations=1)
    table(
        "Start",
        ("until the first step is done", "CPU s", "wall s", "bar"),
        [clock.row("second start, all caches filled", bar="5")],
    )


def stages(n_points: int, n_frames: int, many: int) -> None:
    from fit.align import align_sequence
    from fit.fuse import fused
    from fit.track import track_sequence

    scene = Scene(n_frames, n_points)
    fitter, finder, settings = scene.fitter, scene.finder, scene.settings
    frames = [(k, scan, None) for k, scan in enumerate(scene.scans)]
    first = align_sequence(fitter, finder, frames[:1], settings)
    # Compiled code is loaded by now.
    rows = []
    clock = Clock()
    first = align_sequence(fitter, finder, frames[:1], settings)
    rows.append(clock.row("first frame, with finding the pose"))
    clock = Clock()
    alignments = align_sequence(fitter, finder, frames, settings, done_before={0: first[0]})
    rows.append(clock.row("alignment, a frame", n_frames - 1, "1.5"))
    clock = Clock()
    fusion, again = fused(fitter, finder, alignments, settings)
    rows.append(clock.row(f"fusion of {n_frames} frames", bar="2"))
    random = np.random.default_rng(3)
    jittered = []
    for k in range(many):
        alignment = alignments[k % n_frames]
        moved = alignment.state.template + 0.001 * random.normal(size=alignment.state.template.shape)
        jittered.append(replace(alignment, frame_id=k, state=alignment.state.moved(template=moved)))
    clock = Clock()
    fused(fitter, finder, jittered, settings)
    rows.append(clock.row(f"fusion of {many} frames", bar="10"))
    clock = Clock()
    track = track_sequence(
        fitter,
        finder,
        fusion,
        again,
        dict(enumerate(scene.scans)),
        settings,
        container_of=scene.container,  # type: ignore[arg-type]
    )
    rows.append(clock.row("tracking, a frame", n_frames, "1"))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    rows.append(("most memory, GB", f"{peak:.2f}", "", "2"))
    table(f"Stages, {n_points} points a scan", ("stage", "CPU s", "wall s", "bar"), rows)
    print(
        f"\nAlignments {1e3 * np.mean([a.distance_m for a in alignments]):.2f} mm from the scans, "
        f"bodies {1e3 * np.mean([f.distance_m for f in track]):.2f} mm."
    )


def peer(n_points: int, quick: bool) -> None:
    from benchmarks.adam_fit import AdamPeer, AdamRates
    from fit.align import POSE_POINTS, as_scan_points, starting_poses
    from fit.coarse import CoarseScan
    from fit.initialise import unwrap_root
    from fit.solver import Objective, Unknowns, minimise
    from fit.state import BodyState

    scene = Scene(1, n_points)
    fitter, finder, settings = scene.fitter, scene.finder, scene.settings
    scan = as_scan_points(scene.scans[0])
    coarse = CoarseScan.of(scan.points, scan.normals)
    pose = starting_poses(finder, coarse, None, None, np.zeros(3), np.inf)[0]
    begin = BodyState(fitter.shaped(pose.betas), unwrap_root(pose.pose), pose.translation, pose.betas)
    prior = finder.prior

    def ours(most: int) -> tuple[float, float]:
        """Processor seconds and energy of the alignment from this start; most: steps of its last stage."""
        clock, state = Clock(), begin
        for weights in settings.align_pose:
            unknowns = Unknowns(template=False, n_betas=settings.pose_betas)
            thin = scan.thinned(POSE_POINTS)
            objective = Objective(fitter, thin, weights, unknowns, prior.mean, prior.precision)
            state = minimise(objective, state, settings.max_iterations, settings.relative_drop).state
        state = minimise(last, state, most, settings.relative_drop).state
        return time.process_time() - clock.processor, last.energy(state)

    last = Objective(fitter, scan, settings.align_joint[-1], Unknowns(), prior.mean, prior.precision)
    ours(settings.max_iterations)
    seconds, energy = ours(settings.max_iterations)
    by_steps = [ours(k) for k in range(settings.max_iterations)]
    adam = AdamPeer(last)
    own, exact = adam.value(begin), last.energy(begin)
    assert abs(own - exact) < 1e-6 * exact, f"the peer's energy is {own}, not {exact}"
    grid = [AdamRates(0.02, 0.002, half_life=100)]
    if not quick:
        grid = [
            AdamRates(0.01, 0.001),
            AdamRates(0.01, 0.001, refresh=5),
            AdamRates(0.01, 0.001, half_life=100),
            AdamRates(0.02, 0.002, half_life=60),
            AdamRates(0.02, 0.002, half_life=100),
            AdamRates(0.02, 0.002, refresh=5, half_life=100),
            AdamRates(0.04, 0.004, half_life=100),
        ]
    levels = (1.2, 1.05, 1.02, 1.0)
    own_times = [min(t for t, e in [*by_steps, (seconds, energy)] if e <= level * energy) for level in levels]
    rows = [("Gauss-Newton (ours)", f"{energy:.5f}", *(f"{t:.2f}" for t in own_times), "1")]
    for rates in grid:
        run = adam.run(begin, rates, 25.0 * seconds, energy)
        reached = [run.seconds_to(level * energy) for level in levels]
        ratio = (
            f"{reached[-1] / seconds:.0f}"
            if np.isfinite(reached[-1])
            else f"> {run.seconds[-1] / seconds:.0f}"
        )
        times = [f"{s:.1f}" if np.isfinite(s) else "never" for s in reached]
        rows.append((f"Adam {rates.text}", f"{min(run.energies):.5f}", *times, ratio))
    table(
        f"The same energy from the same start, {n_points} points; CPU s to reach the solver's final energy E",
        ("", "energy in the end", "1.2 E", "1.05 E", "1.02 E", "E", "ratio at E"),
        rows,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer points, frames and settings")
    parser.add_argument("--part", choices=PARTS, help="only this table")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    n_points, n_frames, many = (12_000, 6, 24) if options.quick else (50_000, 12, 200)
    if options.here:
        if options.part == "start":
            start()
        elif options.part == "stages":
            stages(n_points, n_frames, many)
        else:
            peer(n_points, options.quick)
        return
    from benchmarks.hull import machine

    print(machine())
    for part in [options.part] if options.part else PARTS:
        command = [sys.executable, "-m", "benchmarks.fit", "--here", "--part", part]
        if part == "start":  # once to fill the caches
            subprocess.run(command, check=True, env=os.environ | THREADS, stdout=subprocess.DEVNULL)
        subprocess.run(
            [*command, "--quick"] if options.quick else command, check=True, env=os.environ | THREADS
        )


if __name__ == "__main__":
    main()
