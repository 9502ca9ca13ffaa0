"""Masks mended by what the other cameras say: a hull carved from the rest, projected.

For each camera, two questions on a grid of voxels around the subject:

- Surplus: pixels of its mask where nearly all others see background, all along the ray. Specks, a passer-by's
  arm; they are taken away.
- Missing: places that every other camera calls person and this one alone does not. A hull of the others has
  parts of its own making there (phantoms), so the picture has its say: where it differs from the background
  at least faintly, the part is given back; where the background has the person's own colours, nobody can
  know, and it becomes unknown; where the background is plain to see, the gap is real and stays.

Both are asked only as finely as the rig's calibration allows: by how many pixels the masks must be widened
until each is covered by the hull of the others. Where that is much, or cameras are few, nothing is done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int, UInt8

from capture.camera import Camera
from capture.colour_difference import scaled_size
from capture.plate_difference import light_gains, light_table, shaded
from capture.rig import Rig
from capture.silhouette_files import PERSON, UNKNOWN
from capture.world import closest_point

_SIDE = 480  # px of the longer side at which the questions are asked
_VOXEL_M, _HALF_WIDTH_M = 0.03, 1.5
_N_OTHERS_SURPLUS, _N_OTHERS_MISSING = 3, 5
_DISSENT_FROM = 6  # so many others, and one of them may be wrong about a surplus
_TOLERANCES = (0, 1, 2, 3, 5)  # px at that size
_EXPLAINED = 0.985
_FAINT_LEVELS = 10
_SIGHTED_SHARE = 0.5
_CAMOUFLAGE_SHARE = 0.6
_COLOUR_STEP = 32
_MOST_SURPLUS = 0.5  # of a mask
_LEAST_AREA = 25  # px at that size

Mask = UInt8[np.ndarray, "_h _w"]
Picture = UInt8[np.ndarray, "_h _w 3"]


@dataclass(frozen=True)
class MaskRepair:
    """A voxel grid projected once into every camera's small picture.

    shape : voxels along x, y, z. pixels : one a camera, (voxels,) index into the flattened small picture, -1
    outside. sizes : of the small pictures. reach : one a camera, half a voxel's diagonal in small px.
    tolerance : px, by which masks are widened first; None: not found out yet, or more than is of use.
    """

    shape: tuple[int, int, int]
    pixels: tuple[Int[np.ndarray, " v"], ...]
    sizes: tuple[tuple[int, int], ...]
    reach: tuple[float, ...]
    tolerance: int | None = None

    @staticmethod
    def build(rig: Rig, samples: Sequence[Sequence[Mask | None]]) -> MaskRepair:
        """samples : masks (as filmed, full size) of a few frames, from which the tolerance is found. rig :
        lens included, metres."""
        middle, _ = closest_point(rig.centres, np.array([camera.forward for camera in rig]))
        voxel_m = _VOXEL_M if len(rig) <= 24 else 4 / 3 * _VOXEL_M
        steps = np.arange(-_HALF_WIDTH_M, _HALF_WIDTH_M, voxel_m)
        grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1)
        points = grid.reshape(-1, 3) + middle
        sizes = tuple(_small_size(camera) for camera in rig)
        pixels, reach = [], []
        for camera, size in zip(rig, sizes, strict=True):
            found, depth = _projected(camera, points, size)
            pixels.append(found)
            usual = float(np.median(depth[found >= 0])) if (found >= 0).any() else 1.0
            scale = size[0] / camera.size[0]
            reach.append(0.87 * voxel_m * float(camera.intrinsics[0, 0]) * scale / max(usual, 1e-6))
        shape = (grid.shape[0], grid.shape[1], grid.shape[2])
        unset = MaskRepair(shape, tuple(pixels), sizes, tuple(reach))
        found_out = [unset._found_tolerance(masks) for masks in samples]
        known = [tolerance for tolerance in found_out if tolerance is not None]
        usual_tolerance = int(np.ceil(np.median(known))) if 2 * len(known) > len(found_out) else None
        return MaskRepair(shape, tuple(pixels), sizes, tuple(reach), usual_tolerance)

    def repaired(
        self,
        masks: Sequence[Mask | None],
        pictures: Sequence[Picture | None],
        backgrounds: Sequence[Picture],
    ) -> tuple[list[Mask | None], list[str]]:
        """The masks (as filmed; 255, 128, 0), mended, and a phrase a camera that says what was done, or "".

        pictures, backgrounds : full size, in one channel order.
        """
        said = ["" for _ in masks]
        out = list(masks)
        n_masks = sum(mask is not None for mask in masks)
        if self.tolerance is None or n_masks < 1 + _N_OTHERS_SURPLUS:
            return out, said
        small = [None if m is None else self._small(m, idx) for idx, m in enumerate(masks)]
        hull = self._asked(small, self.tolerance)
        if hull is None:
            return out, said
        for camera_idx, mask in enumerate(masks):
            here = small[camera_idx]
            if mask is None or here is None:
                continue
            surplus = self._surplus(hull, camera_idx, here)
            gone = 0
            result = mask
            # Where most of a mask is denied, it is not clear that the others are right.
            if surplus.any() and surplus.sum() < _MOST_SURPLUS * here.sum():
                full = _enlarged(surplus, mask.shape) & (mask == PERSON)
                gone = int(full.sum())
                result = np.where(full, 0, result).astype(np.uint8)
            back, unsure = 0, 0
            picture = pictures[camera_idx]
            if picture is not None and n_masks > _N_OTHERS_MISSING:
                given, unknown = self._missing(hull, camera_idx, here, picture, backgrounds[camera_idx])
                fresh = _enlarged(given, mask.shape) & (result != PERSON)
                back = int(fresh.sum())
                result = np.where(fresh, PERSON, result).astype(np.uint8)
                doubt = _enlarged(unknown, mask.shape) & (result == 0)
                unsure = int(doubt.sum())
                result = np.where(doubt, UNKNOWN, result).astype(np.uint8)
            out[camera_idx] = result
            counts = {"taken away": gone, "given back": back, "unknown": unsure}
            changes = [f"{n} px {what}" for what, n in counts.items() if n]
            said[camera_idx] = ", ".join(changes)
        return out, said

    def _small(self, mask: Mask, camera_idx: int) -> Bool[np.ndarray, "_h _w"]:
        person = cv2.threshold(mask, PERSON - 1, 255, cv2.THRESH_BINARY)[1]
        return cv2.resize(person, self.sizes[camera_idx], interpolation=cv2.INTER_AREA) > 127

    def _asked(self, small: Sequence[Bool[np.ndarray, "_h _w"] | None], tolerance: int) -> _Hull | None:
        """Who says background where; None without a hull."""
        asked = [idx for idx, mask in enumerate(small) if mask is not None]
        widened = {}
        for idx in asked:
            mask = small[idx]
            assert mask is not None
            widened[idx] = cv2.dilate(mask.astype(np.uint8), _disc(self.reach[idx] + tolerance)).ravel()
        box = self._box(widened)
        if box is None:
            return None
        against, seen = {}, {}
        for idx in asked:
            pixels = self.pixels[idx].reshape(self.shape)[box]
            visible = pixels >= 0
            # A mask is asked through index -1 too, harmlessly: what is not visible counts for nobody.
            against[idx] = visible & (widened[idx][pixels] == 0)
            seen[idx] = visible
        return _Hull(box, against, sum(a.astype(np.int16) for a in against.values()), seen)

    def _box(self, widened: dict[int, np.ndarray]) -> tuple[slice, slice, slice] | None:
        """Where in the grid at most one camera objects, asked at every third voxel, with a margin."""
        third = (slice(None, None, 3),) * 3
        count = np.zeros((), np.int64)
        n_seen = np.zeros((), np.int64)
        for idx, mask in widened.items():
            pixels = self.pixels[idx].reshape(self.shape)[third]
            count = count + ((pixels >= 0) & (mask[pixels] == 0))
            n_seen = n_seen + (pixels >= 0)
        inside = np.asarray((count <= 1) & (n_seen >= min(3, len(widened))))
        labels, n_parts = scipy.ndimage.label(inside)
        if n_parts == 0:
            return None
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        hit = np.argwhere(labels == sizes.argmax())
        low, high = hit.min(axis=0) * 3 - 6, hit.max(axis=0) * 3 + 7
        starts = np.maximum(low, 0)
        stops = np.minimum(high, self.shape)
        slices = [slice(int(start), int(stop)) for start, stop in zip(starts, stops, strict=True)]
        return slices[0], slices[1], slices[2]

    def _seen_as(
        self,
        box: tuple[slice, slice, slice],
        voxels: Bool[np.ndarray, "x y z"],
        camera_idx: int,
        radius: float,
    ) -> Bool[np.ndarray, "_h _w"]:
        """The voxels in the camera's small picture, widened by `radius` px."""
        width, height = self.sizes[camera_idx]
        image = np.zeros(width * height, np.uint8)
        pixels = self.pixels[camera_idx].reshape(self.shape)[box][voxels]
        image[pixels[pixels >= 0]] = 1
        return cv2.dilate(image.reshape(height, width), _disc(radius)) > 0

    def _surplus(
        self, hull: _Hull, camera_idx: int, mask: Bool[np.ndarray, "_h _w"], allowed: int | None = None
    ) -> Bool[np.ndarray, "_h _w"]:
        """Of the small mask, what no place explains that the others allow."""
        others = len(hull.against) - 1
        if allowed is None:
            allowed = 1 if others >= _DISSENT_FROM else 0
        dissent = hull.count - hull.against[camera_idx]
        voxels = dissent <= allowed
        support = self._seen_as(hull.box, voxels, camera_idx, 1.5 * self.reach[camera_idx])
        surplus = (mask & ~support).astype(np.uint8)
        solid = cv2.morphologyEx(surplus, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).astype(np.uint8)
        parts = _large_parts(solid).astype(np.uint8)
        # With the rim that the opening took off.
        return (cv2.dilate(parts, np.ones((3, 3), np.uint8)) > 0) & (surplus > 0)

    def _missing(
        self,
        hull: _Hull,
        camera_idx: int,
        mask: Bool[np.ndarray, "_h _w"],
        picture: Picture,
        background: Picture,
    ) -> tuple[Bool[np.ndarray, "_h _w"], Bool[np.ndarray, "_h _w"]]:
        """(given back, unknown), small: what the others see as person and this camera does not."""
        nothing = np.zeros_like(mask)
        alone = hull.against[camera_idx] & (hull.count == 1)
        n_others = sum(seen.astype(np.int16) for idx, seen in hull.seen.items() if idx != camera_idx)
        alone &= np.asarray(n_others >= _N_OTHERS_MISSING)
        if not alone.any():
            return nothing, nothing
        every = alone | (hull.count == 0)
        reach, tolerance = self.reach[camera_idx], self.tolerance or 0
        seen = self._seen_as(hull.box, every, camera_idx, reach).astype(np.uint8)
        # The others' masks were widened: their hull is too wide by as much on either side.
        core = cv2.erode(seen, _disc(2 * reach + tolerance)) > 0
        candidate = (core & ~mask).astype(np.uint8)
        candidate = cv2.morphologyEx(candidate, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        parts = _large_parts(candidate)
        if not parts.any():
            return nothing, nothing
        size = self.sizes[camera_idx]
        now, then = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (picture, background))
        table = light_table(light_gains(now, then))
        even = now if table is None else cv2.LUT(now, table)
        # A shadow differs too, and where one camera took it for the person, others may have.
        shadow = shaded(even, then, np.maximum(cv2.cvtColor(then, cv2.COLOR_RGB2GRAY), 1)) > 0
        faint = (cv2.absdiff(even, then).max(axis=2) > _FAINT_LEVELS) & ~shadow
        alike = _has_persons_colours(now, then, mask)
        labels, n_parts = scipy.ndimage.label(parts)
        given, unknown = nothing.copy(), nothing.copy()
        for part in range(1, n_parts + 1):
            here = labels == part
            if faint[here].mean() >= _SIGHTED_SHARE:
                near = cv2.dilate(here.astype(np.uint8), _disc(reach + tolerance)) > 0
                given |= (near & faint & (seen > 0)) | here
            elif alike[here].mean() >= _CAMOUFLAGE_SHARE:
                unknown |= here
        return given & ~mask, unknown & ~mask

    def _found_tolerance(self, masks: Sequence[Mask | None]) -> int | None:
        """By how much (small px) masks must be widened until the hull of the others covers nearly all of
        each."""
        small = [None if mask is None else self._small(mask, idx) for idx, mask in enumerate(masks)]
        if sum(mask is not None for mask in small) < 1 + _N_OTHERS_SURPLUS:
            return None
        for tolerance in _TOLERANCES:
            hull = self._asked(small, tolerance)
            if hull is None:
                continue
            shares = [
                1 - self._surplus(hull, idx, mask, allowed=0).sum() / max(1, mask.sum())
                for idx, mask in enumerate(small)
                if mask is not None
            ]
            if np.median(shares) >= _EXPLAINED:
                return tolerance
        return None


