"""A 3x4 projection matrix split into intrinsics and pose (RQ), the matrix itself kept exactly.

Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 6.2.4. A projection matrix is known up to
a factor; its size is fixed by making the third row's first three values a unit vector (the third coordinate
is then the depth), its sign by asking for a right-handed camera (a positive determinant). If the subject
then has negative depth, the calibration is mirrored: `capture.world` looks at that once silhouettes are
known.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from jaxtyping import Float

from capture.camera import Camera


def camera_from_projection(name: str, size: tuple[int, int], matrix: Float[np.ndarray, "3 4"]) -> Camera:
    """The right-handed pinhole with this matrix (3 4), world units as in the matrix.

    Raises ValueError for a matrix that is no projection: a value that is not finite, or a singular left 3x3
    block.
    """
    if not np.isfinite(matrix).all():
        raise ValueError("a value is not a finite number")
    axis_length = np.linalg.norm(matrix[2, :3])
    if axis_length == 0:
        raise ValueError("the third row begins with three zeros, so no depth can be read off")
    exact = matrix / axis_length
    determinant = np.linalg.det(exact[:, :3])
    if abs(determinant) < 1e-9 * np.linalg.norm(exact[0, :3]) * np.linalg.norm(exact[1, :3]):
        raise ValueError("the left 3x3 block is singular, so the camera has no position")
    if determinant < 0:
        exact = -exact
    upper, rotation = scipy.linalg.rq(exact[:, :3])
    signs = np.where(np.diag(upper) < 0, -1.0, 1.0)
    intrinsics = upper * signs
    rotation = signs[:, None] * rotation
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = np.linalg.solve(intrinsics, exact[:, 3])
    return Camera(name, size, intrinsics / intrinsics[2, 2], pose, np.zeros(0), exact)
