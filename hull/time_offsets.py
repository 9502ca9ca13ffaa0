"""How many frames a camera is behind or ahead of the others, from silhouettes alone.

The hull of the other cameras at one moment is held against the camera's silhouettes of the frames around it:
it fits best the one that shows the same moment. The fit falls off on both sides at a rate that the person's
speed sets, so its peak is found to a fraction of a frame; a person who stands still leaves no peak, and then
nothing is said. Cameras found to be off are moved and the rest is asked again, so several may be off at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from hull.reference import Moment, View, fit_of_mask, moment_of

MOST_FRAMES = 14
"""How far away a camera's own moment is looked for, frames."""
# A move must improve the fit (intersection over union less what sticks out) by so much, in so many of the
# moments, and by so many standard errors.
_LEAST_GAIN, _AGREEING, _ERRORS = 0.003, 0.75, 3.0
# The fit must fall by so much over two frames, or the person stands too still to tell.
_LEAST_FALL = 0.004
_MOST_ROUNDS = 5
# A camera that is so many small pixels off its calibration fits another moment of a person who walks on;
# what such a shift of its picture explains as well is not told.
_SHIFT_PX = 3

MaskOf = Callable[[int, int], "UInt8[np.ndarray, '_h _w'] | None"]
"""(camera, place of a frame) -> its mask, or None."""


@dataclass(frozen=True)
class TimeOffset:
    """One camera against the others.

    frames : its frame t + frames shows what the others show at t (positive: it is late); to a tenth. None:
        cannot be told.
    gain : how much better it fits there than at 0.
    curve : (shift, fit) for every shift tried.
    """

    frames: float | None
    gain: float
    curve: tuple[tuple[int, float], ...] = ()

    @property
    def is_off(self) -> bool:
        """Whether the camera is off by a frame or more."""
        return self.frames is not None and round(self.frames) != 0


def time_offsets(
    moments: Sequence[Moment],
    members: Sequence[int],
    asked: Sequence[int],
    mask_of: MaskOf,
    most: int = MOST_FRAMES,
) -> dict[int, TimeOffset]:
    """The offset of every camera asked against the members (of which it may be one).

    `moments` are of the frames as they were read; `mask_of` hands out the masks around them. Offsets are
    told against what most members show.
    """
    shifts = dict.fromkeys(asked, 0)
    found: dict[int, TimeOffset] = {}
    current = list(moments)
    views: dict[tuple[int, int], View | None] = {}

    def view_of(i: int, k: int) -> View | None:
        if (i, k) not in views:
            mask = mask_of(i, k)
            view = None if mask is None else View.of(mask)
            views[i, k] = view if view is not None and view.n_person else None
        return views[i, k]

    for _ in range(_MOST_ROUNDS):
        tables = {i: _table(current, members, i, view_of, most) for i in asked}
        gains = {i: _gain(tables[i], most, shifts[i]) for i in asked}
        for i, (gain, shift) in gains.items():
            if gain > 0 and not _is_time(current, members, i, view_of, shifts[i], shift):
                gains[i] = 0.0, shifts[i]
        found = {i: _judged(table, most, gains[i]) for i, table in tables.items()}
        best = max((gain for gain, _ in gains.values()), default=0.0)
        moved = {i: shift for i, (gain, shift) in gains.items() if gain > 0 and gain >= 0.5 * best}
        if not moved:
            break
        shifts.update(moved)
        current = [shown for moment in moments if (shown := _moved(moment, shifts, mask_of)) is not None]
    # What most cameras show is the others' moment: so many frames all of them may have been moved together.
    common = _most_common([shifts[i] for i in members if i in shifts])
    return {
        i: TimeOffset(None if offset.frames is None else offset.frames - common, offset.gain, offset.curve)
        for i, offset in found.items()
    }


def _most_common(numbers: Sequence[int]) -> int:
    return max(sorted(set(numbers), key=abs), key=list(numbers).count) if numbers else 0


def _moved(moment: Moment, shifts: dict[int, int], mask_of: MaskOf) -> Moment | None:
    """The moment with the cameras' masks from the frames that show it."""
    masks = [
        mask_of(i, moment.k + shifts[i]) if shifts.get(i) else (None if view is None else view.mask)
        for i, view in enumerate(moment.views)
    ]
    return moment_of(moment.k, moment.cameras, masks)


