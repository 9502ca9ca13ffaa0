"""Pose and shape parameters alone, under clothes: in the manner of Yang, Franco, Hetroy-Wheeler, Wuhrer 2016.

"Estimation of human body shape in motion with wide clothing" (ECCV 2016) fits a statistical body to a
sequence of clothed scans: one set of shape parameters for all frames, a pose a frame, the cloth outside of
the body, and no free-form surface. Here with this project's body and solver: the poses by the same one-sided
robust data term with the shape held; then, with the poses held, the points of all frames are carried back to
the zero pose and the betas are found there, from all frames at once. The frames start from the poses of the
cloth alignments, so the comparison is about shape, not about starting poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fit.align import Alignment, as_scan_points
from fit.initialise import PoseFinder
from fit.settings import FitSettings, StageWeights
from fit.solver import Fitter, Objective, ScanPoints, Unknowns, minimise
from fit.state import BodyState
from hull.scan import Scan

#: Pose and betas in turn, so often.
ROUNDS = 3
POSE_POINTS = 6000
#: Points of all frames together in the zero pose.
SHAPE_POINTS = 60_000
#: The best of fit 0.003, 0.01, 0.03, 0.1 and sigma 20, 50 mm on seeds 8001 and 8002 (three sequences of 12
#: frames, normal and loose clothes), which no table reports.
FIT, SIGMA_M = 0.03, 0.02


@dataclass(frozen=True)
class Parametric:
    """betas (B) of the person and a state a frame, by frame number."""

    betas: Float[np.ndarray, "b"]
    states: dict[int, BodyState]


def weights_of(fit: float = FIT, sigma_m: float = SIGMA_M, gate: bool = True) -> StageWeights:
    """The one-sided data term: all cloth, outside of the body at full weight, near it at `fit` of that."""
    return StageWeights(cloth=True, sigma_m=sigma_m, fit=fit, gate=gate)


def fit_parameters(
    fitter: Fitter,
    finder: PoseFinder,
    scans: Mapping[int, Scan],
    alignments: Sequence[Alignment],
    settings: FitSettings,
    fit: float = FIT,
    sigma_m: float = SIGMA_M,
) -> Parametric:
    """Poses and one shape for all frames whose alignment did not fail."""
    good = [a for a in alignments if a.status != "failed"]
    betas = np.median([a.state.betas for a in good], axis=0)
    betas[settings.pose_betas :] = 0.0  # the smooth ones follow folds of cloth
    poses = {a.frame_id: (a.state.pose, a.state.translation) for a in good}
    points = {k: as_scan_points(scans[k]).thinned(POSE_POINTS) for k in poses}
    prior = finder.prior
    states: dict[int, BodyState] = {}
    for round_idx in range(ROUNDS):
        for k, (pose, translation) in poses.items():
            objective = Objective(
                fitter,
                _all_cloth(points[k]),
                weights_of(fit, sigma_m),
                Unknowns(template=False, betas=False),
                prior.mean,
                prior.precision,
            )
            start = BodyState(fitter.shaped(betas), pose, translation, betas)
            states[k] = minimise(objective, start, settings.max_iterations, settings.relative_drop).state
            poses[k] = states[k].pose, states[k].translation
        if round_idx == ROUNDS - 1:
            break
        unposed = [in_zero_pose(fitter, states[k], points[k]) for k in states]
        betas = _betas_of(fitter, _union(unposed), betas, settings, fit, sigma_m)
    return Parametric(betas, states)


def in_zero_pose(fitter: Fitter, state: BodyState, scan: ScanPoints) -> ScanPoints:
    """Points of a posed scan (m), carried to the zero pose with the surface that they are nearest to."""
    body = fitter.body(state)
    closest = fitter.surface.closest(body.vertices, scan.points)
    corners = fitter.model.faces[closest.triangle_idx]
    turn = np.einsum("nc,ncij->nij", closest.barycentric, body.rotations[corners])
    foot = np.einsum("nc,nci->ni", closest.barycentric, state.template[corners])
    back = np.linalg.solve(turn, np.stack([scan.points - closest.points, scan.normals], axis=2))
    normals = back[:, :, 1] / np.maximum(np.linalg.norm(back[:, :, 1], axis=1, keepdims=True), 1e-30)
    return ScanPoints(foot + back[:, :, 0], normals, scan.weight, scan.is_skin)


def _betas_of(
    fitter: Fitter, scan: ScanPoints, betas: np.ndarray, settings: FitSettings, fit: float, sigma_m: float
) -> Float[np.ndarray, "b"]:
    n_joints = len(fitter.model.parents)
    size = 3 * (n_joints - 1)
    objective = Objective(
        fitter,
        _all_cloth(scan),
        weights_of(fit, sigma_m),
        Unknowns(template=False, pose=False, translation=False, n_betas=settings.pose_betas),
        np.zeros(size),
        np.zeros((size, size)),
    )
    start = BodyState(fitter.shaped(betas), np.zeros((n_joints, 3)), np.zeros(3), betas)
    return minimise(objective, start, settings.max_iterations, settings.relative_drop).state.betas


def _union(scans: Sequence[ScanPoints]) -> ScanPoints:
    whole = ScanPoints(
        np.concatenate([s.points for s in scans]),
        np.concatenate([s.normals for s in scans]),
        np.concatenate([s.weight for s in scans]),
        np.concatenate([s.is_skin for s in scans]),
    )
    return whole.drawn(SHAPE_POINTS) if len(whole.points) > SHAPE_POINTS else whole


def _all_cloth(scan: ScanPoints) -> ScanPoints:
    return ScanPoints(scan.points, scan.normals, scan.weight, np.zeros(len(scan.points), dtype=bool))
