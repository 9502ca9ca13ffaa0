"""Cloth alignments (paper section 4.2): every scan registered by a template of its own, as if it were all
skin.

The pose is found first (initialise.py), then pose and shape alone are fitted, then the template joins them.
What is left in the unposed templates is cloth, with the motion factored out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fit.coarse import CoarsePose, CoarseScan
from fit.initialise import PoseFinder, unwrap_root
from fit.settings import FitSettings
from fit.solver import Fitter, Objective, ScanPoints, Unknowns, minimise
from fit.state import BodyState
from hull.scan import Scan

#: So many points tell the pose; the template then takes all of them.
POSE_POINTS = 12_000
#: A score this much worse than the best frame's means that the previous pose did not carry over.
LOST = 1.10
#: Alignments whose points stay this far away on average are marked: the pose is probably wrong.
SUSPICIOUS_M = 0.03


@dataclass(frozen=True)
class Alignment:
    """One aligned frame, in the body's upright frame.

    state.template is the unposed clothed template; score: coarse distance of the starting pose, m;
    distance_m: mean distance of the scan to the alignment; status: "ok", "suspect" or "failed", with
    `message` saying why.
    """

    frame_id: int
    state: BodyState
    score: float
    distance_m: float
    status: str = "ok"
    message: str = ""


def as_scan_points(scan: Scan) -> ScanPoints:
    """A scan as the objective takes it."""
    return ScanPoints(
        scan.points, scan.normals, scan.weight, scan.is_skin if scan.skin_share is None else scan.skin_share
    )


def align_frame(
    fitter: Fitter,
    finder: PoseFinder,
    scan: ScanPoints,
    starts: list[CoarsePose],
    settings: FitSettings,
    joints: Float[np.ndarray, "j 3"] | None = None,
) -> BodyState:
    """Best alignment of one scan from one or more starting poses.

    All starts go through the pose-and-shape stage; the one with the lowest energy gets the template. joints:
    hold the skeleton fixed (J 3) instead of letting it follow the betas.
    """
    thin = scan.thinned(POSE_POINTS)
    best: BodyState | None = None
    best_energy = np.inf
    for start in starts:
        state = BodyState(fitter.shaped(start.betas), unwrap_root(start.pose), start.translation, start.betas)
        energy = np.inf
        for weights in settings.align_pose:
            objective = Objective(
                fitter,
                thin,
                weights,
                Unknowns(template=False, n_betas=settings.pose_betas),
                finder.prior.mean,
                finder.prior.precision,
                joints=joints,
            )
            outcome = minimise(objective, state, settings.max_iterations, settings.relative_drop)
            state, energy = outcome.state, outcome.energies[-1]
        if best is None or energy < best_energy:
            best, best_energy = state, energy
    assert best is not None, "align_frame needs at least one start"
    for weights in settings.align_joint:
        objective = Objective(
            fitter, scan, weights, Unknowns(), finder.prior.mean, finder.prior.precision, joints=joints
        )
        best = minimise(objective, best, settings.max_iterations, settings.relative_drop).state
    return best


def align_sequence(
    fitter: Fitter,
    finder: PoseFinder,
    scans: Iterable[tuple[int, Scan | None, Float[np.ndarray, "25 4"] | None]],
    settings: FitSettings,
    report: Callable[[Alignment], None] = lambda alignment: None,
    done_before: Mapping[int, Alignment] | None = None,
) -> list[Alignment]:
    """Align the frames in order: (frame_id, scan in the body's frame or None, keypoints or None).

    Each frame starts from the previous pose; where that scores clearly worse than the best frame so far, or
    there is none, the pose is found anew. A frame without a scan is passed over; one that raises is kept,
    marked "failed". Frames of `done_before` are taken as they are; `report` hears of the others.
    """
    from threadpoolctl import threadpool_limits

    # The matrices of pose finding are small: threads would only fight over them.
    with threadpool_limits(limits=1, user_api="blas"):
        return _align_in_order(fitter, finder, scans, settings, report, done_before or {})


def _align_in_order(
    fitter: Fitter,
    finder: PoseFinder,
    scans: Iterable[tuple[int, Scan | None, Float[np.ndarray, "25 4"] | None]],
    settings: FitSettings,
    report: Callable[[Alignment], None],
    done_before: Mapping[int, Alignment],
) -> list[Alignment]:
    done: list[Alignment] = []
    previous: CoarsePose | None = None
    centroid = np.zeros(3)
    best_score = np.inf
    for frame_id, scan, keypoints in scans:
        if scan is None:
            continue
        if frame_id in done_before:
            alignment = done_before[frame_id]
            done.append(alignment)
            if alignment.status == "failed":
                previous = None
            else:
                state = alignment.state
                previous = CoarsePose(state.pose, state.translation, state.betas, alignment.score)
                best_score, centroid = min(best_score, alignment.score), scan.points.mean(0)
            continue
        try:
            if not (np.isfinite(scan.points).all() and np.isfinite(scan.normals).all()):
                raise FloatingPointError("the scan holds NaN or infinite coordinates")
            coarse = CoarseScan.of(scan.points, scan.normals)
            starts = starting_poses(finder, coarse, keypoints, previous, centroid, best_score)
            state = align_frame(fitter, finder, as_scan_points(scan), starts, settings)
            posed = fitter.posed(state)
            distance = mean_distance(fitter, posed, scan.points)
        except (FloatingPointError, np.linalg.LinAlgError) as error:
            rest = BodyState(
                fitter.shaped(np.zeros(finder.n_model_betas)),
                finder.mean_pose(),
                np.zeros(3),
                np.zeros(finder.n_model_betas),
            )
            alignment = Alignment(frame_id, rest, np.inf, np.inf, "failed", f"frame {frame_id:06d}: {error}")
            done.append(alignment)
            report(alignment)
            previous = None
            continue
        score = starts[0].score
        alignment = Alignment(frame_id, state, score, distance)
        if distance > SUSPICIOUS_M:
            alignment = replace(
                alignment,
                status="suspect",
                message=f"frame {frame_id:06d}: the alignment stays {1e3 * distance:.0f} mm from the scan "
                "on average",
            )
        best_score = min(best_score, score)
        previous = CoarsePose(state.pose, state.translation, state.betas, score)
        centroid = scan.points.mean(0)
        done.append(alignment)
        report(alignment)
    return done


def starting_poses(
    finder: PoseFinder,
    coarse: CoarseScan,
    keypoints: Float[np.ndarray, "25 4"] | None,
    previous: CoarsePose | None,
    previous_centroid: Float[np.ndarray, "3"],
    best_score: float,
) -> list[CoarsePose]:
    """Where to start a frame: keypoints where given, else the previous pose, else (or when lost) the hull
    alone."""
    starts: list[CoarsePose] = []
    betas = None if previous is None else previous.betas
    if keypoints is not None:
        found = finder.from_keypoints(coarse, keypoints, betas)
        if found is not None:
            starts.append(found)
    if previous is not None:
        starts.append(finder.from_previous(coarse, previous, previous_centroid))
    if not starts or min(at.score for at in starts) > LOST * best_score:
        starts += finder.from_hull(coarse, betas)[:2]
    starts = sorted(starts, key=lambda at: at.score)
    return [at for at in starts if at.score < 1.25 * starts[0].score][:2]


def mean_distance(fitter: Fitter, posed: np.ndarray, points: np.ndarray) -> float:
    """Mean unsigned distance of points to a posed body, m."""
    return float(np.abs(fitter.surface.closest(posed, points).distance).mean())
