"""What 3x4 matrices leave open about pixels, told from the silhouettes: where rows and columns are counted
from, at which picture size, and whether the first pixel's centre is 0 or one half.

Everything is a map of the picture, so each possibility is a 3x3 matrix before the given ones. The matrices as
they are come first: where the silhouettes agree under them nothing else is looked for. Otherwise every
possibility is scored by the share of the silhouettes that the others' hull covers (`ray_agreement`); the
likely ones by how far rays along the outlines miss the other silhouettes, and one is taken only if it is
clearly better than what was given, camera by camera. Half a pixel shows in how deep those rays dip into the
other silhouettes, which peaks at the right offset.

World axes cannot be told from pictures: a mirrored world agrees with its silhouettes and is left to
`capture.world`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from capture.projection_split import camera_from_projection
from capture.ray_agreement import (
    Evidence,
    Masks,
    coarse_evidence,
    covered_shares,
    fine_evidence,
    outline_depths,
)
from capture.rig import Rig
from capture.world import find_subject, subject_extent

_N_CAMERAS = 16  # at most, evenly chosen: more cost time and add nothing
# Silhouettes covered, and rays that miss the others by so little: nothing gross is wrong.
_GOOD, _GOOD_PX = 0.9, 0.15
# What another convention must reach: share covered (and how near the best), and misses that are less by so
# many pixels, by so many standard errors, and by this ratio.
_ACCEPTED, _NEAR_SHARE = 0.75, 0.1
_LEAST_GAIN_PX, _CLEAR, _RATIO = 0.05, 3.0, 0.6
_MOST_MISS_PX = 5.0
_REACH = 0.65  # of the subject's extent, to both sides of its middle
_FACTORS = (1.0, 1 / 2, 1 / 4, 2.0, 4.0, 1 / 3, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 3.0)
# Symmetric about what is kept without evidence: noise flattens the peak and draws it to their middle.
_OFFSETS_PX = (-1.0, -0.5, 0.0, 0.5, 1.0)
_CLIP_PX = (-3.0, 2.0)
_NEAR_PX, _MOST_ERROR_PX = 0.2, 0.1
_ENOUGH = 10  # cameras times frames from which half a pixel should be told
_AXES: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    # (u, v) of ours from (u, v) of the file: signs, or a swap; negative counts from the far side.
    "as given": ((1, 0), (0, 1)),
    "rows counted from the bottom": ((1, 0), (0, -1)),
    "columns counted from the right": ((-1, 0), (0, 1)),
    "rows from the bottom and columns from the right": ((-1, 0), (0, -1)),
    "rows and columns swapped": ((0, 1), (1, 0)),
}


@dataclass(frozen=True)
class Convention:
    """How a file counts pixels. axes : a key of the table above. factor : our picture's size over the one the
    matrices are for. first_px : the file's coordinate of the first pixel's centre."""

    axes: str = "as given"
    factor: float = 1.0
    first_px: float = 0.0

    def ours_from_file(self, size: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
        """(3 3): a file's pixel to ours, for pictures of this size (width, height)."""
        s = self.factor
        offset = s * (0.5 - self.first_px) - 0.5
        scaled = np.array([[s, 0, offset], [0, s, offset], [0, 0, 1.0]])
        turn = np.eye(3)
        turn[:2, :2] = _AXES[self.axes]
        far = (np.array(size) - 1) * (turn[:2, :2].sum(axis=1) < 0)
        turn[:2, 2] = far
        return turn @ scaled

    def applied(self, rig: Rig) -> Rig:
        """The rig of matrices that are in this convention, in ours."""
        if self == Convention():
            return rig
        return Rig(
            tuple(
                camera_from_projection(c.name, c.size, self.ours_from_file(c.size) @ c.projection_matrix)
                for c in rig
            )
        )


@dataclass(frozen=True)
class Settled:
    """rig : in our convention. doubts, settled : sentences, as in `capture.world.World`."""

    rig: Rig
    convention: Convention
    doubts: tuple[str, ...]
    settled: tuple[str, ...]


