"""From one person's measurements to the left half of the body as an implicit surface, and to the 24 joints.

Frame while building: floor y = 0, +z front, +x the body's left, T-pose, palms down, metres. Trunk and limbs
are lofts, muscles and fat ellipsoids and cones, all joined by a smooth union whose radius is chosen part by
part.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
from jaxtyping import Float

from .anthropometry import GIRTHS, Measurements, mix, survey_mean
from .implicit import Cone, Ellipsoid, ImplicitBody, Loft, unit
from .skeleton import JOINT, LEFT_JOINTS, MIRROR
from .stations import ARM, FINGERS, FIT, FOOT, HEAD, LEG, NECK, PALM, SMALL_TOES, TAPE_CORRECTION, TORSO

FOOT_TURN_DEG = 7.0  # toes point outwards when standing
SHOULDER_INSET_M = 0.030  # joint centre inwards from the acromion
STANCE_M = 0.030  # ankles stand this much wider than the hip joints
MIDLINE_GAP_M = 0.004  # left between the thighs

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
    ratio_mid = {name: own[name] / between[name] for name in GIRTHS}
    y = height_map(m)
    scale = m.stature / 1.69

    hip_x = 0.088 * (0.55 + 0.45 * ratio_mid["hip"]) * np.sqrt(scale) * np.exp(0.5 * m.hip_breadth)
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
    return Build(m, y, ratio, ratio_mid, scale, joints, foot_forward, length * share, length * (1 - share))


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


def add_neck_and_head(body: ImplicitBody, b: Build) -> None:
    m = b.m
    height, length, breadth = m.head_height, m.head_length / 0.194, m.head_breadth / 0.150
    chin = m.stature - height
    radius = 0.95 * m.neck / (2 * np.pi)
    low, high = np.array([0, b.y(0.822), -0.040]), np.array([0, chin + 0.42 * height, 0.006])
    neck_rows = [
        (s, 0, 0, radius * side, radius * side, radius * front, radius * back, 2, 2)
        for s, side, front, back in NECK
    ]
    neck_along = np.linspace(0, np.linalg.norm(high - low), len(NECK))
    body.add(Loft(low, high - low, (1, 0, 0), (0, 0, 1), neck_rows, neck_along, 0.032, (0.03, 0.03)))

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
        add_neck_and_head,
        add_shoulder_girdle,
        add_breast,
        add_arm,
        add_hand,
        add_leg,
        add_foot,
    ):
        add(body, build)
    return body, build.joints
