"""What real recordings have and synthetic ones lack: cameras that are not quite where they are said to be,
and outlines that wander.

Both are given in pixels (one standard deviation), so that rigs of different picture sizes can be compared.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.camera import Camera
from capture.rig import Rig

OUTLINE_LENGTH_PX = 6.0
"""Outlines wander in waves of about this length: segmentation errs by patches, not by single pixels."""


def misplaced_rig(rig: Rig, sigma_px: float, seed: int) -> Rig:
    """The rig as an imperfect calibration would give it (pinholes).

    Each camera is turned about its centre so that the picture's middle moves by `sigma_px` (one standard
    deviation, each way) and its rim by as much through the roll. The same seed errs alike at every sigma.
    """
    rng = np.random.default_rng([seed, 11])
    return Rig(tuple(_turned(camera, sigma_px * rng.standard_normal(3)) for camera in rig))


def displaced_rig(rig: Rig, turn_deg: tuple[float, float], shift_m: tuple[float, float], seed: int) -> Rig:
    """The rig as a calibration would give it that is not its own any more (pinholes): each camera turned
    about its centre and its centre shifted, in random directions, by angles and ways drawn evenly from two
    ranges."""
    rng = np.random.default_rng([seed, 12])
    cameras = []
    for camera in rig:
        axis, way = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        pose = np.eye(4)
        turn = cv2.Rodrigues(np.radians(rng.uniform(*turn_deg)) * axis)[0]
        pose[:3, :3] = turn @ camera.camera_from_world[:3, :3]
        pose[:3, 3] = -pose[:3, :3] @ (camera.centre + rng.uniform(*shift_m) * way)
        cameras.append(replace(camera, camera_from_world=pose, projection=None))
    return Rig(tuple(cameras))


def _turned(camera: Camera, error_px: Float[np.ndarray, " 3"]) -> Camera:
    focal_x, focal_y = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    about = np.array([-error_px[1] / focal_y, error_px[0] / focal_x, error_px[2] / (0.5 * min(camera.size))])
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(about)[0]
    return replace(camera, camera_from_world=turn @ camera.camera_from_world, projection=None)


def wandering_outline(
    mask: UInt8[np.ndarray, "h w"], sigma_px: float, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w"]:
    """The silhouette (255 person, 0 background) with its outline moved in and out by about `sigma_px`.

    The outline is where the signed distance to it equals a smooth random field of that standard deviation.
    """
    if sigma_px <= 0 or not mask.any():
        return mask
    height, width = mask.shape
    margin = int(np.ceil(4 * sigma_px)) + 2
    x, y, w, h = cv2.boundingRect(mask)
    rows = slice(max(y - margin, 0), min(y + h + margin, height))
    columns = slice(max(x - margin, 0), min(x + w + margin, width))
    # A person who reaches the picture's border goes on beyond it: no outline is made up there.
    part = cv2.copyMakeBorder(mask[rows, columns], 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    inside = cv2.distanceTransform(part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    outside = cv2.distanceTransform(255 - part, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    noise = cv2.GaussianBlur(
        rng.standard_normal(inside.shape), (0, 0), OUTLINE_LENGTH_PX, borderType=cv2.BORDER_REFLECT
    )
    noise *= sigma_px / noise.std()
    moved = np.zeros_like(mask)
    moved[rows, columns] = np.where(inside - outside + noise > 0, np.uint8(255), np.uint8(0))
    return moved
