"""What the skinning alone leaves: one free-form template a person, shared by all frames, and a pose a frame.

The template may take any shape (offsets of every vertex on top of the shape coefficients), so what remains is
what no rest shape can repair: how the body bends. Joints stay where the coefficients put them. Least squares
from the true vertices to the model's surface, in turns: the poses with the template held, then the template
with the poses held.

One frame says nothing: a template that is free meets any single pose exactly. Even several frames of one
motion are met too well, so the number to believe is the one on frames that the template was not fitted to
(`on_unseen_frames`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_matrix, csr_matrix, diags, eye, kron
from scipy.sparse.linalg import cg

from fit.body.model import BodyModel
from fit.body.pose_prior import PosePrior
from fit.body.skinning import SkinningArrays, joints_from_betas, shape_template, skin_with_jacobian
from fit.closest import closest_points

ROUNDS = 5  # not quite the end: three more take another 0.1 mm off the mill's 1.0
POSE_STEPS = 2  # Gauss-Newton steps in each round
SIGMA_M = 0.004
POSE_WEIGHT = 2e-4  # ten times less than with shape alone: the pose is well seen
SMOOTHNESS = 2e-3
"""Weight of an offset's squared difference from its neighbours' mean, against a squared distance: a bump of 5
mm on one vertex costs as much as 0.2 mm of distance there. Only what no true vertex says is decided by it."""
TETHER = 1e-5  # of the offsets themselves, so that the system has one solution
SIDEWAYS = 0.02
"""Weight of sliding along the surface, against leaving it: keeps vertices from drifting."""
UNSCORED_SHARE = 0.1


@dataclass(frozen=True)
class FreeForm:
    """template (V 3) in the rest pose; joints (J 3); poses (T J 3) and translations (T 3), body's frame."""

    template: Float[np.ndarray, "v 3"]
    joints: Float[np.ndarray, "j 3"]
    poses: Float[np.ndarray, "t j 3"]
    translations: Float[np.ndarray, "t 3"]


@dataclass(frozen=True)
class Points:
    """True skin: points (T N 3) m in the body's frame, the same N of every frame; weight (N), mean 1."""

    points: Float[np.ndarray, "t n 3"]
    weight: Float[np.ndarray, "n"]

    @staticmethod
    def of(
        frames: Float[np.ndarray, "t v 3"], outer: Bool[np.ndarray, "v"], scored: Bool[np.ndarray, "v"]
    ) -> Points:
        """All vertices on the outside; those that are not scored count little."""
        weight = np.where(scored[outer], 1.0, UNSCORED_SHARE)
        return Points(frames[:, outer], weight / weight.mean())

    def only(self, frame_idx: Int[np.ndarray, "k"]) -> Points:
        """Some of the frames."""
        return replace(self, points=self.points[frame_idx])


def fit_freeform(
    model: BodyModel,
    true: Points,
    betas: Float[np.ndarray, "b"],
    poses: Float[np.ndarray, "t j 3"],
    translations: Float[np.ndarray, "t 3"],
    *,
    template: Float[np.ndarray, "v 3"] | None = None,
) -> FreeForm:
    """The template and the poses nearest to the true frames, from a fit of shape and pose.

    With a `template` given it is held, and only the poses are sought.
    """
    arrays = SkinningArrays.of(model)
    joints = np.asarray(joints_from_betas(arrays, betas))
    start = np.asarray(shape_template(arrays, betas))
    arrays = SkinningArrays.of(model.with_betas(1))  # the Jacobian of the betas is not asked for
    held = template is not None
    current = start if template is None else template
    poses, translations = poses.copy(), translations.copy()
    stiffness = _stiffness(model)
    for _ in range(2 if held else ROUNDS):
        rows, hits = [], []
        for k in range(len(poses)):
            for _ in range(POSE_STEPS):
                poses[k], translations[k] = _posed_nearer(
                    model, arrays, current, joints, poses[k], translations[k], true.points[k], true.weight
                )
            if not held:
                matrix, gap = _by_template(
                    model, arrays, current, joints, poses[k], translations[k], true.points[k], true.weight
                )
                rows.append(matrix)
                hits.append(gap)
        if not held:
            normal = sum(m.T @ m for m in rows) / len(poses) + stiffness
            pull = sum(m.T @ g for m, g in zip(rows, hits, strict=True)) / len(poses)
            pull -= stiffness @ (current - start).ravel()
            scale = diags(1.0 / normal.diagonal())
            step, failed = cg(normal, pull, rtol=1e-4, maxiter=600, M=scale)
            assert failed >= 0, "conjugate gradients broke down"
            current = current + step.reshape(-1, 3)
    return FreeForm(current, joints, poses, translations)


