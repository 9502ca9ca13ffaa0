"""The joint regressor: every joint as a sparse convex combination of vertices (Loper et al., SMPL, section
4.2).
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from .skeleton import JOINT_NAMES, MIRROR

N_CANDIDATES = 240  # per joint, of the nearest vertices
STRIDE = 5  # of them: every fifth is enough, the skin is smooth
SUM_WEIGHT = 30.0  # how hard a row is asked to sum to one, against metres of error
SHRINKAGE = 0.015  # small against the millimetres that are at stake, large enough to spread the weight


def fit_joint_regressor(
    halves: Float[np.ndarray, "n h 3"],
    joints: Float[np.ndarray, "n 24 3"],
    partner: Int[np.ndarray, "v"],
) -> Float[np.ndarray, "24 v"]:
    """Non-negative least squares on drawn people; rows sum to one and are mirror images of one another.

    Midline joints are fitted in the sagittal plane and split between both sides.
    """
    mean, mean_joints = halves.mean(0), joints.mean(0)
    regressor = np.zeros((len(JOINT_NAMES), len(partner)))
    for j, name in enumerate(JOINT_NAMES):
        if name.startswith("right_"):
            continue
        on_midline = MIRROR[j] == j
        nearest = np.argsort(np.linalg.norm(mean - mean_joints[j], axis=1), kind="stable")
        candidates = nearest[: STRIDE * N_CANDIDATES : STRIDE]
        axes = slice(1, 3) if on_midline else slice(0, 3)
        matrix = halves[:, candidates, axes].transpose(0, 2, 1).reshape(-1, N_CANDIDATES)
        matrix = np.vstack([matrix, np.full((1, N_CANDIDATES), SUM_WEIGHT), np.eye(N_CANDIDATES) * SHRINKAGE])
        target = np.concatenate([joints[:, j, axes].ravel(), [SUM_WEIGHT], np.zeros(N_CANDIDATES)])
        share, _ = nnls(matrix, target)
        share /= share.sum()
        if on_midline:
            np.add.at(regressor[j], candidates, share / 2)
            np.add.at(regressor[j], partner[candidates], share / 2)
        else:
            regressor[j, candidates] = share
            regressor[MIRROR[j], partner[candidates]] = share
    return regressor
