"""A rig refined from what a recording holds: silhouettes, and keypoints where there are any.

Coarse to fine: the outermost touching planes of all pairs of cameras (and the keypoints) bring a rig that is
a degree off to within about a pixel; then planes that touch anywhere are paired, several times, as the
pairing gets surer. A camera that keeps contradicting the others (it shows another moment, or it
is not the camera that it is said to be) is left as it was and told, and does not move the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from capture.keypoint_adjustment import Detections, KeypointTerm
from capture.rig import Rig
from capture.rig_adjustment import AdjustmentSettings, RigPose, Term, adjusted, noise_px
from hull.errors import HullError
from hull.tangency import InnerTangency, OuterTangency
from hull.touching_planes import OutlineFrame

# A camera contradicts the others if its median residual is so many times the usual one, and so large
# (outlines, keypoints)...
_FACTOR, _LEAST_PX = 4.0, (3.0, 12.0)
# ... or smaller, while its large residuals (a fifth of them) stand out too: one that shows another moment
# is turned until the trunk fits, and the limbs do not; outlines that are merely ragged leave no such
# residuals.
_LARGE_FACTOR, _LARGE_PX, _SMALLER = 6.0, (4.0, 30.0), 0.27
_LARGE_PERCENTILE = 80
# At most this share of the cameras may, else nobody can tell who is right.
_MOST_OUT = 1 / 3
_FEWEST = 3
# Planes are paired when nearer than so many times the noise, within these pixels; so many times over.
_REACH, _LEAST_REACH_PX, _MOST_REACH_PX, _ROUNDS = 4.0, 2.0, 6.0, 4
_FINE = AdjustmentSettings(least_scale_px=0.5)
# Numbers that a rig is judged by may not get worse by more than this.
_IOU_SLACK, _PX_SLACK = 0.003, 1.02


@dataclass(frozen=True, eq=False)
class Evidence:
    """What some frames of a recording say of its rig.

    outlines : of each frame. people : (C 25 3) of each frame with keypoints, see `Detections.of_frames`.
    """

    outlines: tuple[OutlineFrame, ...]
    people: tuple[Float[np.ndarray, "c j 3"], ...]

    def cameras(self, n_cameras: int) -> Bool[np.ndarray, " c"]:
        """Which cameras show anything."""
        seen = np.zeros(n_cameras, bool)
        for frame in self.outlines:
            seen |= [outline is not None for outline in frame.outlines]
        for people in self.people:
            seen |= (people[..., 2] > 0).any(axis=1)
        return seen


@dataclass(frozen=True, eq=False)
class Refinement:
    """pose : of all cameras, those left as they were included. moved : (C,) which were refined.
    left : for each of the others a sentence on why not."""

    pose: RigPose
    moved: Bool[np.ndarray, " c"]
    left: dict[int, str]


@dataclass(frozen=True, eq=False)
class RigScore:
    """How well a rig agrees with frames that it was not refined with; each (C,), NaN where nothing is known.

    outline_px : median residual of the outermost touching planes that the camera is part of.
    keypoint_px : median distance of its detections to the triangulated joints.
    iou : with the hull of the other cameras, mean over frames.
    outlines_px, keypoints_px : medians over all residuals.
    """

    outline_px: Float[np.ndarray, " c"]
    keypoint_px: Float[np.ndarray, " c"]
    iou: Float[np.ndarray, " c"]
    outlines_px: float
    keypoints_px: float

    @property
    def mean_iou(self) -> float:
        return float(np.nanmean(self.iou)) if np.isfinite(self.iou).any() else float("nan")

    def better_than(self, other: RigScore) -> bool:
        """Whether this rig agrees better in its main number (keypoints, else outlines), and the hull of the
        others does not agree worse."""
        if self.mean_iou < other.mean_iou - _IOU_SLACK:
            return False
        if np.isfinite(self.keypoints_px):
            if self.keypoints_px > _PX_SLACK * other.keypoints_px:
                return False
            return self.keypoints_px < other.keypoints_px or self.mean_iou > other.mean_iou
        return self.outlines_px < other.outlines_px


def refine_pose(rig: Rig, evidence: Evidence, *, focal: bool = False) -> Refinement:
    """The rig moved until the evidence agrees.

    rig : pinholes, metres. focal : focal lengths too. Raises HullError where too few cameras show anything.
    """
    given = RigPose.of(rig)
    seen = evidence.cameras(len(rig))
    n_needed = 2 if evidence.people else _FEWEST
    if seen.sum() < n_needed:
        names = ", ".join(np.array(rig.names)[seen]) or "none"
        raise HullError(
            f"{int(seen.sum())} of {len(rig)} cameras show anybody in the frames chosen ({names}); refining "
            f"needs {n_needed}: choose other frames with --frames, or mend the silhouettes"
        )
    left = {int(k): "shows nobody in the frames chosen; left as it was" for k in np.flatnonzero(~seen)}
    use = seen.copy()
    pose, badness = _coarse(given, evidence, use, focal)
    while badness.max() > 1:
        worst = int(np.argmax(badness))
        if seen.sum() - use.sum() + 1 > _MOST_OUT * seen.sum() or use.sum() <= _FEWEST:
            break
        use[worst] = False
        pose, badness = _coarse(given, evidence, use, focal)
    for camera_idx in np.flatnonzero(seen & ~use).tolist():
        back = use.copy()
        back[camera_idx] = True
        alone = np.arange(len(rig)) == camera_idx
        tried, badness = _coarse(given, evidence, back, focal, free=alone, start=_with(pose, given, alone))
        if badness[camera_idx] <= 1:
            use, pose = back, tried
            continue
        large = [_by_camera(term, tried, len(rig))[1][camera_idx] for term in _terms(evidence, back)]
        left[camera_idx] = (
            f"contradicts the others by {np.nanmax(large):.0f} px and more, wherever it is turned; left as "
            "it was. Does it show the same moment, and is it the camera that it is said to be?"
        )
    pose = _fine(given, evidence, use, focal, pose)
    pose = _with(pose, given, ~use)
    return Refinement(pose, use, left)


def score_pose(
    rig: Rig, pose: RigPose, evidence: Evidence, use: Bool[np.ndarray, " c"], iou: Float[np.ndarray, " c"]
) -> RigScore:
    """How well a pose agrees with evidence that it was not made from. `use`: whose residuals count. `iou`:
    see `RigScore`."""
    outlines = OuterTangency(evidence.outlines, use).residuals(pose)
    keypoints = KeypointTerm(Detections.of_frames(evidence.people).of_cameras(use)).residuals(pose)
    by_camera, over_all = [], []
    for residuals, cameras in (outlines, keypoints):
        by_camera.append(np.array([_median(residuals[(cameras == k).any(axis=1)]) for k in range(len(rig))]))
        over_all.append(_median(residuals))
    return RigScore(by_camera[0], by_camera[1], iou, over_all[0], over_all[1])


def _median(residuals: Float[np.ndarray, " r"]) -> float:
    return float(np.median(np.abs(residuals))) if residuals.size else float("nan")


def _with(pose: RigPose, other: RigPose, which: Bool[np.ndarray, " c"]) -> RigPose:
    """The pose, with some cameras as they are in another."""
    here = which[:, None, None]
    return RigPose(
        np.where(here, other.intrinsics, pose.intrinsics),
        np.where(here, other.rotations, pose.rotations),
        np.where(which[:, None], other.centres, pose.centres),
    )


def _terms(evidence: Evidence, use: Bool[np.ndarray, " c"]) -> list[Term]:
    keypoints = Detections.of_frames(evidence.people).of_cameras(use)
    terms: list[Term] = [OuterTangency(evidence.outlines, use)]
    return [*terms, KeypointTerm(keypoints)] if keypoints.n_points else terms


def _coarse(
    given: RigPose,
    evidence: Evidence,
    use: Bool[np.ndarray, " c"],
    focal: bool,
    free: Bool[np.ndarray, " c"] | None = None,
    start: RigPose | None = None,
) -> tuple[RigPose, Float[np.ndarray, " c"]]:
    """The pose from what can be paired without a doubt, and how far (C,) each camera's contradiction is
    beyond what is tolerated (1)."""
    terms = _terms(evidence, use)
    pose = adjusted(given, terms, use if free is None else free, focal=focal, start=start)
    return pose, _badness(terms, pose, len(use))


def _badness(terms: Sequence[Term], pose: RigPose, n_cameras: int) -> Float[np.ndarray, " c"]:
    worst = np.zeros(n_cameras)
    for term, least, least_large in zip(terms, _LEAST_PX, _LARGE_PX, strict=False):
        usual, large = _by_camera(term, pose, n_cameras)
        if not np.isfinite(usual).any():
            continue
        beyond = _FACTOR * float(np.nanmedian(usual))
        certain = usual / max(beyond, least)
        likely = usual / max(beyond, _SMALLER * least)
        likely = np.fmin(likely, large / max(_LARGE_FACTOR * float(np.nanmedian(large)), least_large))
        worst = np.fmax(worst, np.fmax(certain, likely))
    return worst


def _by_camera(
    term: Term, pose: RigPose, n_cameras: int
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Median (C,) px of the residuals that speak of a camera, and the size that a fifth of them exceed."""
    residuals, cameras = term.residuals(pose)
    each = [np.abs(residuals[(cameras == k).any(axis=1)]) for k in range(n_cameras)]
    usual, large = np.array(
        [np.percentile(mine, (50, _LARGE_PERCENTILE)) if mine.size else (np.nan, np.nan) for mine in each]
    ).T
    return usual, large


def _fine(
    given: RigPose, evidence: Evidence, use: Bool[np.ndarray, " c"], focal: bool, pose: RigPose
) -> RigPose:
    outer, *keypoints = _terms(evidence, use)
    for _ in range(_ROUNDS):
        residuals, _ = outer.residuals(pose)
        reach = float(np.clip(_REACH * noise_px(residuals, 0.0), _LEAST_REACH_PX, _MOST_REACH_PX))
        inner = InnerTangency(evidence.outlines, use, pose, reach)
        # Bulges on the convex hull are among the inner planes; where there are few others, all planes count.
        outlines = [inner] if len(inner.touches.cameras) > len(residuals) else [inner, outer]
        pose = adjusted(given, [*outlines, *keypoints], use, _FINE, focal=focal, start=pose)
    return pose
