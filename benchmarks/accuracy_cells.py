"""One cell of the accuracy tables: a person in an outfit, moving, seen in one way, fitted and scored.

The fit is the pipeline's own (`_fit`, the one place that calls it), with its default settings. A finished
cell is a JSON file; it is used again as long as body, settings, fit and benchmark are the same.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import accuracy_baseline, accuracy_protocol, accuracy_subjects
from benchmarks.accuracy_baseline import Parametric, fit_parameters
from benchmarks.accuracy_protocol import (
    Posed,
    Score,
    error_by_frame,
    low_quantile_shape,
    marker_errors_mm,
    markers_of,
    mean_shape,
    rms_by_confidence,
    score,
    share_within,
    value_at,
)
from benchmarks.accuracy_subjects import LABELLED, RIGS, SCANS, Recorded, rig_of
from bodyhull.folder import write_atomically
from fit.align import Alignment, align_sequence
from fit.body.model import load_body
from fit.body.pose_prior import PosePrior
from fit.closest import Container
from fit.evaluate import Surface, average, signed_error_mm
from fit.fuse import FusionShape, fused, usable
from fit.hull_excess import hull_excess
from fit.initialise import PoseFinder
from fit.settings import FitSettings
from fit.skin import labelled
from fit.solver import Fitter
from fit.state import BodyState
from fit.surface import vertex_areas
from fit.track import TrackedFrame, track_sequence
from hull.scan import Scan

BODY = "free:neutral"
#: At most so many frames, evenly spread, are scored; markers are followed through all of them.
SCORED_FRAMES = 12
#: In so many of them errors are compared with the confidence.
CONFIDENCE_FRAMES = 5
#: The modules of `render` that decide how a person looks and moves.
MAKE_PEOPLE = ("subject", "garments", "wardrobe", "motions", "limb_angles", "synthetic")
BASELINE, MEAN, QUANTILE, FUSION, DETAILED = "parameters", "mean", "quantile", "fusion", "detailed"
MEASURES = ("paper", "under_cloth", "bare", "direct")
RESULTS = (BASELINE, MEAN, QUANTILE, FUSION, DETAILED)


@dataclass(frozen=True)
class Cell:
    """seed, outfit, motion: who does what; source: one of INPUTS; n_frames: of the whole sequence; used: so
    many of them, evenly spread, are fitted (0: all)."""

    seed: int
    outfit: str
    motion: str
    source: str
    n_frames: int
    used: int = 0

    @property
    def name(self) -> str:
        """What its file is called."""
        part = f"-of-{self.n_frames}" if self.used else ""
        return f"{self.seed}-{self.outfit}-{self.motion}-{self.source}-{self.used or self.n_frames}{part}"

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """The frames that are fitted."""
        n = self.used or self.n_frames
        # In the middles of n equal parts: the ends of a period are the same moment.
        return tuple(((np.arange(n) + 0.5) * self.n_frames / n).astype(int).tolist())


@dataclass(frozen=True)
class Fitted:
    """All that a fit gives: cloth alignments as first found, and as fused; fusion shape, track, seconds."""

    first: list[Alignment]
    alignments: list[Alignment]
    fusion: FusionShape
    track: list[TrackedFrame]
    seconds: float


@lru_cache(maxsize=1)
def _tools() -> tuple[Fitter, PoseFinder]:
    model = load_body(BODY, show_progress=False)
    return Fitter.of(model), PoseFinder.of(model, PosePrior.standard())


def _fit(
    scans: dict[int, Scan], container_of: Callable[[int], Container | None], settings: FitSettings
) -> Fitted:
    """What `bodyhull fit` does with scans or hulls, in its order."""
    started = time.perf_counter()
    fitter, finder = _tools()
    first = align_sequence(fitter, finder, [(k, s, None) for k, s in scans.items()], settings)
    scans, shares = labelled(fitter, scans, first, settings)
    fusion, alignments = fused(fitter, finder, first, settings, shares, hull_excess(fitter, scans, first))
    track = track_sequence(fitter, finder, fusion, alignments, scans, settings, container_of=container_of)
    return Fitted(first, alignments, fusion, track, time.perf_counter() - started)


@lru_cache(maxsize=1)
def _seen(
    seed: int, outfit: str, motion: str, n_frames: int, kind: str, frame_ids: tuple[int, ...]
) -> tuple[Recorded, dict[int, Scan], dict[int, Container]]:
    """A sequence and its labelled scans, or its hulls."""
    settings = FitSettings()
    recorded = Recorded.of(seed, outfit, motion, n_frames)
    if kind not in RIGS:
        return recorded, {k: recorded.scan(k, settings.n_points) for k in frame_ids}, {}
    rig = rig_of(kind)
    pairs = {k: recorded.hull(k, rig, settings.n_points, settings.seed) for k in frame_ids}
    return recorded, {k: s for k, (s, _) in pairs.items()}, {k: c for k, (_, c) in pairs.items()}


def measure(cell: Cell) -> dict[str, Any]:
    """Make the cell's input, fit it, score it. Errors in mm."""
    settings = FitSettings()
    kind = cell.source if cell.source in RIGS else SCANS
    recorded, scans, containers = _seen(
        cell.seed, cell.outfit, cell.motion, cell.n_frames, kind, cell.frame_ids
    )
    if cell.source == SCANS:  # all cloth
        scans = {k: replace(s, is_skin=np.zeros_like(s.is_skin)) for k, s in scans.items()}
    fitted = _fit(scans, containers.get, settings)
    started = time.perf_counter()
    parametric = None
    if cell.source != LABELLED:  # it knows no skin
        fitter, finder = _tools()
        parametric = fit_parameters(fitter, finder, scans, fitted.first, settings)
    found = _scored(recorded, fitted, parametric)
    return {
        "cell": asdict(cell),
        "machine_seconds": {
            "fit": round(fitted.seconds, 1),
            "measures": round(time.perf_counter() - started, 1),
        },
        "scan": _of_scans(recorded, scans),
        **found,
    }


