"""One picture and its background to the subject's silhouette.

For every pixel, two probabilities: of its colour if it is background (the background's colour there, within
the range of its neighbours, possibly dimmed by a shadow), and of its colour if it is the person (whose
colours are learnt from the pixels that differ beyond doubt). Their ratio decides nearly everything. Where it
does not (black shorts before a black chair, a background that was never seen, soft shadows at the feet) the
labels that cut along the picture's edges are found by a minimum cut (Boykov and Jolly, ICCV 2001). Holes
between arm and body are real and stay.

Worked at half size in the picture as filmed; a guided filter (He, Sun, Tang, ECCV 2010; OpenCV's ximgproc)
then moves the mask's edge to the full picture's edge. The mask is undistorted afterwards, so no picture is
ever resampled.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Bool, Float, UInt8
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from capture.colour_difference import departure

_SURE_LEVELS = 28
_NOISE_LEVELS = 4.0
_SHADOW_GAINS = (0.5, 0.57, 0.65, 0.74, 0.84, 0.93, 1.08, 1.18)
_SHADOW_SHARE = 0.15
_SURPRISE_SHARE = 0.05  # of either side's pixels that look like anything
_COLOUR_BINS = 16
_ANY_COLOUR = 256.0**-3
_EVIDENCE_WEIGHT = 0.3  # neighbours' errors are alike: a pixel's evidence counts less than if it stood alone
_EDGE_WEIGHT = 6.0
_EDGE_LEVELS = 10.0
_DECIDED = 1.5

Picture = UInt8[np.ndarray, "h w 3"]
Mask = Bool[np.ndarray, "h w"]


def segment(
    picture: Picture, background: Picture, outline: Mask, trusted: Mask | None = None
) -> UInt8[np.ndarray, "h w"]:
    """255 on the subject, 0 elsewhere (h w); all zero where nothing differs from the background.

    outline : where the subject can be; nothing outside it is kept.
    trusted : where `background` is the background; None: everywhere.
    """
    full = np.zeros(picture.shape[:2], np.uint8)
    rows, columns = np.flatnonzero(outline.any(axis=1)), np.flatnonzero(outline.any(axis=0))
    if rows.size < 8 or columns.size < 8:
        return full
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    size = ((columns[-1] + 2 - columns[0]) // 2, (rows[-1] + 2 - rows[0]) // 2)
    known = np.ones(full.shape, bool) if trusted is None else trusted
    small_outline, small_known = (
        cv2.resize(mask[box].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        for mask in (outline, known)
    )
    small, small_background = (
        cv2.resize(image[box], size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        for image in (picture, background)
    )
    person = segment_small(small, small_background, small_outline, small_known)
    if not person.any():
        return full
    rough = cv2.resize(person.astype(np.float32), (columns[-1] + 1 - columns[0], rows[-1] + 1 - rows[0]))
    fine = cv2.ximgproc.guidedFilter(np.ascontiguousarray(picture[box]), rough, 5, 40.0) > 0.5
    full[box] = np.where(_main_parts(_without_specks(fine & outline[box])), 255, 0)
    return full


def segment_small(picture: Picture, background: Picture, outline: Mask, known: Mask) -> Mask:
    """The person (h w) in one picture by probabilities and minimum cut, without the refinement at full
    size."""
    differs = departure(picture, background) > _SURE_LEVELS
    solid = (
        cv2.morphologyEx(
            (differs & outline & known).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
        )
        > 0
    )
    if solid.sum() < 50:
        return np.zeros(outline.shape, bool)
    nearby = cv2.dilate(outline.astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
    if_person = (1 - _SURPRISE_SHARE) * _colour_density(picture, solid)[_bins(picture)]
    elsewhere = _colour_density(background, nearby & known)[_bins(picture)]
    if_background = (1 - _SURPRISE_SHARE) * np.where(
        known, _background_density(picture, background), elsewhere
    )
    surprise = _SURPRISE_SHARE * _ANY_COLOUR
    evidence = np.clip(np.log((if_person + surprise) / (if_background + surprise)), -8, 8)
    return _minimum_cut(np.where(outline, _EVIDENCE_WEIGHT * evidence, -10.0), picture, outline)


def _background_density(picture: Picture, background: Picture) -> Float[np.ndarray, "h w"]:
    """Probability density of each pixel's colour (per level cubed) if it shows the background, lit or
    shaded."""
    shaded = np.mean(
        [_range_density(picture, cv2.convertScaleAbs(background, alpha=g)) for g in _SHADOW_GAINS], axis=0
    )
    return (1 - _SHADOW_SHARE) * _range_density(picture, background) + _SHADOW_SHARE * shaded


def _range_density(picture: Picture, background: Picture) -> Float[np.ndarray, "h w"]:
    """Density of a colour drawn evenly from the background's range up to half a pixel around, plus noise,
    per channel.

    The range forgives a small shift between plate and video. A busy background (stripes) spreads its
    probability over a wide range, so it explains any one colour poorly.
    """
    kernel = np.ones((3, 3), np.uint8)
    middle = background.astype(np.float32)
    # Half-way to the neighbours' extremes: where linear interpolation arrives half a pixel away.
    high = (cv2.dilate(background, kernel) + middle) / 2
    low = (cv2.erode(background, kernel) + middle) / 2
    value = picture.astype(np.float32)
    off = np.maximum(np.maximum(value - high, low - value), 0) / _NOISE_LEVELS
    width = high - low + np.sqrt(2 * np.pi).astype(np.float32) * _NOISE_LEVELS
    return np.exp(-0.5 * (off**2).sum(axis=2)).astype(np.float64) / width.prod(axis=2)


def _bins(picture: Picture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    index = picture // (256 // _COLOUR_BINS)
    return index[..., 0], index[..., 1], index[..., 2]


def _colour_density(picture: Picture, where: Mask) -> Float[np.ndarray, "n n n"]:
    """Density of colours (per level cubed) among these pixels: a histogram, smoothed over neighbouring
    bins."""
    counts = np.zeros((_COLOUR_BINS,) * 3)
    np.add.at(counts, tuple(channel[where] for channel in _bins(picture)), 1.0)
    counts = scipy.ndimage.gaussian_filter(counts, 0.6)
    return counts / max(counts.sum(), 1e-12) / (256 / _COLOUR_BINS) ** 3


def _minimum_cut(evidence: Float[np.ndarray, "h w"], picture: Picture, outline: Mask) -> Mask:
    """The labels that minimise evidence against them plus the price of a boundary, which is low along edges.

    Pixels with strong evidence are fixed first, so that the graph holds only the doubtful ones: a few
    thousand.
    """
    around = cv2.blur(evidence.astype(np.float32), (3, 3))
    fixed = (
        (np.abs(evidence) >= _DECIDED) & (np.abs(around) >= _DECIDED) & (np.sign(around) == np.sign(evidence))
    )
    person = around > 0
    open_ = outline & ~fixed
    n_open = int(open_.sum())
    if n_open == 0:
        return person & outline
    number = np.full(open_.shape, -1)
    number[open_] = np.arange(n_open)
    source, sink = n_open, n_open + 1
    to_person, to_rest = np.maximum(evidence, 0)[open_], np.maximum(-evidence, 0)[open_]
    tails, heads, prices = [], [], []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here, there = _shifted_slices(down, right, open_.shape)
        step = np.abs(picture[here].astype(np.float32) - picture[there]).max(axis=2)
        price = _EDGE_WEIGHT * (0.02 + np.exp(-0.5 * (step / _EDGE_LEVELS) ** 2)) / np.hypot(down, right)
        both = open_[here] & open_[there]
        tails += [number[here][both], number[there][both]]
        heads += [number[there][both], number[here][both]]
        prices += [price[both]] * 2
        # A fixed neighbour pulls with the price of the boundary to it.
        for one, other in ((here, there), (there, here)):
            border = open_[one] & ~open_[other]
            target = person[other] & outline[other]
            np.add.at(to_person, number[one][border & target], price[border & target])
            np.add.at(to_rest, number[one][border & ~target], price[border & ~target])
    every = np.arange(n_open)
    tails += [np.full(n_open, source), every]
    heads += [every, np.full(n_open, sink)]
    prices += [to_person, to_rest]
    capacity = np.rint(1000 * np.concatenate(prices)).astype(np.int32)
    index = (np.concatenate(tails), np.concatenate(heads))
    graph = scipy.sparse.csr_array((capacity, index), shape=(n_open + 2, n_open + 2))
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    on_person_side = np.zeros(n_open + 2, bool)
    on_person_side[reached] = True
    person[open_] = on_person_side[:n_open]
    return person & outline


def _shifted_slices(
    down: int, right: int, shape: tuple[int, ...]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Two views of a picture whose pixels are neighbours: (row, column) and (row + down, column + right)."""
    height, width = shape
    rows = slice(0, height - down), slice(down, height)
    columns = (slice(max(0, -right), width - max(0, right)), slice(max(0, right), width - max(0, -right)))
    return (rows[0], columns[0]), (rows[1], columns[1])


def _without_specks(person: Mask) -> Mask:
    """Holes of less than 1/5000 of the person are noise, not a view through; filled."""
    holes, _ = scipy.ndimage.label(~person)
    sizes = np.bincount(holes.ravel())
    small = np.flatnonzero(sizes < 2e-4 * person.sum())
    return person | np.isin(holes, small[small > 0])


def _main_parts(person: Mask) -> Mask:
    """The largest connected part, and the others of at least 1 % of it (a forearm beyond a dark sleeve)."""
    labels, n_parts = scipy.ndimage.label(person)
    if n_parts == 0:
        return person
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.isin(labels, np.flatnonzero(sizes >= 0.01 * sizes.max()))
