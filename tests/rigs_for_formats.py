"""Rigs that formats are tested with: awkward on purpose, and points that every camera sees."""

from dataclasses import replace

import numpy as np

from capture.camera import Camera
from capture.layouts import dome_layout
from capture.rig import Rig

LENS = np.array([-0.21, 0.06, 1.1e-3, -7e-4, 0.012, 0.021, -0.013, 0.004])


def awkward_rig(n_terms: int = 0, n_cameras: int = 4, skew: float = 0.0, seed: int = 0) -> Rig:
    """Unequal focal lengths, principal points off the middle, landscape and portrait, a lens of `n_terms`."""
    rng = np.random.default_rng(seed)
    wide, tall = dome_layout(n_cameras, (1280, 720)), dome_layout(n_cameras, (600, 800))

    def one(camera: Camera) -> Camera:
        matrix = camera.intrinsics + np.array([[0, skew, 7.25], [0, 3.5, -4.125], [0, 0, 0]])
        return replace(camera, intrinsics=matrix, distortion=LENS[:n_terms] * rng.uniform(0.5, 1.5, n_terms))

    return Rig(tuple(one(tall[k] if k % 2 else wide[k]) for k in range(n_cameras)))


def seen_points(rig: Rig, n_points: int = 60, seed: int = 1) -> np.ndarray:
    """(N 3): around the subject, m."""
    return np.random.default_rng(seed).uniform([-0.4, -0.4, 0.1], [0.4, 0.4, 1.9], (n_points, 3))


def worst_px(rig: Rig, other: Rig, metres_per_unit: float = 1.0) -> float:
    """Largest difference of the points' pixels, cameras in order; the other rig in its own unit."""
    points = seen_points(rig)
    pairs = zip(rig, other, strict=True)
    differences = [a.project(points)[0] - b.project(points / metres_per_unit)[0] for a, b in pairs]
    return float(np.abs(differences).max())
