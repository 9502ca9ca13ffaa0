"""The hand: palm, four fingers and the thumb."""

import numpy as np

from .implicit import Cone, ImplicitBody, Loft, unit
from .plan import Build

FINGERS = (  # name, sideways at the knuckle, knuckle and tip / hand length, radius there, spread in degrees
    ("index", 0.0300, 0.475, 0.925, 0.0090, 0.0070, 4.5),
    ("middle", 0.0098, 0.490, 1.000, 0.0092, 0.0070, 1.0),
    ("ring", -0.0103, 0.480, 0.945, 0.0088, 0.0066, -3.0),
    ("little", -0.0295, 0.450, 0.790, 0.0078, 0.0060, -8.0),
)
PALM = (  # distance / hand length, up, down, front, back
    (-0.08, 0.0190, 0.0190, 0.0275, 0.0265),
    (0.05, 0.0180, 0.0190, 0.0290, 0.0270),
    (0.16, 0.0165, 0.0200, 0.0350, 0.0310),
    (0.28, 0.0150, 0.0180, 0.0390, 0.0360),
    (0.40, 0.0135, 0.0150, 0.0405, 0.0390),
    (0.48, 0.0120, 0.0125, 0.0400, 0.0395),
)


def add_hand(body: ImplicitBody, b: Build) -> None:
    wrist, length, width = b.joint("left_wrist"), b.m.hand_length, b.m.hand_breadth / 0.0835
    rows = [
        (f, 0, 0, up * width, down * width, front * width, back * width, 2.5, 2.5)
        for f, up, down, front, back in PALM
    ]
    along = [f * length for f, *_ in PALM]
    body.add(Loft(wrist, (1, 0, 0), (0, 1, 0), (0, 0, 1), rows, along, 0.02, (0.02, 0.009), blur=0.015))
    for _, sideways, knuckle, tip, radius_a, radius_b, spread_deg in FINGERS:
        base = wrist + np.array([knuckle * length, 0, sideways * width])
        reach = (tip - knuckle) * length - radius_b * width
        spread = np.radians(spread_deg)
        first = unit([np.cos(spread), -0.10, np.sin(spread)])  # a relaxed hand: fingers bend a little
        second = unit([np.cos(spread), -0.26, np.sin(spread)])
        middle = base + first * reach * 0.50
        radius_mid = 0.5 * (radius_a + radius_b) * width
        body.add(Cone(base - first * 0.010, middle, radius_a * width, radius_mid, 0.006, carries=True))
        body.add(
            Cone(middle, middle + second * reach * 0.50, radius_mid, radius_b * width, 0.004, carries=True)
        )
    thumb = [
        wrist + np.array([along_m * length, down, side * width])
        for along_m, down, side in (
            (0.10, -0.006, 0.020),
            (0.33, -0.016, 0.051),
            (0.485, -0.021, 0.070),
            (0.625, -0.024, 0.080),
        )
    ]
    for k, (radius_a, radius_b, blend_m) in enumerate(
        ((0.0165, 0.0120, 0.016), (0.0118, 0.0098, 0.006), (0.0100, 0.0078, 0.004))
    ):
        body.add(Cone(thumb[k], thumb[k + 1], radius_a * width, radius_b * width, blend_m, carries=True))
