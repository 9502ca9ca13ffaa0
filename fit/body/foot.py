"""The foot: a loft from heel to ball, five toes; as a relief the arch, the ankle bones and the heel's cord.

Places are (fraction of foot length from the heel, side, up): metres on a foot of average breadth and height,
side outwards, up from the floor. The sole stands on y = 0.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .implicit import Cone, ImplicitBody, Loft
from .implicit_relief import Bump, Relief
from .plan import Build, Vector

# Fraction of length from heel, side of the instep's ridge, centre height, lateral, medial, up, down.
FOOT = (
    (0.030, 0.000, 0.032, 0.0215, 0.0215, 0.024, 0.0265),
    (0.090, 0.000, 0.034, 0.0290, 0.0290, 0.034, 0.034),
    (0.180, 0.000, 0.036, 0.0325, 0.0325, 0.048, 0.036),
    (0.300, -0.001, 0.036, 0.0350, 0.0325, 0.054, 0.036),
    (0.420, -0.004, 0.033, 0.0405, 0.0315, 0.049, 0.033),
    (0.550, -0.008, 0.028, 0.0495, 0.0320, 0.037, 0.028),
    (0.670, -0.011, 0.022, 0.0565, 0.0355, 0.026, 0.022),
    (0.740, -0.010, 0.018, 0.0545, 0.0370, 0.018, 0.018),
    (0.790, -0.008, 0.014, 0.0470, 0.0340, 0.011, 0.014),
    (0.835, -0.006, 0.010, 0.0380, 0.0300, 0.005, 0.009),
)
TOES = (  # root and tip: fraction, side, up and radius; the big one first
    ((0.700, -0.0300, 0.0178, 0.0175), (0.945, -0.0265, 0.0126, 0.0126)),
    ((0.700, -0.0085, 0.0180, 0.0120), (0.953, -0.0050, 0.0076, 0.0074)),
    ((0.695, 0.0080, 0.0165, 0.0115), (0.925, 0.0100, 0.0073, 0.0071)),
    ((0.680, 0.0220, 0.0150, 0.0110), (0.885, 0.0240, 0.0070, 0.0068)),
    ((0.660, 0.0350, 0.0135, 0.0110), (0.835, 0.0370, 0.0067, 0.0065)),
)
MEAN_LENGTH_M = 0.258
TOE_BLEND_M = 0.0025


@dataclass(frozen=True)
class Foot:
    """The frame of one foot."""

    heel: Vector
    forward: Vector
    length: float
    width: float  # over the average
    height: float

    def at(self, fraction: float, side: float, up: float) -> Vector:
        sideways = np.array([self.forward[2], 0, -self.forward[0]])
        along = self.forward * fraction * self.length + sideways * side * self.width
        return self.heel + along + np.array([0, up * self.height, 0])


def foot_of(b: Build) -> Foot:
    m, ankle = b.m, b.joint("left_ankle")
    heel = np.array([ankle[0], 0, ankle[2]]) - b.foot_forward * 0.235 * m.foot_length
    return Foot(heel, b.foot_forward, m.foot_length, m.foot_breadth / 0.0975, b.y(0.0445) / 0.075)


def add_foot(body: ImplicitBody, b: Build) -> None:
    foot = foot_of(b)
    rows = [
        (
            f,
            s * foot.width,
            c * foot.height,
            out * foot.width,
            inner * foot.width,
            up * foot.height,
            down * foot.height,
            2.1,
            3.6,
        )
        for f, s, c, out, inner, up, down in FOOT
    ]
    along = [f * foot.length for f, *_ in FOOT]
    sideways = foot.at(0.0, 1.0, 0.0) - foot.heel
    body.add(
        Loft(foot.heel, foot.forward, sideways, (0, 1, 0), rows, along, 0.035, (0.012, 0.012), blur=0.02)
    )
    for root, tip in TOES:
        radii = root[3] * foot.width, tip[3] * foot.width
        # The toe's end, not its centre, keeps its place: broad feet are not longer.
        tip_fraction = tip[0] + tip[3] / MEAN_LENGTH_M - radii[1] / foot.length
        ends = foot.at(*root[:3]), foot.at(tip_fraction, *tip[1:3])
        body.add(Cone(*ends, *radii, TOE_BLEND_M, carries=True))
    body.add(Relief(foot_forms(b, foot)))


def toe_gaps(foot: Foot) -> list[Float[np.ndarray, "2 3"]]:
    """Lines between neighbouring toes, from the web to the shorter tip, at half the toes' height."""
    gaps = []
    for one, other in itertools.pairwise(TOES):
        line = []
        for fraction in (other[1][0] - 0.085, other[1][0]):
            places = []
            for root, tip in (one, other):
                share = (fraction - root[0]) / (tip[0] - root[0])
                side, _, radius = (r + (t - r) * share for r, t in zip(root[1:], tip[1:], strict=True))
                places.append((side, radius))
            (side_a, radius_a), (side_b, radius_b) = places
            line.append(foot.at(fraction, 0.5 * (side_a + radius_a + side_b - radius_b), 0.008))
        gaps.append(np.stack(line))
    return gaps


def foot_forms(b: Build, foot: Foot) -> list[Bump]:
    ankle, lean = b.joint("left_ankle"), 1 - 0.6 * float(np.clip(b.m.fat / 0.3, -0.4, 1.2))
    return [
        Bump(foot.at(0.430, -0.034, 0.000), (0.016, 0.018, 0.029), -0.0140),  # arch
        Bump(ankle + np.array([0.036, -0.006, -0.008]), (0.010, 0.011, 0.009), 0.0028 * lean),  # ankle bones
        Bump(ankle + np.array([-0.036, 0.006, 0.004]), (0.010, 0.012, 0.010), 0.0025 * lean),
        Bump(
            ankle + np.array([0.022, 0.000, -0.038]), (0.009, 0.024, 0.011), -0.0040 * lean
        ),  # beside the heel's cord
        Bump(ankle + np.array([-0.022, 0.004, -0.036]), (0.009, 0.024, 0.011), -0.0040 * lean),
    ]
