"""Bundle adjustment's part for keypoints: one person's joints, seen by several cameras, as unknown points.

A joint in a frame is a point of its own; joints are solved for given the cameras and eliminated from the
cameras' equations (the Schur complement; Triggs et al., Bundle adjustment, 2000). That keeps the unknowns to
the cameras, so that silhouettes can be weighed in the same equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from capture.rig_adjustment import N_POSE, Equations, RigPose, fading

# OpenPose's own noise on a person 1000 px tall is some pixels; less is never believed.
_LEAST_NOISE_PX = 0.3
# A joint whose detections disagree with each other more than this many times the usual does not move cameras.
_WIDTH = 3.0
_POINT_STEPS = 6
# Median length of a residual with two coordinates, in their standard deviations.
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True, eq=False)
class Detections:
    """Where joints were detected, one a row: the point (R,) that it is of, counted without gaps, the camera
    (R,), and the pixel (R 2) of the camera's pinhole. Every point is seen by two cameras at least."""

    point: Int[np.ndarray, " r"]
    camera: Int[np.ndarray, " r"]
    pixels: Float[np.ndarray, "r 2"]

    @staticmethod
    def of_frames(frames: Sequence[Float[np.ndarray, "c j 3"]]) -> Detections:
        """From each frame's chosen person: (C J 3) pixels of the pinhole and a score, 0 where there is
        none."""
        points, cameras, pixels = [], [], []
        n_points = 0
        for people in frames:
            seen = people[..., 2] > 0
            for joint_idx in np.flatnonzero(seen.sum(axis=0) >= 2):
                those = np.flatnonzero(seen[:, joint_idx])
                cameras.append(those)
                pixels.append(people[those, joint_idx, :2])
                points.append(np.full(len(those), n_points))
                n_points += 1
        if not points:
            return Detections(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
        return Detections(np.concatenate(points), np.concatenate(cameras), np.concatenate(pixels))

    def of_cameras(self, use: np.ndarray) -> Detections:
        """Only what the cameras in use (C,) saw, of points that two of them saw."""
        kept = use[self.camera]
        kept &= np.bincount(self.point[kept], minlength=int(self.point.max(initial=-1)) + 1)[self.point] >= 2
        _, point = np.unique(self.point[kept], return_inverse=True)
        return Detections(point.astype(int), self.camera[kept], self.pixels[kept])

    @property
    def n_points(self) -> int:
        return int(self.point.max(initial=-1)) + 1


class KeypointTerm:
    """Reprojection of joints: what cameras contradict one another by, in pixels."""

    def __init__(self, detections: Detections) -> None:
        self._seen = detections

    def residuals(self, pose: RigPose) -> tuple[Float[np.ndarray, " r"], Int[np.ndarray, "r 2"]]:
        """Lengths (R,) px from each detection to the joint's projection, and its camera, twice (R 2)."""
        residuals, _, _ = _projected(pose, self._seen, self._points(pose))
        return np.linalg.norm(residuals, axis=1), np.repeat(self._seen.camera[:, None], 2, axis=1)

    def equations(self, pose: RigPose, scale_px: float, n_unknowns: int) -> Equations:
        """Normal equations of a step (see `capture.rig_adjustment`), joints eliminated."""
        seen, n_cameras = self._seen, len(pose.centres)
        n_columns = n_cameras * n_unknowns
        if not seen.n_points:
            return Equations(np.zeros((n_columns, n_columns)), np.zeros(n_columns))
        residuals, by_point, in_camera = _projected(pose, seen, self._points(pose))
        by_camera = _by_camera(pose, seen, by_point, in_camera, n_unknowns)
        length = np.linalg.norm(residuals, axis=1)
        noise = max(float(np.median(length)) / _RAYLEIGH_MEDIAN, _LEAST_NOISE_PX)
        weight = fading(length, scale_px) / noise**2
        own = np.zeros((n_cameras, n_unknowns, n_cameras, n_unknowns))
        right = np.zeros((n_cameras, n_unknowns))
        weighted = weight[:, None, None] * by_camera
        squares = np.einsum("rai,raj->rij", by_camera, weighted)
        for camera_idx in range(n_cameras):
            rows = seen.camera == camera_idx
            own[camera_idx, :, camera_idx] = squares[rows].sum(axis=0)
            right[camera_idx] = -np.einsum("rai,ra->i", weighted[rows], residuals[rows])
        of_point, pull = _point_equations(seen, residuals, by_point, weight)
        across = np.zeros((seen.n_points, n_cameras, n_unknowns, 3))
        # A camera sees a joint once: no two rows go to one place.
        across[seen.point, seen.camera] = np.einsum("rai,raj->rij", weighted, by_point)
        flat = across.reshape(seen.n_points, n_columns, 3)
        eliminated = np.einsum("pui,pij->puj", flat, np.linalg.inv(of_point))
        through = np.tensordot(eliminated, flat, axes=([0, 2], [0, 2]))
        return Equations(
            own.reshape(n_columns, n_columns) - through,
            right.ravel() - np.einsum("pui,pi->u", eliminated, pull),
        )

    def _points(self, pose: RigPose) -> Float[np.ndarray, "p 3"]:
        """The joints (P 3), world: where their rays meet, then robustly by reprojection."""
        seen = self._seen
        if not seen.n_points:
            return np.zeros((0, 3))
        points = _meeting_points(pose, seen)
        for _ in range(_POINT_STEPS):
            residuals, by_point, _ = _projected(pose, seen, points)
            length = np.linalg.norm(residuals, axis=1)
            weight = fading(length, max(_WIDTH * float(np.median(length)), 1.0))
            matrix, right = _point_equations(seen, residuals, by_point, weight)
            step = np.linalg.solve(matrix, right[..., None])[..., 0]
            # A person's joints do not jump by metres: rays that hardly meet would send them anywhere.
            points = points + np.clip(step, -0.3, 0.3)
        return points


def _meeting_points(pose: RigPose, seen: Detections) -> Float[np.ndarray, "p 3"]:
    homogeneous = np.column_stack([seen.pixels, np.ones(len(seen.pixels))])
    rays = np.einsum("rij,rj->ri", np.linalg.inv(pose.intrinsics)[seen.camera], homogeneous)
    rays = np.einsum("rij,ri->rj", pose.rotations[seen.camera], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    matrix = np.tile(1e-6 * np.eye(3), (seen.n_points, 1, 1))
    right = np.tile(1e-6 * pose.centres.mean(axis=0), (seen.n_points, 1))
    np.add.at(matrix, seen.point, across)
    np.add.at(right, seen.point, np.einsum("rij,rj->ri", across, pose.centres[seen.camera]))
    return np.linalg.solve(matrix, right[..., None])[..., 0]


def _point_equations(
    seen: Detections,
    residuals: Float[np.ndarray, "r 2"],
    by_point: Float[np.ndarray, "r 2 3"],
    weight: Float[np.ndarray, " r"],
) -> tuple[Float[np.ndarray, "p 3 3"], Float[np.ndarray, "p 3"]]:
    weighted = weight[:, None, None] * by_point
    # So weak that it only keeps the matrix of a joint without weight from being singular.
    matrix = np.tile(1e-6 * np.eye(3), (seen.n_points, 1, 1))
    right = np.zeros((seen.n_points, 3))
    np.add.at(matrix, seen.point, np.einsum("rai,raj->rij", weighted, by_point))
    np.add.at(right, seen.point, -np.einsum("rai,ra->ri", weighted, residuals))
    return matrix, right


def _projected(
    pose: RigPose, seen: Detections, points: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, "r 2"], Float[np.ndarray, "r 2 3"], Float[np.ndarray, "r 3"]]:
    """Projection minus detection (R 2) px, its derivative by the joint (R 2 3), and the joint in the
    camera's axes (R 3)."""
    rotation, intrinsics = pose.rotations[seen.camera], pose.intrinsics[seen.camera]
    there = np.einsum("rij,rj->ri", rotation, points[seen.point] - pose.centres[seen.camera])
    # Behind the camera a joint means nothing; it is kept in front of it, far off, and fades out.
    depth = np.maximum(there[:, 2], 0.05)
    plane = np.column_stack([there[:, :2] / depth[:, None], np.ones(len(depth))])
    pixels = np.einsum("rij,rj->ri", intrinsics[:, :2], plane)
    by_there = np.zeros((len(depth), 2, 3))
    by_there[:, :, :2] = intrinsics[:, :2, :2] / depth[:, None, None]
    by_there[:, :, 2] = -np.einsum("raj,rj->ra", by_there[:, :, :2], plane[:, :2])
    return pixels - seen.pixels, np.einsum("raj,rjk->rak", by_there, rotation), there


def _by_camera(
    pose: RigPose,
    seen: Detections,
    by_point: Float[np.ndarray, "r 2 3"],
    there: Float[np.ndarray, "r 3"],
    n_unknowns: int,
) -> Float[np.ndarray, "r 2 p"]:
    """Derivatives (R 2 P) of projections by their camera's step."""
    from_centre = np.einsum("rij,ri->rj", pose.rotations[seen.camera], there)
    rows = np.zeros((len(there), 2, n_unknowns))
    # The camera turned by w sees the joint as if it had turned by -w about its centre.
    rows[:, :, :3] = -np.cross(from_centre[:, None], by_point)
    rows[:, :, 3:N_POSE] = -by_point
    if n_unknowns > N_POSE:
        plane = there[:, :2] / np.maximum(there[:, 2:], 0.05)
        rows[:, :, N_POSE] = np.einsum("rij,rj->ri", pose.intrinsics[seen.camera][:, :2, :2], plane)
    return rows
