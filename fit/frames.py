"""The body's upright frame and the recording's world: one rotation between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hull.scan import Scan


def recording_from_body(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The shortest rotation that takes the body's up (y) to the recording's up, as a 4x4 matrix."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    y = np.array([0.0, 1.0, 0.0])
    cosine = float(y @ up)
    out = np.eye(4)
    if cosine < -1.0 + 1e-12:
        out[:3, :3] = np.diag([1.0, -1.0, -1.0])  # upside down: half a turn about x
        return out
    axis = np.cross(y, up)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    out[:3, :3] = np.eye(3) + cross + cross @ cross / (1.0 + cosine)
    return out


def apply(
    transform: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Transform points (..., 3)."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def scan_in_body_frame(scan: Scan, recording_from_body: Float[np.ndarray, "4 4"]) -> Scan:
    """The scan as the fitter sees it: y up."""
    rotation = recording_from_body[:3, :3]
    return replace(scan, points=scan.points @ rotation, normals=scan.normals @ rotation)
