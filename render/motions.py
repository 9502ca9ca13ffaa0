"""Motions for synthetic recordings, by name: smooth joint rotations over time, feet kept on the floor.

Each motion is a function of the phase 0..1 that turns a few joints of a standing person; a seed varies its
size and timing and adds the small sway that nobody stands without. The three of the BUFF captures that the
paper reports (tilt and twist, hips, shoulder mill) are here, and others that a hull finds harder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fit.body.skeleton import JOINT, N_JOINTS, PARENTS, axis_angle_to_matrix

Joints = dict[str, tuple[float, float, float]]
"""Axis-angle of some joints (rad, body frame: x the body's left, y up, z front); all others stay at rest."""


@dataclass(frozen=True)
class Motion:
    """A motion before it is put on the floor.

    pose: rad. stance: which ankle stays in place (left, right), sums to 1.
    """

    name: str
    pose: Float[np.ndarray, "t j 3"]
    stance: Float[np.ndarray, "t 2"]


@dataclass(frozen=True)
class _Moment:
    joints: Joints
    stance: tuple[float, float] = (0.5, 0.5)


def _both(name: str, x: float, y: float, z: float) -> Joints:
    """The same turn on both sides, mirrored at the body's plane x = 0."""
    return {f"left_{name}": (x, y, z), f"right_{name}": (x, -y, -z)}


def _arms(down: float, elbow: float = 0.25) -> Joints:
    """Arms hanging (`down` rad below the T-pose), elbows a little bent."""
    return {
        **_both("collar", 0.0, 0.0, -0.1 * down),
        **_both("shoulder", 0.0, 0.0, -0.9 * down),
        **_both("elbow", 0.0, -elbow, 0.0),
    }


def _wave(phase: float) -> float:
    """0 -> 1 -> 0 over a period, at rest at the ends."""
    return 0.5 - 0.5 * np.cos(2 * np.pi * phase)


def _ease(phase: float) -> float:
    """0 -> 1, at rest at both ends."""
    phase = min(max(phase, 0.0), 1.0)
    return phase * phase * (3 - 2 * phase)


def _softly_above(value: float, low: float) -> float:
    """max(value, low) with its corner rounded: joints have no jerk."""
    return low + 0.5 * (value - low + float(np.hypot(value - low, 0.3)))


def _tilt_twist(phase: float, size: float) -> _Moment:
    """Leans forward and sideways while the trunk turns left, arms half out."""
    lean, turn = size * _wave(phase), size * np.sin(2 * np.pi * phase)
    trunk = {f"spine{i}": (0.22 * lean, 0.22 * turn, 0.09 * turn) for i in (1, 2, 3)}
    return _Moment(
        {
            **trunk,
            **_arms(0.75 - 0.25 * lean, 0.35),
            **_both("hip", -0.18 * lean, 0.0, 0.1),
            "pelvis": (0.12 * lean, 0.15 * turn, 0.0),
            "neck": (-0.1 * lean, 0.12 * turn, 0.0),
            "head": (-0.1 * lean, 0.15 * turn, 0.0),
            **_both("knee", 0.12 * lean, 0.0, 0.0),
            **_both("ankle", -0.06 * lean, 0.0, -0.1),
        }
    )


def _hips(phase: float, size: float) -> _Moment:
    """The pelvis circles over standing feet; the trunk and the legs turn against it."""
    tip, roll = 0.2 * size * np.cos(2 * np.pi * phase), 0.2 * size * np.sin(2 * np.pi * phase)
    spine = {f"spine{i}": (-0.36 * tip, 0.0, -0.36 * roll) for i in (1, 2, 3)}
    bend = 0.28 + 0.08 * np.cos(2 * np.pi * phase)
    return _Moment(
        {
            "pelvis": (tip, 0.12 * roll, roll),
            **spine,
            "left_hip": (-tip - 0.5 * bend, 0.15, -1.35 * roll + 0.16),
            "right_hip": (-tip - 0.5 * bend, -0.15, -1.35 * roll - 0.16),
            **_both("knee", bend, 0.0, 0.0),
            "left_ankle": (-0.5 * bend, 0.0, 0.35 * roll - 0.16),
            "right_ankle": (-0.5 * bend, 0.0, 0.35 * roll + 0.16),
            # hands on the hips
            **_both("collar", 0.0, 0.0, -0.05),
            **_both("shoulder", 0.55, 0.35, -0.85),
            **_both("elbow", 0.0, -1.35, 0.35),
        }
    )


def _shoulders_mill(phase: float, size: float) -> _Moment:
    """Both arms circle, half a turn apart, as in a swimmer's warming up."""
    joints: Joints = {"spine3": (0.03, 0.15 * np.sin(2 * np.pi * phase), 0.0), **_both("hip", 0.0, 0.0, 0.08)}
    joints |= _both("ankle", 0.0, 0.0, -0.08)
    for side, sign, shift in (("left", 1.0, 0.0), ("right", -1.0, 0.5)):
        angle = 2 * np.pi * (phase + shift)
        lift = -0.45 + 0.85 * size * np.sin(angle)
        swing = 0.8 * size * np.cos(angle)
        joints[f"{side}_collar"] = (0.0, -0.12 * sign * swing, 0.22 * sign * _softly_above(lift, -0.3))
        joints[f"{side}_shoulder"] = (0.0, -0.7 * sign * swing, 0.85 * sign * lift)
        joints[f"{side}_elbow"] = (0.0, -sign * (0.45 - 0.2 * np.sin(angle)), 0.0)
    return _Moment(joints)


def _walk(phase: float, size: float) -> _Moment:
    """One double step forward."""
    joints: Joints = {}
    for side, sign, shift in (("left", 1.0, 0.0), ("right", -1.0, 0.5)):
        angle = 2 * np.pi * (phase + shift)
        forward = np.cos(angle)  # +1: this leg is in front
        swinging = max(0.0, -np.sin(angle))  # coming forward through the air
        joints[f"{side}_hip"] = (-0.42 * size * forward - 0.25 * swinging + 0.04, 0.0, 0.02 * sign)
        knee = 0.10 + 0.16 * max(0.0, np.sin(angle)) + 0.95 * size * swinging**1.5
        joints[f"{side}_knee"] = (knee, 0.0, 0.0)
        joints[f"{side}_ankle"] = (0.16 * forward - 0.12 + 0.1 * swinging, 0.0, -0.02 * sign)
        joints[f"{side}_foot"] = (-0.28 * max(0.0, -forward) * max(0.0, np.sin(angle) + 0.5), 0.0, 0.0)
        swing = -forward  # arms against the legs
        joints[f"{side}_collar"] = (0.0, -0.06 * sign * swing, -0.1 * sign)
        joints[f"{side}_shoulder"] = (-0.48 * size * swing, -0.12 * sign, -1.12 * sign)
        joints[f"{side}_elbow"] = (0.0, -sign * (0.35 + 0.25 * max(0.0, swing)), 0.0)
    turn = 0.1 * size * np.cos(2 * np.pi * phase)
    joints |= {"pelvis": (0.03, -turn, 0.0), "spine1": (0.02, 0.5 * turn, 0.0), "spine2": (0.02, turn, 0.0)}
    joints |= {"spine3": (0.0, 0.5 * turn, 0.0), "head": (0.0, -0.5 * turn, 0.0)}
    # the weight passes from foot to foot where both are on the ground
    left = float(np.clip(0.5 + 2.5 * np.sin(2 * np.pi * phase), 0.0, 1.0))
    return _Moment(joints, (left, 1.0 - left))


def _squat(phase: float, size: float) -> _Moment:
    """Down and up, heels on the ground, arms forward for balance."""
    down = min(size, 1.1) * _wave(phase)
    return _Moment(
        {
            **_both("hip", -1.45 * down, 0.22 * down, 0.1 + 0.22 * down),
            **_both("knee", 1.75 * down, 0.0, 0.0),
            **_both("ankle", -0.62 * down, 0.0, -0.1 - 0.12 * down),
            "pelvis": (0.35 * down, 0.0, 0.0),
            **{f"spine{i}": (0.1 * down, 0.0, 0.0) for i in (1, 2, 3)},
            "head": (-0.25 * down, 0.0, 0.0),
            **_both("collar", 0.0, -0.12 * down, -0.1 + 0.08 * down),
            **_both("shoulder", 0.0, -1.05 * down, -1.05 + 0.85 * down),
            **_both("elbow", 0.0, -0.25, 0.0),
        }
    )


def _lunge(phase: float, size: float) -> _Moment:
    """The left leg steps far forward and bends, and comes back; the arms go with the trunk."""
    down = min(size, 1.1) * _wave(phase)
    return _Moment(
        {
            "left_hip": (-1.05 * down, 0.05, 0.06),
            "left_knee": (1.12 * down + 0.05, 0.0, 0.0),
            "left_ankle": (-0.15 * down, 0.0, -0.06),
            "right_hip": (0.32 * down, -0.05, -0.06),
            "right_knee": (0.62 * down + 0.05, 0.0, 0.0),
            "right_ankle": (-0.30 * down, 0.0, 0.06),
            "right_foot": (-0.55 * down, 0.0, 0.0),
            "pelvis": (0.08 * down, 0.0, 0.0),
            "spine1": (0.06 * down, 0.1 * down, 0.0),
            "spine3": (0.04 * down, 0.12 * down, 0.0),
            **_both("collar", 0.0, 0.0, -0.1),
            "left_shoulder": (0.35 * down, -0.15, -1.1 + 0.25 * down),
            "right_shoulder": (-0.55 * down, 0.15, 1.1 - 0.2 * down),
            **_both("elbow", 0.0, -0.3 - 0.5 * down, 0.0),
        },
        (0.0, 1.0),
    )


def _a_t_u(phase: float, size: float) -> _Moment:
    """Arms from an A over a T to a U, one slow raise."""
    up = _ease(phase)
    lift = -0.95 + up * (1.75 * min(size, 1.1))
    return _Moment(
        {
            **_both("collar", 0.0, 0.0, 0.18 * lift + 0.05 * up),
            **_both("shoulder", 0.0, 0.0, 0.82 * lift),
            **_both("elbow", 0.0, -0.25 * (1 - up), 0.9 * up**3),
            **_both("hip", 0.0, 0.0, 0.1),
            **_both("ankle", 0.0, 0.0, -0.1),
        }
    )


MOTIONS: dict[str, Callable[[float, float], _Moment]] = {
    "tilt-twist": _tilt_twist,
    "hips": _hips,
    "shoulders-mill": _shoulders_mill,
    "walk": _walk,
    "squat": _squat,
    "lunge": _lunge,
    "a-t-u": _a_t_u,
}
"""Every motion by its name on the command line."""


def make_motion(name: str, n_frames: int, seed: int = 0) -> Motion:
    """The named motion in `n_frames` steps, over one period. ValueError for an unknown name or no frames.

    seed: varies the size of the movement (10 %), where in its period it begins (a twentieth), and the sway.
    """
    if name not in MOTIONS:
        raise ValueError(f"no motion is called {name!r}; there are: {', '.join(MOTIONS)}")
    if n_frames < 1:
        raise ValueError(f"a motion of {n_frames} frames: at least 1 is needed")
    rng = np.random.default_rng([seed, 7])
    size, begin = float(rng.uniform(0.9, 1.05)), float(rng.uniform(0.0, 0.05))
    # half a step in: the period's two ends are the same moment, and a first frame at rest tells the least
    phases = begin + (np.arange(n_frames) + 0.5) / n_frames * (1.0 - begin)
    moments = [MOTIONS[name](float(phase), size) for phase in phases]
    pose = np.zeros((n_frames, N_JOINTS, 3))
    for frame_idx, moment in enumerate(moments):
        for joint, turn in moment.joints.items():
            pose[frame_idx, JOINT[joint]] = turn
    return Motion(name, pose + _sway(phases, rng), np.array([m.stance for m in moments]))


def _sway(phases: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "t j 3"]:
    """Slow turns of every joint above the ankles, about 1.5 degrees, and a posture of one's own."""
    scale = np.full(N_JOINTS, 0.025)
    for name in ("pelvis", "left_ankle", "right_ankle", "left_foot", "right_foot", "left_hand", "right_hand"):
        scale[JOINT[name]] = 0.006
    for name in ("left_knee", "right_knee", "left_hip", "right_hip"):
        scale[JOINT[name]] = 0.01
    still = rng.standard_normal((N_JOINTS, 3))
    sine, cosine = rng.standard_normal((2, N_JOINTS, 3)) * 0.7
    angle = 2 * np.pi * phases[:, None, None]
    sway = still + sine * np.sin(angle) + cosine * np.cos(angle)
    return sway * scale[:, None]


def joint_positions(
    pose: Float[np.ndarray, "t j 3"], joints: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, "t j 3"]:
    """Where the joints go (body frame, m) when the pelvis stays in place."""
    out = np.empty((len(pose), len(joints), 3))
    for frame_idx, turns in enumerate(pose):
        turn = axis_angle_to_matrix(turns)
        world = np.empty_like(turn)
        for joint_idx, parent in enumerate(PARENTS):
            if parent < 0:
                world[joint_idx], out[frame_idx, joint_idx] = turn[joint_idx], joints[joint_idx]
            else:
                world[joint_idx] = world[parent] @ turn[joint_idx]
                bone = joints[joint_idx] - joints[parent]
                out[frame_idx, joint_idx] = out[frame_idx, parent] + world[parent] @ bone
    return out


def stance_travel(motion: Motion, joints: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "t 3"]:
    """Horizontal translation (m, body frame, y = 0) that keeps the standing ankle in place, over the film's
    middle.

    The step between two frames undoes what the standing foot would have slid; over the whole film the pelvis
    is on average above the origin, so that a walk stays within the cameras' view. Heights are for the caller,
    who knows the soles.
    """
    places = joint_positions(motion.pose, joints)
    ankles = places[:, [JOINT["left_ankle"], JOINT["right_ankle"]]]
    weight = 0.5 * (motion.stance[1:] + motion.stance[:-1])
    steps = -(weight[:, :, None] * np.diff(ankles, axis=0)).sum(1)
    travel = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])
    travel -= (travel + places[:, 0]).mean(0)
    travel[:, 1] = 0.0
    return travel