def _scored(recorded: Recorded, fitted: Fitted, parametric: Parametric | None) -> dict[str, Any]:
    good = [f for f in fitted.track if f.status != "failed"]
    chosen = {
        good[i].frame_id
        for i in np.linspace(0, len(good) - 1, min(len(good), SCORED_FRAMES)).round().astype(int)
    }
    surely = sorted(chosen)[:: max(1, len(chosen) // CONFIDENCE_FRAMES)]
    faces, scored = recorded.subject.body.faces, recorded.scored
    bodies = _Bodies(fitted, parametric)
    scores: dict[str, list[Score]] = {name: [] for name in bodies.names}
    sure: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    expected: list[float] = []
    thickness = fitted.fusion.thickness
    for frame in good:
        if frame.frame_id not in chosen:
            continue
        truth = recorded.truth(frame.frame_id)
        for name in bodies.names:
            result = bodies.posed(name, frame)
            scores[name].append(score(result, truth, faces, scored, recorded.under_cloth, recorded.bare))
            if name == FUSION and frame.frame_id in surely and fitted.fusion.confidence is not None:
                reposed = scores[name][-1].reposed
                sure.append(
                    (
                        value_at(fitted.fusion.confidence, result.surface, reposed[scored]),
                        signed_error_mm(reposed[scored], result.surface),
                        vertex_areas(reposed, faces)[scored],
                    )
                )
                if thickness is not None and recorded.under_cloth.any():
                    under = reposed[scored & recorded.under_cloth]
                    expected.append(1e3 * float(value_at(thickness.expected, result.surface, under).mean()))
    markers = markers_of(recorded.subject.template, recorded.subject.joints)
    true_markers = np.stack([recorded.truth(f.frame_id)[list(markers.values())] for f in good])
    pose = {}
    for name in (BASELINE, DETAILED):
        if name not in bodies.names:
            continue
        errors = marker_errors_mm(
            true_markers, np.stack([bodies.posed(name, f).surface.vertices for f in good])
        )
        pose[name] = {
            "by_frame": error_by_frame(errors).round(3).tolist(),
            "share_within": share_within(errors).round(5).tolist(),
            "by_marker": dict(zip(markers, errors.mean((0, 1)).round(2).tolist(), strict=True)),
        }
    return {
        "frames": {
            "fitted": len(fitted.track),
            "failed": len(fitted.track) - len(good),
            "suspect": sum(f.status == "suspect" for f in good),
            "scored": len(chosen),
        },
        "expected_cloth_mm": float(np.mean(expected)) if expected else None,
        "trust": fitted.fusion.trust,
        "errors": {
            name: {
                measure: asdict(average([getattr(s, measure) for s in scores[name]])) for measure in MEASURES
            }
            for name in bodies.names
        },
        "confidence": rms_by_confidence(*(np.concatenate(x) for x in zip(*sure, strict=True)))
        if sure
        else None,
        "pose": {"frame_ids": [f.frame_id for f in good], **pose},
    }


class _Bodies:
    """Every result of a cell as a posed body a frame."""

    def __init__(self, fitted: Fitted, parametric: Parametric | None) -> None:
        self._fitter = _tools()[0]
        self._fusion, self._parametric = fitted.fusion, parametric
        # The same alignments that the fusion shape was made from, unposed with the poses found together: a
        # harder rival than the first ones.
        templates = np.stack([a.state.template for a in usable(fitted.alignments)])
        faces = self._fitter.model.faces
        self._shapes = {
            MEAN: mean_shape(templates),
            QUANTILE: low_quantile_shape(templates, faces),
            FUSION: fitted.fusion.template,
        }
        self.names = [r for r in RESULTS if r != BASELINE or parametric is not None]

    def posed(self, name: str, frame: TrackedFrame) -> Posed:
        """A result in a frame; all but the baseline share the track's poses."""
        fitter, model = self._fitter, self._fitter.model
        if name == BASELINE:
            assert self._parametric is not None
            state = self._parametric.states[frame.frame_id]
            joints = fitter.joints(state.betas)
        else:
            template = frame.state.template if name == DETAILED else self._shapes[name]
            state = BodyState(template, frame.state.pose, frame.state.translation, self._fusion.betas)
            joints = self._fusion.joints
        return Posed(
            Surface(fitter.posed(state, joints), model.faces),
            model.weights,
            fitter.posed_joints(state, joints),
            model.parents,
        )


def _of_scans(recorded: Recorded, scans: dict[int, Scan]) -> dict[str, float]:
    """How far the scans themselves lie from the naked body, mm: mean over their points at what is scored, and
    at what is under cloth of that."""
    from fit.closest import closest_points

    faces, scored = recorded.subject.body.faces, recorded.scored
    frames = list(scans)[:: max(1, len(scans) // CONFIDENCE_FRAMES)]
    off, cloth = [], []
    for k in frames:
        closest = closest_points(recorded.truth(k), faces, scans[k].points)
        corners = faces[closest.triangle_idx]
        off.append(closest.distance[scored[corners].all(1)])
        cloth.append(closest.distance[(scored & recorded.under_cloth)[corners].all(1)])
    under = np.concatenate(cloth)
    return {
        "mean_mm": 1e3 * float(np.concatenate(off).mean()),
        "cloth_mm": 1e3 * float(under.mean()) if len(under) else 0.0,
        "skin_share": float(np.mean([s.is_skin.mean() for s in scans.values()])),
    }


@lru_cache(maxsize=1)
def version() -> str:
    """A hash of what decides a cell's numbers: body, settings, the code of fit, carving, people and
    measures."""
    root = Path(__file__).resolve().parents[1]
    found = sha256()
    found.update(load_body(BODY, show_progress=False).content_hash.encode())
    found.update(repr(FitSettings()).encode())
    files = [f for room in ("fit", "hull") for f in sorted((root / room).rglob("*.py"))]
    files += [root / "render" / f"{name}.py" for name in MAKE_PEOPLE]
    files += [Path(m.__file__) for m in (accuracy_baseline, accuracy_protocol, accuracy_subjects)]
    for file in [*files, Path(__file__)]:
        found.update(file.read_bytes())
    return found.hexdigest()[:12]


def load_cell(out: Path, cell: Cell, *, any_version: bool = False) -> dict[str, Any] | None:
    """A finished cell, or None where there is none of this version."""
    try:
        found = json.loads((out / "cells" / f"{cell.name}.json").read_text())
    except (OSError, ValueError):
        return None
    if found.get("cell") != asdict(cell) or not (any_version or found.get("version") == version()):
        return None
    return found


def finish_cells(out: Path, cells: Sequence[Cell]) -> list[str]:
    """Measure the cells that are not there yet, one by one, and write each; the names of those that raised,
    with the reason."""
    lost = []
    for cell in cells:
        if load_cell(out, cell) is not None:
            continue
        try:
            found = measure(cell) | {"version": version()}
        except (ValueError, FloatingPointError, np.linalg.LinAlgError) as error:
            lost.append(f"{cell.name}: {error}")
            continue
        text = json.dumps(found, indent=1) + "\n"
        write_atomically(out / "cells" / f"{cell.name}.json", lambda path, text=text: path.write_text(text))
    return lost
