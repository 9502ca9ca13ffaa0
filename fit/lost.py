"""Frames in which the body was lost are told by three signs, from numbers that the alignment has at hand.

How far body and scan keep from each other (energy); how far a joint went since the neighbouring frame
(speed); how much of the scan no part of the body explains, and how much of the body stands out of the scan
(coverage). Each is measured against the sequence's own median, since clothes, cameras and frame rates differ:
loose clothes and hulls of four cameras leave centimetres everywhere, and that is no sign of anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from fit.body.skeleton import JOINT_NAMES
from fit.coarse import LEFT_OUT_M, CoarseBody, CoarsePose, CoarseScan, left_out, score

#: From so many frames on a median says what is usual.
ENOUGH = 4
#: Beyond the median by so many robust deviations is out of line; one frame in thousands would be by chance.
DEVIATIONS = 5.0
#: But never less than this share of the median distance: poses of one person differ by that in themselves.
DISTANCE_SHARE = 0.12
#: An arm from the elbow down is 4 % of a body's surface; half of that hidden is still worth a second try.
LEFT_OUT_SHARE = 0.02
#: A limb that ends in the air is as large; hands and feet alone, which hulls often lack, are 2 % each.
OUTSIDE_SHARE = 0.025
#: Body vertices farther out of the scan than this are no bad silhouette.
OUTSIDE_M = 0.06
#: A joint that goes so many times as far as is usual; people start and stop within a few frames.
STEP_FACTOR = 4.0
#: But a quarter of a metre (a hand at 6 m/s filmed at 25 frames a second) is never remarkable,
STEP_FLOOR_M = 0.25
#: and more than a metre is at any frame rate that shows movement: an arm is not much longer.
STEP_LIMIT_M = 1.0
#: Mean distance of the joints of two poses that are the same pose found twice.
SAME_POSE_M = 0.05


@dataclass(frozen=True)
class Signs:
    """What tells whether a frame's body is in its place.

    distance_m: mean symmetric distance of the coarse body and the scan; left_out: share of the scan far from
    the body; outside: share of the body out of the scan, or where there is none near; joints (J 3), m.
    """

    distance_m: float
    left_out: float
    outside: float
    joints: Float[np.ndarray, "j 3"]

    @staticmethod
    def of(body: CoarseBody, scan: CoarseScan, at: CoarsePose) -> Signs:
        """Read a pose that was aligned to this scan."""
        posed = body.forward(at)
        points = posed.points[: body.n_surface]
        away, nearest = cKDTree(scan.points).query(points)
        out = ((points - scan.points[nearest]) * scan.normals[nearest]).sum(1)
        # Past the end of an open tube (a sleeve without its hand) the nearest normals point aside.
        outside = (out > OUTSIDE_M) | ((away > LEFT_OUT_M) & (out > -OUTSIDE_M))
        return Signs(score(body, scan, at), left_out(body, scan, at), float(outside.mean()), posed.origin)


@dataclass(frozen=True)
class Usual:
    """Median and robust deviation of each sign over frames, and the median step of the fastest joint (m a
    frame); n: of how many frames."""

    n: int
    distance_m: tuple[float, float]
    left_out: tuple[float, float]
    outside: tuple[float, float]
    n_steps: int
    step_m: float

    @staticmethod
    def of(signs: Sequence[Signs], steps_m: Sequence[float]) -> Usual:
        """What is usual in these frames; steps_m: between neighbours among them."""

        def spread(values: list[float]) -> tuple[float, float]:
            if not values:
                return 0.0, 0.0
            median = float(np.median(values))
            return median, 1.4826 * float(np.median(np.abs(np.array(values) - median)))

        return Usual(
            len(signs),
            spread([s.distance_m for s in signs]),
            spread([s.left_out for s in signs]),
            spread([s.outside for s in signs]),
            len(steps_m),
            float(np.median(steps_m)) if len(steps_m) else 0.0,
        )


@dataclass(frozen=True)
class Step:
    """The farthest way of a joint between two frames: metres a frame, and its sentence's parts."""

    metres: float
    joint: str
    since_id: int

    @staticmethod
    def between(
        joints: Float[np.ndarray, "j 3"], others: Float[np.ndarray, "j 3"], since_id: int, n_frames: float
    ) -> Step:
        """n_frames: how far the two are apart, in the sequence's usual spacing."""
        way = np.linalg.norm(joints - others, axis=1) / max(n_frames, 1.0)
        return Step(float(way.max()), JOINT_NAMES[int(way.argmax())].replace("_", " "), since_id)


def is_fast(step: Step | None, usual: Usual) -> bool:
    """Whether a joint moved implausibly far."""
    if step is None:
        return False
    limit = STEP_LIMIT_M
    if usual.n_steps >= ENOUGH:
        limit = min(limit, max(STEP_FACTOR * usual.step_m, STEP_FLOOR_M))
    return step.metres > max(limit, 1.5 * usual.step_m)


def complaints(
    signs: Signs, step: Step | None, usual: Usual, neighbour: Signs | None = None
) -> tuple[str, ...]:
    """What is out of line, a clause each with its number; none where nothing is.

    neighbour: a frame that is trusted; what is no worse than there (somebody carries a bag from here on) is
    not told.
    """
    out = []

    def odd(name: str, floor: float) -> bool:
        value, (median, deviation) = getattr(signs, name), getattr(usual, name)
        there = median if neighbour is None else max(median, getattr(neighbour, name))
        return bool(value > there + max(DEVIATIONS * deviation, floor))

    usually = {name: getattr(usual, name)[0] for name in ("distance_m", "left_out", "outside")}
    if usual.n >= ENOUGH and odd("distance_m", DISTANCE_SHARE * usual.distance_m[0]):
        out.append(
            f"the body keeps {1e3 * signs.distance_m:.0f} mm from the scan, "
            f"{1e3 * usually['distance_m']:.0f} mm is usual"
        )
    if step is not None and is_fast(step, usual):
        before = f", {usual.step_m:.2f} m is usual" if usual.n_steps >= ENOUGH else ""
        out.append(f"the {step.joint} moved {step.metres:.2f} m a frame from {step.since_id:06d}{before}")
    if usual.n and odd("left_out", LEFT_OUT_SHARE):
        out.append(
            f"{100 * signs.left_out:.1f} % of the scan is far from the body, "
            f"{100 * usually['left_out']:.1f} % is usual: a limb may be left out"
        )
    if usual.n and odd("outside", OUTSIDE_SHARE):
        out.append(
            f"{100 * signs.outside:.1f} % of the body stands out of the scan, "
            f"{100 * usually['outside']:.1f} % is usual"
        )
    return tuple(out)


def same_pose(one: Float[np.ndarray, "j 3"], other: Float[np.ndarray, "j 3"]) -> bool:
    """Whether two poses, found from different starts, are one."""
    return bool(np.linalg.norm(one - other, axis=1).mean() < SAME_POSE_M)
