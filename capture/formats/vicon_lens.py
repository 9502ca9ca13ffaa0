"""Vicon's lens and OpenCV's run in opposite directions: one takes seen pixels to ideal ones, the other ideal
to seen. Each is fitted to the other over the whole picture, and the error of the fit is measured.

Vicon: ideal = c + (1 + k1 r^2 + k2 r^4 + k3 r^6)(seen - c), r in pixels from the centre c. OpenCV: Brown's
model with a denominator (k1 to k6) and tangential terms (p1 p2), on the plane z = 1.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy.optimize
from jaxtyping import Float

from capture.camera import Camera

_N_SIDE = 33


def opencv_from_vicon(
    size: tuple[int, int],
    intrinsics: Float[np.ndarray, "3 3"],
    centre: Float[np.ndarray, "2"],
    radial: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "8"], float]:
    """OpenCV's eight values for a Vicon lens, and the largest error in the picture (px).

    `size` (width, height) px, `centre` px, `radial` 1/px^2, 1/px^4, 1/px^6.
    """
    seen = _grid(size)
    ideal = _vicon_ideal(seen, centre, radial)
    plane = _plane(intrinsics, ideal)
    wanted = _plane(intrinsics, seen)
    focal = float(intrinsics[0, 0])

    def misfit(lens: np.ndarray) -> np.ndarray:
        bent = cv2.projectPoints(
            np.column_stack([plane, np.ones(len(plane))]), np.zeros(3), np.zeros(3), np.eye(3), lens
        )[0]
        return (focal * (bent.reshape(-1, 2) - wanted)).ravel()

    # Radii of about one: k1 to k6 are then of one size.
    found = scipy.optimize.least_squares(
        misfit, np.zeros(8), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    if np.abs(centre - intrinsics[:2, 2]).max() < 1e-9:
        found.x[2:4] = 0  # a lens about the principal point has no tangential part
    return found.x, float(np.abs(misfit(found.x)).max())


def vicon_from_opencv(camera: Camera) -> tuple[Float[np.ndarray, "3"], float]:
    """Vicon's three terms about the principal point for a camera's lens, and the largest error (px)."""
    if not camera.distortion.any():
        return np.zeros(3), 0.0
    seen = _grid(camera.size)
    ideal = camera.undistort(seen)
    centre = camera.intrinsics[:2, 2]
    away = seen - centre
    # A least-squares problem that is linear in k1, k2, k3; radii as shares of the largest keep it well posed.
    radius2 = (away**2).sum(axis=1)
    largest2 = radius2.max()
    powers = (radius2 / largest2)[:, None] ** np.arange(1, 4)
    columns = (away[:, :, None] * powers[:, None, :]).reshape(-1, 3)
    scaled = np.linalg.lstsq(columns, (ideal - seen).ravel())[0]
    radial = scaled / largest2 ** np.arange(1, 4)
    error = _vicon_ideal(seen, centre, radial) - ideal
    return radial, float(np.abs(error).max())


def _vicon_ideal(
    seen: Float[np.ndarray, "n 2"], centre: Float[np.ndarray, "2"], radial: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 2"]:
    away = seen - centre
    r2 = (away**2).sum(axis=1, keepdims=True)
    return centre + away * (1 + r2 * (radial[0] + r2 * (radial[1] + r2 * radial[2])))


def _plane(
    intrinsics: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    return (pixels - intrinsics[:2, 2]) / np.diag(intrinsics)[:2]


def _grid(size: tuple[int, int]) -> Float[np.ndarray, "n 2"]:
    columns, rows = (np.linspace(-0.5, extent - 0.5, _N_SIDE) for extent in size)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
