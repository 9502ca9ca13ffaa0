"""The first pose, found with no help: from the hull alone, or from triangulated keypoints.

Starting poses face eight directions; the best are kept, refined, and their arms tried anew in other
configurations, since a lost arm (folded onto the trunk) is nearly the only way to fail. The paper used
landmarks for this (section 5.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fit.body.model import BodyModel
from fit.coarse import CoarseBody, CoarsePose, CoarsePrior, CoarseScan, Targets, refine, score

if TYPE_CHECKING:
    from fit.body.pose_prior import PosePrior

N_HEADINGS = 8
KEPT = 3
#: Arm configurations refined a side, out of all that arm_configurations() lists.
REFINED_ARMS = 6
#: SMPL joint numbers from collar to wrist.
ARMS = ((13, 16, 18, 20), (14, 17, 19, 21))
COARSE_TO_FINE_M = (0.3, 0.15, 0.08, 0.05)
#: Facing ways this far apart, rad, are different hypotheses.
OTHER_HEADING = 1.0
#: A score this much worse than the best frame's means that the previous pose did not carry over.
LOST = 1.10


@dataclass(frozen=True)
class PoseFinder:
    """Everything that finding a pose needs, made once for a model."""

    body: CoarseBody
    prior: CoarsePrior
    arm_seeds: Float[np.ndarray, "2 s 4 3"]
    n_model_betas: int

    @staticmethod
    def of(model: BodyModel, prior: PosePrior) -> PoseFinder:
        """Build the coarse body; prior: over all joints but the root."""
        return PoseFinder(
            CoarseBody.of(model),
            CoarsePrior(prior.mean, np.linalg.inv(prior.covariance)),
            arm_configurations(),
            model.shape_directions.shape[2],
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
        return CoarsePose(
            pose, np.array([centroid[0], 0.5 * (shift[1] + scan_low[1] - low[1]), centroid[2]]), betas
        )

    def standing_betas(self, scan: CoarseScan) -> Float[np.ndarray, "b"]:
        """The first coefficient set so that the body in the mean pose is as high as the scan (within 3
        deviations)."""

        def height(first: float) -> float:
            betas = np.zeros(self.n_model_betas)
            betas[0] = first
            points = self.body.forward(CoarsePose(self.mean_pose(), np.zeros(3), betas)).points
            return float(np.ptp(points[: self.body.n_surface, 1]))

        wanted, slope = float(np.ptp(scan.points[:, 1])), 0.5 * (height(1.0) - height(-1.0))
        betas = np.zeros(self.n_model_betas)
        betas[0] = np.clip((wanted - height(0.0)) / slope, -3.0, 3.0) if abs(slope) > 1e-3 else 0.0
        return betas

    def from_hull(self, scan: CoarseScan, betas: np.ndarray | None = None) -> list[CoarsePose]:
        """Hypotheses from the hull alone, best first. betas: of the same person in another frame, if
        known."""
        starts = [np.zeros(self.n_model_betas), self.standing_betas(scan)] if betas is None else [betas]
        headings = 2.0 * np.pi * np.arange(N_HEADINGS) / N_HEADINGS
        tried = [self.facing(scan, heading, first) for heading in headings for first in starts]
        for sigma, iterations, kept in (
            (0.3, 6, 2 * KEPT),
            (0.15, 6, KEPT),
            (0.08, 6, KEPT),
            (0.05, 6, KEPT),
        ):
            tried = [refine(self.body, scan, self.prior, at, (sigma,), iterations) for at in tried]
            tried = sorted(tried, key=lambda at: at.score)[:kept]
        best = tried[0]
        reseeded = [self.reseed_arms(scan, best)]
        # The best of those that face another way has its arms tried too: it might be the true one with an arm
        # lost.
        others = [at for at in tried[1:] if heading_difference(at, best) > OTHER_HEADING]
        reseeded += [self.reseed_arms(scan, at) for at in others[:1]]
        return sorted(reseeded, key=lambda at: at.score)

    def reseed_arms(self, scan: CoarseScan, at: CoarsePose) -> CoarsePose:
        """Try other arm configurations, one side at a time; keep what scores best."""
        for arm, seeds in zip(ARMS, self.arm_seeds, strict=True):
            trials = []
            for seed in seeds:
                pose = at.pose.copy()
                pose[list(arm)] = seed
                trial = CoarsePose(pose, at.translation, at.betas)
                trials.append(CoarsePose(pose, at.translation, at.betas, self.score(scan, trial)))
            best = at
            for start in sorted(trials, key=lambda trial: trial.score)[:REFINED_ARMS]:
                trial = refine(self.body, scan, self.prior, start, COARSE_TO_FINE_M[2:], iterations=4)
                if trial.score < best.score:
                    best = trial
            at = best
        return at

    def from_previous(
        self, scan: CoarseScan, previous: CoarsePose, previous_centroid: np.ndarray
    ) -> CoarsePose:
        """The previous frame's pose, moved by the shift of the centroid and refined."""
        shift = scan.points.mean(0) - previous_centroid
        start = CoarsePose(previous.pose, previous.translation + shift, previous.betas)
        return refine(self.body, scan, self.prior, start, COARSE_TO_FINE_M[1:])

    def from_keypoints(
        self, scan: CoarseScan, keypoints: Float[np.ndarray, "25 4"], betas: np.ndarray | None = None
    ) -> CoarsePose | None:
        """The pose that reaches triangulated BODY_25 keypoints (x y z confidence; NaN where unseen) inside
        the hull.

        None when fewer than eight keypoints, or not both sides of the body, were seen.
        """
        betas = np.zeros(self.n_model_betas) if betas is None else betas
        seen = np.isfinite(keypoints).all(axis=1) & (keypoints[:, 3] > 0)
        right, left = [2, 3, 4, 9, 10, 11], [5, 6, 7, 12, 13, 14]
        if seen.sum() < 8 or not seen[right].any() or not seen[left].any():
            return None
        targets = Targets(
            np.where(seen[:, None], keypoints[:, :3], 0.0),
            np.where(seen, np.clip(keypoints[:, 3], 0.1, 1.0), 0.0),
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


def arm_configurations() -> Float[np.ndarray, "2 s 4 3"]:
    """Rotation vectors of collar, shoulder, elbow, wrist for the left and the right arm, over all that arms
    do.

    Upper arms point in ten directions around the shoulder, with the elbow nearly straight; in five of them
    also bent. From the T-pose, x to the body's left, y up, z to the front.
    """
    directions = {
        "down": (0.15, -1.0, 0.05), "side": (1.0, 0.0, 0.0), "front": (0.1, -0.1, 1.0),
        "up": (0.25, 1.0, 0.0), "up front": (0.3, 0.7, 0.7), "up side": (0.7, 0.7, 0.0),
        "down front": (0.2, -0.7, 0.7),
        "down side": (0.7, -0.7, 0.1), "across": (-0.4, -0.2, 1.0), "down back": (0.3, -0.8, -0.5),
    }  # fmt: skip
    bent = ("down", "side", "front", "up side", "down front")
    rows = []
    for name, direction in directions.items():
        to = np.asarray(direction) / np.linalg.norm(direction)
        axis = np.cross([1.0, 0.0, 0.0], to)
        length = np.linalg.norm(axis)
        shoulder = axis / max(length, 1e-9) * np.arctan2(length, to[0])
        for flexion in (0.3, 1.6) if name in bent else (0.3,):
            rows.append([np.zeros(3), shoulder, np.array([0.0, -flexion, 0.0]), np.zeros(3)])
    left = np.array(rows)
    return np.stack([left, left * np.array([1.0, -1.0, -1.0])])


def heading_difference(a: CoarsePose, b: CoarsePose) -> float:
    """Angle between the directions that two bodies face, rad."""
    front = [Rotation.from_rotvec(at.pose[0]).apply([0.0, 0.0, 1.0]) for at in (a, b)]
    return float(np.arccos(np.clip(front[0] @ front[1], -1.0, 1.0)))


def unwrap_root(pose: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3"]:
    """The same pose with every rotation vector at most pi long."""
    return Rotation.from_rotvec(pose).as_rotvec()
