"""Errors of a result against the true naked body, by the paper's protocol and directly.

Paper (section 6.2): pose the true template so that it fits the result best; then the distance from each true
vertex to the result's surface. The pose is optimised inside the measure, so it scores shape. Direct: the true
body of the same frame against the posed result, which scores pose and shape. Both in millimetres, over outer
vertices of torso, arms, legs and neck, weighted by the area that belongs to each vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from fit.closest import closest_points
from fit.coarse import CoarseBody, CoarsePose
from fit.surface import vertex_areas

FIT_ITERATIONS = 12
#: Vertices that drive the re-posing of the truth: enough for 24 joints, a fraction of the time of all.
FIT_VERTICES = 4000


@dataclass(frozen=True)
class ErrorSummary:
    """rms, mean, bias (positive: the result is too fat), p90, in mm."""

    rms: float
    mean: float
    bias: float
    p90: float


@dataclass(frozen=True)
class Surface:
    """A result mesh: vertices (V 3) m, faces (F 3)."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def summarise(signed_mm: Float[np.ndarray, "n"], weight: Float[np.ndarray, "n"]) -> ErrorSummary:
    """Weighted statistics of signed distances (positive where the result lies outside the truth)."""
    if len(signed_mm) == 0 or weight.sum() <= 0:
        return ErrorSummary(float("nan"), float("nan"), float("nan"), float("nan"))
    weight = weight / weight.sum()
    size = np.abs(signed_mm)
    order = np.argsort(size)
    cumulative = np.cumsum(weight[order])
    p90 = size[order][min(int(np.searchsorted(cumulative, 0.9)), len(size) - 1)]
    return ErrorSummary(
        rms=float(np.sqrt((weight * size**2).sum())),
        mean=float((weight * size).sum()),
        bias=float((weight * signed_mm).sum()),
        p90=float(p90),
    )


def signed_error_mm(truth: Float[np.ndarray, "n 3"], result: Surface) -> Float[np.ndarray, "n"]:
    """Distance of true vertices to the result's surface in mm; positive where the truth lies inside the
    result."""
    return -1e3 * closest_points(result.vertices, result.faces, truth).distance


def average(summaries: list[ErrorSummary]) -> ErrorSummary:
    """Over frames: root mean square of rms, plain means of the others."""
    if not summaries:
        return ErrorSummary(float("nan"), float("nan"), float("nan"), float("nan"))
    return ErrorSummary(
        rms=float(np.sqrt(np.mean([s.rms**2 for s in summaries]))),
        mean=float(np.mean([s.mean for s in summaries])),
        bias=float(np.mean([s.bias for s in summaries])),
        p90=float(np.mean([s.p90 for s in summaries])),
    )


@dataclass(frozen=True)
class Rig:
    """Bones for a mesh that has none of its own: skin weights (V J), joints (J 3) as posed, parents (J)."""

    weights: Float[np.ndarray, "v j"]
    joints: Float[np.ndarray, "j 3"]
    parents: Int[np.ndarray, "j"]


def transfer_rig(
    truth: Float[np.ndarray, "v 3"],
    body: Surface,
    body_weights: Float[np.ndarray, "w j"],
    joints: Float[np.ndarray, "j 3"],
    parents: Int[np.ndarray, "j"],
) -> Rig:
    """Give a true body the bones of a fitted one in the same pose: weights from the closest surface point."""
    closest = closest_points(body.vertices, body.faces, truth)
    corners = body.faces[closest.triangle_idx]
    return Rig(
        np.einsum("nc,ncj->nj", closest.barycentric, body_weights[corners]), joints, np.asarray(parents)
    )


