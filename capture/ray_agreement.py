"""How well silhouettes agree under a calibration, without carving: whether the rays through a silhouette meet
the cones of all others.

A pixel belongs to the projected visual hull exactly if some point on its ray lies inside every other
silhouette. So the share of a silhouette's pixels for which that holds is the intersection over union of hull
and silhouette (Laurentini 1994: the hull never leaves a silhouette), here from a few sampled pixels and
depths. `covered_shares` tells that for gross errors; `outline_depths` asks for rays along the outlines how
deep, in pixels, their best point lies inside the other silhouettes, which fractions of a pixel change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.rig import Rig
from capture.silhouette_files import PERSON, UNKNOWN

Masks = Sequence[UInt8[np.ndarray, "_h _w"] | None]

_COARSE_PX = 160  # longer side of the pictures that gross errors are looked for in
_N_PIXELS, _N_DEPTHS, _N_ROUGH = 48, 48, 72
_N_OUTLINE, _N_FINE = 32, 13
_FAR_PX = 1e4
_MARGIN_PX = 16  # about a silhouette's box at full size; farther away than this is simply outside


@dataclass(frozen=True)
class Evidence:
    """One frame's silhouettes, prepared for many looks at them.

    seen : indices of the cameras with a silhouette. maps : for each of those, signed distance from the
    outline (px of the map, inside positive). scale : map pixels a picture pixel; corner : the map's first
    pixel (u, v) in the scaled picture. whole : whether the silhouette stays clear of the border, so that
    outside the picture is background. samples : pixels of the picture (K 2) whose rays are asked.
    """

    seen: tuple[int, ...]
    maps: tuple[Float[np.ndarray, "_h _w"], ...]
    scale: tuple[float, ...]
    corner: tuple[tuple[int, int], ...]
    whole: tuple[bool, ...]
    samples: tuple[Float[np.ndarray, "_k 2"], ...]


def coarse_evidence(masks: Masks, n_most: int, seed: int = 0) -> Evidence:
    """Small pictures and random pixels inside the silhouettes, of at most `n_most` cameras."""
    rng = np.random.default_rng(seed)
    return _evidence(masks, n_most, lambda mask: _inside_pixels(mask, rng), _COARSE_PX)


def fine_evidence(masks: Masks, n_most: int) -> Evidence:
    """Pictures at full size and pixels along the outlines, of at most `n_most` cameras."""
    return _evidence(masks, n_most, _outline_pixels, None)


def covered_shares(
    rig: Rig, evidence: Evidence, subject: Float[np.ndarray, " 3"], reach: float
) -> Float[np.ndarray, " s"]:
    """For each camera in `evidence.seen` (S,) the share of its silhouette that the others' hull covers.

    subject (3,), reach: where points on the rays are tried, world units.
    """
    offsets = np.linspace(-reach, reach, _N_DEPTHS)
    shares = []
    for k, camera_idx in enumerate(evidence.seen):
        origin, directions = _rays(rig, camera_idx, evidence.samples[k])
        middle = (subject - origin) @ directions.T
        points = origin + directions[:, None] * (middle[:, None] + offsets)[..., None]
        depth = _least_inside(rig, evidence, points, k)
        # One pixel of the small pictures is left to them and to the steps along the ray.
        shares.append(float((depth.max(axis=1) > -1.0).mean()))
    return np.array(shares)


def outline_depths(
    rigs: Sequence[Rig], evidence: Evidence, subject: Float[np.ndarray, " 3"], reach: float
) -> list[list[Float[np.ndarray, "_k"]]]:
    """For each rig (slight variants of the middle one) and camera in `evidence.seen`: how deep (px) the best
    point on each outline ray lies inside the others' silhouettes, negative where none lies inside all."""
    rough = np.linspace(-reach, reach, _N_ROUGH)
    usual = rigs[len(rigs) // 2]
    results: list[list[np.ndarray]] = [[] for _ in rigs]
    for k, camera_idx in enumerate(evidence.seen):
        origin, directions = _rays(usual, camera_idx, evidence.samples[k])
        middle = (subject - origin) @ directions.T
        points = origin + directions[:, None] * (middle[:, None] + rough)[..., None]
        best = middle + rough[_least_inside(usual, evidence, points, k).argmax(axis=1)]
        for rig, found in zip(rigs, results, strict=True):
            origin_now, directions_now = _rays(rig, camera_idx, evidence.samples[k])
            at, step = best, rough[1] - rough[0]
            deepest = np.zeros(0)
            for _ in range(2):
                tried = at[:, None] + step * np.linspace(-1, 1, _N_FINE)
                points = origin_now + directions_now[:, None] * tried[..., None]
                inside = _least_inside(rig, evidence, points, k)
                at = np.take_along_axis(tried, inside.argmax(axis=1)[:, None], axis=1)[:, 0]
                deepest, step = inside.max(axis=1), 2 * step / (_N_FINE - 1)
            found.append(deepest)
    return results


def _least_inside(
    rig: Rig, evidence: Evidence, points: Float[np.ndarray, "k t 3"], own: int
) -> Float[np.ndarray, "k t"]:
    """The smallest signed distance (map px) over all silhouettes but camera number `own` of the evidence."""
    shape = points.shape[:2]
    flat = points.reshape(-1, 3)
    least = np.full(len(flat), _FAR_PX)
    for k, camera_idx in enumerate(evidence.seen):
        if k == own:
            continue
        pixels, _ = rig[camera_idx].project(flat)
        mapped = np.nan_to_num((pixels + 0.5) * evidence.scale[k] - 0.5, nan=-_FAR_PX) - evidence.corner[k]
        at = np.clip(mapped, -_FAR_PX, _FAR_PX).astype(np.float32).reshape(*shape, 2)
        outside = -_FAR_PX if evidence.whole[k] else _FAR_PX
        found = cv2.remap(
            evidence.maps[k],
            np.ascontiguousarray(at[..., 0]),
            np.ascontiguousarray(at[..., 1]),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=outside,
        )
        least = np.minimum(least, found.ravel())
    return least.reshape(shape)


def _rays(
    rig: Rig, camera_idx: int, pixels: Float[np.ndarray, "k 2"]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "k 3"]]:
    return rig[camera_idx].rays(pixels)


