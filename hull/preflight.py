"""Which camera is wrong, and how: everything that cameras say about one another, before a run is begun.

In order: who agrees; what is wrong with the whole rig if few do; for each camera that does not fit the hull
of those that agree, which known mistake undone makes it fit (`hull.repairs`), another moment included
(`hull.time_offsets`); who gives nothing where it should see the person; and who repeats its pictures.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from capture.finding import Finding, FindingKind
from capture.frame_facts import FrameFacts
from capture.still_pictures import FrozenRun, frozen_runs
from hull.moments_verdict import frozen_cameras, late_cameras, silent_cameras
from hull.reference import NO_FIT, Fit, Moment, moment_of, normalising_scale, turned
from hull.repairs import Repair, best_for_rig, camera_repairs, fits_with_pictures_of, likely_for_rig, repaired
from hull.time_offsets import MOST_FRAMES, MaskOf, TimeOffset, time_offsets
from hull.trust import (
    EXPLAINED,
    Trust,
    cut_by,
    fits_without_each,
    mean_fits,
    quick_agreement,
    trusted_cameras,
)

_N_MOMENTS, _N_MOMENTS_LARGE, _LARGE_RIG = 6, 4, 24
# A rig is looked at as a whole where less than this is explained.
_WELL_EXPLAINED = 0.97
# Nothing is wrong with the whole of a rig of which this share agrees.
_MOST = 0.75
# All cameras agree less than this (see `quick_agreement`) only where all of them are wrong.
_HOPELESS = 0.4
# A camera is looked at closely when this share of its silhouette sticks out of the hull of the others, and
# so many times the typical share and a bit.
_SURPLUS, _FACTOR, _BIT = 0.03, 3.0, 0.01
# A mistake undone must lift the fit by so much and leave no more sticking out than this.
_LIFT, _REST = 0.05, 0.05
_FEWEST_TO_JUDGE = 4
# Fewer frames tell no time.
_FEWEST_FRAMES = 6


@dataclass(frozen=True, eq=False)
class Examination:
    """What was found. C cameras.

    Fields
    ------
    findings : in order of cameras.
    members : cameras that agree and that nothing is wrong with.
    trust : of all, as the files stand (or with the whole rig's mistake undone).
    fits : how each camera fits the hull of the others, without what is undone.
    offsets : in frames.
    moments : what was looked at, in metres as far as known; `rig_repair` is done to them.
    rig_repair : the mistake of the whole rig, if there is one.
    doubtful : cameras that fit badly and whose mistake is unknown: the share of the others' silhouettes that
        each forbids.
    """

    findings: tuple[Finding, ...]
    members: tuple[int, ...]
    trust: Trust
    fits: dict[int, Fit]
    offsets: dict[int, TimeOffset]
    moments: tuple[Moment, ...]
    rig_repair: Repair | None
    doubtful: dict[int, float]


def examine(facts: FrameFacts) -> Examination:
    """Everything above, from the masks that were read."""
    runs = frozen_runs(facts)
    frozen = {(run.camera_idx, k) for run in runs for k in range(run.first + 1, run.last + 1)}

    def mask_of(i: int, k: int) -> UInt8[np.ndarray, "_h _w"] | None:
        if not 0 <= k < len(facts.frame_ids) or (i, k) in frozen:
            return None
        return facts.mask(i, k)

    n_cameras = len(facts.rig)
    places = _moments_to_ask(facts, runs)
    masks = {k: [mask_of(i, k) for i in range(n_cameras)] for k in places}
    scale = float(np.median([normalising_scale(tuple(facts.rig), m) for m in masks.values()] or [1.0]))
    cameras = [camera.with_world_scaled(scale) for camera in facts.rig]
    moments = [moment for k in places if (moment := moment_of(k, cameras, masks[k])) is not None]
    asked = [i for i in range(n_cameras) if any(moment.views[i] is not None for moment in moments)]
    findings: list[Finding] = []
    if not moments or len(asked) < 2:
        nobody = Trust((), 1.0, len(asked))
        return Examination(tuple(silent_cameras(facts, [], [], {})), (), nobody, {}, {}, (), None, {})

    rig_repair: Repair | None = None
    better: tuple[Repair, list[Moment], Trust] | None = None
    trust: Trust | None = None
    plain = quick_agreement(moments, asked)
    can_judge = len(asked) >= _FEWEST_TO_JUDGE
    if can_judge and plain < _HOPELESS:
        # To find out who agrees would take long where nearly nobody does.
        likely = likely_for_rig(moments, asked, plain)
        if likely and likely[0][0] > 2 * plain:
            better = best_for_rig(moments, asked, likely, _HOPELESS)
    if better is None:
        trust = trusted_cameras(moments, asked)
        most_agree = trust.surplus < EXPLAINED and len(trust.members) >= _MOST * len(asked)
        if can_judge and trust.score < _WELL_EXPLAINED and not most_agree:
            likely = likely_for_rig(moments, asked, plain)
            better = best_for_rig(moments, asked, likely, trust.score)
    if better is not None:
        rig_repair, moments, trust = better
        findings.append(
            Finding(rig_repair.kind, facts.rig.names, rig_repair.told, rig_repair.action, whole_rig=True)
        )
    assert trust is not None
    fits = mean_fits(fits_without_each(moments, trust.members, asked))
    suspects = _suspects(trust, fits, asked)
    members = [i for i in trust.members if i not in suspects]
    if len(members) < max(3, len(asked) // 2):
        members = list(trust.members)
    offsets: dict[int, TimeOffset] = {}
    if len(facts.frame_ids) >= _FEWEST_FRAMES:
        shown = _turned_masks(mask_of, rig_repair)
        offsets = time_offsets(moments, members, asked, shown, _reach(facts))
    named: set[int] = set()
    if len(asked) >= _FEWEST_TO_JUDGE:
        for finding, those in _explained(facts, moments, members, fits, offsets, suspects, asked):
            findings.append(finding)
            named |= those
    findings += late_cameras(facts, offsets, runs, named, asked)
    named |= {facts.rig.names.index(name) for f in findings if not f.whole_rig for name in f.cameras}
    findings += frozen_cameras(facts, runs, offsets, named)
    good = [i for i in members if i not in named]
    findings += silent_cameras(facts, moments, good, offsets)
    doubtful = {i: cut_by(moments, good, i) for i in suspects if i not in named and i not in good}
    order = {name: n for n, name in enumerate(facts.rig.names)}
    findings.sort(key=lambda f: (not f.whole_rig, order.get(f.cameras[0], 0) if f.cameras else 0))
    return Examination(
        tuple(findings), tuple(good), trust, fits, offsets, tuple(moments), rig_repair, doubtful
    )


def _reach(facts: FrameFacts) -> int:
    return int(np.clip(len(facts.frame_ids) // 2 - 1, 1, MOST_FRAMES))


def _turned_masks(mask_of: MaskOf, repair: Repair | None) -> MaskOf:
    """Masks as the repair of the whole rig leaves them."""
    way = None if repair is None else repair.turn
    if way is None:
        return mask_of

    def turned_mask_of(i: int, k: int) -> UInt8[np.ndarray, "_h _w"] | None:
        mask = mask_of(i, k)
        return None if mask is None else turned(mask, way)

    return turned_mask_of


def _moments_to_ask(facts: FrameFacts, runs: Sequence[FrozenRun]) -> list[int]:
    """Places of frames, spread, that most cameras show."""
    n_frames = len(facts.frame_ids)
    n = _N_MOMENTS if len(facts.rig) < _LARGE_RIG else _N_MOMENTS_LARGE
    shown = facts.present.sum(axis=0).astype(float)
    shown += 0.5 * (facts.present & ~facts.border).sum(axis=0)
    for run in runs:
        shown[run.first + 1 : run.last + 1] -= 0.5
    # Other moments must be there on both sides of it.
    margin = min(MOST_FRAMES, n_frames // 4)
    edges = np.linspace(margin, n_frames - margin, min(n, n_frames) + 1)
    places = []
    for first, end in itertools.pairwise(edges):
        within = np.arange(int(np.floor(first)), max(int(np.ceil(end)), int(np.floor(first)) + 1))
        within = within[within < n_frames]
        if len(within):
            # The middle one among the best.
            best = within[shown[within] >= shown[within].max() - 1e-9]
            places.append(int(best[len(best) // 2]))
    return sorted(set(places))


def _suspects(trust: Trust, fits: dict[int, Fit], asked: Sequence[int]) -> list[int]:
    """Cameras that do not fit the hull of those that agree."""
    surplus = [fits[i].surplus for i in trust.members if i in fits]
    limit = max(_SURPLUS, _FACTOR * float(np.median(surplus or [0.0])) + _BIT)
    return [i for i in asked if i not in trust.members or fits.get(i, NO_FIT).surplus > limit]


@dataclass(frozen=True)
class _Candidate:
    kind: FindingKind
    score: float
    repair: Repair | None = None
    other: int | None = None


def _explained(
    facts: FrameFacts,
    moments: Sequence[Moment],
    members: Sequence[int],
    fits: dict[int, Fit],
    offsets: dict[int, TimeOffset],
    suspects: Sequence[int],
    asked: Sequence[int],
) -> list[tuple[Finding, set[int]]]:
    """Findings for cameras that one known mistake explains, and who they are of."""
    names = facts.rig.names
    typical = float(np.median([fits[i].surplus for i in members if i in fits] or [0.0]))
    limit = max(_REST, _FACTOR * typical + 0.02)
    best: dict[int, _Candidate] = {}
    for i in suspects:
        now = fits.get(i, NO_FIT)
        candidates = [
            _Candidate(each.repair.kind, each.score, each.repair)
            for each in repaired(moments, members, i, camera_repairs())
            if each.fit.surplus <= limit
        ]
        others = [j for j in asked if j != i]
        for j, fit in fits_with_pictures_of(moments, members, i, others).items():
            if fit.surplus <= limit and j in suspects:
                candidates.append(_Candidate(FindingKind.SWAPPED, fit.iou - fit.surplus, other=j))
        offset = offsets.get(i)
        if offset is not None and offset.is_off:
            candidates.append(_Candidate(FindingKind.UNSYNCHRONISED, now.iou - now.surplus + offset.gain))
        if not candidates:
            continue
        found = max(candidates, key=lambda each: each.score)
        if found.score > now.iou - now.surplus + _LIFT:
            best[i] = found
    told: list[tuple[Finding, set[int]]] = []
    done: set[int] = set()
    for i, found in best.items():
        if i in done or found.kind is FindingKind.UNSYNCHRONISED:
            continue
        if found.kind is FindingKind.SWAPPED:
            group = _circle(best, i)
            if len(group) < 2:
                continue
            done |= set(group)
            listed = tuple(names[j] for j in sorted(group))
            shows = ", ".join(f"{names[j]} stands where {names[best[j].other or 0]} films" for j in group)
            told.append(
                (
                    Finding(
                        FindingKind.SWAPPED,
                        listed,
                        f"the calibrations (or the pictures) of these cameras are exchanged ({shows})",
                        "exchange them back",
                    ),
                    set(group),
                )
            )
            continue
        assert found.repair is not None
        done.add(i)
        numbers = {} if found.repair.number is None else {"ratio": found.repair.number}
        told.append(
            (
                Finding(found.kind, (names[i],), found.repair.told, found.repair.action, numbers=numbers),
                {i},
            )
        )
    return told


def _circle(best: dict[int, _Candidate], start: int) -> list[int]:
    """Cameras that show one another's pictures in turn, from `start` back to it; empty if they do not."""
    group, at = [start], best[start].other
    while at is not None and at != start and at in best and at not in group:
        if best[at].kind is not FindingKind.SWAPPED:
            return []
        group.append(at)
        at = best[at].other
    return group if at == start else []