def _table(
    moments: Sequence[Moment],
    members: Sequence[int],
    i: int,
    view_of: Callable[[int, int], View | None],
    most: int,
) -> Float[np.ndarray, "m s"]:
    """(M 2 most + 1) how camera i's silhouettes around each moment fit the hull of the other members; NaN."""
    table = np.full((len(moments), 2 * most + 1), np.nan)
    for row, moment in zip(table, moments, strict=True):
        covered = moment.rest_mask(members, i)
        if covered is None or not covered.any():
            continue
        for shift in range(-most, most + 1):
            view = view_of(i, moment.k + shift)
            if view is not None:
                fit = fit_of_mask(covered, view)
                row[shift + most] = fit.iou - fit.surplus
    return table


def _gain(table: Float[np.ndarray, "m s"], most: int, now: int) -> tuple[float, int]:
    """How much better the best shift fits than the present one, and which it is; 0 where none is surely
    better."""
    here = table[:, now + most]
    best, shift = 0.0, now
    for column in range(2 * most + 1):
        difference = table[:, column] - here
        difference = difference[np.isfinite(difference)]
        if len(difference) < min(3, len(table)) or column == now + most:
            continue
        gain = float(difference.mean())
        error = float(difference.std() / np.sqrt(len(difference)))
        sure = gain > _LEAST_GAIN and gain > _ERRORS * error and (difference > 0).mean() >= _AGREEING
        if sure and gain > best:
            best, shift = gain, column - most
    return best, shift


def _is_time(
    moments: Sequence[Moment],
    members: Sequence[int],
    i: int,
    view_of: Callable[[int, int], View | None],
    now: int,
    shift: int,
) -> bool:
    """Whether another moment explains more than a small shift of the camera's picture does."""
    steps = range(-_SHIFT_PX, _SHIFT_PX + 1)
    scores: dict[tuple[int, int, int], list[float]] = {}
    for moment in moments:
        covered = moment.rest_mask(members, i)
        views = {at: view_of(i, moment.k + at) for at in (now, shift)}
        if covered is None or None in views.values():
            continue
        for down in steps:
            for right in steps:
                moved = np.roll(covered, (down, right), axis=(0, 1))
                for at, view in views.items():
                    assert view is not None
                    fit = fit_of_mask(moved, view)
                    scores.setdefault((at, down, right), []).append(fit.iou - fit.surplus)
    best = {at: max((float(np.mean(v)) for key, v in scores.items() if key[0] == at), default=0.0)
            for at in (now, shift)}  # fmt: skip
    return best[shift] - best[now] > _LEAST_GAIN


def _judged(table: Float[np.ndarray, "m s"], most: int, sure: tuple[float, int]) -> TimeOffset:
    counted = np.isfinite(table).sum(axis=0)
    fit = np.where(counted > 0, np.nansum(table, axis=0) / np.maximum(counted, 1), np.nan)
    curve = tuple((s - most, float(f)) for s, f in enumerate(fit) if np.isfinite(f))
    gain, shift = sure
    place = shift + most
    # Only moments that have all of them: other moments fit better or worse as a whole.
    around = [p for p in range(place - 2, place + 3) if 0 <= p <= 2 * most]
    whole = table[np.isfinite(table[:, around]).all(axis=1)][:, around]
    if not len(whole):
        return TimeOffset(None, 0.0, curve)
    mean = dict(zip(around, whole.mean(axis=0), strict=True))
    top = mean[place]
    fall = top - float(np.mean([mean[p] for p in around if abs(p - place) == 2]))
    if fall < _LEAST_FALL:
        return TimeOffset(None, 0.0, curve)
    fraction = 0.0
    if place - 1 in mean and place + 1 in mean:
        left, right = mean[place - 1], mean[place + 1]
        fraction = 0.5 * (right - left) / max(top - min(left, right), 1e-9)
    first = table[:, most]
    total = float(np.nanmean(table[:, place] - first)) if np.isfinite(table[:, place] - first).any() else gain
    return TimeOffset(round(shift + float(np.clip(fraction, -0.5, 0.5)), 1), total, curve)
