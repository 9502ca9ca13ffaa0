"""In which order the frames of a sequence are aligned: the surest first, then both ways in time from it.

Finding a pose with no help fails most easily where the body is folded up; from a pose that stands clear, its
neighbours follow. So a few frames spread over the sequence are tried, and the one whose best hypothesis is
good and far better than any that faces another way comes first. The choice depends on the scans alone, so
that a run that goes on after a stop walks the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fit.coarse import CoarsePose, CoarseScan
from fit.initialise import OTHER_HEADING, PoseFinder, heading_difference
from hull.scan import Scan

#: A frame is tried for so many of the sequence, and at most so many in all: each costs half a second.
FRAMES_A_TRY, MOST_TRIED = 6, 5
#: A hypothesis that is this many times better than all that face another way is as sure as can be.
CLEAR = 1.25

Keypoints = Float[np.ndarray, "25 4"]


@dataclass(frozen=True)
class FirstFrame:
    """Where to begin: its place in the sequence, and the hypotheses that were found on the way (none from
    keypoints)."""

    frame_idx: int
    hypotheses: tuple[CoarsePose, ...] = ()


def tried_frames(n_frames: int) -> list[int]:
    """Places of the frames that are tried, even over the sequence."""
    n_tries = min(MOST_TRIED, 1 + n_frames // FRAMES_A_TRY)
    return [int((k + 0.5) * n_frames / n_tries) for k in range(n_tries)]


def doubt(hypotheses: Sequence[CoarsePose]) -> float:
    """How doubtful a frame's best hypothesis is, m: its score, less where those facing another way are far
    worse."""
    best = min(hypotheses, key=lambda at: at.score)
    rivals = [at.score for at in hypotheses if heading_difference(at, best) > OTHER_HEADING]
    margin = min(rivals, default=np.inf) / max(best.score, 1e-9)
    return float(best.score / min(margin, CLEAR))


def surest_frame(finder: PoseFinder, frames: Sequence[tuple[int, Scan, Keypoints | None]]) -> FirstFrame:
    """The frame to begin with. Where keypoints help, the best of those that have them."""
    usable = [k for k, (_, scan, _) in enumerate(frames) if is_finite(scan)]
    if not usable:
        return FirstFrame(0)
    helped = [k for k in usable if _has_keypoints(frames[k][2])]
    candidates = helped or usable
    chosen = [candidates[k] for k in tried_frames(len(candidates))]
    if len(chosen) == 1:
        return FirstFrame(chosen[0])
    best, least = FirstFrame(chosen[0]), np.inf
    for k in chosen:
        _, scan, keypoints = frames[k]
        coarse = CoarseScan.of(scan.points, scan.normals, weight=scan.weight)
        found = None if keypoints is None else finder.from_keypoints(coarse, keypoints)
        hypotheses = [found] if found is not None else finder.search(coarse)
        doubtful = doubt(hypotheses)
        if doubtful < least:
            best, least = FirstFrame(k, () if found is not None else tuple(hypotheses)), doubtful
    return best


def both_ways(n_frames: int, first: int) -> tuple[range, range]:
    """Places in the order of alignment: from the first to the end, then from before the first to the
    beginning."""
    return range(first, n_frames), range(first - 1, -1, -1)


def is_finite(scan: Scan) -> bool:
    """Whether there is nothing but numbers in a scan."""
    return bool(np.isfinite(scan.points).all() and np.isfinite(scan.normals).all())


def _has_keypoints(keypoints: Keypoints | None) -> bool:
    return keypoints is not None and bool(np.isfinite(keypoints).all(axis=1).sum() >= 8)
