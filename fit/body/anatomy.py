"""From one person's measurements to the left half of the body as an implicit surface, and to the 24 joints.

Frame while building: floor y = 0, +z front, +x the body's left, T-pose, palms down, metres. Trunk and limbs
are lofts, muscles and fat ellipsoids and cones, all joined by a smooth union whose radius is chosen part by
part.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from .anthropometry import Measurements, mix, survey_mean
from .foot import add_foot
from .hand import add_hand
from .head import add_head
from .implicit import Cone, Ellipsoid, ImplicitBody, Loft
from .plan import STANCE_M, Build, plan
from .stations import ARM, FIT, LEG, NECK, TAPE_CORRECTION, TORSO

MIDLINE_GAP_M = 0.004  # left between the thighs


def add_torso(body: ImplicitBody, b: Build) -> None:
    m = b.m
    chest_flattening = np.exp(0.5 * m.chest_depth)
    rows, along = [], []
    for fraction, width_m, width_f, front_m, front_f, back_m, back_f, n_front, n_back, girth, powers in TORSO:
        q, (power_w, power_f, power_b) = b.ratio[girth], powers
        # Proportions that the girth leaves open, faded in around the level where they are measured.
        at_chest = np.exp(-(((fraction - 0.735) / 0.09) ** 2))
        at_belly = np.exp(-(((fraction - 0.590) / 0.05) ** 2))
        at_hip = np.exp(-(((fraction - 0.510) / 0.05) ** 2))
        deeper = chest_flattening**at_chest
        wider = np.exp(m.hip_breadth * at_hip)
        width = mix((width_f, width_m), m.sex) * q**power_w / deeper * wider
        front = mix((front_f, front_m), m.sex) * q**power_f * deeper * np.exp(m.belly_depth * at_belly)
        back = mix((back_f, back_m), m.sex) * q**power_b * deeper * np.exp(0.5 * m.buttock_depth * at_hip)
        if fraction > 0.75:  # the shoulder girdle follows the skeleton
            width *= b.ratio["biacromial"] ** 0.6
        rows.append((fraction, 0, 0, width, width, front, back, n_front, n_back))
        along.append(b.y(fraction))
    body.add(Loft((0, 0, 0), (0, 1, 0), (1, 0, 0), (0, 0, 1), rows, along, 0.02, (0.030, 0.03)))


def add_neck(body: ImplicitBody, b: Build) -> None:
    m = b.m
    height = m.head_height
    chin = m.stature - height
    radius = 0.95 * m.neck / (2 * np.pi)
    low, high = np.array([0, b.y(0.822), -0.040]), np.array([0, chin + 0.42 * height, 0.006])
    neck_rows = [
        (s, 0, 0, radius * side, radius * side, radius * front, radius * back, 2, 2)
        for s, side, front, back in NECK
    ]
    neck_along = np.linspace(0, np.linalg.norm(high - low), len(NECK))
    body.add(Loft(low, high - low, (1, 0, 0), (0, 0, 1), neck_rows, neck_along, 0.032, (0.03, 0.03)))


def add_shoulder_girdle(body: ImplicitBody, b: Build) -> None:
    m, y, scale = b.m, b.y, b.scale
    shoulder, chest, brawn = b.joint("left_shoulder"), b.ratio["chest"], m.muscle
    chest_mid = b.ratio_mid["chest"]
    arm = m.biceps / 0.312
    trapezius = 0.031 * (m.neck / 0.364) * brawn**0.25
    neck_side = (0.016, y(0.850), -0.036)
    acromion = shoulder + np.array([-0.030, 0.028 * scale, -0.012])
    body.add(Cone(neck_side, acromion, trapezius, 0.026 * arm**0.5, 0.055))
    clavicle_end = shoulder + np.array([-0.020, 0.020 * scale, 0.005])
    body.add(Cone((0.020, y(0.818), 0.012), clavicle_end, 0.018, 0.024, 0.045))
    pectoral = np.array([0.084, 0.060, 0.046]) * (0.90 + 0.10 * brawn) * chest_mid**0.8
    body.add(Ellipsoid((0.52 * shoulder[0], y(0.752), 0.064 * chest), pectoral, 0.06))
    # Latissimus behind and the front fold: between them they make the armpit.
    lat_low = (0.108 * chest, y(0.715), -0.040)
    lat_radii = 0.034 * brawn**0.3 * chest_mid, 0.043 * chest_mid
    body.add(Cone(shoulder + np.array([-0.010, -0.024, -0.034]), lat_low, *lat_radii, 0.05))
    fold_low = (0.090 * chest, y(0.752), 0.050)
    fold_radii = 0.032 * brawn**0.2 * chest_mid, 0.039 * chest_mid
    body.add(Cone(shoulder + np.array([0.0, -0.016, 0.014]), fold_low, *fold_radii, 0.045))
    body.add(Ellipsoid((0.085, y(0.765), -0.090 * chest), np.array([0.060, 0.075, 0.040]) * chest_mid, 0.05))


def add_breast(body: ImplicitBody, b: Build) -> None:
    size = 0.30 + 0.58 * np.sqrt(b.m.bust)
    wall_z = mix((0.099, 0.121), b.m.sex) * b.ratio["chest"] * np.exp(0.5 * b.m.chest_depth)
    centre = (
        0.50 * b.joint("left_shoulder")[0] + 0.006,
        b.y(0.722) - 0.006 * size,
        wall_z - 0.062 + 0.048 * size,
    )
    body.add(Ellipsoid(centre, np.array([0.058, 0.058, 0.050]) * size * np.sqrt(b.scale), 0.04))


def add_arm(body: ImplicitBody, b: Build) -> None:
    m = b.m
    shoulder = b.joint("left_shoulder")
    rows, along = [], []
    for station, up, down, front, back, girth in ARM:
        q = b.ratio_mid[girth] * FIT[girth]
        if girth == "biceps":
            q *= m.muscle ** (0.10 * np.exp(-(((station - 0.2) / 0.25) ** 2)))
        rows.append((station, 0, 0, up * q, down * q, front * q, back * q, 2.05, 2.05))
        along.append(station * m.upper_arm if station < 1 else m.upper_arm + (station - 1) * m.lower_arm)
    axis = b.joint("left_wrist") - shoulder
    body.add(Loft(shoulder, axis, (0, 1, 0), (0, 0, 1), rows, along, 0.045, (0.03, 0.015)))
    q = b.ratio_mid["biceps"]
    deltoid = np.array([0.075, 0.050 * q, 0.058 * q]) * m.muscle**0.12
    body.add(Ellipsoid(shoulder + np.array([0.030 * b.scale, 0.006, 0]), deltoid, 0.035))


def add_leg(body: ImplicitBody, b: Build) -> None:
    m = b.m
    hip, knee, ankle = b.joint("left_hip"), b.joint("left_knee"), b.joint("left_ankle")
    length = b.thigh_m + b.shank_m
    rows, along = [], []
    for station, lateral, medial, front, back, girth in LEG:
        q = b.ratio_mid[girth] * FIT[girth]
        at_knee = np.exp(-(((station - 1) / 0.35) ** 2))
        shift_x, shift_z = 0.004 * at_knee, 0.014 * at_knee
        out, inner = lateral * q, medial * q
        t = station * b.thigh_m if station < 1 else b.thigh_m + (station - 1) * b.shank_m
        if station > -0.05:
            # Thighs never cross the midline: what the inside loses is given to the outside.
            room = hip[0] + STANCE_M * t / length + shift_x - MIDLINE_GAP_M
            limited = room - 0.006 * np.log1p(np.exp((room - inner) / 0.006))
            out, inner = out + 0.5 * (inner - limited), limited
        rows.append((station, shift_x, shift_z, out, inner, front * q, back * q, 2.1, 2.1))
        along.append(t)
    down = ankle - hip
    body.add(Loft(hip, down, (1, 0, 0), (0, 0, 1), rows, along, 0.07, (0.05, 0.02)))
    seat = 0.985 * (m.hip / 1.02) ** 1.1 * np.exp(m.buttock_depth)
    body.add(
        Ellipsoid((0.078 * seat, b.y(0.508), -0.062 * seat), np.array([0.078, 0.088, 0.078]) * seat, 0.04)
    )
    calf = m.calf / 0.382
    belly_of_calf = hip + down * (b.thigh_m + 0.30 * b.shank_m) / length + [-0.014, 0, -0.030]
    body.add(Ellipsoid(belly_of_calf, np.array([0.036, 0.085, 0.036]) * calf, 0.04))
    q = b.ratio_mid["knee"]
    body.add(
        Ellipsoid(knee + np.array([0, 0.008, 0.034 * q]), np.array([0.026, 0.032, 0.020]) * q, 0.025)
    )  # patella
    for outer in ((0.028, -0.004, -0.006), (-0.028, 0.006, 0.004)):  # malleoli
        body.add(Ellipsoid(ankle + outer, (0.010, 0.014, 0.012), 0.018))


def read_by_tape(m: Measurements) -> Measurements:
    """The girths to model so that a tape around the finished mesh reads the ones asked for.

    Smooth unions add a little more to thin bodies than to heavy ones; `stations.TAPE_CORRECTION` holds how
    much.
    """
    average = survey_mean(m.sex)
    modelled = {}
    for name, (constant, by_sex, by_size) in TAPE_CORRECTION.items():
        asked = getattr(m, name)
        excess = constant + by_sex * (m.sex - 0.5) + by_size * np.log(asked / getattr(average, name))
        modelled[name] = float(asked * np.exp(-excess))
    return replace(m, **modelled)


def make_person(m: Measurements) -> tuple[ImplicitBody, Float[np.ndarray, "24 3"]]:
    """The implicit left half body and the joints of a person with these measurements.

    The order of the parts matters: a smooth union bulges where a later part meets an earlier one.
    """
    build = plan(read_by_tape(m))
    body = ImplicitBody()
    for add in (
        add_torso,
        add_neck,
        add_head,
        add_shoulder_girdle,
        add_breast,
        add_arm,
        add_hand,
        add_leg,
        add_foot,
    ):
        add(body, build)
    return body, build.joints
