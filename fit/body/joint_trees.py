"""The joint trees of the SMPL family, and bodies with fingers and faces seen as bodies of SMPL's 24 joints.

SMPL has 24 joints; SMPL-H (Romero et al., Embodied Hands, 2017) replaces the two hands by fifteen finger
joints each; SMPL-X (Pavlakos et al., 2019) adds jaw and eyes. The first 22 are the same in all three.
"""

import numpy as np
from jaxtyping import Float, Int

from .skeleton import N_JOINTS, PARENTS

N_BODY_JOINTS = 22  # shared by all three, pelvis to wrists
_HEAD, _LEFT_WRIST, _RIGHT_WRIST = 15, 20, 21
_FINGERS = 5  # index, middle, little, ring, thumb: three joints each


def _hand(wrist: int, first: int) -> tuple[int, ...]:
    """Parents of a hand's fifteen joints, the first of which has the index `first`."""
    return tuple(
        wrist if k == 0 else first + 3 * finger + k - 1 for finger in range(_FINGERS) for k in range(3)
    )


_BODY = PARENTS[:N_BODY_JOINTS]
TREES: dict[str, tuple[int, ...]] = {
    "SMPL": PARENTS,
    "SMPL-H": (*_BODY, *_hand(_LEFT_WRIST, 22), *_hand(_RIGHT_WRIST, 37)),
    "SMPL-X": (*_BODY, _HEAD, _HEAD, _HEAD, *_hand(_LEFT_WRIST, 25), *_hand(_RIGHT_WRIST, 40)),
}
"""Parents of every joint by kind of body, -1 for the root."""
KIND_OF_SIZE = {len(parents): kind for kind, parents in TREES.items()}
FIRST_KNUCKLES = {"SMPL-H": (25, 40), "SMPL-X": (28, 43)}
"""The middle fingers' first joints, left and right: where SMPL's hand joints are put."""


def driven_ancestors(kind: str) -> Int[np.ndarray, "j"]:
    """For every joint of this kind the nearest of the 22 body joints on its way to the root (or itself)."""
    ancestor: list[int] = []
    for joint, parent in enumerate(TREES[kind]):
        ancestor.append(joint if joint < N_BODY_JOINTS else ancestor[parent])
    return np.array(ancestor)


def fold_weights(kind: str, weights: Float[np.ndarray, "v j"]) -> Float[np.ndarray, "v 24"]:
    """Skinning weights for SMPL's joints: a joint at rest moves with its parent, so its weight is the
    parent's. Exact as long as fingers, jaw and eyes keep their rest pose."""
    if kind == "SMPL":
        return weights
    folded = np.zeros((len(weights), N_JOINTS))
    np.add.at(folded.T, driven_ancestors(kind), weights.T)
    return folded


def fold_pose_directions(kind: str, directions: Float[np.ndarray, "v 3 p"]) -> Float[np.ndarray, "v 3 207"]:
    """Correctives of the 21 body joints; those of joints at rest are zero, and SMPL's hands have none."""
    if kind == "SMPL":
        return directions
    n_kept = 9 * (N_BODY_JOINTS - 1)
    folded = np.zeros((*directions.shape[:2], 9 * (N_JOINTS - 1)))
    folded[:, :, :n_kept] = directions[:, :, :n_kept]
    return folded


def fold_regressor(kind: str, regressor: Float[np.ndarray, "j v"]) -> Float[np.ndarray, "24 v"]:
    """The 22 body joints, and the middle fingers' first knuckles for SMPL's hands."""
    if kind == "SMPL":
        return regressor
    return np.concatenate([regressor[:N_BODY_JOINTS], regressor[list(FIRST_KNUCKLES[kind])]])
