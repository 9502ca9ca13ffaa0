"""The foot: a loft from heel to ball, and five toes."""

import numpy as np

from .implicit import Cone, ImplicitBody, Loft
from .plan import Build, Vector

# Foot: fraction of length from heel, centre height, lateral, medial, up, down (mean foot, metres).
FOOT = [
    (0.030, 0.034, 0.022, 0.022, 0.024, 0.028),
    (0.090, 0.036, 0.029, 0.029, 0.034, 0.034),
    (0.180, 0.036, 0.033, 0.033, 0.048, 0.036),
    (0.300, 0.036, 0.034, 0.034, 0.054, 0.036),
    (0.420, 0.033, 0.037, 0.035, 0.050, 0.033),
    (0.550, 0.028, 0.042, 0.039, 0.038, 0.028),
    (0.670, 0.022, 0.046, 0.046, 0.028, 0.022),
    (0.750, 0.018, 0.046, 0.047, 0.021, 0.018),
    (0.810, 0.015, 0.043, 0.046, 0.016, 0.015),
    (0.850, 0.013, 0.040, 0.044, 0.012, 0.013),
]
SMALL_TOES = (  # sideways at root and tip, tip / foot length, tip radius
    (-0.0060, -0.0025, 0.952, 0.0098),
    (0.0085, 0.0125, 0.928, 0.0092),
    (0.0215, 0.0260, 0.895, 0.0088),
    (0.0335, 0.0375, 0.855, 0.0085),
)


def add_foot(body: ImplicitBody, b: Build) -> None:
    m = b.m
    width, height, length = m.foot_breadth / 0.0975, b.y(0.0445) / 0.075, m.foot_length
    forward, ankle = b.foot_forward, b.joint("left_ankle")
    sideways = np.array([forward[2], 0, -forward[0]])
    heel = np.array([ankle[0], 0, ankle[2]]) - forward * 0.235 * length
    rows = [
        (f, 0, centre * height, out * width, inner * width, up * height, down * height, 2.1, 3.6)
        for f, centre, out, inner, up, down in FOOT
    ]
    along = [f * length for f, *_ in FOOT]
    body.add(Loft(heel, forward, sideways, (0, 1, 0), rows, along, 0.035, (0.012, 0.010), blur=0.02))

    def at(fraction: float, side: float, up: float) -> Vector:
        return heel + forward * fraction * length + sideways * side * width + np.array([0, up * height, 0])

    body.add(
        Cone(at(0.76, -0.029, 0.017), at(0.945, -0.025, 0.0135), 0.0165 * width, 0.0130 * width, 0.012, True)
    )
    for root, end, tip, radius in SMALL_TOES:
        body.add(
            Cone(at(0.74, root, 0.015), at(tip, end, 0.0095), 0.0115 * width, radius * width, 0.006, True)
        )