def settle_convention(rig: Rig, frames: Sequence[Masks]) -> Settled:
    """The convention of a rig of 3x4 matrices (file units), from the silhouettes of one or more frames.

    With fewer than three silhouettes in every frame nothing is told and nothing changed.
    """
    usable = [masks for masks in frames if sum(mask is not None for mask in masks) >= 3][:2]
    if not usable:
        return Settled(rig, Convention(), (), ())
    evidence = [fine_evidence(masks, _N_CAMERAS) for masks in usable]
    coarse = coarse_evidence(usable[0], _N_CAMERAS)
    given = _fit(rig, Convention(), usable, evidence, coarse)
    best = given
    if given.share < _GOOD or given.miss_px > _GOOD_PX or not given.right_handed:
        best = _best_other(rig, given, usable, evidence, coarse)
    doubts, settled = [], []
    if best is not given:
        doubts.append(
            f"The matrices count pixels otherwise: {described(best.convention)}. So the outlines agree to "
            f"{best.miss_px:.2g} px, as given to {given.miss_px:.2g} px; they were converted."
        )
    found = best.convention
    first = best.first_pixel()
    if first is not None:
        value, error = first
        told = f"the silhouettes put the first pixel's centre at {value:.2f} px, give or take {error:.2f}"
        if abs(value - 0.5) < _NEAR_PX and error < _MOST_ERROR_PX:
            found = replace(found, first_px=0.5)
            settled.append(f"Pixel centres of the matrices: at 0.5 ({told}); they were converted.")
        elif len(best.depths) >= _ENOUGH:  # fewer cameras are not expected to tell
            sure = abs(value) < _NEAR_PX and error < _MOST_ERROR_PX
            text = "at whole numbers" if sure else "taken at whole numbers, though that is not sure"
            (settled if sure else doubts).append(f"Pixel centres of the matrices: {text} ({told}).")
    return Settled(found.applied(rig), found, tuple(doubts), tuple(settled))


@dataclass(frozen=True)
class _Fit:
    """How the silhouettes agree under a convention.

    share : of the silhouettes that the others' hull covers. depths, misses : a line a camera and frame, a
    column an offset of the first pixel (`_OFFSETS_PX`): mean depth of the outline rays inside the other
    silhouettes, clipped, and mean of how much they miss them (px).
    """

    convention: Convention
    share: float
    right_handed: bool
    depths: Float[np.ndarray, "n o"]
    misses: Float[np.ndarray, "n o"]

    @property
    def least_misses(self) -> Float[np.ndarray, " n"]:
        """Misses at the offset where they are least on the whole."""
        return self.misses[:, int(self.misses.mean(axis=0).argmin())]

    @property
    def miss_px(self) -> float:
        return float(self.least_misses.mean())

    def first_pixel(self) -> tuple[float, float] | None:
        """The file's coordinate of the first pixel's centre and its standard error (px of the file), from
        where the outlines agree best; None where that has no peak."""
        whole = _peak(self.depths.mean(axis=0))
        if whole is None:
            return None
        # Jackknife over cameras and frames: how much the answer hangs on any one of them.
        n = len(self.depths)
        left_out = [_peak(np.delete(self.depths, k, axis=0).mean(axis=0)) for k in range(n)]
        if any(value is None for value in left_out):
            return None
        spread = _jackknife_error(np.array(left_out, dtype=np.float64))
        # Two frames of a camera err alike, and cameras that are off by some pixels have a common part of
        # about that over the root of their number.
        return -whole, float(np.hypot(np.sqrt(2) * spread, self.miss_px / np.sqrt(n / 2)))


def _fit(
    rig: Rig, convention: Convention, frames: Sequence[Masks], evidence: Sequence[Evidence], coarse: Evidence
) -> _Fit:
    meant = convention.applied(rig)
    variants = [_moved_along_rows(rig, convention, offset) for offset in _OFFSETS_PX]
    depths, misses = [], []
    for masks, one in zip(frames, evidence, strict=True):
        place = _place(meant, masks)
        if place is not None:
            by_offset = outline_depths(variants, one, *place)
            depths += list(zip(*([np.clip(d, *_CLIP_PX).mean() for d in k] for k in by_offset), strict=True))
            misses += list(
                zip(*([-np.clip(d, -_MOST_MISS_PX, 0).mean() for d in k] for k in by_offset), strict=True)
            )
    return _Fit(
        convention,
        _share(meant, frames[0], coarse),
        _is_right_handed(meant, frames[0]),
        np.array(depths).reshape(-1, len(_OFFSETS_PX)),
        np.array(misses).reshape(-1, len(_OFFSETS_PX)),
    )