def on_unseen_frames(
    model: BodyModel,
    true: Points,
    betas: Float[np.ndarray, "b"],
    poses: Float[np.ndarray, "t j 3"],
    translations: Float[np.ndarray, "t 3"],
) -> tuple[FreeForm, FreeForm] | None:
    """Every second frame with the template fitted to the others, and the reverse; None with one frame.

    First the even frames, whose template is the odd ones', then the odd.
    """
    even, odd = np.arange(0, len(poses), 2), np.arange(1, len(poses), 2)
    if not len(odd):
        return None
    out = []
    for asked, given in ((even, odd), (odd, even)):
        known = fit_freeform(model, true.only(given), betas, poses[given], translations[given])
        out.append(
            fit_freeform(
                model, true.only(asked), betas, poses[asked], translations[asked], template=known.template
            )
        )
    return out[0], out[1]


def _posed_nearer(
    model: BodyModel,
    arrays: SkinningArrays,
    template: np.ndarray,
    joints: np.ndarray,
    pose: np.ndarray,
    translation: np.ndarray,
    points: np.ndarray,
    weight: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step of a frame's pose and translation, the prior's pull included."""
    prior = PosePrior.standard()
    posed, _, jacobian = (
        np.asarray(x) for x in skin_with_jacobian(arrays, template, joints, pose, translation)
    )
    n_pose = pose.size + 3
    found = closest_points(posed, model.faces, points)
    corners = model.faces[found.triangle_idx]
    full = np.zeros((len(points), n_pose))
    for c in range(3):
        along = np.einsum("na,nap->np", found.direction, jacobian[corners[:, c], :, :n_pose])
        full += found.barycentric[:, c, None] * along
    pull = full * (weight / len(points) / SIGMA_M**2)[:, None]
    hessian, gradient = pull.T @ full, pull.T @ found.distance  # distance falls by J x
    precision = POSE_WEIGHT * prior.precision
    hessian[np.diag_indices(n_pose)] += 1e-6
    hessian[3:-3, 3:-3] += precision
    gradient[3:-3] -= precision @ (pose.ravel()[3:] - prior.mean)
    move = cho_solve(cho_factor(hessian), gradient)
    move *= min(1.0, 0.3 / max(np.abs(move[:-3]).max(), 1e-9))
    return pose + move[:-3].reshape(-1, 3), translation + move[-3:]


def _by_template(
    model: BodyModel,
    arrays: SkinningArrays,
    template: np.ndarray,
    joints: np.ndarray,
    pose: np.ndarray,
    translation: np.ndarray,
    points: np.ndarray,
    weight: np.ndarray,
) -> tuple[csr_matrix, np.ndarray]:
    """How the gaps of a frame's points change with the template (rows x 3 V), and the gaps (m), weighted."""
    posed, rotations, _ = (
        np.asarray(x) for x in skin_with_jacobian(arrays, template, joints, pose, translation)
    )
    found = closest_points(posed, model.faces, points)
    corners = model.faces[found.triangle_idx]
    n, v = len(points), model.n_vertices
    root = np.sqrt(weight / n * v)  # so that a vertex has about the same weight whatever the number of points
    spread = coo_matrix(
        (found.barycentric.ravel(), (np.repeat(np.arange(n), 3), corners.ravel())), shape=(n, v)
    ).tocsr()
    blocks = [[diags(rotations[:, a, b]) for b in range(3)] for a in range(3)]
    moved = [sum(kron(block, _unit(b)) for b, block in enumerate(row)) for row in blocks]  # (V, 3 V) an axis
    by_axis = [spread @ m for m in moved]
    along = sum(diags(root * found.direction[:, a]) @ by_axis[a] for a in range(3))
    sideways = np.sqrt(SIDEWAYS) * root
    gap = points - found.points
    across = gap - found.distance[:, None] * found.direction
    rows = [along, *(diags(sideways) @ by_axis[a] for a in range(3))]
    gaps = [root * found.distance, *(sideways * across[:, a] for a in range(3))]
    return csr_matrix(_stacked(rows)), np.concatenate(gaps)


def _unit(axis: int) -> np.ndarray:
    return np.eye(3)[axis : axis + 1]


def _stacked(rows: list[csr_matrix]) -> csr_matrix:
    from scipy.sparse import vstack

    return vstack(rows, format="csr")


def _stiffness(model: BodyModel) -> csr_matrix:
    """Quadratic form (3 V, 3 V) of the offsets: differences from the neighbours' mean, and their size."""
    n = model.n_vertices
    i, j = model.faces.ravel(), np.roll(model.faces, -1, axis=1).ravel()
    edges = coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n, n)).tocsr()
    edges.data[:] = 1.0
    mean = diags(1.0 / np.asarray(edges.sum(1)).ravel()) @ edges
    bend = eye(n) - mean
    return kron(SMOOTHNESS * bend.T @ bend + TETHER * eye(n), eye(3)).tocsr()
