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

from .limb_angles import STANDING, Turn, ankle_lift, standing_leg, turned_arm

Joints = dict[str, Turn]
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


def _both_arms(shoulder: Turn, axial: float, elbow: float, pronation: float = 0.0) -> Joints:
    """`turned_arm` on both sides."""
    return {
        **turned_arm("left", shoulder, axial, elbow, pronation),
        **turned_arm("right", shoulder, axial, elbow, pronation),
    }


def _planted(pelvis: Turn, place: Turn, *, apart: float, knee_out: float) -> Joints:
    """The pelvis turned and moved to `place` (thighs, from where it is in a person who stands straight) over
    two feet that stay flat where they are, `apart` farther from the middle than at rest.
    """
    joints: Joints = {"pelvis": pelvis}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        foot = STANDING * (sign, 1.0, 1.0) + (sign * apart, 0.0, 0.0)
        joints |= standing_leg(side, pelvis, foot - np.array(place), knee_out=knee_out)
    return joints


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
            # the pelvis goes back a little as the trunk goes forward
            **_planted(
                (0.12 * lean, 0.15 * turn, 0.0),
                (0.0, -0.025 - 0.01 * lean, -0.12 * lean),
                apart=0.19,
                knee_out=0.05,
            ),
            "neck": (-0.1 * lean, 0.12 * turn, 0.0),
            "head": (-0.1 * lean, 0.15 * turn, 0.0),
        }
    )


def _hips(phase: float, size: float) -> _Moment:
    """The pelvis circles over standing feet, hands on the hips; the trunk stays upright above it."""
    ahead, aside = np.cos(2 * np.pi * phase), np.sin(2 * np.pi * phase)
    # tipped back where it is in front, the hip that it goes to is the higher one
    tip, roll = -0.17 * size * ahead, 0.17 * size * aside
    spine = {f"spine{i}": (-0.36 * tip, 0.0, -0.36 * roll) for i in (1, 2, 3)}
    place = (0.15 * size * aside, -0.1, 0.15 * size * ahead)
    return _Moment(
        {
            **_planted((tip, 0.12 * roll, roll), place, apart=0.26, knee_out=0.15),
            **spine,
            **_both("collar", 0.0, 0.0, -0.05),
            # each arm makes way for the hip that comes to it
            **turned_arm("left", (0.0, 0.2, -0.55 + 0.45 * roll), axial=1.32, elbow=1.54, pronation=-0.37),
            **turned_arm("right", (0.0, 0.2, -0.55 - 0.45 * roll), axial=1.32, elbow=1.54, pronation=-0.37),
            **_both("wrist", -0.38, -0.56, 0.57),
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


def _pulse(phase: float, at: float) -> float:
    """1 at a moment of the period, 0 a quarter of it away."""
    return float(np.exp(6.0 * (np.cos(2 * np.pi * (phase - at)) - 1.0)))


def _walk(phase: float, size: float) -> _Moment:
    """One double step forward: heels strike, feet roll over their balls, knees bend while a leg swings."""
    turn = 0.1 * size * np.cos(2 * np.pi * phase)
    pelvis = (0.03, -turn, 0.0)
    height = -0.02 - 0.05 * size * (1.0 + np.cos(4 * np.pi * phase))  # lowest with both feet on the ground
    joints: Joints = {}
    for side, sign, shift in (("left", 1.0, 0.0), ("right", -1.0, 0.5)):
        own = phase + shift
        forward = np.cos(2 * np.pi * own)  # +1: this leg is in front
        toes_down = size * (0.6 * _pulse(own, 0.55) - 0.24 * _pulse(own, -0.02))
        swing_height = 0.12 * max(0.0, -np.sin(2 * np.pi * own)) ** 2
        foot = STANDING * (sign, 1.0, 1.0) + (
            -0.12 * sign,
            ankle_lift(toes_down) + swing_height - height,
            0.7 * size * forward,
        )
        joints |= standing_leg(side, pelvis, foot, knee_out=0.06, toes_down=toes_down)
        joints[f"{side}_foot"] = (
            -0.8 * max(0.0, toes_down) ** 1.5,
            0.0,
            0.0,
        )  # toes stay down as a heel lifts
        swing = -forward  # arms against the legs
        joints[f"{side}_collar"] = (0.0, -0.06 * sign * swing, -0.1 * sign)
        joints[f"{side}_shoulder"] = (-0.48 * size * swing, -0.12 * sign, -1.12 * sign)
        joints[f"{side}_elbow"] = (0.0, -sign * (0.35 + 0.12 * (1.0 + swing)), 0.0)
    joints |= {"pelvis": pelvis, "spine1": (0.02, 0.5 * turn, 0.0), "spine2": (0.02, turn, 0.0)}
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
    """Arms from an A over a T to a U, one slow raise; on the way they turn, until palms face front."""
    up = _ease(phase)
    lift = -0.95 + up * (1.95 * min(size, 1.1))
    return _Moment(
        {
            **_both("collar", 0.0, 0.0, 0.18 * lift + 0.05 * up),
            **_both_arms((0.0, 0.0, 0.82 * lift), axial=-0.8 * up, elbow=0.25 + 0.4 * up**3),
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