def _moved_along_rows(rig: Rig, convention: Convention, offset_px: float) -> Rig:
    """As `convention.applied`, after moving the file's pixels along their rows.

    Along columns as well, hulls of cameras that look down would move with the pixels and tell nothing.
    """
    along = np.array([[1, 0, offset_px], [0, 1, 0], [0, 0, 1.0]])
    return Rig(
        tuple(
            camera_from_projection(
                c.name, c.size, convention.ours_from_file(c.size) @ along @ c.projection_matrix
            )
            for c in rig
        )
    )


def _best_other(
    rig: Rig, given: _Fit, frames: Sequence[Masks], evidence: Sequence[Evidence], coarse: Evidence
) -> _Fit:
    """Another convention, where one agrees clearly better and gives right-handed cameras; else `given`."""
    shares: dict[Convention, float] = {}
    for candidate in _candidates(rig):
        if given.share >= _GOOD and candidate.factor != 1:
            continue  # another picture size would not have covered nine tenths
        meant = candidate.applied(rig)
        if _is_right_handed(meant, frames[0]):
            shares[candidate] = _share(meant, frames[0], coarse)
    likely = [c for c, share in shares.items() if share >= max(_ACCEPTED, max(shares.values()) - _NEAR_SHARE)]
    fits = [_fit(rig, c, frames, evidence, coarse) for c in likely]
    fits = [fit for fit in fits if fit.misses.shape == given.misses.shape and len(fit.misses) > 1]
    if not fits:
        return given
    best = min(fits, key=lambda fit: fit.miss_px)
    better = given.least_misses - best.least_misses
    gain = float(better.mean())
    error = _jackknife_error(np.array([np.delete(better, k).mean() for k in range(len(better))]))
    clear = gain > _LEAST_GAIN_PX and gain > _CLEAR * error and best.miss_px < _RATIO * given.miss_px
    return best if clear and best.share > given.share - _NEAR_SHARE else given


def _is_right_handed(rig: Rig, masks: Masks) -> bool:
    """Whether most cameras have the subject in front, with the sign that makes them right-handed."""
    subject, _ = find_subject(rig, masks)
    return bool(np.mean([(subject - c.centre) @ c.forward > 0 for c in rig]) > 0.5)


def _jackknife_error(left_out: Float[np.ndarray, " n"]) -> float:
    n = len(left_out)
    return float(np.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum()))


def agreement(rig: Rig, masks: Masks) -> float:
    """Mean share (0 to 1) of the silhouettes that the hull of the others covers, from a few rays."""
    return _share(rig, masks, coarse_evidence(masks, _N_CAMERAS))


def _candidates(rig: Rig) -> Iterable[Convention]:
    """Every mixture of axes and picture size but the given one. Sizes that put the principal points far off
    the pictures' middles are left out."""
    middles = np.array([c.intrinsics[:2, 2] for c in rig]) + 0.5
    sizes = np.array([c.size for c in rig], dtype=np.float64)
    for axes in _AXES:
        swapped = _AXES[axes][0][0] == 0
        for factor in _FACTORS:
            off = np.abs(factor * (middles[:, ::-1] if swapped else middles) / sizes - 0.5)
            if np.median(off) < 0.3 and (axes, factor) != ("as given", 1.0):
                yield Convention(axes, factor)


def _share(rig: Rig, masks: Masks, evidence: Evidence) -> float:
    place = _place(rig, masks)
    return 0.0 if place is None else float(covered_shares(rig, evidence, *place).mean())


def _place(rig: Rig, masks: Masks) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """The subject's middle and how far from it to look along rays, file units."""
    subject, _ = find_subject(rig, masks)
    extent = subject_extent(rig, masks, subject)
    if extent is None or not np.isfinite(extent) or extent <= 0:
        return None
    return subject, _REACH * extent


def _peak(values: Float[np.ndarray, " o"]) -> float | None:
    """Offset at which a parabola through the values of `_OFFSETS_PX` peaks; None where it opens upwards."""
    bend, slope, _ = np.polyfit(_OFFSETS_PX, values, 2)
    return None if bend > -1e-3 else float(-slope / (2 * bend))


def described(convention: Convention) -> str:
    """What a file does otherwise, in words; nothing for what is as ours."""
    parts = [] if convention.axes == "as given" else [convention.axes]
    if convention.factor != 1:
        times = 1 / convention.factor
        parts.append(f"for pictures {times:.3g} times as large")
    return ", ".join(parts)
