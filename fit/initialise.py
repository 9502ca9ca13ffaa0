"""The first pose, found with no help: from the hull alone, or from triangulated keypoints.

Starting poses face eight directions; the best are kept, refined, and their arms tried anew in other configurations, since
a lost arm (folded onto the trunk) is nearly the only way to fail. The paper used landmarks for this (section 5.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fit.body.model import BodyModel
from fit.body.pose_prior import PosePrior
from fit.coarse import CoarseBody, CoarsePose, CoarsePrior, CoarseScan, Targets, refine, score

N_HEADINGS = 8
KEPT = 3
ARM_SEEDS = 8
#: SMPL joint numbers from collar to wrist.
ARMS = ((13, 16, 18, 20), (14, 17, 19, 21))
COARSE_TO_FINE_M = (0.3, 0.15, 0.08, 0.05)
#: A score this much worse than the best frame's means that the previous pose did not carry over.
LOST = 1.10


@dataclass(frozen=True)
class PoseFinder:
    """Everything that finding a pose needs, made once for a model."""

    body: CoarseBody
    prior: CoarsePrior
    arm_seeds: Float[np.ndarray, "s j 3"]
    n_model_betas: int

    @staticmethod
    def of(model: BodyModel, prior: PosePrior, seed: int = 0) -> PoseFinder:
        """Build the coarse body and draw the arm configurations from the pose prior."""
        precision = np.linalg.inv(prior.covariance)
        samples = prior.sample(ARM_SEEDS, seed=seed)
        n_joints = len(model.parents)
        seeds = np.zeros((ARM_SEEDS, n_joints, 3))
        seeds[:, 1:] = np.asarray(samples).reshape(ARM_SEEDS, n_joints - 1, 3)
        return PoseFinder(
            CoarseBody.of(model), CoarsePrior(prior.mean, precision), seeds, model.shape_directions.shape[2]
        )

    def mean_pose(self) -> Float[np.ndarray, "j 3"]:
        """The prior's mean with an upright root."""
        return np.vstack([np.zeros(3), self.prior.mean.reshape(-1, 3)])

    def facing(self, scan: CoarseScan, heading_rad: float, betas: np.ndarray) -> CoarsePose:
        """The mean pose turned about the vertical, its centre on the scan's."""
        pose = self.mean_pose()
        pose[0] = [0.0, heading_rad, 0.0]
        at = CoarsePose(pose, np.zeros(3), betas)
        points = self.body.forward(at).points[: self.body.n_surface]
        low, high = points.min(0), points.max(0)
        scan_low, scan_high = scan.points.min(0), scan.points.max(0)
        shift = 0.5 * (scan_low + scan_high) - 0.5 * (low + high)
        # Feet on the scan's lowest point, horizontally on its centroid: raised arms must not lift the body.
        centroid = scan.points.mean(0) - points.mean(0)
        return CoarsePose(pose, np.array([centroid[0], 0.5 * (shift[1] + scan_low[1] - low[1]), centroid[2]]), betas)

    def from_hull(self, scan: CoarseScan, betas: np.ndarray | None = None) -> list[CoarsePose]:
        """Hypotheses from the hull alone, best first."""
        betas = np.zeros(self.n_model_betas) if betas is None else betas
        tried = []
        for k in range(N_HEADINGS):
            start = self.facing(scan, 2.0 * np.pi * k / N_HEADINGS, betas)
            tried.append(refine(self.body, scan, self.prior, start, COARSE_TO_FINE_M[:2], iterations=5))
        tried = sorted(tried, key=lambda at: at.score)[:KEPT]
        tried = [refine(self.body, scan, self.prior, at, COARSE_TO_FINE_M[2:]) for at in tried]
        tried = sorted(tried, key=lambda at: at.score)
        return sorted([self.reseed_arms(scan, at) for at in tried[:2]] + tried[2:], key=lambda at: at.score)

    def reseed_arms(self, scan: CoarseScan, at: CoarsePose) -> CoarsePose:
        """Try other arm configurations, one side at a time; keep what scores best."""
        for arm in ARMS:
            best = at
            for seed in self.arm_seeds:
                pose = at.pose.copy()
                pose[list(arm)] = seed[list(arm)]
                start = CoarsePose(pose, at.translation, at.betas)
                trial = refine(self.body, scan, self.prior, start, COARSE_TO_FINE_M[2:], iterations=4)
                if trial.score < best.score:
                    best = trial
            at = best
        return at

    def from_previous(self, scan: CoarseScan, previous: CoarsePose, previous_centroid: np.ndarray) -> CoarsePose:
        """The previous frame's pose, moved by the shift of the centroid and refined."""
        shift = scan.points.mean(0) - previous_centroid
        start = CoarsePose(previous.pose, previous.translation + shift, previous.betas)
        return refine(self.body, scan, self.prior, start, COARSE_TO_FINE_M[1:])

    def from_keypoints(
        self, scan: CoarseScan, keypoints: Float[np.ndarray, "25 4"], betas: np.ndarray | None = None
    ) -> CoarsePose | None:
        """The pose that reaches triangulated BODY_25 keypoints (x y z confidence; NaN where unseen) inside the hull.

        None when fewer than eight keypoints, or not both sides of the body, were seen.
        """
        betas = np.zeros(self.n_model_betas) if betas is None else betas
        seen = np.isfinite(keypoints).all(axis=1) & (keypoints[:, 3] > 0)
        right, left = [2, 3, 4, 9, 10, 11], [5, 6, 7, 12, 13, 14]
        if seen.sum() < 8 or not seen[right].any() or not seen[left].any():
            return None
        targets = Targets(
            np.where(seen[:, None], keypoints[:, :3], 0.0), np.where(seen, np.clip(keypoints[:, 3], 0.1, 1.0), 0.0)
        )
        best: CoarsePose | None = None
        for k in range(4):
            start = self.facing(scan, 0.5 * np.pi * k, betas)
            at = refine(self.body, None, self.prior, start, (0.5, 0.2), iterations=10, targets=targets)
            miss = float(np.median(np.linalg.norm(self.landmarks(at)[seen] - keypoints[seen, :3], axis=1)))
            at = CoarsePose(at.pose, at.translation, at.betas, miss)
            if best is None or at.score < best.score:
                best = at
        assert best is not None
        return refine(self.body, scan, self.prior, best, COARSE_TO_FINE_M[1:], targets=targets)

    def landmarks(self, at: CoarsePose) -> Float[np.ndarray, "25 3"]:
        """BODY_25 points of a pose."""
        return self.body.forward(at).points[self.body.n_surface :]

    def score(self, scan: CoarseScan, at: CoarsePose) -> float:
        """Mean symmetric distance, m."""
        return score(self.body, scan, at)


def unwrap_root(pose: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3"]:
    """The same pose with every rotation vector at most pi long."""
    return Rotation.from_rotvec(pose).as_rotvec()
