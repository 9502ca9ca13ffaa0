"""`bodyhull rig-study`: how good hull and body get with a rig that need not exist yet.

A clothed synthetic person is filmed by every rig of the plan, with cameras and outlines that err, and each
recording goes through the pipeline like any other; then hull and body are compared with the truth.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from bodyhull.config import RunConfig, digest
from bodyhull.errors import UserError
from bodyhull.folder import RunFolder, write_atomically
from bodyhull.study_plan import Case, StudyPlan
from capture.errors import RecordingError
from hull.errors import HullError

if TYPE_CHECKING:
    from render.synthetic import Performance

_POINTS_OF_A_HULL = 20_000


@dataclass(frozen=True)
class StudySubject:
    """Who is filmed, doing what, in how many frames."""

    body: str = "free:neutral"
    seed: int = 7
    garment: str = "tshirt-trousers"
    motion: str = "tilt-twist"
    frames: int = 8


@dataclass(frozen=True)
class Outcome:
    """What came of one rig. Errors in millimetres; None where there is none (a body that was not fitted).

    hull_bias, hull_rms, hull_p95: the hull's points against the true clothed surface, all frames (bias:
    positive outside). shape_rms, shape_bias: the fusion shape by the paper's measure; posed_rms: the detailed
    bodies as they stand. frames_lost: frames without a hull or without a body. pixel_mm: a pixel at the
    subject. failure: the sentence that ended it.
    """

    case: Case
    hull_bias: float | None = None
    hull_rms: float | None = None
    hull_p95: float | None = None
    shape_rms: float | None = None
    shape_bias: float | None = None
    posed_rms: float | None = None
    frames_lost: int = 0
    pixel_mm: float | None = None
    seconds: float = 0.0
    failure: str = ""


def run_study(
    out: Path, plan: StudyPlan, subject: StudySubject, *, with_body: bool = True, n_jobs: int = 1
) -> dict[Case, Outcome]:
    """Every case of the plan, in `n_jobs` processes. Finished cases are kept in OUT/cases/<name> and taken
    from there.

    A rig that yields nothing is an outcome with its sentence, not an error.
    """
    done: dict[Case, Outcome] = {}
    todo: list[Case] = []
    for case in plan.cases():
        found = _kept(out, case, _case_key(plan, case, subject, with_body))
        if found is None:
            todo.append(case)
        else:
            done[case] = found
    # The longest first, so that the processes end together.
    todo.sort(key=lambda case: -case.cameras * case.width_px)
    with tqdm(total=len(todo), desc="rigs", unit="rig", disable=not todo) as bar:
        if n_jobs == 1:
            for case in todo:
                done[case] = study_case(out, plan, case, subject, with_body)
                bar.update()
        elif todo:
            _one_thread_each()
            with ProcessPoolExecutor(n_jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
                jobs = [pool.submit(study_case, out, plan, case, subject, with_body) for case in todo]
                try:
                    for job in as_completed(jobs):
                        done[job.result().case] = job.result()
                        bar.update()
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise
    return {case: done[case] for case in plan.cases()}


def study_case(out: Path, plan: StudyPlan, case: Case, subject: StudySubject, with_body: bool) -> Outcome:
    """Film, carve, fit and measure one rig below OUT/cases; its outcome is written there too."""
    from render.spoil import misplaced_rig, wandering_outline
    from render.synthetic import film_performance, write_setup, write_truth

    started = time.perf_counter()
    folder = out / "cases" / case.name
    recording, run = folder / "recording", folder / "run"
    performance = _performance(subject)
    rig = plan.rig(case)
    noise = np.random.default_rng([subject.seed, 17])
    write_setup(recording / "setup", misplaced_rig(rig, case.calibration_px, subject.seed))
    film_performance(
        recording,
        performance,
        rig,
        pictures=False,
        spoil=lambda _camera, _frame, mask: wandering_outline(mask, case.mask_px, noise),
        progress=False,
    )
    write_truth(recording / "truth" / "truth.npz", performance, asdict(subject) | asdict(case))
    config = RunConfig(recording, run, body=subject.body, units="m", up="z", overwrite=True)
    try:
        found = _measure(config, recording / "truth", performance, with_body)
    except (UserError, RecordingError, HullError) as error:
        found = {"failure": str(error).replace(f"{out}{os.sep}", ""), "frames_lost": subject.frames}
    distance = float(np.median(np.linalg.norm(rig.centres - [0, 0, 1], axis=1)))
    focal = float(np.median([camera.intrinsics[0, 0] for camera in rig]))
    outcome = Outcome(
        case,
        **found,
        pixel_mm=round(1e3 * distance / focal, 3),
        seconds=round(time.perf_counter() - started, 1),
    )
    key = _case_key(plan, case, subject, with_body)
    text = json.dumps({"key": key} | asdict(outcome), indent=1) + "\n"
    write_atomically(folder / "outcome.json", lambda path: path.write_text(text))
    return outcome


def _measure(config: RunConfig, truth: Path, performance: Performance, with_body: bool) -> dict[str, Any]:
    from bodyhull.carving import carve_stage
    from bodyhull.evaluating import evaluate_stage
    from bodyhull.fitting import fit_stage

    carve_stage(config)
    found = _hull_errors(RunFolder(config.out), performance)
    if not with_body:
        return found
    try:
        fit_stage(config)
        errors = evaluate_stage(config, truth)
    except UserError as error:
        return found | {"failure": str(error).replace(f"{config.out}: ", "")}
    frames = RunFolder(config.out).read_state()["stages"]["fit"]["frames"]
    summary = errors["summary"]
    return found | {
        "shape_rms": summary["fusion, paper"]["rms"],
        "shape_bias": summary["fusion, paper"]["bias"],
        "posed_rms": summary["detailed, direct"]["rms"],
        "frames_lost": sum(entry["status"] == "failed" for entry in frames.values()),
    }


def _hull_errors(folder: RunFolder, performance: Performance) -> dict[str, Any]:
    from hull.mesh_file import load_mesh
    from hull.scan import even_samples
    from render.clothed import DressedTruth

    frames = folder.read_state()["stages"]["hull"]["frames"]
    off = []
    for frame_idx in range(len(performance.vertices)):
        if frames[f"{frame_idx:06d}"]["status"] == "failed":
            continue
        vertices, faces = load_mesh(folder.hull(frame_idx))
        face, barycentric = even_samples(vertices, faces, _POINTS_OF_A_HULL, seed=0)
        points = np.einsum("nk,nki->ni", barycentric, vertices[faces[face]])
        off.append(1e3 * DressedTruth(performance.surfaces(frame_idx)).signed_distance(points))
    signed = np.concatenate(off)
    return {
        "hull_bias": round(float(signed.mean()), 3),
        "hull_rms": round(float(np.sqrt((signed**2).mean())), 3),
        "hull_p95": round(float(np.percentile(np.abs(signed), 95)), 3),
        "frames_lost": len(performance.vertices) - len(off),
    }


def _performance(subject: StudySubject) -> Performance:
    from fit.body.model import load_body
    from render.subject import make_subject
    from render.synthetic import perform

    person = make_subject(load_body(subject.body), subject.seed, subject.garment)
    return perform(person, subject.motion, subject.frames, subject.seed)


def _case_key(plan: StudyPlan, case: Case, subject: StudySubject, with_body: bool) -> str:
    where = {k: v for k, v in plan.as_dict().items() if k in ("layout", "calibration", "size", "units", "up")}
    return digest({"case": asdict(case), "subject": asdict(subject), "with_body": with_body, "rig": where})


def _kept(out: Path, case: Case, key: str) -> Outcome | None:
    path = out / "cases" / case.name / "outcome.json"
    try:
        values = json.loads(path.read_text())
        if values.pop("key") != key:
            return None
        return Outcome(**(values | {"case": case}))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _one_thread_each() -> None:
    """The children share the cores and the terminal: each library keeps to one thread, and no child shows
    bars.
    """
    os.environ.setdefault("TQDM_DISABLE", "1")
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
