"""Where limbs and trunk may start when a pose is found with no help (initialise.py).

A limb that starts on the wrong side of something stays there: nearest neighbours cannot pull an arm off the
trunk. So limbs are tried in configurations over all that people do, and whole bodies in a few stances. All
from the T-pose, x to the body's left, y up, z to the front; rotation vectors, rad.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

#: SMPL joint numbers from collar to wrist, and from hip to ankle; left, right.
ARMS = ((13, 16, 18, 20), (14, 17, 19, 21))
LEGS = ((1, 4, 7), (2, 5, 8))
_MIRROR = np.array([1.0, -1.0, -1.0])

#: Directions of the left upper arm, with the bends of the elbow tried in each, and the turns of the upper arm
#: about its own length (0: the forearm bends forwards, positive: downwards, negative: upwards).
_ARM_WAYS: tuple[tuple[tuple[float, float, float], tuple[tuple[float, float], ...]], ...] = (
    ((0.15, -1.0, 0.05), ((0.3, 0.0), (1.6, 0.0), (2.2, 0.0))),  # hanging; a hand brought up
    ((1.0, 0.0, 0.0), ((0.3, 0.0), (1.6, 0.0), (1.6, -1.5), (1.6, 1.5))),  # out to the side
    ((0.1, -0.1, 1.0), ((0.3, 0.0), (1.6, 0.0), (1.6, -1.5))),  # to the front
    ((0.25, 1.0, 0.0), ((0.3, 0.0), (1.6, 0.0))),  # up
    ((0.3, 0.7, 0.7), ((0.3, 0.0), (1.6, 0.0))),
    ((0.7, 0.7, 0.0), ((0.3, 0.0), (1.6, 0.0), (2.2, -0.8))),
    ((0.2, -0.7, 0.7), ((0.3, 0.0), (1.6, 0.0), (1.6, 0.8), (2.2, -1.0))),
    ((0.7, -0.7, 0.1), ((0.3, 0.0), (1.6, 0.0), (1.6, 1.3))),  # the last: hands on hips
    ((0.9, 0.4, 0.0), ((2.2, -1.5),)),  # a hand on the head
    ((0.7, -0.5, 0.4), ((2.3, -1.5),)),  # a telephone at the ear
    ((-0.4, -0.2, 1.0), ((0.3, 0.0),)),  # across
    ((0.3, -0.8, -0.5), ((0.3, 0.0), (1.2, 1.2))),  # behind the back
)
#: Left hip (rotation vector) and bend of the knee: straight, stepping ahead and back, raised, on a chair,
#: squatting, kneeling, wide, crossed over.
_LEG_WAYS: tuple[tuple[tuple[float, float, float], float], ...] = (
    ((-0.05, 0.0, 0.08), 0.1),
    ((-0.5, 0.0, 0.05), 0.2),
    ((0.35, 0.0, 0.05), 0.3),
    ((0.3, 0.0, 0.05), 1.1),
    ((0.0, 0.0, 0.05), 1.6),
    ((-0.9, 0.0, 0.05), 1.1),
    ((-1.5, 0.0, 0.05), 0.4),
    ((-1.5, 0.1, 0.15), 1.5),
    ((-1.7, 0.3, 0.4), 2.0),
    ((-0.5, 0.2, 0.6), 0.9),
    ((-0.1, 0.1, 0.5), 0.1),
    ((-0.2, 0.0, -0.2), 0.2),
    ((-1.6, 0.0, -0.3), 1.2),
)


def arm_configurations() -> Float[np.ndarray, "2 s 4 3"]:
    """Rotation vectors of collar, shoulder, elbow, wrist for the left and the right arm, over all that arms
    do."""
    rows = []
    for direction, bends in _ARM_WAYS:
        to = np.asarray(direction) / np.linalg.norm(direction)
        axis = np.cross([1.0, 0.0, 0.0], to)
        length = np.linalg.norm(axis)
        swing = Rotation.from_rotvec(axis / max(length, 1e-9) * np.arctan2(length, to[0]))
        for flexion, turn in bends:
            shoulder = (swing * Rotation.from_rotvec([turn, 0.0, 0.0])).as_rotvec()
            rows.append([np.zeros(3), shoulder, np.array([0.0, -flexion, 0.0]), np.zeros(3)])
    left = np.array(rows)
    return np.stack([left, left * _MIRROR])


def leg_configurations() -> Float[np.ndarray, "2 s 3 3"]:
    """The same of hip, knee and ankle."""
    left = np.array([[hip, (knee, 0.0, 0.0), (0.0, 0.0, 0.0)] for hip, knee in _LEG_WAYS])
    return np.stack([left, left * _MIRROR])


def stances(mean_pose: Float[np.ndarray, "j 3"]) -> tuple[Float[np.ndarray, "j 3"], ...]:
    """Whole bodies to start from, upright and facing z: the mean pose, and sitting or squatting.

    A scan of somebody low is otherwise filled by a standing child with its legs in the ground.
    """
    sits = mean_pose.copy()
    for (hip, knee, ankle), sign in zip(LEGS, (1.0, -1.0), strict=True):
        sits[hip], sits[knee], sits[ankle] = (-1.4, 0.1 * sign, 0.2 * sign), (1.5, 0.0, 0.0), (-0.2, 0.0, 0.0)
    return mean_pose, sits
