"""What each fixed camera sees behind the subject: the plate, corrected by the video itself.

A plate was taken at another moment: the exposure drifted, people stood elsewhere, the subject may stand on
it. The video knows better wherever it shows the background, and other cameras tell where that is:

1. Lift the plate to the video's brightness (slowly varying over the picture).
2. Foregrounds against it, a coarse hull of them (`capture.subject_region`): the part of it that moves is the
subject. 3. Parts of the hull that never move are ghosts, people on the plate or standing behind: there, the
video's own steady
   colour replaces the plate.
4. With these, outlines of the subject frame by frame: wherever a pixel lies outside the outline in enough
frames, the
   median over those frames is the background. The plate remains only where the subject always stands in
   front.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from capture.colour_difference import CLEAR_LEVELS, departure, foreground, shrunk
from capture.rig import Rig
from capture.segmentation import segment_small
from capture.subject_region import RegionFinder, grown

_WORKING_SIDE = 960
_STEADY_LEVELS = 8
_STEADY_SHARE = 0.85
_N_FREE_FRAMES = 4
_N_FREE_FRAMES_GHOST = 2

Picture = UInt8[np.ndarray, "_h _w 3"]
Samples = UInt8[np.ndarray, "_t _h _w 3"]


@dataclass(frozen=True)
class Backgrounds:
    """One background a camera, full size, lens as filmed; where the subject can be is found with `finder`.

    pictures : one a camera, (h w 3) uint8 in the channel order of the samples.
    trusted : one a camera, (h w): False where a ghost stands on the plate and the video never shows what is
    behind.
    finder : the region finder; small, steady : at its scale, the backgrounds and the videos' medians over
    time.
    """

    pictures: tuple[Picture, ...]
    trusted: tuple[Bool[np.ndarray, "_h _w"], ...]
    small: tuple[Picture, ...]
    steady: tuple[Picture, ...]
    finder: RegionFinder
    scale: float

    def outlines(self, pictures: list[Picture | None]) -> list[Bool[np.ndarray, "_h _w"] | None]:
        """Where the subject can be in one frame's full-size pictures: one (h w) mask a camera at full size.

        The part of the widened hull that moves most; None for a camera without a picture, or where there is
        no hull at all.
        """
        frame, now = [], []
        for picture, small, steady in zip(pictures, self.small, self.steady, strict=True):
            if picture is None:  # no evidence: everything may be foreground, nothing moves
                frame.append(np.full(small.shape[:2], 255, np.uint8))
                now.append(steady)
            else:
                now.append(shrunk(picture, self.scale))
                frame.append(foreground(now[-1], small))
        voxels = _subject_voxels(self.finder, frame, now, self.steady)
        result: list[Bool[np.ndarray, "_h _w"] | None] = []
        for camera_idx, picture in enumerate(pictures):
            if picture is None or not voxels.any():
                result.append(None)
                continue
            outline = self.finder.outline(camera_idx, voxels).astype(np.uint8)
            size = picture.shape[1::-1]
            result.append(cv2.resize(outline, size, interpolation=cv2.INTER_NEAREST) > 0)
        return result


def build_backgrounds(
    rig: Rig, plates: list[Picture], read_samples: Callable[[int], Iterator[Picture]]
) -> Backgrounds:
    """Backgrounds of a rig's cameras (lens included) from their plates and frames spread over the videos.

    read_samples(camera_idx) yields the same moments for every camera, full size; it is called twice a
    camera, so that only one camera's samples are in memory at full size.
    """
    scale = min(1.0, _WORKING_SIDE / max(max(camera.size) for camera in rig))
    samples = [np.stack([shrunk(p, scale) for p in read_samples(idx)]) for idx in range(len(rig))]
    steady = [median_over_time(stack) for stack in samples]
    small = [lifted(shrunk(plate, scale), middle) for plate, middle in zip(plates, steady, strict=True)]
    finder = RegionFinder.build(rig, scale)
    patches, ghosts = _find_ghosts(finder, samples, steady, small)
    for picture, middle, patch in zip(small, steady, patches, strict=True):
        picture[patch] = middle[patch]
    # Twice: with better backgrounds the outlines are tighter, and more pixels are free in more frames.
    for _ in range(2):
        outlines = _subject_outlines(finder, samples, steady, small, ghosts)
        for camera_idx, stack in enumerate(samples):
            middle, free = _over_free_frames(stack, outlines[camera_idx], ghosts[camera_idx])
            small[camera_idx][free] = middle[free]
    for camera_idx, ghost in enumerate(ghosts):
        _look_behind_ghost(
            samples[camera_idx], outlines[camera_idx], ghost, patches[camera_idx], small[camera_idx]
        )
    pictures, trusted = [], []
    for camera_idx, plate in enumerate(plates):
        shape = plate.shape[:2]
        # Only where the subject can ever be: nothing else of the background is asked for at full size.
        box = _box_at_full_size(
            np.any(outlines[camera_idx], axis=0).reshape(small[camera_idx].shape[:2]), shape
        )
        full = np.stack([picture[box] for picture in read_samples(camera_idx)])
        picture = lifted(plate, _enlarged(steady[camera_idx], shape))
        patch = _enlarged(patches[camera_idx], shape)[box]
        picture[box][patch] = median_over_time(full)[patch]
        covered = np.stack([_enlarged(outline, shape)[box] for outline in outlines[camera_idx]])
        ghost = _enlarged(ghosts[camera_idx], shape)
        middle, free = _over_free_frames(full, covered, ghost[box])
        picture[box][free] = middle[free]
        known = ~ghost
        known[box] |= free | patch
        pictures.append(picture)
        trusted.append(known)
    return Backgrounds(tuple(pictures), tuple(trusted), tuple(small), tuple(steady), finder, scale)


def _enlarged(
    image: Shaped[np.ndarray, "h w *channels"], shape: tuple[int, ...]
) -> Shaped[np.ndarray, "H W *channels"]:
    """A picture (bilinear) or a mask (nearest) of the working size at the full size `shape` (height,
    width)."""
    if image.dtype == np.bool_:
        return cv2.resize(image.astype(np.uint8), shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    return cv2.resize(image, shape[1::-1], interpolation=cv2.INTER_LINEAR)


def _box_at_full_size(mask: Shaped[np.ndarray, "_h _w"], shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of the full-size picture around a smaller mask's set pixels, with a margin of 5 %."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    slices = []
    for hit, small_length, length in ((rows, mask.shape[0], shape[0]), (columns, mask.shape[1], shape[1])):
        low, high = (hit[0], hit[-1] + 1) if hit.size else (0, small_length)
        margin = 0.05 * length
        factor = length / small_length
        slices.append(slice(max(0, int(low * factor - margin)), min(length, int(high * factor + margin) + 1)))
    return slices[0], slices[1]


def lifted(plate: Picture, target: Picture) -> Picture:
    """The plate with the slowly varying brightness and tint of `target`, learnt where the two nearly
    agree."""
    difference = target.astype(np.float32) - plate
    agree = (np.abs(difference).max(axis=2) < 25).astype(np.float32)
    radius = max(plate.shape) / 40
    weight = cv2.GaussianBlur(agree, (0, 0), radius) + 1e-3
    drift = cv2.GaussianBlur(difference * agree[..., None], (0, 0), radius) / weight[..., None]
    return np.clip(np.rint(plate + drift), 0, 255).astype(np.uint8)


def median_over_time(samples: Samples) -> Picture:
    """(h w 3): the median of (T h w 3), in strips so that no second copy of the samples is made."""
    result = np.empty(samples.shape[1:], np.uint8)
    for row in range(0, samples.shape[1], 64):
        strip = samples[:, row : row + 64].copy()
        strip.partition(len(samples) // 2, axis=0)
        result[row : row + 64] = strip[len(samples) // 2]
    return result


def _subject_voxels(
    finder: RegionFinder,
    frame: list[UInt8[np.ndarray, "_h _w"]],
    now: Sequence[Picture],
    steady: Sequence[Picture],
) -> Bool[np.ndarray, " v"]:
    """The hull's part (V,) in which most has moved away from the videos' median, counted in pixels over all
    cameras.

    A ghost can be as large as the subject, but nothing moves in it. What is foreground without moving counts
    a little, so that a subject who never moves is found by size.
    """
    labels = finder.parts(frame)
    n_parts = int(labels.max())
    if n_parts < 2:
        return labels == 1
    weight = [
        np.where(f > 0, 0.02 + (departure(p, s) > CLEAR_LEVELS), 0.0)
        for f, p, s in zip(frame, now, steady, strict=True)
    ]
    score = np.zeros(n_parts + 1)
    for part in range(1, n_parts + 1):
        score[part] = sum(float(w[finder.outline(idx, labels == part)].sum()) for idx, w in enumerate(weight))
    return labels == int(score.argmax())


def _subject_outlines(
    finder: RegionFinder,
    samples: list[Samples],
    steady: list[Picture],
    small: list[Picture],
    ghosts: list[Bool[np.ndarray, "_h _w"]],
) -> list[Bool[np.ndarray, "_t _h _w"]]:
    """Per camera, (T h w) at the finder's scale: where the subject can be in each sample.

    Where a ghost stands on the plate, this camera's own foreground is worthless: there the other cameras
    alone say where the subject is, and with less widening, because the plate cannot be fallen back on.
    """
    outlines: list[list[Bool[np.ndarray, "_h _w"]]] = [[] for _ in samples]
    for time_idx in range(len(samples[0])):
        frame = [foreground(s[time_idx], b) for s, b in zip(samples, small, strict=True)]
        now = [stack[time_idx] for stack in samples]
        voxels = _subject_voxels(finder, frame, now, steady)
        for camera_idx, ghost in enumerate(ghosts):
            outline = finder.outline(camera_idx, voxels)
            if ghost.any() and len(frame) > 2:
                others: list[UInt8[np.ndarray, "_h _w"] | None] = [*frame]
                others[camera_idx] = None
                seen_by_others = finder.parts(others, widen=0.4)
                hit = np.bincount(seen_by_others[voxels], minlength=1)
                if hit[1:].any():
                    tight = finder.outline(camera_idx, seen_by_others == 1 + int(hit[1:].argmax()), widen=0.6)
                    outline = np.where(ghost, outline & tight, outline)
            outlines[camera_idx].append(outline)
    return [np.stack(camera) for camera in outlines]


def _look_behind_ghost(
    samples: Samples,
    outlines: Bool[np.ndarray, "_t _h _w"],
    ghost: Bool[np.ndarray, "_h _w"],
    patched: Bool[np.ndarray, "_h _w"],
    background: Picture,
) -> None:
    """Narrow `outlines` and complete `background` (both in place) where the subject always may stand before
    a ghost.

    The segmentation itself copes with a background that is not known everywhere; where its masks leave a
    pixel free often enough, the background there becomes known, and the next round's masks are better.
    """
    for _ in range(2):
        known = ~ghost | patched | _over_free_frames(samples, outlines, ghost)[1]
        if (~known & outlines.any(axis=0)).sum() < 50:
            return
        for time_idx, picture in enumerate(samples):
            person = segment_small(picture, background, outlines[time_idx], known)
            outlines[time_idx] &= grown(person, 5.0) | ~ghost
        middle, free = _over_free_frames(samples, outlines, ghost)
        background[free] = middle[free]


def _find_ghosts(
    finder: RegionFinder, samples: list[Samples], steady: list[Picture], small: list[Picture]
) -> tuple[list[Bool[np.ndarray, "_h _w"]], list[Bool[np.ndarray, "_h _w"]]]:
    """Ghosts, per camera at the finder's scale: (patches, zones), both (h w).

    A part of the hull is a ghost if almost nothing moves in it in most cameras while the subject, the part
    with the most movement, does move. If nothing moves anywhere, no part can be told from the subject, and
    there are no ghosts.
    patches : pixels of ghosts whose colour in the video is steady, and is not the plate's.
    zones : pixels of ghosts where the video never shows the plate's colour: the plate is wrong there.
    """
    close = [
        np.abs(s.astype(np.int16) - m).max(axis=3) <= _STEADY_LEVELS
        for s, m in zip(samples, steady, strict=True)
    ]
    share = [c.mean(axis=0) for c in close]
    nearest = [np.min([departure(p, b) for p in s], axis=0) for s, b in zip(samples, small, strict=True)]
    patches = [np.zeros(m.shape[:2], bool) for m in steady]
    zones = [np.zeros(m.shape[:2], bool) for m in steady]
    n_samples = len(samples[0])
    for time_idx in sorted({0, n_samples // 3, 2 * n_samples // 3, n_samples - 1}):
        frame = [foreground(s[time_idx], b) for s, b in zip(samples, small, strict=True)]
        labels = finder.parts(frame)
        if labels.max() < 2:
            continue
        moving = [_moving_shares(finder, labels, idx, frame[idx], share[idx]) for idx in range(len(frame))]
        typical = [_upper_median([camera[part] for camera in moving]) for part in range(labels.max())]
        now = [stack[time_idx] for stack in samples]
        subject = int(labels[_subject_voxels(finder, frame, now, steady)][0])
        for part in range(1, labels.max() + 1):
            if part == subject or not typical[part - 1] < min(0.2, 0.4 * typical[subject - 1]):
                continue
            for camera_idx in range(len(samples)):
                where = finder.outline(camera_idx, labels == part)
                zones[camera_idx] |= where & (nearest[camera_idx] > CLEAR_LEVELS // 2)
                differs = departure(steady[camera_idx], small[camera_idx]) > CLEAR_LEVELS // 2
                patches[camera_idx] |= where & differs & (share[camera_idx] >= _STEADY_SHARE)
    return patches, [grown(zone, 3.0) for zone in zones]


def _upper_median(shares: list[float]) -> float:
    """The middle share, the higher of two, of the cameras that see the part; 1 where none does.

    The higher, because a subject may walk straight along the axis of half the cameras and not move in their
    pictures.
    """
    seen = sorted(share for share in shares if not np.isnan(share))
    return seen[len(seen) // 2] if seen else 1.0


def _moving_shares(
    finder: RegionFinder,
    labels: Int[np.ndarray, " v"],
    camera_idx: int,
    frame: UInt8[np.ndarray, "_h _w"],
    steady_share: Float[np.ndarray, "_h _w"],
) -> list[float]:
    """For each part of the hull: how much of its foreground in this camera is unsteady over time; NaN: not
    seen."""
    shares = []
    for part in range(1, labels.max() + 1):
        seen = finder.outline(camera_idx, labels == part) & (frame > 0)
        shares.append(float((steady_share[seen] < _STEADY_SHARE).mean()) if seen.sum() > 50 else float("nan"))
    return shares


def _over_free_frames(
    samples: Samples, outlines: Bool[np.ndarray, "_t _h _w"], ghosts: Bool[np.ndarray, "_h _w"]
) -> tuple[Picture, Bool[np.ndarray, "_h _w"]]:
    """The median of each pixel over the samples whose outline it lies outside of, and where there were
    enough of them.

    Where a ghost stands on the plate fewer are enough: there is nothing better to fall back on.
    """
    n_free = (~outlines).sum(axis=0)
    result = np.empty(samples.shape[1:], np.uint8)
    for row in range(0, samples.shape[1], 64):
        rows = slice(row, row + 64)
        # Covered samples sort to the end, so that the free ones' median stands at half their number.
        strip = np.where(outlines[:, rows, :, None], 255, samples[:, rows]).astype(np.uint8)
        strip.sort(axis=0)
        middle = (n_free[None, rows, :, None] - 1).clip(0) // 2
        result[rows] = np.take_along_axis(strip, middle, axis=0)[0]
    return result, n_free >= np.where(ghosts, _N_FREE_FRAMES_GHOST, _N_FREE_FRAMES)
