"""The head: skull, face and ears.

Fractions are of the height from chin to crown; z runs forwards from the line through the ears.
"""

import numpy as np

from .implicit import Cone, Ellipsoid, ImplicitBody, Loft, unit
from .plan import Build, Vector

# Head: height above chin / head height, half width, front, back (mean head; z from tragion line).
HEAD = [
    (0.000, 0.031, 0.078, 0.020, 2.1),
    (0.060, 0.045, 0.086, 0.028, 2.2),
    (0.140, 0.054, 0.090, 0.040, 2.3),
    (0.250, 0.061, 0.093, 0.058, 2.35),
    (0.350, 0.066, 0.094, 0.074, 2.35),
    (0.450, 0.069, 0.092, 0.086, 2.3),
    (0.550, 0.071, 0.093, 0.095, 2.25),
    (0.620, 0.073, 0.096, 0.098, 2.2),
    (0.700, 0.075, 0.096, 0.100, 2.15),
]


def add_head(body: ImplicitBody, b: Build) -> None:
    m = b.m
    height, length, breadth = m.head_height, m.head_length / 0.194, m.head_breadth / 0.150
    chin = m.stature - height
    ear_z = 0.018  # the ears' line ahead of the shoulders
    rows, along = [], []
    for fraction, width, front, back, n in HEAD:
        jaw = 1 + 0.05 * (m.sex - 0.5) * (fraction < 0.4) + 0.10 * m.fat * np.exp(-((fraction / 0.3) ** 2))
        half = width * breadth * jaw
        rows.append((fraction, 0, 0, half, half, front * length, back * length, n, n))
        along.append(chin + fraction * height)
    crown_cap = (0.014, 0.30 * height)  # one tall cap instead of rows up to the crown, which would flatten it
    body.add(Loft((0, 0, ear_z), (0, 1, 0), (1, 0, 0), (0, 0, 1), rows, along, 0.022, crown_cap, blur=0.012))

    size = height / 0.225

    def at(x: float, fraction: float, z: float) -> Vector:
        return np.array([x * breadth, chin + fraction * height, ear_z + z * length])

    def lump(
        x: float, fraction: float, z: float, radii: tuple[float, float, float], blend_m: float
    ) -> Ellipsoid:
        return Ellipsoid(at(x, fraction, z), np.array(radii) * size, blend_m)

    body.add(Cone(at(0.0, 0.50, 0.089), at(0.0, 0.340, 0.107), 0.0065 * size, 0.0095 * size, 0.014))  # nose
    body.add(lump(0.011, 0.315, 0.098, (0.009, 0.008, 0.010), 0.008))  # nostril wing
    body.add(lump(0.0, 0.205, 0.089, (0.023, 0.0070, 0.009), 0.010))  # upper lip
    body.add(lump(0.0, 0.165, 0.087, (0.019, 0.0070, 0.009), 0.010))  # lower lip
    body.add(lump(0.0, 0.045, 0.080, (0.019, 0.016, 0.014), 0.018))  # chin
    body.add(lump(0.042, 0.365, 0.062, (0.019, 0.019, 0.019), 0.035))  # cheek
    body.add(lump(0.028, 0.57, 0.084, (0.024, 0.009, 0.012), 0.016))  # brow
    body.cut(lump(0.032, 0.490, 0.101, (0.017, 0.010, 0.016), 0.012))  # eye socket
    body.add(lump(0.031, 0.487, 0.076, (0.0125, 0.0115, 0.0125), 0.006))  # eye
    outward, upward = unit([1, 0, 0.35]), unit([0, 1, -0.15])
    ear_axes = np.stack([outward, upward, np.cross(outward, upward)])
    body.add(Ellipsoid(at(0.0735, 0.42, -0.012), np.array([0.008, 0.030, 0.017]) * size, 0.007, ear_axes))
