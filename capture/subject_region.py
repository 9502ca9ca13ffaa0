"""Where the subject can be: a coarse visual hull of generously widened foregrounds, and its outline in every
camera.

A calibration that is a degree off moves a silhouette by 30 pixels; a thin arm would vanish from an exact
hull. So the foregrounds are widened first, and the result says where to look for the subject, never what its
outline is. What walks behind, or stands on a background plate, is seen by too few cameras or elsewhere, and
falls away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Int, UInt8

from capture.colour_difference import scaled_size
from capture.rig import Rig
from capture.world import closest_point

_VOXEL_M = 0.05
_HALF_WIDTH_M = 1.7
_WIDEN_SHARE = 1 / 64  # of the picture's longer side: about 1 degree of a common lens
_N_VIEWS_NEEDED = 2
_SMALLEST_PART = 30


@dataclass(frozen=True)
class RegionFinder:
    """A voxel grid around the point that the cameras look at, projected once into pictures scaled by `scale`.

    rig : lens included, metres. shape : voxels along x, y, z.
    pixels : one a camera, (voxels 2) whole pixels of the scaled picture; visible : one a camera, (voxels,).
    """

    shape: tuple[int, int, int]
    pixels: tuple[Int[np.ndarray, "v 2"], ...]
    visible: tuple[Bool[np.ndarray, " v"], ...]
    sizes: tuple[tuple[int, int], ...]

    @staticmethod
    def build(rig: Rig, scale: float) -> RegionFinder:
        """Cube of 3.4 m around the point closest to all optical axes, 5 cm voxels."""
        middle, _ = closest_point(rig.centres, np.array([camera.forward for camera in rig]))
        steps = np.arange(-_HALF_WIDTH_M, _HALF_WIDTH_M, _VOXEL_M)
        grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)
        points = grid.reshape(-1, 3) + middle
        pixels, visible, sizes = [], [], []
        for camera in rig:
            size = scaled_size(camera.size, scale)
            projected, depth = camera.project(points)
            seen = (depth > 0) & np.isfinite(projected).all(axis=1)
            # Pixel centres at whole numbers: the first pixel's corner is at -0.5 in both pictures.
            scaled = np.where(seen[:, None], (projected + 0.5) * (size[0] / camera.size[0]) - 0.5, -1.0)
            rounded = np.rint(np.clip(scaled, -1, 1e6)).astype(np.int64)
            pixels.append(rounded)
            visible.append(seen & (rounded >= 0).all(axis=1) & (rounded < size).all(axis=1))
            sizes.append(size)
        shape = grid.shape[:3]
        return RegionFinder((shape[0], shape[1], shape[2]), tuple(pixels), tuple(visible), tuple(sizes))

    def parts(
        self, foregrounds: Sequence[UInt8[np.ndarray, "_h _w"] | None], widen: float = 1.0
    ) -> Int[np.ndarray, " v"]:
        """The widened hull's connected parts: a label a voxel (V,), 0 outside, 1, 2, ... by falling size.

        foregrounds : one a camera, at the scaled size, non-zero where something differs from the background;
        None: this camera is not asked. widen : factor on the usual widening.
        A camera outside whose picture a voxel lies says nothing about it; two others must see it. Parts of
        fewer than 30 voxels (4 litres) are dropped.
        """
        inside = np.ones(int(np.prod(self.shape)), dtype=bool)
        n_views = np.zeros(len(inside), dtype=int)
        for pixels, visible, foreground in zip(self.pixels, self.visible, foregrounds, strict=True):
            if foreground is None:
                continue
            widened = cv2.dilate(foreground, _disc(widen * max(foreground.shape) * _WIDEN_SHARE))
            hit = pixels[visible]
            inside[visible] &= widened[hit[:, 1], hit[:, 0]] > 0
            n_views += visible
        inside &= n_views >= min(_N_VIEWS_NEEDED, len(self.pixels))
        labels = scipy.ndimage.label(inside.reshape(self.shape))[0].ravel()
        sizes = np.bincount(labels)
        sizes[0] = 0
        order = np.argsort(-sizes, kind="stable")
        rank = np.zeros(len(sizes), dtype=np.int64)
        kept = order[sizes[order] >= _SMALLEST_PART]
        rank[kept] = np.arange(1, len(kept) + 1)
        return rank[labels]

    def outline(
        self, camera_idx: int, voxels: Bool[np.ndarray, " v"], widen: float = 1.0
    ) -> Bool[np.ndarray, "h w"]:
        """(h w) of the scaled picture: where these voxels are seen, widened to close the gaps between
        them."""
        width, height = self.sizes[camera_idx]
        image = np.zeros((height, width), np.uint8)
        hit = self.pixels[camera_idx][voxels & self.visible[camera_idx]]
        image[hit[:, 1], hit[:, 0]] = 1
        return cv2.dilate(image, _disc(widen * max(width, height) / 80)) > 0


def _disc(radius_px: float) -> UInt8[np.ndarray, "k k"]:
    side = 2 * max(1, round(radius_px)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)


def grown(mask: Bool[np.ndarray, "h w"], radius_px: float) -> Bool[np.ndarray, "h w"]:
    """The mask widened by a disc."""
    return cv2.dilate(mask.astype(np.uint8), _disc(radius_px)) > 0
