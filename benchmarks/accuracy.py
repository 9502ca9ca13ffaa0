"""How near the body under the clothes comes to the true one: the tables of Zhang et al. (CVPR 2017) on people
whose body is known. Prints Markdown tables; writes them with CSV files and plots to `--out`.

    python -m benchmarks.accuracy --quick          # 2 people, 12 frames
    python -m benchmarks.accuracy                  # 6 people, 2 outfits, 3 motions, 40 frames; hulls of 16
    python -m benchmarks.accuracy --full           # with hulls of 68 cameras of 4 MP as well
    python -m benchmarks.accuracy --only 9001 hips scans         # some cells
    python -m benchmarks.accuracy --show           # the tables of what is finished

Measured on an AMD EPYC: a cell of 40 frames from scans takes about 60 s of one core, a fit with what it is
measured by; hulls of 16 take 1.3 s a frame more, of 68 of 4 MP 6 s. So `--quick` takes 6 minutes of one core,
the default about 3 hours, `--full` about 6; `--jobs` shares them out, by default over all cores.

Finished cells stay in OUT/cells, so that a run that was stopped goes on; they are made again once the fit,
the people or the measures change. `--quick` films other people (8901, 8902) than the tables (9001 to 9006),
so that everyday use tunes nothing on those.

table      the paper's table 1: parameters only, fusion, detailed; all cloth, labelled, and hulls
looseness  bias by how loose the clothes are
frames     the same sequence with ever more of its frames
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from benchmarks import accuracy_plots as plots
from benchmarks import accuracy_tables as tables
from benchmarks.accuracy_cells import BODY, Cell, finish_cells, load_cell, version
from benchmarks.accuracy_subjects import (
    HULLS_16,
    HULLS_68,
    LABELLED,
    LOOSENESS,
    MOTIONS,
    OUTFITS,
    RIGS,
    SCANS,
    SEEDS,
    dressed_subject,
)
from benchmarks.accuracy_tables import Found
from benchmarks.hull import machine
from bodyhull.folder import write_atomically

STUDIES = ("table", "looseness", "frames")
QUICK_SEEDS, QUICK_FRAMES = (8901, 8902), 12
FRAMES = 40
#: Numbers of frames that are compared.
FEWER = (3, 6, 12, 24)


def plan(quick: bool, full: bool, n_frames: int) -> dict[str, list[Cell]]:
    """The cells of every study; they share some."""
    seeds = QUICK_SEEDS if quick else SEEDS
    outfits, motions = (OUTFITS[:1], MOTIONS[:1]) if quick else (OUTFITS, MOTIONS)
    inputs = [SCANS, LABELLED, HULLS_16, *([HULLS_68] if full else [])]
    table = [Cell(s, o, m, i, n_frames) for s in seeds for o in outfits for m in motions for i in inputs]
    loose = seeds[:1] if quick else seeds[:4]
    grades = (LOOSENESS[0], LOOSENESS[2], LOOSENESS[3]) if quick else LOOSENESS
    looseness = [Cell(s, o, MOTIONS[0], SCANS, n_frames) for s in loose for o in grades]
    if not quick:
        looseness += [Cell(s, o, MOTIONS[0], HULLS_16, n_frames) for s in loose[:2] for o in LOOSENESS]
    frames = [
        Cell(s, OUTFITS[0], MOTIONS[0], SCANS, n_frames, n)
        for s in seeds[: 1 if quick else 2]
        for n in FEWER
        if n < n_frames
    ]
    frames += [Cell(s, OUTFITS[0], MOTIONS[0], SCANS, n_frames) for s in seeds[: 1 if quick else 2]]
    return {"table": table, "looseness": looseness, "frames": frames}


def chosen(cells: Sequence[Cell], only: Sequence[str]) -> list[Cell]:
    """The cells that `only` names: values of one fact are alternatives, different facts all have to hold."""
    wanted: dict[str, set[str]] = {}
    for text in only:
        facts = [
            f for f in ("seed", "outfit", "motion", "source") if text in {str(getattr(c, f)) for c in cells}
        ]
        for fact in facts:
            wanted.setdefault(fact, set()).add(text)
    return [c for c in cells if all(str(getattr(c, fact)) in texts for fact, texts in wanted.items())]


def finish(out: Path, cells: Sequence[Cell], n_jobs: int) -> list[str]:
    """Make the cells that are missing, in processes; what was lost, a sentence each."""
    from tqdm import tqdm

    jobs: dict[tuple[object, ...], list[Cell]] = {}
    for cell in cells:
        if load_cell(out, cell) is None:
            # All cloth and labelled share their scans.
            kind = cell.source if cell.source in RIGS else SCANS
            jobs.setdefault((cell.seed, cell.outfit, cell.motion, kind, cell.n_frames, cell.used), []).append(
                cell
            )
    # The longest first, so that the processes end together.
    order = sorted(
        jobs.values(),
        key=lambda job: -sum((c.used or c.n_frames) + 200 * (c.source == HULLS_68) for c in job),
    )
    lost: list[str] = []
    if not order:
        return lost
    os.environ.setdefault("TQDM_DISABLE", "1")
    for library in ("OMP", "OPENBLAS", "MKL", "NUMBA"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    with (
        tqdm(total=sum(map(len, order)), desc="cells", unit="cell", disable=False) as bar,
        ProcessPoolExecutor(
            n_jobs, multiprocessing.get_context("spawn"), _end_with_parent, (os.getpid(),)
        ) as pool,
    ):
        pending = {pool.submit(finish_cells, out, job): job for job in order}
        try:
            for done in as_completed(pending):
                lost += done.result()
                bar.update(len(pending[done]))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return lost


def _end_with_parent(parent: int) -> None:
    """A process of the pool ends soon after a parent that was killed, instead of waiting for it for ever."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(2.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def report(out: Path, studies: dict[str, list[Cell]], any_version: bool) -> str:
    """Every table of what is finished; CSV files and plots go to `out`."""
    found = {
        name: [c for c in (load_cell(out, cell, any_version=any_version) for cell in cells) if c is not None]
        for name, cells in studies.items()
    }
    text: list[str] = []
    table = found.get("table", [])
    everything: dict[str, Found] = {}
    for name in found:
        everything |= {str(c["cell"]): c for c in found[name]}
    cells = list(everything.values())
    if not cells:
        return "No cell is finished."
    versions = {c["version"] for c in cells}
    if len(versions) > 1 or versions != {version()}:
        text.append(
            f"\nCells of {len(versions)} versions of the code ({', '.join(sorted(versions))}); "
            f"now {version()}."
        )
    drawn: list[tuple[str, Callable[[Path, Sequence[Found]], None], list[Found]]] = []
    if table:
        text += [tables.table_one(table), tables.summary(table), tables.laws(table)]
        text += [tables.confidence_table(table), tables.pose_table(table)]
        beyond = [beyond_parameters_mm(seed) for seed in sorted({c["cell"]["seed"] for c in table})]
        text.append(
            f"\nBeyond any parameters of the fitted body: {', '.join(f'{x:.2f}' for x in beyond)} mm RMS"
            " along the normal, person by person. The paper's people were real, and its 17 to 20 mm for "
            "parameters only come from another body model."
        )
        drawn += [
            ("table.png", plots.table_figure, table),
            ("pose.png", plots.pose_figure, table),
            ("confidence.png", plots.confidence_figure, table),
        ]
        _write(out / "pose.csv", tables.pose_csv(table))
    if found.get("looseness"):
        text.append(tables.looseness_table(found["looseness"]))
        drawn.append(("looseness.png", plots.looseness_figure, found["looseness"]))
    if found.get("frames"):
        by_number = [_with_used(c) for c in found["frames"]]
        text.append(tables.frames_table(by_number))
        drawn.append(("frames.png", plots.frames_figure, by_number))
    for name, draw, which in drawn:
        draw(out / name, which)
    _write(out / "cells.csv", tables.cells_csv(cells))
    _write(out / "tables.md", "\n".join(text) + "\n")
    seconds = [c["machine_seconds"]["fit"] for c in cells]
    text.append(
        f"\n{len(cells)} cells; a fit took {sum(seconds) / len(seconds):.0f} s on average. "
        f"Tables, CSV and plots: {out}/"
    )
    return "\n".join(text)


