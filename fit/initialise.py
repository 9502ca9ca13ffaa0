"""The first pose, found with no help: from the hull alone, or from triangulated keypoints.

Starting poses stand or sit and face eight directions; the best that differ are kept, refined, and their arms
and legs tried anew in other configurations, since a lost limb (folded onto the trunk) is nearly the only way
to fail. The paper used landmarks for this (section 5.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fit.body.model import BodyModel
from fit.coarse import CoarseBody, CoarsePose, CoarsePrior, CoarseScan, Targets, left_out, refine, score
from fit.limb_seeds import ARMS, LEGS, arm_configurations, leg_configurations, stances

if TYPE_CHECKING:
    from fit.body.pose_prior import PosePrior

N_HEADINGS = 8
KEPT = 3
#: The search among many starts is done with so many vertices, the rest with all of the coarse body's.
QUICK_VERTICES = 350
#: (sigma m, iterations, how many of the best go on) of the search.
SEARCH = ((0.3, 6, 8), (0.15, 6, 4), (0.08, 6, 4), (0.05, 6, 4))
#: Configurations refined a limb, out of all that limb_seeds.py lists.
REFINED_ARMS, REFINED_LEGS = 6, 4
#: Hypotheses whose joints are this near on average are one.
SAME_M = 0.03
#: A larger share of the scan far from the body means that a limb is not where it should be.
LEFT_OUT = 0.01
COARSE_TO_FINE_M = (0.3, 0.15, 0.08, 0.05)
#: Facing ways this far apart, rad, are different hypotheses.
OTHER_HEADING = 1.0


@dataclass(frozen=True)
class PoseFinder:
    """Everything that finding a pose needs, made once for a model."""

    body: CoarseBody
    prior: CoarsePrior
    quick: CoarseBody
    arm_seeds: Float[np.ndarray, "2 s 4 3"]
    leg_seeds: Float[np.ndarray, "2 l 3 3"]
    n_model_betas: int

    @staticmethod
    def of(model: BodyModel, prior: PosePrior) -> PoseFinder:
        """Build the coarse body; prior: over all joints but the root."""
        return PoseFinder(
            CoarseBody.of(model),
            CoarsePrior(prior.mean, np.linalg.inv(prior.covariance)),
            CoarseBody.of(model, QUICK_VERTICES),
            arm_configurations(),
            leg_configurations(),
            model.shape_directions.shape[2],
        )

    def mean_pose(self) -> Float[np.ndarray, "j 3"]:
        """The prior's mean with an upright root."""
        return np.vstack([np.zeros(3), self.prior.mean.reshape(-1, 3)])

    def facing(
        self,
        scan: CoarseScan,
        heading_rad: float,
        betas: np.ndarray,
        stance: Float[np.ndarray, "j 3"] | None = None,
    ) -> CoarsePose:
        """A stance (the mean pose unless given) turned about the vertical, its centre on the scan's."""
        pose = self.mean_pose() if stance is None else stance.copy()
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

    def search(self, scan: CoarseScan, betas: np.ndarray | None = None) -> list[CoarsePose]:
        """Hypotheses from the hull alone, best first, limbs as they fell. betas: of the same person in
        another frame, if known."""
        stands, low = stances(self.mean_pose())
        none = np.zeros(self.n_model_betas)
        bodies = [(stands, none), (stands, self.standing_betas(scan)), (low, none)]
        if betas is not None:
            bodies = [(stands, betas), (low, betas)]
        headings = 2.0 * np.pi * np.arange(N_HEADINGS) / N_HEADINGS
        tried = [self.facing(scan, heading, b, stance) for heading in headings for stance, b in bodies]
        for sigma, iterations, kept in SEARCH:
            tried = [refine(self.quick, scan, self.prior, at, (sigma,), iterations) for at in tried]
            tried = self._different(sorted(tried, key=lambda at: at.score))[:kept]
        return tried

    def _different(self, hypotheses: list[CoarsePose]) -> list[CoarsePose]:
        """Those that no earlier one is the same as: starts that ran into one pose are worth one place."""
        kept: list[CoarsePose] = []
        joints: list[np.ndarray] = []
        for at in hypotheses:
            own = self.quick.forward(at).origin
            if all(np.linalg.norm(own - other, axis=1).mean() > SAME_M for other in joints):
                kept.append(at)
                joints.append(own)
        return kept

    def from_hull(
        self,
        scan: CoarseScan,
        betas: np.ndarray | None = None,
        hypotheses: Sequence[CoarsePose] | None = None,
    ) -> list[CoarsePose]:
        """Hypotheses from the hull alone, best first, every limb tried elsewhere. hypotheses: of `search`,
        where it was done already."""
        tried = list(hypotheses) if hypotheses else self.search(scan, betas)
        best = tried[0]
        # The best of those that face another way has its limbs tried too: it might be the true one with an
        # arm lost.
        others = [at for at in tried[1:] if heading_difference(at, best) > OTHER_HEADING]
        reseeded = [self.reseed(scan, at) for at in [best, *others[:1]]]
        fine = [refine(self.body, scan, self.prior, at, COARSE_TO_FINE_M[2:], 4) for at in reseeded]
        return sorted(fine, key=lambda at: at.score)

    def reseed(self, scan: CoarseScan, at: CoarsePose) -> CoarsePose:
        """Try other configurations of arms and legs, one limb at a time; keep what scores best.

        Once more and more widely where a part of the scan is still far from all of the body: a limb may have
        stood in another's place.
        """
        for sigmas_m in (COARSE_TO_FINE_M[2:], COARSE_TO_FINE_M[1:]):
            for limbs, seeds, refined in (
                (ARMS, self.arm_seeds, REFINED_ARMS),
                (LEGS, self.leg_seeds, REFINED_LEGS),
            ):
                for limb, own_seeds in zip(limbs, seeds, strict=True):
                    at = self._reseed_limb(scan, at, limb, own_seeds, refined, sigmas_m)
            if left_out(self.quick, scan, at) < LEFT_OUT:
                break
        return at

    def _reseed_limb(
        self,
        scan: CoarseScan,
        at: CoarsePose,
        limb: tuple[int, ...],
        seeds: Float[np.ndarray, "s k 3"],
        refined: int,
        sigmas_m: tuple[float, ...],
    ) -> CoarsePose:
        trials = []
        for seed in seeds:
            pose = at.pose.copy()
            pose[list(limb)] = seed
            trial = CoarsePose(pose, at.translation, at.betas)
            trials.append(replace(trial, score=score(self.quick, scan, trial)))
        best = at
        for start in sorted(trials, key=lambda trial: trial.score)[:refined]:
            trial = refine(self.quick, scan, self.prior, start, sigmas_m, iterations=4)
            if trial.score < best.score:
                best = trial
        return best

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


def heading_difference(a: CoarsePose, b: CoarsePose) -> float:
    """Angle between the directions that two bodies face, rad."""
    front = [Rotation.from_rotvec(at.pose[0]).apply([0.0, 0.0, 1.0]) for at in (a, b)]
    return float(np.arccos(np.clip(front[0] @ front[1], -1.0, 1.0)))


def unwrap_root(pose: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3"]:
    """The same pose with every rotation vector at most pi long."""
    return Rotation.from_rotvec(pose).as_rotvec()
