"""Silhouettes of two cameras touch the same planes: equations between cameras without any point or board.

Each touching plane (`hull.touching_planes`) gives one equation between two cameras: the two rays and the line
between the centres lie in one plane. Told in pixels, as Sampson's distance. Refining a network of cameras
from silhouettes this way: Sinha and Pollefeys, IJCV 2010.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from capture.rig_adjustment import N_POSE, Equations, RigPose, fading, noise_px
from hull.touching_planes import OutlineFrame, Touches, inner_touches, outer_touches

_LEAST_NOISE_PX = 0.3


class OuterTangency:
    """The outermost touching planes, found anew for every pose: right from any start."""

    def __init__(self, frames: Sequence[OutlineFrame], use: Bool[np.ndarray, " c"]) -> None:
        """`frames`: outlines a frame. `use`: which cameras (C,) take part."""
        self._frames = tuple(frames)
        self._use = use.copy()

    def residuals(self, pose: RigPose) -> tuple[Float[np.ndarray, " r"], Int[np.ndarray, "r 2"]]:
        """Residuals (R,) px, and the pairs of cameras (R 2) they speak of."""
        return _residuals(pose, self._touches(pose))

    def equations(self, pose: RigPose, scale_px: float, n_unknowns: int) -> Equations:
        """Normal equations of a step (see `capture.rig_adjustment`)."""
        return _equations(pose, self._touches(pose), scale_px, n_unknowns)

    def _touches(self, pose: RigPose) -> Touches:
        return Touches.joined([outer_touches(frame, pose, self._use) for frame in self._frames])


class InnerTangency:
    """Touching planes wherever outlines bulge, as they are paired near one pose: many more, from a good
    start."""

    def __init__(
        self, frames: Sequence[OutlineFrame], use: Bool[np.ndarray, " c"], near: RigPose, reach_px: float
    ) -> None:
        """Paired where two cameras' planes are less than `reach_px` apart in the pose `near`."""
        self.touches = Touches.joined([inner_touches(frame, near, use, reach_px) for frame in frames])

    def residuals(self, pose: RigPose) -> tuple[Float[np.ndarray, " r"], Int[np.ndarray, "r 2"]]:
        """Residuals (R,) px, and the pairs of cameras (R 2) they speak of."""
        return _residuals(pose, self.touches)

    def equations(self, pose: RigPose, scale_px: float, n_unknowns: int) -> Equations:
        """Normal equations of a step (see `capture.rig_adjustment`)."""
        return _equations(pose, self.touches, scale_px, n_unknowns)


def _residuals(pose: RigPose, touches: Touches) -> tuple[Float[np.ndarray, " r"], Int[np.ndarray, "r 2"]]:
    return linearised(pose, touches, 0)[0], touches.cameras


def _equations(pose: RigPose, touches: Touches, scale_px: float, n_unknowns: int) -> Equations:
    residuals, rows = linearised(pose, touches, n_unknowns)
    columns = touches.cameras[:, :, None] * n_unknowns + np.arange(n_unknowns)
    starts = np.arange(len(residuals) + 1) * 2 * n_unknowns
    shape = (len(residuals), len(pose.centres) * n_unknowns)
    jacobian = csr_array((rows.ravel(), columns.ravel(), starts), shape=shape)
    weight = fading(residuals, scale_px) / noise_px(residuals, _LEAST_NOISE_PX) ** 2
    weighted = csr_array(((rows * weight[:, None, None]).ravel(), columns.ravel(), starts), shape=shape)
    return Equations((jacobian.T @ weighted).toarray(), -(weighted.T @ residuals))


def linearised(
    pose: RigPose, touches: Touches, n_unknowns: int
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r 2 p"]]:
    """Residuals (R,) px and their derivatives (R 2 P) by the steps of both cameras; P may be 0.

    How a place moves along its outline does not matter where the plane touches, and how the residual's unit
    changes is left out: it multiplies the residual, which is small.
    """
    first, second = touches.cameras.T
    # Rows times these are rays in the world.
    turn = (pose.rotations[first], pose.rotations[second])
    in_camera = touches.rays(pose)
    rays = [np.einsum("rij,ri->rj", turn[side], in_camera[:, side]) for side in (0, 1)]
    baseline = pose.centres[second] - pose.centres[first]
    # The volume spanned by the two rays and the baseline, d0 . (b x d1), is nought where a plane holds all.
    by_ray = (np.cross(baseline, rays[1]), np.cross(rays[0], baseline))
    volume = (rays[0] * by_ray[0]).sum(axis=1)
    square = np.zeros(len(volume))
    for side, cameras in ((0, first), (1, second)):
        focal = pose.intrinsics[cameras][:, [0, 1], [0, 1]]
        square += ((np.einsum("rij,rj->ri", turn[side], by_ray[side])[:, :2] / focal) ** 2).sum(axis=1)
    size = np.sqrt(np.maximum(square, 1e-300))
    rows = np.zeros((len(volume), 2, n_unknowns))
    if n_unknowns:
        # Nothing is gained by a shorter baseline: that part of the derivative would shrink the whole rig.
        by_centre = np.cross(rays[1], rays[0])
        by_centre -= (volume / np.maximum((baseline**2).sum(axis=1), 1e-18))[:, None] * baseline
        for side, sign in ((0, -1.0), (1, 1.0)):
            rows[:, side, :3] = np.cross(rays[side], by_ray[side])
            rows[:, side, 3:N_POSE] = sign * by_centre
            if n_unknowns > N_POSE:
                # A longer lens narrows the ray towards the axis.
                narrowed = in_camera[:, side] * [-1.0, -1.0, 0.0]
                rows[:, side, N_POSE] = (by_ray[side] * np.einsum("rij,ri->rj", turn[side], narrowed)).sum(
                    axis=1
                )
        rows /= size[:, None, None]
    return volume / size, rows
