"""Pose correctives: what linear skinning lacks against dual quaternions, made linear in the joint rotations.

For every joint, a ridge regression on (R - I) of the difference between dual-quaternion skinning (Kavan et
al. 2008) and linear blend skinning, pulled back to the rest pose: 207 columns in SMPL's layout. Elbows and
knees keep their volume; there is no muscle in it.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from .skeleton import MIRROR, N_JOINTS, axis_angle_to_matrix, blend_linearly, world_from_rest

N_ROTATIONS = 40
ANGLES_RAD = (0.2, 1.6)
RIDGE = 0.05


def _multiply(a: Float[np.ndarray, "... 4"], b: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 4"]:
    """Quaternion product, scalar first."""
    w1, v1, w2, v2 = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = w1 * w2 - (v1 * v2).sum(-1, keepdims=True)
    return np.concatenate([scalar, w1 * v2 + w2 * v1 + np.cross(v1, v2)], -1)


def blend_dual_quaternions(
    vertices: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, "v 24"], bones: Float[np.ndarray, "24 4 4"]
) -> Float[np.ndarray, "v 3"]:
    """Posed vertices by dual-quaternion skinning."""
    xyzw = Rotation.from_matrix(bones[:, :3, :3]).as_quat()
    real = np.concatenate([xyzw[:, 3:], xyzw[:, :3]], 1)
    dual = 0.5 * _multiply(np.concatenate([np.zeros((N_JOINTS, 1)), bones[:, :3, 3]], 1), real)
    # All bones of a vertex on the hemisphere of its strongest one.
    sign = np.where(np.einsum("va,ja->vj", real[weights.argmax(1)], real) < 0, -1.0, 1.0)
    q, d = (weights * sign) @ real, (weights * sign) @ dual
    norm = np.linalg.norm(q, axis=1, keepdims=True)
    q, d = q / norm, d / norm
    conjugate = q * [1, -1, -1, -1]
    points = np.concatenate([np.zeros((len(vertices), 1)), vertices], 1)
    return (_multiply(_multiply(q, points), conjugate) + 2 * _multiply(d, conjugate))[:, 1:]


def fit_pose_correctives(
    vertices: Float[np.ndarray, "v 3"],
    weights: Float[np.ndarray, "v 24"],
    joints: Float[np.ndarray, "24 3"],
    partner: Int[np.ndarray, "v"],
    seed: int = 1,
) -> Float[np.ndarray, "v 3 207"]:
    """Corrective directions of the mean body, left-right symmetric."""
    directions = np.zeros((len(vertices), 3, 9 * (N_JOINTS - 1)))
    rng = np.random.default_rng(seed)
    for j in range(1, N_JOINTS):
        touched = np.flatnonzero((weights[:, j] > 0.002) & (weights[:, j] < 0.998))
        features, lacks = [], []
        for _ in range(N_ROTATIONS):
            axis = rng.standard_normal(3)
            rotations = np.tile(np.eye(3), (N_JOINTS, 1, 1))
            rotations[j] = axis_angle_to_matrix(axis / np.linalg.norm(axis) * rng.uniform(*ANGLES_RAD))
            bones = world_from_rest(rotations, joints)
            linear, blended = blend_linearly(vertices[touched], weights[touched], bones)
            wanted = blend_dual_quaternions(vertices[touched], weights[touched], bones)
            # Near a half turn the blended matrix is almost singular: drop what it would blow up.
            back = np.linalg.pinv(blended, rcond=0.2)
            features.append((rotations[j] - np.eye(3)).ravel())
            lacks.append(np.einsum("vab,vb->va", back, wanted - linear))
        x, y = np.array(features), np.array(lacks).reshape(N_ROTATIONS, -1)
        fitted = np.linalg.solve(x.T @ x + RIDGE * np.eye(9), x.T @ y)
        directions[touched, :, 9 * (j - 1) : 9 * j] = fitted.reshape(9, len(touched), 3).transpose(1, 2, 0)
    return 0.5 * (directions + mirror_correctives(directions, partner))


def mirror_correctives(
    directions: Float[np.ndarray, "v 3 207"], partner: Int[np.ndarray, "v"]
) -> Float[np.ndarray, "v 3 207"]:
    """The correctives seen in the mirror: joints swap sides, and a rotation's xy, xz, yx, zx entries change
    sign.
    """
    flip = np.array([-1.0, 1.0, 1.0])
    per_joint = directions.reshape(len(directions), 3, N_JOINTS - 1, 3, 3)
    swapped = per_joint[partner][:, :, MIRROR[1:] - 1]
    signs = flip[:, None, None, None] * np.outer(flip, flip)[None, None]
    return (swapped * signs[None]).reshape(directions.shape)
