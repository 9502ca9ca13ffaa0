"""One person's plan: heights of landmarks, girth ratios and the joints, for every part of the anatomy.

Frame: floor y = 0, +z front, +x the body's left, T-pose, palms down, metres.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float

from .anthropometry import GIRTHS, TRUNK_SECTIONS, Measurements, survey_mean
from .skeleton import JOINT, LEFT_JOINTS, MIRROR

FOOT_TURN_DEG = 7.0  # toes point outwards when standing
SHOULDER_INSET_M = 0.030  # joint centre inwards from the acromion
STANCE_M = 0.030  # ankles stand this much wider than the hip joints

Vector = Float[np.ndarray, "3"]


def height_map(m: Measurements) -> Callable[[float], float]:
    """Heights in metres of landmarks given as fractions of the average body's stature.

    Piecewise linear between the measured heights of knee, crotch, navel, acromion and cervicale.
    """
    average = survey_mean(m.sex)
    names = ("knee_height", "crotch_height", "navel_height", "acromion_height", "cervicale_height", "stature")
    fractions = np.array([0.0] + [getattr(average, name) / average.stature for name in names])
    heights = np.array([0.0] + [getattr(m, name) for name in names])
    return lambda fraction: float(np.interp(fraction, fractions, heights))


@dataclass(frozen=True)
class Build:
    """What every part of the anatomy needs to know of one person."""

    m: Measurements
    y: Callable[[float], float]
    ratio: dict[str, float]  # girths over those of the average of the same sex
    ratio_mid: dict[str, float]  # girths over those of the average midway between the sexes
    depth: dict[str, float]  # log of depth / breadth of the trunk over that of the average of the same sex
    scale: float  # stature over 1.69 m
    joints: Float[np.ndarray, "24 3"]
    foot_forward: Vector
    thigh_m: float
    shank_m: float

    def joint(self, name: str) -> Vector:
        return self.joints[JOINT[name]]


def plan(m: Measurements) -> Build:
    """Girth ratios and the joints (left ones placed, right ones mirrored)."""
    own, same_sex, between = asdict(m), asdict(survey_mean(m.sex)), asdict(survey_mean(0.5))
    ratio = {name: own[name] / same_sex[name] for name in (*GIRTHS, "biacromial")}
    depth = {
        name: float(
            np.log(own[f"{name}_depth"] / same_sex[f"{name}_depth"])
            - np.log(own[f"{name}_breadth"] / same_sex[f"{name}_breadth"])
        )
        for name in TRUNK_SECTIONS
    }
    ratio_mid = {name: own[name] / between[name] for name in GIRTHS}
    y = height_map(m)
    scale = m.stature / 1.69

    hip_x = 0.088 * (0.55 + 0.45 * ratio_mid["hip"]) * np.sqrt(scale) * np.exp(-0.2 * depth["hip"])
    hip = np.array([hip_x, y(0.506), 0.0])
    ankle = np.array([hip_x + STANCE_M, y(0.0445), -0.030])
    share = (y(0.506) - y(0.277)) / (y(0.506) - y(0.0445))
    knee = hip + (ankle - hip) * share + np.array([0.004, 0, 0.014])
    shoulder_x = m.biacromial * 0.5 - SHOULDER_INSET_M * scale
    shoulder = np.array([shoulder_x, y(0.811), -0.022])
    elbow = shoulder + np.array([m.upper_arm, -0.002, -0.006])
    wrist = elbow + np.array([m.lower_arm, 0.002, 0.006])
    turn = np.radians(FOOT_TURN_DEG)
    foot_forward = np.array([np.sin(turn), 0.0, np.cos(turn)])
    ball = ankle + foot_forward * (0.50 * m.foot_length)
    ball[1] = y(0.0445) * 0.32

    joints = np.zeros((24, 3))
    placed = {
        "pelvis": (0, y(0.545), 0.005),
        "spine1": (0, y(0.605), -0.010),
        "spine2": (0, y(0.680), -0.012),
        "spine3": (0, y(0.722), -0.010),
        "neck": (0, y(0.842), -0.030),
        "head": (0, m.stature - 0.88 * m.head_height, 0.004),
        "left_hip": hip,
        "left_knee": knee,
        "left_ankle": ankle,
        "left_foot": ball,
        "left_collar": (shoulder_x * 0.42, y(0.797), -0.022),
        "left_shoulder": shoulder,
        "left_elbow": elbow,
        "left_wrist": wrist,
        "left_hand": wrist + np.array([0.47 * m.hand_length, -0.004, 0.004]),
    }
    for name, position in placed.items():
        joints[JOINT[name]] = position
    for j in LEFT_JOINTS:
        joints[MIRROR[j]] = joints[j] * [-1, 1, 1]
    length = float(np.linalg.norm(ankle - hip))
    return Build(
        m, y, ratio, ratio_mid, depth, scale, joints, foot_forward, length * share, length * (1 - share)
    )
