"""Findings about a camera's moments: late or early, hung, or silent where it should see the person."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from capture.camera import Camera
from capture.finding import Finding, FindingKind
from capture.frame_facts import FrameFacts
from capture.still_pictures import FrozenRun
from hull.reference import Moment, moment_of
from hull.time_offsets import TimeOffset

# A camera that gives nothing in this share of the frames, where it should see the person, is dead.
_ABSENT_SHARE, _FEWEST_ABSENT, _N_ASKED, _SEEN_SHARE = 0.05, 3, 6, 0.5
# Of those frames it should see the person in so many: if it does at other times, and if it never does.
_MOSTLY, _SOMETIMES = 0.75, 0.3


def late_cameras(
    facts: FrameFacts,
    offsets: dict[int, TimeOffset],
    runs: Sequence[FrozenRun],
    named: set[int],
    asked: Sequence[int],
) -> list[Finding]:
    """Cameras that show another moment than the others, if nothing else is wrong with them (`named`)."""
    found = []
    step = facts.usual_step
    for i in asked:
        offset = offsets.get(i)
        if i in named or offset is None or not offset.is_off or len(asked) < 3:
            continue
        assert offset.frames is not None
        n = round(offset.frames)
        inner = [run for run in runs if run.camera_idx == i and not _at_end(facts, run)]
        longest = max((len(run) - 1 for run in inner), default=0)
        if longest > abs(n):
            # A camera that hung shows other moments than it should for that reason.
            continue
        late = "late" if n > 0 else "early"
        found.append(
            Finding(
                FindingKind.UNSYNCHRONISED,
                (facts.rig.names[i],),
                f"it is {abs(n) * step} frame{'s' * (abs(n) * step != 1)} {late}: its frame t "
                f"{'+' if n > 0 else '-'} {abs(n) * step} shows what the others show at t",
                f"renumber its frames by {-n * step:+d}",
                numbers={"offset_frames": n * step},
            )
        )
    return found


def _at_end(facts: FrameFacts, run: FrozenRun) -> bool:
    return run.first == 0 or run.last == len(facts.frame_ids) - 1


def frozen_cameras(
    facts: FrameFacts, runs: Sequence[FrozenRun], offsets: dict[int, TimeOffset], named: set[int]
) -> list[Finding]:
    """Cameras that repeat a picture; not the one picture that a late camera (`named`) fills its gap with."""
    found = []
    for i in sorted({run.camera_idx for run in runs}):
        mine = [run for run in runs if run.camera_idx == i]
        if i in named:
            offset = offsets.get(i)
            n = 0 if offset is None or offset.frames is None else abs(round(offset.frames))
            # A late camera whose first picture stands in for those that it has not got; the offset may be
            # a frame off.
            mine = [run for run in mine if not (_at_end(facts, run) and len(run) - 1 <= n + 1)]
        if not mine:
            continue
        n_repeats = sum(len(run) - 1 for run in mine)
        stretches = ", ".join(
            f"{facts.frame_ids[run.first]} to {facts.frame_ids[run.last]}" for run in mine[:4]
        ) + ", ..." * (len(mine) > 4)
        found.append(
            Finding(
                FindingKind.STALE,
                (facts.rig.names[i],),
                f"it repeats one picture while the others move (frames {stretches})",
                "copy these frames from the camera again, or delete them (a missing picture does no harm)",
                numbers={"frames": n_repeats},
            )
        )
    return found


def silent_cameras(
    facts: FrameFacts,
    moments: Sequence[Moment],
    good: Sequence[int],
    offsets: dict[int, TimeOffset],
) -> list[Finding]:
    """Cameras without a silhouette in frames in which they should show the person."""
    found = []
    n_frames = len(facts.frame_ids)
    for i in range(len(facts.rig)):
        absent = np.flatnonzero(_absent(facts, i, offsets.get(i)))
        if len(absent) < max(_FEWEST_ABSENT, _ABSENT_SHARE * n_frames) and len(absent) < n_frames:
            continue
        others = [j for j in good if j != i]
        asked = absent[np.linspace(0, len(absent) - 1, min(_N_ASKED, len(absent))).astype(int)]
        expected = [
            _would_see(moments[0].cameras, facts, others, i, int(k)) for k in np.unique(asked) if moments
        ]
        told = [share for share in expected if share is not None]
        if len(absent) == n_frames and not told:
            share = 1.0
        elif not told:
            continue
        else:
            share = float(np.mean([value > _SEEN_SHARE for value in told]))
        always = len(absent) == n_frames
        # Who walks about is out of sight at times; a camera that never shows them has no such excuse.
        if share < (_SOMETIMES if always else _MOSTLY):
            continue
        where = (
            "in none of the frames looked at"
            if always
            else f"not in {len(absent)} of {n_frames} frames (first {facts.frame_ids[absent[0]]})"
        )
        found.append(
            Finding(
                FindingKind.DEAD,
                (facts.rig.names[i],),
                f"it shows the person {where}, though it should" if told else f"it shows a person {where}",
                "look at its files and cable, and leave it out"
                if always
                else "look at its pictures there; frames without one do no harm but few witnesses",
                numbers={"frames": len(absent)},
            )
        )
    return found


def _absent(facts: FrameFacts, i: int, offset: TimeOffset | None) -> Bool[np.ndarray, " t"]:
    """(T,) frames without a silhouette, but for those that a camera which is late or early cannot have."""
    absent = ~facts.present[i]
    if offset is not None and offset.is_off and offset.frames is not None:
        n = round(offset.frames)
        beyond = slice(0, n) if n > 0 else slice(len(absent) + n, None)
        absent[beyond] = False
    return absent


def _would_see(
    cameras: Sequence[Camera], facts: FrameFacts, others: Sequence[int], i: int, k: int
) -> float | None:
    """The share of the others' hull that lies in camera i's picture; None without a hull."""
    moment = moment_of(k, cameras, [facts.mask(j, k) if j in others else None for j in range(len(cameras))])
    if moment is None:
        return None
    hull = moment.hull(others)
    return None if hull is None else hull.share_in_picture(cameras[i])