@dataclass(frozen=True)
class _Hull:
    """A box of the grid: who says background in each voxel, how many do, and who sees it at all."""

    box: tuple[slice, slice, slice]
    against: dict[int, Bool[np.ndarray, "_x _y _z"]]
    count: Int[np.ndarray, "_x _y _z"]
    seen: dict[int, Bool[np.ndarray, "_x _y _z"]]


def _small_size(camera: Camera) -> tuple[int, int]:
    return scaled_size(camera.size, min(1.0, _SIDE / max(camera.size)))


def _projected(
    camera: Camera, points: Float[np.ndarray, "v 3"], size: tuple[int, int]
) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    projected, depth = camera.project(points)
    seen = (depth > 0) & np.isfinite(projected).all(axis=1)
    scaled = np.where(seen[:, None], (projected + 0.5) * (size[0] / camera.size[0]) - 0.5, -1.0)
    rounded = np.rint(np.clip(scaled, -1, 1e6)).astype(np.int32)
    inside = seen & (rounded >= 0).all(axis=1) & (rounded < size).all(axis=1)
    return np.where(inside, rounded[:, 1] * size[0] + rounded[:, 0], -1).astype(np.int32), depth


def _has_persons_colours(
    now: Picture, then: Picture, mask: Bool[np.ndarray, "_h _w"]
) -> Bool[np.ndarray, "_h _w"]:
    """Where the background's colour is one that the person wears."""
    bins = 256 // _COLOUR_STEP

    def index(image: Picture) -> Int[np.ndarray, "_h _w"]:
        steps = (image // _COLOUR_STEP).astype(np.int64)
        return (steps[..., 0] * bins + steps[..., 1]) * bins + steps[..., 2]

    worn = np.bincount(index(now)[mask], minlength=bins**3) / max(1, mask.sum())
    return worn[index(then)] > 0.02


def _large_parts(mask: UInt8[np.ndarray, "_h _w"]) -> Bool[np.ndarray, "_h _w"]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST_AREA
    large[0] = False
    return large[labels]


def _enlarged(small: Bool[np.ndarray, "_h _w"], shape: tuple[int, ...]) -> Bool[np.ndarray, "_H _W"]:
    soft = cv2.resize(small.astype(np.float32), shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return soft > 0.5


def _disc(radius_px: float) -> UInt8[np.ndarray, "k k"]:
    side = 2 * max(1, round(radius_px)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)
