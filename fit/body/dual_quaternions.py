"""Dual-quaternion skinning (Kavan et al. 2008): it keeps volume where linear blending loses it."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .skeleton import N_JOINTS


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
