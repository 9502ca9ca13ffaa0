"""Joint angles from where hands and feet are: legs whose feet stand, arms that turn about their own length.

A motion says where the pelvis and the feet are and gets hips, knees and ankles. Lengths are in THIGHS, the
distance from hip to knee, so that one motion serves all sizes; proportions are those of an average adult,
and people who differ from them stand a few millimetres off. Frame: the body's (x its left, y up, z front);
angles in radians.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Turn = tuple[float, float, float]
"""A joint's rotation vector, rad."""

HIP = np.array([0.224, -0.168, -0.013])
"""The left hip from the pelvis' joint at rest; the right one is its mirror image."""
THIGH, SHANK = np.array([0.049, -0.999, -0.003]), np.array([0.028, -1.006, -0.074])
"""From hip to knee and from knee to ankle, left, at rest."""
STANDING = HIP + THIGH + SHANK
"""The left ankle from the pelvis' joint when standing straight."""
BALL_AHEAD, HEEL_BEHIND = 0.31, 0.11
"""Where a foot rolls, from the ankle."""


def standing_leg(
    side: str,
    pelvis: Turn,
    ankle: Float[np.ndarray, " 3"],
    *,
    knee_out: float = 0.0,
    toes_down: float = 0.0,
) -> dict[str, Turn]:
    """Hip, knee and ankle of the leg whose ankle is at `ankle` from the pelvis' joint (thighs).

    pelvis: how the body's root is turned. knee_out: the whole leg and foot turned outwards. toes_down: the
    foot's tilt; the sole is level where it is 0. A place out of reach is met in direction, the knee straight.
    The knee turns about the body's own sideways axis only, as knees do.
    """
    mirror = np.array([1.0 if side == "left" else -1.0, 1.0, 1.0])
    hip, thigh, shank = HIP * mirror, THIGH * mirror, SHANK * mirror
    root = Rotation.from_rotvec(pelvis)
    target = np.asarray(ankle) - root.apply(hip)
    # |thigh + Rx(k) shank|^2 = constant + a cos k + b sin k, solved for the knee's angle k
    constant = thigh @ thigh + shank @ shank + 2 * thigh[0] * shank[0]
    a = 2 * (thigh[1] * shank[1] + thigh[2] * shank[2])
    b = 2 * (thigh[2] * shank[1] - thigh[1] * shank[2])
    ratio = (float(target @ target) - constant) / np.hypot(a, b)
    knee = max(float(np.arccos(np.clip(ratio, -1.0, 1.0)) + np.arctan2(b, a)), 0.0)
    yaw = Rotation.from_rotvec([0.0, knee_out * mirror[0], 0.0])
    leg = yaw.apply(thigh + Rotation.from_rotvec([knee, 0.0, 0.0]).apply(shank))
    # first forwards about x until the depth fits, then sideways about z, which keeps the depth
    reach = float(np.hypot(leg[1], leg[2]))
    depth = float(np.clip(target[2] / np.linalg.norm(target) * np.linalg.norm(leg) / reach, -1.0, 1.0))
    forwards = Rotation.from_rotvec([np.arctan2(leg[2], -leg[1]) - np.arcsin(depth), 0.0, 0.0])
    leg = forwards.apply(leg)
    aside = np.arctan2(target[0], -target[1]) - np.arctan2(leg[0], -leg[1])
    world = Rotation.from_rotvec([0.0, 0.0, aside]) * forwards * yaw
    shin = world * Rotation.from_rotvec([knee, 0.0, 0.0])
    foot = yaw * Rotation.from_rotvec([toes_down, 0.0, 0.0])
    return {
        f"{side}_hip": _turn(root.inv() * world),
        f"{side}_knee": (knee, 0.0, 0.0),
        f"{side}_ankle": _turn(shin.inv() * foot),
    }


def ankle_lift(toes_down: float) -> float:
    """How much higher (thighs) an ankle is when its foot rolls on the ball (toes down) or the heel (up)."""
    # the two slopes meet smoothly at a level sole: joints have no jerk
    slope, bend = 0.5 * (BALL_AHEAD - HEEL_BEHIND), 0.5 * (BALL_AHEAD + HEEL_BEHIND)
    return float(np.sin(slope * toes_down + bend * (np.hypot(toes_down, 0.05) - 0.05)))


def turned_arm(
    side: str, shoulder: Turn, axial: float, elbow: float, pronation: float = 0.0
) -> dict[str, Turn]:
    """Shoulder and elbow of an arm that is turned about its own length, as an upper arm is, and then bent.

    shoulder: the left arm's turn from the T-pose, mirrored for the right. axial: the upper arm about its own
    length; positive turns a forearm that points forwards down (inwards), negative up (outwards). elbow: its
    bend, forwards in the T-pose. pronation: the forearm about its own length, positive turns the thumb down.
    """
    mirror = np.array([1.0, 1.0, 1.0] if side == "left" else [1.0, -1.0, -1.0])
    upper = Rotation.from_rotvec(np.asarray(shoulder)) * Rotation.from_rotvec([axial, 0.0, 0.0])
    fore = Rotation.from_rotvec([0.0, -elbow, 0.0]) * Rotation.from_rotvec([pronation, 0.0, 0.0])
    return {
        f"{side}_shoulder": _turn_of(upper.as_rotvec() * mirror),
        f"{side}_elbow": _turn_of(fore.as_rotvec() * mirror),
    }


def _turn(rotation: Rotation) -> Turn:
    return _turn_of(rotation.as_rotvec())


def _turn_of(vector: np.ndarray) -> Turn:
    x, y, z = vector.tolist()
    return (x, y, z)
