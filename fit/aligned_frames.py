"""The frames of a sequence while they are being aligned: who starts from whom, who is tried again.

Two passes: `align_all` walks from the surest frame both ways and tries a frame at once where it looks lost;
`look_again` measures every frame against the whole sequence and tries the odd ones from both neighbours and
from the hull alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from fit.align import (
    Alignment,
    align_frame,
    as_scan_points,
    distance_complaint,
    mean_distance,
    starting_poses,
)
from fit.coarse import CoarsePose, CoarseScan
from fit.initialise import PoseFinder
from fit.lost import Signs, Step, Usual, complaints, is_fast, same_pose
from fit.sequence_order import both_ways, is_finite, surest_frame
from fit.settings import FitSettings
from fit.solver import Fitter
from fit.state import BodyState
from hull.scan import Scan

Frame = tuple[int, Scan, Float[np.ndarray, "25 4"] | None]
#: Of two poses of a frame the one with the smaller distance is taken; within this share the one that moved
#: less, since a body that faces the other way keeps nearly the same distance.
AS_GOOD = 1.03


@dataclass
class AlignedFrames:
    """Frames, and what is known of them by their place in the sequence."""

    fitter: Fitter
    finder: PoseFinder
    frames: list[Frame]
    settings: FitSettings
    report: Callable[[Alignment], None]
    done_before: Mapping[int, Alignment]
    found: dict[int, Alignment] = field(default_factory=dict)
    signs: dict[int, Signs] = field(default_factory=dict)

    def in_order(self) -> list[Alignment]:
        """The alignments in the frames' order."""
        return [self.found[k] for k in sorted(self.found)]

    def align_all(self) -> None:
        """Every frame, from the surest one to the end and then to the beginning."""
        self.found = {
            k: self.done_before[frame_id]
            for k, (frame_id, _, _) in enumerate(self.frames)
            if frame_id in self.done_before
        }
        if len(self.found) == len(self.frames):
            self.signs = {k: self._known_signs(one) for k, one in self.found.items() if _is_there(one)}
            return
        done, self.found = self.found, {}
        first = surest_frame(self.finder, self.frames)
        for way in both_ways(len(self.frames), first.frame_idx):
            previous: int | None = None
            if self.found and not self._is_lost(first.frame_idx):
                previous = first.frame_idx
            for k in way:
                if k in done:
                    self.found[k] = done[k]
                    if _is_there(done[k]):
                        self.signs[k] = self._known_signs(done[k])
                else:
                    self.found[k] = self._aligned(k, previous, first.hypotheses if not self.found else ())
                    self.report(self.found[k])
                if not self._is_lost(k):
                    previous = k

    def look_again(self) -> None:
        """Try those that are out of line with the whole sequence once more; a sentence where they stay so."""
        usual = self._usual()
        for k in sorted(self.signs):
            before = self.found[k]
            step = self._isolated_step(k)
            told = complaints(self.signs[k], step, usual)
            if before.tried and not before.lost:
                after = _told(before, told if len(told) > 1 or not is_fast(step, usual) else ())
            elif told or before.lost:
                coarse = self._coarse(k)
                starts = [self._carried(k, other, coarse) for other in self._neighbours(k)]
                after = self._best_of(k, coarse, starts, step, usual, lambda k=k: self._isolated_step(k))
            else:
                continue
            self.found[k] = after
            if (after.state is not before.state) or after.message != before.message:
                self.report(after)

    def _aligned(self, k: int, previous: int | None, hypotheses: tuple[CoarsePose, ...]) -> Alignment:
        """One frame of the walk; `previous`: the frame to start from."""
        frame_id, scan, keypoints = self.frames[k]
        try:
            if not is_finite(scan):
                raise FloatingPointError("the scan holds NaN or infinite coordinates")
            coarse = self._coarse(k)
            start, centroid = None, np.zeros(3)
            if previous is not None:
                start, centroid = self._pose(previous), self.frames[previous][1].points.mean(0)
            best_score = min((one.score for one in self.found.values()), default=np.inf)
            starts = starting_poses(self.finder, coarse, keypoints, start, centroid, best_score, hypotheses)
            alignment, signs = self._from(k, coarse, starts)
            self.signs[k], usual = signs, self._usual(without=k)
            step = self._step(k, previous)
            self.found[k] = alignment
            trusted = None if previous is None else self.signs[previous]
            if complaints(signs, step, usual, trusted):
                return self._best_of(k, coarse, [], step, usual, lambda: self._step(k, previous), trusted)
            return alignment
        except (FloatingPointError, np.linalg.LinAlgError) as error:
            self.signs.pop(k, None)
            none = np.zeros(self.finder.n_model_betas)
            rest = BodyState(self.fitter.shaped(none), self.finder.mean_pose(), np.zeros(3), none)
            return Alignment(frame_id, rest, np.inf, np.inf, "failed", f"frame {frame_id:06d}: {error}")

    def _from(self, k: int, coarse: CoarseScan, starts: list[CoarsePose]) -> tuple[Alignment, Signs]:
        """A frame aligned from these starts, and its signs."""
        frame_id, scan, _ = self.frames[k]
        state = align_frame(self.fitter, self.finder, as_scan_points(scan), starts, self.settings)
        distance = mean_distance(self.fitter, self.fitter.posed(state), scan.points)
        signs = Signs.of(self.finder.body, coarse, CoarsePose(state.pose, state.translation, state.betas))
        alignment = Alignment(
            frame_id,
            state,
            starts[0].score,
            distance,
            coarse_m=signs.distance_m,
            left_out=signs.left_out,
            outside=signs.outside,
        )
        return _told(alignment, ()), signs

    def _best_of(
        self,
        k: int,
        coarse: CoarseScan,
        starts: list[CoarsePose],
        step: Step | None,
        usual: Usual,
        step_of: Callable[[], Step | None],
        trusted: Signs | None = None,
    ) -> Alignment:
        """The frame as it is, or as other starts (these, and the hull alone) give it, whichever is better;
        with its complaints where there are any left."""
        kept, kept_signs, kept_step = self.found[k], self.signs[k], step
        anew = self.finder.from_hull(coarse, kept.state.betas)[:2]
        alone: Signs | None = None
        for tried in ([start] for start in [*starts, *anew]):
            try:
                other, signs = self._from(k, coarse, tried)
            except (FloatingPointError, np.linalg.LinAlgError):
                continue
            if tried[0] is anew[0]:
                alone = signs
            self.signs[k] = signs
            other_step = step_of()
            if _is_better(signs, other_step, kept_signs, kept_step):
                kept, kept_signs, kept_step = other, signs, other_step
        self.signs[k] = kept_signs
        left = complaints(kept_signs, kept_step, usual, trusted)
        # Two ways to the same pose: where joints are only fast, or the scan has something that is no body,
        # the pose is right all the same, and neighbours may start from it.
        agreed = alone is not None and same_pose(alone.joints, kept_signs.joints)
        if agreed and len(left) == 1 and is_fast(kept_step, usual):
            left = ()
        return _told(replace(kept, tried=True, lost=bool(left) and not agreed), left)

    # What is known of the frames

    def _coarse(self, k: int) -> CoarseScan:
        scan = self.frames[k][1]
        return CoarseScan.of(scan.points, scan.normals, weight=scan.weight)

    def _pose(self, k: int) -> CoarsePose:
        one = self.found[k]
        return CoarsePose(one.state.pose, one.state.translation, one.state.betas, one.score)

    def _carried(self, k: int, other: int, coarse: CoarseScan) -> CoarsePose:
        """The pose of another frame, brought to this one."""
        return self.finder.from_previous(coarse, self._pose(other), self.frames[other][1].points.mean(0))

    def _is_lost(self, k: int) -> bool:
        return self.found[k].lost or not _is_there(self.found[k])

    def _known_signs(self, one: Alignment) -> Signs:
        state = one.state
        joints = self.finder.body.forward(CoarsePose(state.pose, state.translation, state.betas)).origin
        return Signs(one.coarse_m, one.left_out, one.outside, joints)

    def _neighbours(self, k: int) -> list[int]:
        """The nearest frames before and after whose body was not lost."""
        good = [other for other in self.signs if other != k and not self.found[other].lost]
        before, after = [o for o in good if o < k], [o for o in good if o > k]
        return [*([max(before)] if before else []), *([min(after)] if after else [])]

    def _spacing(self) -> float:
        """Frame numbers between neighbours, usually."""
        ids = [frame_id for frame_id, _, _ in self.frames]
        return float(np.median(np.diff(ids))) if len(ids) > 1 else 1.0

    def _step(self, k: int, other: int | None) -> Step | None:
        """How far the joints are from where they are in another frame."""
        if other is None or other not in self.signs:
            return None
        since = self.frames[other][0]
        n_frames = abs(self.frames[k][0] - since) / self._spacing()
        return Step.between(self.signs[k].joints, self.signs[other].joints, since, n_frames)

    def _isolated_step(self, k: int) -> Step | None:
        """The smaller one of the steps from the neighbours: who is far from both is out of line, who is far
        from one only has a neighbour who is, or jumps."""
        steps = [self._step(k, other) for other in self._neighbours(k)]
        return min((s for s in steps if s is not None), key=lambda s: s.metres, default=None)

    def _usual(self, without: int | None = None) -> Usual:
        known = [k for k in sorted(self.signs) if k != without]
        steps = [self._step(b, a) for a, b in pairwise(known)]
        return Usual.of([self.signs[k] for k in known], [s.metres for s in steps if s is not None])


def _is_there(one: Alignment) -> bool:
    return one.status != "failed"


def _is_better(signs: Signs, step: Step | None, than: Signs, than_step: Step | None) -> bool:
    """Whether the first of two poses of a frame is to be taken."""
    if same_pose(signs.joints, than.joints) and signs.distance_m * AS_GOOD > than.distance_m:
        return False
    if max(signs.distance_m, than.distance_m) > AS_GOOD * min(signs.distance_m, than.distance_m):
        return signs.distance_m < than.distance_m
    if step is None or than_step is None:
        return False
    return step.metres < than_step.metres


def _told(alignment: Alignment, clauses: tuple[str, ...]) -> Alignment:
    """The alignment with its status and sentence."""
    clauses = (*distance_complaint(alignment.distance_m), *clauses)
    if not clauses:
        return replace(alignment, status="ok", message="")
    return replace(
        alignment, status="suspect", message=f"frame {alignment.frame_id:06d}: {'; '.join(clauses)}"
    )
