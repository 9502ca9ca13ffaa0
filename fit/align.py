"""Cloth alignments (paper section 4.2): every scan registered by a template of its own, as if it were all
skin.

The pose is found first (initialise.py), then pose and shape alone are fitted, then the template joins them.
What is left in the unposed templates is cloth, with the motion factored out. Frames are aligned from the
surest one both ways in time (sequence_order.py), each from its neighbour; a frame in which the body was lost
(lost.py) is started anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

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
    `message` saying why. coarse_m, left_out, outside: signs of a lost body (`lost.Signs`), of the aligned
    pose; tried: other starts were tried; lost: they gave other poses and none was right, so that no neighbour
    starts here.
    """

    frame_id: int
    state: BodyState
    score: float
    distance_m: float
    status: str = "ok"
    message: str = ""
    coarse_m: float = np.inf
    left_out: float = 0.0
    outside: float = 0.0
    tried: bool = False
    lost: bool = False


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
    """Align frames that follow each other in time: (frame_id, scan in the body's frame or None, keypoints or
    None). The results are in the same order.

    The surest frame comes first; the others start from the pose of the frame beside them, later ones first,
    then earlier ones. Where that scores clearly worse than the best frame so far, or there is none, the pose
    is found anew; so it is where the body was lost, and once more when all frames are there. A frame without
    a scan is passed over; one that raises is kept, marked "failed". Frames of `done_before` are taken as
    they are; `report` hears of the others, and again of one that a second look changed.
    """
    from threadpoolctl import threadpool_limits

    from fit.aligned_frames import AlignedFrames

    frames = [(frame_id, scan, keypoints) for frame_id, scan, keypoints in scans if scan is not None]
    # The matrices of pose finding are small: threads would only fight over them.
    with threadpool_limits(limits=1, user_api="blas"):
        walk = AlignedFrames(fitter, finder, frames, settings, report, done_before or {})
        walk.align_all()
        walk.look_again()
    return walk.in_order()


def starting_poses(
    finder: PoseFinder,
    coarse: CoarseScan,
    keypoints: Float[np.ndarray, "25 4"] | None,
    previous: CoarsePose | None,
    previous_centroid: Float[np.ndarray, "3"],
    best_score: float,
    hypotheses: Sequence[CoarsePose] = (),
) -> list[CoarsePose]:
    """Where to start a frame: keypoints where given, else the previous pose, else (or when lost) the hull
    alone (from `hypotheses` of `PoseFinder.search`, where it was searched already)."""
    starts: list[CoarsePose] = []
    betas = None if previous is None else previous.betas
    if keypoints is not None:
        found = finder.from_keypoints(coarse, keypoints, betas)
        if found is not None:
            starts.append(found)
    if previous is not None:
        starts.append(finder.from_previous(coarse, previous, previous_centroid))
    if not starts or min(at.score for at in starts) > LOST * best_score:
        starts += finder.from_hull(coarse, betas, hypotheses)[:2]
    starts = sorted(starts, key=lambda at: at.score)
    return [at for at in starts if at.score < 1.25 * starts[0].score][:2]


def distance_complaint(distance_m: float) -> tuple[str, ...]:
    """What there is to say of an alignment that keeps this mean distance: nothing, or a clause."""
    if distance_m <= SUSPICIOUS_M:
        return ()
    return (f"the alignment stays {1e3 * distance_m:.0f} mm from the scan on average",)


def mean_distance(fitter: Fitter, posed: np.ndarray, points: np.ndarray) -> float:
    """Mean unsigned distance of points to a posed body, m."""
    return float(np.abs(fitter.surface.closest(posed, points).distance).mean())
