"""Pictures that do not change while the other cameras' do: a camera that hangs and repeats itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from capture.frame_facts import FrameFacts

# Nothing changes where not even this share of what changes in the typical other camera does, while that is
# at least such a share of the person's area. So many repeats in a row are no accident.
_SHARE, _LEAST_MOVE, _LEAST_RUN = 0.02, 0.003, 3


@dataclass(frozen=True)
class FrozenRun:
    """Frames (places first to last, inclusive) of one camera that all show the same picture."""

    camera_idx: int
    first: int
    last: int

    def __len__(self) -> int:
        return self.last - self.first + 1


def frozen_runs(facts: FrameFacts) -> list[FrozenRun]:
    """Every stretch in which one camera repeats its picture and the others do not."""
    found = []
    n_cameras, n_frames = facts.changed.shape
    for i in range(n_cameras):
        others = np.delete(facts.changed, i, axis=0)
        told = np.isfinite(others).sum(axis=0) >= 2
        typical = np.full(n_frames, np.nan)
        typical[told] = np.nanmedian(others[:, told], axis=0)
        # A person cut by the border may move where the camera does not see it.
        whole = ~facts.border[i] | ~facts.present[i]
        with np.errstate(invalid="ignore"):
            still = (facts.changed[i] <= _SHARE * typical) & (typical > _LEAST_MOVE) & whole
            pause = (facts.changed[i] == 0) & ~still & whole
        for first, last in _runs(still, pause):
            found.append(FrozenRun(i, first - 1, last))
    return found


def _runs(still: Bool[np.ndarray, " t"], pause: Bool[np.ndarray, " t"]) -> list[tuple[int, int]]:
    """First and last place of runs of `still`, which may be bridged by `pause`; long ones only."""
    found: list[tuple[int, int]] = []
    first, last, n_still = None, 0, 0
    for k in range(len(still) + 1):
        if k < len(still) and (still[k] or (pause[k] and first is not None)):
            if first is None:
                first, n_still = k, 0
            if still[k]:
                last, n_still = k, n_still + 1
        elif first is not None:
            if n_still >= _LEAST_RUN:
                found.append((first, last))
            first = None
    return found
