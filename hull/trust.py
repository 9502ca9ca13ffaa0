"""Which cameras agree: those whose common hull explains all their silhouettes, the odd ones left out.

An intersection lacks what any one camera refuses, so a wrong camera makes the silhouettes of *all the others*
stick out of the common hull. The camera without which they stick out least is left out, again and again,
until the rest agrees. Two wrong ones hide each other's effect; then places count that a single camera
refuses (two votes to carve).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hull.reference import NO_FIT, Fit, Moment, fit_of_mask, mean_fit

# Silhouettes that stick out by less than this share are explained.
EXPLAINED = 0.02
# Leaving a camera out must explain this share of what sticks out, and this much of the silhouettes.
_GAIN, _LEAST_GAIN = 0.3, 0.01
# So many cameras are tried a round: those that refuse most of what the others have in common.
_N_TRIED = 10
# Wrong ones that hide each other leave more than this; frames enough to tell.
_HIDDEN, _N_MOMENTS = 0.03, 4


@dataclass(frozen=True)
class Trust:
    """members : cameras (places in the rig) that agree. surplus: mean share of their silhouettes that sticks
    out of their common hull. n_asked: cameras with evidence."""

    members: tuple[int, ...]
    surplus: float
    n_asked: int

    @property
    def score(self) -> float:
        """0 to 1: how much of the rig's silhouettes is explained."""
        return len(self.members) / max(self.n_asked, 1) * (1 - self.surplus)


def trusted_cameras(
    moments: Sequence[Moment], asked: Sequence[int], fewest: int = 3, at_least: float = 0.0
) -> Trust:
    """The cameras among `asked` that agree in these frames; at least half of them, and `fewest`, stay.

    `at_least`: give up as soon as the score cannot be better than that.
    """
    moments = moments[:: max(len(moments) // _N_MOMENTS, 1)]
    members = [i for i in asked if any(moment.views[i] is not None for moment in moments)]
    n_asked = len(members)
    surplus = _surplus(moments, members, 1)
    stop = max(n_asked // 2, fewest, int(at_least * n_asked))
    while surplus > EXPLAINED and len(members) > stop:
        candidates = _refusing(moments, members)
        leaving, least = None, surplus
        for votes in _votes(surplus, len(members)):
            base = surplus if votes == 1 else _surplus(moments, members, votes)
            tried = {i: _surplus(moments, [j for j in members if j != i], votes) for i in candidates}
            best = min(tried, key=lambda i: tried[i])
            if base - tried[best] > max(_GAIN * base, _LEAST_GAIN):
                leaving, least = best, tried[best]
                break
        if leaving is None:
            break
        members.remove(leaving)
        surplus = least if votes == 1 else _surplus(moments, members, 1)
    return Trust(tuple(members), surplus, n_asked)


def _votes(surplus: float, n_members: int) -> tuple[int, ...]:
    if surplus < _HIDDEN:
        return (1,)
    return (1, 2, 3) if n_members > 6 else (1, 2)


def quick_agreement(moments: Sequence[Moment], asked: Sequence[int]) -> float:
    """0 to 1: how well all these cameras fit what all but one or two of them agree on, however many are
    wrong."""
    votes = 1 if len(asked) < 4 else 2 if len(asked) <= 8 else 3
    fits = [
        fit
        for moment in moments[:: max(len(moments) // 2, 1)]
        for fit in moment.fits(moment.hull(asked, votes), asked).values()
    ]
    return mean_fit(fits).iou


def _surplus(moments: Sequence[Moment], members: Sequence[int], votes: int) -> float:
    """Mean over frames and cameras of what sticks out of the members' hull."""
    shares = [
        fit.surplus
        for moment in moments
        for fit in moment.fits(moment.hull(members, votes), members).values()
    ]
    return float(np.mean(shares)) if shares else 1.0


def _refusing(moments: Sequence[Moment], members: Sequence[int]) -> list[int]:
    """Members in the order of how much they refuse of what most have in common, worst first."""
    if len(members) <= _N_TRIED:
        return list(members)
    refused = dict.fromkeys(members, 0.0)
    for moment in moments:
        for i, fit in moment.fits(moment.hull(members, 3), members).items():
            refused[i] += fit.missing + fit.surplus
    return sorted(members, key=lambda i: -refused[i])[:_N_TRIED]


def fits_without_each(
    moments: Sequence[Moment], members: Sequence[int], asked: Sequence[int]
) -> dict[int, list[Fit]]:
    """For each camera asked, how its silhouettes fit the hull of the members without it, a frame each."""
    found: dict[int, list[Fit]] = {i: [] for i in asked}
    for moment in moments:
        for i in asked:
            view = moment.views[i]
            if view is not None:
                covered = moment.rest_mask(members, i)
                found[i].append(NO_FIT if covered is None else fit_of_mask(covered, view))
    return found


def cut_by(moments: Sequence[Moment], members: Sequence[int], i: int) -> float:
    """The share of the members' silhouettes that camera i, which is none of them, forbids: so much more of
    them sticks out of their common hull with it than without."""
    few = moments[:: max(len(moments) // _N_MOMENTS, 1)]
    with_it, without = [], []
    for moment in few:
        if moment.views[i] is None:
            continue
        with_it += [f.surplus for f in moment.fits(moment.hull([*members, i]), members).values()]
        without += [f.surplus for f in moment.fits(moment.hull(members), members).values()]
    return float(np.mean(with_it) - np.mean(without)) if with_it else 0.0


def mean_fits(found: dict[int, list[Fit]]) -> dict[int, Fit]:
    """The mean over frames of `fits_without_each`, for cameras with any."""
    return {i: mean_fit(fits) for i, fits in found.items() if fits}
