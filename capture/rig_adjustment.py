"""Moving a rig's cameras until what they saw agrees: damped least squares over all cameras at once.

Terms (`hull.tangency`, `capture.keypoint_adjustment`) say how much the cameras contradict one another, and
hand in normal equations; the solver adds a weak prior to the given rig, which also settles what nobody can
see (where the world's origin is, how it is turned, how large it is), and takes robust Gauss-Newton steps.
The scale of the robust loss falls from step to step to what the residuals really spread by (graduated
non-convexity; Black and Anandan, CVIU 1996): a rig that is a degree off has no small residual at first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from capture.rig import Rig

N_POSE = 6
"""Unknowns of a camera's pose: a turn about its own centre (rad, world axes) and a shift of it (m, world)."""


@dataclass(frozen=True, eq=False)
class RigPose:
    """Where a rig's cameras stand while they are being moved. Pinholes, metres.

    intrinsics (C 3 3) px, rotations (C 3 3) camera from world, centres (C 3) world.
    """

    intrinsics: Float[np.ndarray, "c 3 3"]
    rotations: Float[np.ndarray, "c 3 3"]
    centres: Float[np.ndarray, "c 3"]

    @staticmethod
    def of(rig: Rig) -> RigPose:
        """The rig's own pose."""
        return RigPose(
            np.array([camera.intrinsics for camera in rig]).reshape(-1, 3, 3),
            np.array([camera.camera_from_world[:3, :3] for camera in rig]).reshape(-1, 3, 3),
            rig.centres,
        )

    def moved(self, step: Float[np.ndarray, "c p"]) -> RigPose:
        """After a step a camera: turn (rad), shift (m) and, where there are seven numbers, log of the focal
        length's change."""
        turns = Rotation.from_rotvec(step[:, :3]).as_matrix()
        intrinsics = self.intrinsics
        if step.shape[1] > N_POSE:
            intrinsics = intrinsics.copy()
            intrinsics[:, :2, :2] *= np.exp(step[:, N_POSE])[:, None, None]
        return RigPose(
            intrinsics, self.rotations @ np.swapaxes(turns, 1, 2), self.centres + step[:, 3:N_POSE]
        )

    def step_from(self, other: RigPose, n_unknowns: int) -> Float[np.ndarray, "c p"]:
        """The step (C P) that leads from another pose here."""
        turns = np.swapaxes(self.rotations, 1, 2) @ other.rotations
        step = np.column_stack([Rotation.from_matrix(turns).as_rotvec(), self.centres - other.centres])
        if n_unknowns > N_POSE:
            step = np.column_stack([step, np.log(self.intrinsics[:, 0, 0] / other.intrinsics[:, 0, 0])])
        return step

    def in_rig(self, rig: Rig, which: Bool[np.ndarray, " c"] | None = None) -> Rig:
        """The rig with its cameras moved here (those of `which`); lenses, sizes and names stay."""
        cameras = []
        for camera_idx, camera in enumerate(rig):
            if which is not None and not which[camera_idx]:
                cameras.append(camera)
                continue
            pose = np.eye(4)
            # Turned step by step, a matrix drifts from being a rotation by rounding.
            pose[:3, :3] = Rotation.from_matrix(self.rotations[camera_idx]).as_matrix()
            pose[:3, 3] = -pose[:3, :3] @ self.centres[camera_idx]
            cameras.append(
                replace(
                    camera,
                    camera_from_world=pose,
                    intrinsics=self.intrinsics[camera_idx],
                    projection=None,
                )
            )
        return Rig(tuple(cameras))


@dataclass(frozen=True, eq=False)
class Equations:
    """What a term makes of a pose: the matrix (U U) and right side (U,) of its normal equations, weighted by
    one over the residuals' variance."""

    matrix: Float[np.ndarray, "u u"]
    right: Float[np.ndarray, " u"]


@runtime_checkable
class Term(Protocol):
    """A source of contradictions between cameras."""

    def residuals(self, pose: RigPose) -> tuple[Float[np.ndarray, " r"], Int[np.ndarray, "r 2"]]:
        """Residuals (R,) px and the cameras (R 2) they speak of (twice the same where it is one)."""

    def equations(self, pose: RigPose, scale_px: float, n_unknowns: int) -> Equations:
        """Normal equations for a step, with residuals beyond about `scale_px` fading out."""


@dataclass(frozen=True)
class AdjustmentSettings:
    """How far a rig may be off, and how it is adjusted.

    prior_turn_rad, prior_shift_m, prior_focal : how far cameras are from where they are said to be, one
        standard deviation; weak beside what silhouettes say, it holds only what they do not tell.
    least_scale_px : the robust loss never gets narrower.
    shrink : by which the loss gets narrower a step.
    most_steps : of Gauss and Newton.
    """

    prior_turn_rad: float = 0.015
    prior_shift_m: float = 0.02
    prior_focal: float = 0.01
    least_scale_px: float = 1.0
    shrink: float = 0.7
    most_steps: int = 40


# A robust loss is as wide as so many times the residuals' median (for a normal distribution, 2 sigma).
_WIDTH = 3.0
_SETTLED = 2e-6  # rad and m


def fading(residuals_px: Float[np.ndarray, " r"], scale_px: float) -> Float[np.ndarray, " r"]:
    """Weights (R,) of Geman and McClure's loss: 1 for small residuals, a quarter at the scale, falling as
    the fourth power."""
    return 1.0 / (1.0 + (residuals_px / scale_px) ** 2) ** 2


def noise_px(residuals_px: Float[np.ndarray, " r"], least_px: float) -> float:
    """Standard deviation of the residuals' bulk (from their median size)."""
    return max(1.48 * float(np.median(np.abs(residuals_px))), least_px) if residuals_px.size else least_px


def adjusted(
    given: RigPose,
    terms: Sequence[Term],
    free: Bool[np.ndarray, " c"],
    settings: AdjustmentSettings | None = None,
    *,
    focal: bool = False,
    start: RigPose | None = None,
) -> RigPose:
    """The pose in which the terms agree best, near the given one; cameras that are not free stay.

    `focal`: focal lengths too. `start`: where to start, if not from the given pose; the loss then starts as
    narrow as the residuals there allow. Terms whose residuals are all of cameras that stay do nothing.
    """
    settings = settings or AdjustmentSettings()
    n_unknowns = N_POSE + int(focal)
    pose = given if start is None else start
    sigma = np.array([settings.prior_turn_rad] * 3 + [settings.prior_shift_m] * 3 + [settings.prior_focal])
    certainty = np.tile(1.0 / sigma[:n_unknowns] ** 2, len(free))
    unknown = np.repeat(free, n_unknowns)
    scales = [np.inf] * len(terms)
    for _ in range(settings.most_steps):
        matrix = np.diag(certainty)
        right = -certainty * pose.step_from(given, n_unknowns).ravel()
        for k, term in enumerate(terms):
            residuals, _ = term.residuals(pose)
            width = max(
                _WIDTH * float(np.median(np.abs(residuals))) if residuals.size else 0.0,
                settings.least_scale_px,
            )
            scales[k] = max(min(width, scales[k]), settings.shrink * scales[k] if scales[k] < np.inf else 0.0)
            part = term.equations(pose, scales[k], n_unknowns)
            matrix += part.matrix
            right += part.right
        step = np.zeros(len(unknown))
        step[unknown] = np.linalg.solve(matrix[np.ix_(unknown, unknown)], right[unknown])
        pose = pose.moved(step.reshape(-1, n_unknowns))
        if np.abs(step).max(initial=0.0) < _SETTLED:
            break
    return pose