def pose_truth_to(
    truth: Float[np.ndarray, "v 3"],
    truth_faces: Int[np.ndarray, "f 3"],
    scored: Bool[np.ndarray, "v"],
    rig: Rig,
    result: Surface,
) -> Float[np.ndarray, "v 3"]:
    """The true body re-posed so that its scored vertices lie nearest to the result's surface (least squares).

    Starts from the true body of the frame, whose pose is near; turns its joints and moves it, never its
    shape.
    """
    n_joints = len(rig.parents)
    area = vertex_areas(truth, truth_faces) * scored
    chosen = np.flatnonzero(area > 0)
    if len(chosen) > FIT_VERTICES:
        chosen = chosen[np.linspace(0, len(chosen) - 1, FIT_VERTICES).astype(int)]
    descends = np.eye(n_joints)
    for j in range(n_joints - 1, 0, -1):
        descends[rig.parents[j]] += descends[j]
    descends = np.minimum(descends, 1.0)

    def skeleton(which: np.ndarray) -> CoarseBody:
        n = len(which)
        return CoarseBody(
            n_surface=n,
            parents=rig.parents,
            rest=truth[which],
            shape=np.zeros((n, 3, 0)),
            rest_normals=np.zeros((n, 3)),
            weights=rig.weights[which],
            joint_rest=rig.joints,
            joint_shape=np.zeros((n_joints, 3, 0)),
            descends=descends,
        )

    body = skeleton(chosen)
    weight = area[chosen] / area[chosen].sum()
    at = CoarsePose(np.zeros((n_joints, 3)), np.zeros(3), np.zeros(0))
    previous = np.inf
    for _ in range(FIT_ITERATIONS):
        posed = body.forward(at)
        closest = closest_points(result.vertices, result.faces, posed.points)
        energy = float((weight * closest.distance**2).sum())
        if previous - energy < 1e-3 * previous:
            break
        previous = energy
        jacobian = body.jacobian(posed)
        # distance = (v - c) . n: point to plane, with a little point to point for stability
        along = np.einsum("na,nap->np", closest.direction, jacobian)
        gap = posed.points - closest.points
        flat = jacobian.reshape(-1, jacobian.shape[2])
        iso = 0.05 * np.repeat(weight, 3)
        hessian = along.T @ (weight[:, None] * along) + flat.T @ (iso[:, None] * flat)
        rhs = -along.T @ (weight * closest.distance) - flat.T @ (iso * gap.ravel())
        hessian[np.diag_indices_from(hessian)] += 1e-6
        step = cho_solve(cho_factor(hessian), rhs)
        pose = (Rotation.from_rotvec(step[:-3].reshape(-1, 3)) * Rotation.from_rotvec(at.pose)).as_rotvec()
        at = CoarsePose(pose, at.translation + step[-3:], at.betas)
    return skeleton(np.arange(len(truth))).forward(at).points


def inside_share(body: Float[np.ndarray, "v 3"], hull: Surface, tolerance_m: float = 0.001) -> float:
    """Share of the body's vertices that lie outside the hull by more than the tolerance."""
    return float((closest_points(hull.vertices, hull.faces, body).distance > tolerance_m).mean())


#: Points less deep than this inside the body touch it.
TOUCH_M = 0.001


@dataclass(frozen=True)
class Penetration:
    """share of a scan's points inside the body, and the mean and 95th percentile of their depths, mm (0 if
    none)."""

    share: float
    mean_mm: float
    p95_mm: float


def penetration(points: Float[np.ndarray, "n 3"], body: Surface) -> Penetration:
    """How much of a scan, or hull, lies inside the body where no cloth can be, by more than TOUCH_M.

    points (N 3), m: even in area.
    """
    depth = -closest_points(body.vertices, body.faces, points).distance
    inside = depth[depth > TOUCH_M]
    if len(inside) == 0:
        return Penetration(0.0, 0.0, 0.0)
    return Penetration(
        len(inside) / len(points), 1e3 * float(inside.mean()), 1e3 * float(np.percentile(inside, 95))
    )


def mean_penetration(frames: list[Penetration]) -> Penetration:
    """Over frames: the mean share, and depths weighted by it."""
    share = np.array([p.share for p in frames])
    weight = share / max(share.sum(), 1e-12)
    return Penetration(
        float(share.mean()),
        float(weight @ [p.mean_mm for p in frames]),
        float(weight @ [p.p95_mm for p in frames]),
    )
