"""The SMPL skeleton: 24 joints, their parents, and what the left-right mirror does to them.

Reference: Loper et al., SMPL (SIGGRAPH Asia 2015), kinematic tree of the released models.
"""

import numpy as np
from jaxtyping import Float, Int

JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    "left_hand", "right_hand",
)  # fmt: skip
PARENTS: tuple[int, ...] = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21,
)  # fmt: skip
N_JOINTS = len(PARENTS)
JOINT = {name: joint_idx for joint_idx, name in enumerate(JOINT_NAMES)}


def _mirrored(name: str) -> str:
    if name.startswith("left_"):
        return "right_" + name.removeprefix("left_")
    if name.startswith("right_"):
        return "left_" + name.removeprefix("right_")
    return name


MIRROR: Int[np.ndarray, "24"] = np.array([JOINT[_mirrored(name)] for name in JOINT_NAMES])
"""For every joint the index of its partner on the other side (itself on the midline)."""
LEFT_JOINTS: tuple[int, ...] = tuple(j for j, name in enumerate(JOINT_NAMES) if name.startswith("left_"))


def axis_angle_to_matrix(axis_angle: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Rotation matrices of rotation vectors (radians), by Rodrigues' formula."""
    vectors = axis_angle.reshape(-1, 3)
    angle = np.linalg.norm(vectors, axis=1)[:, None, None] + 1e-12  # any unit axis serves a zero angle
    x, y, z = (vectors / angle[:, :, 0]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    rotations = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotations.reshape(*axis_angle.shape, 3)


def world_from_rest(
    rotations: Float[np.ndarray, "j 3 3"],
    joints: Float[np.ndarray, "j 3"],
    parents: tuple[int, ...] = PARENTS,
) -> Float[np.ndarray, "j 4 4"]:
    """Where every bone takes a point of the rest pose (body frame, metres), by forward kinematics.

    `rotations` are relative to the parent bone; the root turns about its own joint. Parents precede children.
    """
    n_joints = len(joints)
    bones = np.tile(np.eye(4), (n_joints, 1, 1))
    for j, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        bones[j] = local if parent < 0 else bones[parent] @ local
    bones[:, :3, 3] -= np.einsum("jab,jb->ja", bones[:, :3, :3], joints)
    return bones


def blend_linearly(
    vertices: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, "v j"], bones: Float[np.ndarray, "j 4 4"]
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3 3"]]:
    """Linear blend skinning in plain numpy (the reference of `skinning.skin`): posed vertices, blended
    matrices.
    """
    blended = np.einsum("vj,jab->vab", weights, bones[:, :3])
    posed = np.einsum("vab,vb->va", blended[:, :, :3], vertices) + blended[:, :, 3]
    return posed, blended[:, :, :3]
