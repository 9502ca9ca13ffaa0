"""The hand: palm with its two balls, four fingers of two parts, the thumb of three; the knuckles as a relief.

Palms down. Lengths along the hand are fractions of its length; sideways (towards the thumb) and down in
metres on a hand of average breadth.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .implicit import Cone, Ellipsoid, ImplicitBody, Loft, unit
from .implicit_relief import Bump, Relief
from .plan import Build, Vector

FINGERS = (  # name, sideways at the knuckle, knuckle and tip / hand length, radius there, spread in degrees
    ("index", 0.0300, 0.475, 0.925, 0.0088, 0.0069, 4.5),
    ("middle", 0.0098, 0.490, 1.000, 0.0090, 0.0070, 1.0),
    ("ring", -0.0103, 0.480, 0.945, 0.0086, 0.0066, -3.0),
    ("little", -0.0295, 0.450, 0.790, 0.0076, 0.0059, -8.0),
)
PALM = (  # distance / hand length, up, down, front, back
    (-0.08, 0.0115, 0.0115, 0.0170, 0.0165),  # well inside the forearm: the union must not thicken the wrist
    (0.05, 0.0165, 0.0170, 0.0270, 0.0255),
    (0.16, 0.0160, 0.0165, 0.0335, 0.0315),
    (0.28, 0.0145, 0.0145, 0.0380, 0.0365),
    (0.40, 0.0132, 0.0132, 0.0402, 0.0390),
    (0.48, 0.0115, 0.0122, 0.0398, 0.0392),
)
THUMB = ((0.10, -0.008, 0.019), (0.33, -0.017, 0.050), (0.485, -0.022, 0.069), (0.625, -0.025, 0.079))
THUMB_RADII = ((0.0160, 0.0116, 0.016), (0.0114, 0.0100, 0.006), (0.0100, 0.0076, 0.004))  # two ends, blend


@dataclass(frozen=True)
class Hand:
    """The frame of one hand."""

    wrist: Vector
    length: float
    width: float  # over the average
    plump: float  # thickness of its flesh over the average

    def at(self, along: float, up: float, side: float) -> Vector:
        return self.wrist + np.array([along * self.length, up * self.width, side * self.width])

    def finger(self, idx: int) -> tuple[Vector, Vector, Vector]:
        """Centres at the knuckle, the middle joint and in the tip: a relaxed hand's fingers bend a little."""
        _, sideways, knuckle, tip, _, radius_tip, spread_deg = FINGERS[idx]
        base = self.at(knuckle, 0.0, sideways)
        reach = (tip - knuckle) * self.length - radius_tip * self.width
        spread = np.radians(spread_deg)
        middle = base + unit([np.cos(spread), -0.10, np.sin(spread)]) * reach * 0.50
        return base, middle, middle + unit([np.cos(spread), -0.26, np.sin(spread)]) * reach * 0.50

    def tips(self) -> Float[np.ndarray, "5 3"]:
        """Centres of the five fingertips, thumb last."""
        return np.stack([*(self.finger(idx)[2] for idx in range(len(FINGERS))), self.at(*THUMB[-1])])


def hand_of(b: Build) -> Hand:
    width = b.m.hand_breadth / 0.0835
    return Hand(b.joint("left_wrist"), b.m.hand_length, width, width * float(np.exp(0.12 * b.m.fat)))


def add_hand(body: ImplicitBody, b: Build) -> None:
    hand = hand_of(b)
    width, plump = hand.width, hand.plump
    rows = []
    for f, up, down, front, back in PALM:
        q = width if f > 0.1 else b.ratio_mid["wrist"]  # the wrist's end follows the wrist
        rows.append((f, 0, 0, up * q, down * q, front * q, back * q, 2.5, 2.5))
    along = [f * hand.length for f, *_ in PALM]
    body.add(Loft(hand.wrist, (1, 0, 0), (0, 1, 0), (0, 0, 1), rows, along, 0.02, (0.02, 0.009), blur=0.015))
    little_ball = np.array([0.036, 0.0110, 0.0130]) * plump
    body.add(Ellipsoid(hand.at(0.21, -0.0090, -0.0215), little_ball, 0.014))
    knuckles: list[Bump] = []
    for idx, (_, _, _, _, radius_a, radius_b, _) in enumerate(FINGERS):
        base, middle, end = hand.finger(idx)
        radius_mid = 0.5 * (radius_a + radius_b) * plump
        inside = base - unit(middle - base) * 0.010
        body.add(Cone(inside, middle, radius_a * plump, radius_mid, 0.005, carries=True))
        body.add(Cone(middle, end, radius_mid, radius_b * plump, 0.004, carries=True))
        knuckles += finger_forms(base, middle, end, width)
    thumb = [hand.at(*place) for place in THUMB]
    for k, (radius_a, radius_b, blend_m) in enumerate(THUMB_RADII):
        body.add(Cone(thumb[k], thumb[k + 1], radius_a * plump, radius_b * plump, blend_m, carries=True))
    lengthwise = unit(thumb[1] - thumb[0])
    across = unit(np.cross(lengthwise, [0, 1, 0]))
    axes = np.stack([lengthwise, across, np.cross(lengthwise, across)])
    thumb_ball = np.array([0.030, 0.0140, 0.0125]) * plump
    body.add(Ellipsoid(0.5 * (thumb[0] + thumb[1]) + [0.004, -0.003, -0.004], thumb_ball, 0.012, axes))
    knuckles += [
        Bump(thumb[1], np.array([0.008, 0.012, 0.012]) * width, 0.0012),
        Bump(thumb[2], np.array([0.006, 0.011, 0.011]) * width, 0.0009),
        Bump(
            hand.at(0.34, -0.015, 0.000), np.array([0.020, 0.012, 0.013]) * width, -0.0030
        ),  # hollow of the palm
    ]
    body.add(Relief(knuckles))


def finger_forms(
    base: Float[np.ndarray, "3"], middle: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], width: float
) -> list[Bump]:
    """The knuckle on the back of the hand, and the two joints of the finger."""
    on_back = base + np.array([-0.004, 0.0125, 0]) * width
    between = 0.5 * (middle + end)
    return [
        Bump(on_back, np.array([0.008, 0.008, 0.0065]) * width, 0.0026),
        Bump(middle, np.array([0.006, 0.011, 0.011]) * width, 0.0005),
        Bump(between, np.array([0.005, 0.010, 0.010]) * width, 0.0003),
    ]