def beyond_parameters_mm(seed: int) -> float:
    """What no set of shape parameters reaches of a person: RMS, along the normal, over all that is scored."""
    from fit.body.model import load_body
    from fit.evaluate import summarise
    from fit.surface import vertex_areas, vertex_normals
    from fit.truth import SCORED_REGIONS

    model, person = load_body(BODY, show_progress=False), dressed_subject(seed, "none")
    space = model.shape_directions.reshape(-1, model.n_betas)
    rest = (person.template - model.template).ravel()
    # Normal equations: the components are independent, and there are few of them.
    rest = (rest - space @ np.linalg.solve(space.T @ space, space.T @ rest)).reshape(-1, 3)
    scored = np.isin(person.region, SCORED_REGIONS)
    along = np.einsum("va,va->v", rest, vertex_normals(person.template, model.faces))
    area = vertex_areas(person.template, model.faces)
    return summarise(1e3 * along[scored], area[scored]).rms


def _with_used(cell: Found) -> Found:
    """A cell whose number of fitted frames is told where all were taken, too."""
    return cell | {"cell": cell["cell"] | {"used": cell["cell"]["used"] or cell["cell"]["n_frames"]}}


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda temporary: temporary.write_text(text))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="minutes: fewer people, frames, motions")
    parser.add_argument("--full", action="store_true", help="hulls of 68 cameras too")
    parser.add_argument("--out", type=Path, default=Path("accuracy"))
    parser.add_argument("--study", nargs="+", choices=STUDIES, default=STUDIES)
    parser.add_argument(
        "--only", nargs="+", default=(), metavar="FACT", help="seeds, outfits, motions, inputs"
    )
    parser.add_argument("--frames", type=int, help=f"of a sequence ({FRAMES}; quick: {QUICK_FRAMES})")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--show", action="store_true", help="only the tables of what is there, of any version"
    )
    options = parser.parse_args()
    n_frames = options.frames or (QUICK_FRAMES if options.quick else FRAMES)
    planned = plan(options.quick, options.full or HULLS_68 in options.only, n_frames)
    every = [c for cells in planned.values() for c in cells]
    known = {str(getattr(c, f)) for c in every for f in ("seed", "outfit", "motion", "source")}
    unknown = [text for text in options.only if text not in known]
    if unknown:
        parser.error(f"--only {' '.join(unknown)}: there are {', '.join(sorted(known))}")
    studies = {name: chosen(planned[name], options.only) for name in options.study}
    print(machine(), flush=True)
    lost: list[str] = []
    if not options.show:
        wanted = list(dict.fromkeys(c for cells in studies.values() for c in cells))
        lost = finish(options.out, wanted, options.jobs)
    print(report(options.out, studies, options.show))
    for sentence in lost:
        print(f"failed: {sentence}", file=sys.stderr)
    return 3 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
