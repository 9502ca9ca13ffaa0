"""Trunk, neck, shoulder girdle, breast and seat of the left half body.

Frame: floor y = 0, +z front, +x the body's left, T-pose, metres.
"""

from math import exp

import numpy as np

from .anthropometry import mix
from .implicit import Cone, Ellipsoid, ImplicitBody, Loft, Sheet
from .plan import Build
from .stations import NECK, TORSO

PARTING_M = 0.0035  # half the gap between the thighs
TORSO_GIRTHS = (("hip", 0.515), ("waist", 0.602), ("chest", 0.725), ("chest", 0.815), ("neck", 0.840))
SECTION_LEVELS = {"chest": (0.735, 0.075), "waist": (0.600, 0.055), "hip": (0.510, 0.050)}
"""Where along the stature the depth of a section is measured, and how far (1 sigma) it is felt."""
BETWEEN_GIRTHS = ((0.660, 0.024), (0.788, 0.022))
"""Where no girth holds the trunk, and how far that reaches: `Measurements.fullness` acts there."""


def bell(x: float, centre: float, sigma: float) -> float:
    """A Gaussian hill of height one."""
    return exp(-0.5 * ((x - centre) / sigma) ** 2)


def between_girths(station: float, girths: tuple[tuple[str, float], ...], ratio: dict[str, float]) -> float:
    """The scale of a section: the nearest girths' own, mixed smoothly so that no step is left between them.

    `girths`: the measured ones along the part and their stations, in order.
    """
    (before, start), (after, end) = girths[0], girths[0]
    for name, where in girths:
        (before, start), (after, end) = (after, end), (name, where)
        if where > station:
            break
    share = min(max((station - start) / (end - start), 0.0), 1.0) if end > start else 0.0
    share = share * share * (3 - 2 * share)
    return float(ratio[before] ** (1 - share) * ratio[after] ** share)


def add_torso(body: ImplicitBody, b: Build) -> None:
    m = b.m
    square = {"waist": m.waist_squareness, "hip": m.hip_squareness}
    rows, along = [], []
    for fraction, width_m, width_f, front_m, front_f, back_m, back_f, n_front, n_back, powers in TORSO:
        q, (power_w, power_f, power_b) = between_girths(fraction, TORSO_GIRTHS, b.ratio), powers
        deeper = np.exp(
            0.5 * sum(bell(fraction, *level) * b.depth[name] for name, level in SECTION_LEVELS.items())
        )
        fuller = np.exp(m.fullness * sum(bell(fraction, *place) for place in BETWEEN_GIRTHS))
        squarer = np.exp(sum(bell(fraction, *SECTION_LEVELS[name]) * value for name, value in square.items()))
        width = mix((width_f, width_m), m.sex) * q**power_w / deeper * fuller
        front = mix((front_f, front_m), m.sex) * q**power_f * deeper * fuller
        back = mix((back_f, back_m), m.sex) * q**power_b * deeper * fuller**0.6  # no hump
        if fraction > 0.75:  # the shoulder girdle follows the skeleton
            width *= b.ratio["biacromial"] ** 0.6
        rows.append((fraction, 0, 0, width, width, front, back, n_front * squarer, n_back * squarer))
        along.append(b.y(fraction))
    body.add(Loft((0, 0, 0), (0, 1, 0), (1, 0, 0), (0, 0, 1), rows, along, 0.02, (0.012, 0.03)))


def add_neck(body: ImplicitBody, b: Build) -> None:
    m = b.m
    height = m.head_height
    chin = m.stature - height
    radius = mix((0.89, 0.955), m.sex) * m.neck / (2 * np.pi)
    low, high = np.array([0, b.y(0.822), -0.040]), np.array([0, chin + 0.42 * height, 0.006])
    neck_rows = [
        (s, 0, 0, radius * side, radius * side, radius * front, radius * back, 2, 2)
        for s, side, front, back in NECK
    ]
    neck_along = np.linspace(0, np.linalg.norm(high - low), len(NECK))
    body.add(Loft(low, high - low, (1, 0, 0), (0, 0, 1), neck_rows, neck_along, 0.032, (0.03, 0.03)))


def add_shoulder_girdle(body: ImplicitBody, b: Build) -> None:
    m, y, scale = b.m, b.y, b.scale
    shoulder, brawn = b.joint("left_shoulder"), m.muscle
    c = b.ratio_mid["chest"]  # muscles of the chest grow with it, or they would hold a slim one open
    arm = m.biceps / 0.312
    trapezius = 0.031 * (m.neck / 0.364) * brawn**0.25
    neck_side = (0.016, y(0.850), -0.036)
    acromion = shoulder + np.array([-0.030, 0.028 * scale, -0.012])
    body.add(Cone(neck_side, acromion, trapezius, 0.026 * arm**0.5, 0.055))
    clavicle_end = shoulder + np.array([-0.020, 0.020 * scale, 0.005])
    body.add(Cone((0.020, y(0.818), 0.012), clavicle_end, 0.018, 0.024, 0.045))
    pectoral = np.array([0.066, 0.060, 0.046]) * (0.90 + 0.10 * brawn) * c
    front = mix((0.064, 0.070), m.sex) * c * np.exp(0.5 * b.depth["chest"])
    body.add(Ellipsoid((0.079 * c, y(0.752), front), pectoral, 0.05))
    # Latissimus behind and the front fold: between them they make the armpit.
    start = 0.033 * brawn**0.25 * np.sqrt(arm)
    lat_low = (0.096 * c, y(0.700), -0.045 * c)
    body.add(Cone(shoulder + np.array([-0.010, -0.024, -0.034]), lat_low, start, 0.034 * c, 0.05))
    fold_low = (0.080 * c, y(0.752), 0.048 * c)
    body.add(Cone(shoulder + np.array([0.0, -0.016, 0.014]), fold_low, 0.97 * start, 0.034 * c, 0.045))
    shoulder_blade = np.array([0.060, 0.075, 0.040]) * c
    body.add(Ellipsoid((0.083 * c, y(0.765), -0.090 * c), shoulder_blade, 0.05))


def add_breast(body: ImplicitBody, b: Build) -> None:
    size = (0.30 + 0.58 * np.sqrt(b.m.bust)) * b.ratio["chest"] ** 0.7
    wall_z = mix((0.099, 0.121), b.m.sex) * b.ratio["chest"] * np.exp(0.5 * b.depth["chest"])
    centre = (0.080 * b.ratio["chest"], b.y(0.722) - 0.006 * size, wall_z - 0.062 + 0.048 * size)
    body.add(Ellipsoid(centre, np.array([0.058, 0.058, 0.050]) * size * np.sqrt(b.scale), 0.04))


def add_seat(body: ImplicitBody, b: Build) -> None:
    """The buttock; after the leg, whose back it covers."""
    seat = 0.985 * (b.m.hip / 1.02) * np.exp(0.5 * b.depth["hip"])
    behind = mix((-0.066, -0.076), b.m.sex)
    body.add(
        Ellipsoid((0.075 * seat, b.y(0.507), behind * seat), np.array([0.074, 0.084, 0.078]) * seat, 0.03)
    )


def part_thighs(body: ImplicitBody, b: Build) -> None:
    """Cut the body open from the crotch downwards, so that the thighs of nobody touch."""
    body.crotch_y = b.m.crotch_height
    body.cut(Sheet(b.m.crotch_height, PARTING_M, 0.016))