def _evidence(masks: Masks, n_most: int, sample, longest: int | None) -> Evidence:  # type: ignore[no-untyped-def]
    usable = [k for k, mask in enumerate(masks) if mask is not None and (mask == PERSON).any()]
    step = max(1, -(-len(usable) // n_most))
    seen = tuple(usable[::step])
    maps, scales, corners, whole, samples = [], [], [], [], []
    for camera_idx in seen:
        mask = masks[camera_idx]
        assert mask is not None
        scale = 1.0 if longest is None else min(1.0, longest / max(mask.shape))
        clear = _is_whole(mask)
        # At full size only the silhouette's surroundings are worth a distance transform.
        box = _box(mask) if longest is None and clear else (0, 0, mask.shape[1], mask.shape[0])
        left, top, right, bottom = box
        maps.append(_signed_distance(mask[top:bottom, left:right], scale))
        scales.append(scale)
        corners.append((left, top))
        whole.append(clear)
        samples.append(sample(mask))
    return Evidence(seen, tuple(maps), tuple(scales), tuple(corners), tuple(whole), tuple(samples))


def _box(mask: UInt8[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom (the latter two excluded) of the person and a margin, within the picture."""
    x, y, width, height = cv2.boundingRect((mask >= UNKNOWN).astype(np.uint8))
    return (
        max(0, x - _MARGIN_PX),
        max(0, y - _MARGIN_PX),
        min(mask.shape[1], x + width + _MARGIN_PX),
        min(mask.shape[0], y + height + _MARGIN_PX),
    )


def _signed_distance(mask: UInt8[np.ndarray, "h w"], scale: float) -> Float[np.ndarray, "_h _w"]:
    """Distance from the outline in pixels of the shrunken picture; unknown counts as person."""
    person = (mask >= UNKNOWN).astype(np.uint8)
    if scale < 1:
        size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
        shrunk = cv2.resize(person * np.uint8(255), size, interpolation=cv2.INTER_AREA)
        person = (shrunk > 127).astype(np.uint8)
    inside = cv2.distanceTransform(person, cv2.DIST_L2, cv2.DIST_MASK_5)
    outside = cv2.distanceTransform(1 - person, cv2.DIST_L2, cv2.DIST_MASK_5)
    # Neighbours across the outline are each one pixel from the other: the outline is half way.
    return np.where(person > 0, inside - 0.5, 0.5 - outside).astype(np.float32)


def _is_whole(mask: UInt8[np.ndarray, "h w"]) -> bool:
    return not any((part >= UNKNOWN).any() for part in (mask[:2], mask[-2:], mask[:, :2], mask[:, -2:]))


def _inside_pixels(mask: UInt8[np.ndarray, "h w"], rng: np.random.Generator) -> Float[np.ndarray, "_k 2"]:
    flat = np.flatnonzero(mask.ravel() == PERSON)
    chosen = flat[rng.integers(0, flat.size, _N_PIXELS)]
    return np.column_stack([chosen % mask.shape[1], chosen // mask.shape[1]]).astype(np.float64)


def _outline_pixels(mask: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "_k 2"]:
    contours, _ = cv2.findContours(
        (mask == PERSON).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    longest = max(contours, key=len).reshape(-1, 2)
    chosen = np.linspace(0, len(longest), _N_OUTLINE, endpoint=False).astype(int)
    return longest[chosen].astype(np.float64)
