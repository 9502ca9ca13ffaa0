"""Left arm and left leg, without hand and foot.

Frame: floor y = 0, +z front, +x the body's left, T-pose, metres.
"""

import numpy as np

from .implicit import Ellipsoid, ImplicitBody, Loft
from .plan import STANCE_M, Build
from .stations import ARM, LEG
from .trunk import bell, between_girths

MIDLINE_GAP_M = 0.004  # left between the thighs
ARM_GIRTHS = (("biceps", 0.5), ("biceps", 0.75), ("forearm", 1.25), ("wrist", 1.95))
LEG_GIRTHS = (("hip", 0.0), ("thigh", 0.22), ("thigh", 0.45), ("knee", 1.0), ("calf", 1.33), ("ankle", 1.90))
HIP_OF_LEG = (-0.10, 0.20)
"""Where the leg's sections are part of the hip's, and how far that reaches."""
BETWEEN_LEG_GIRTHS = ((0.66, 0.16), (1.60, 0.09))
"""Where no girth holds the leg (0 hip, 1 knee, 2 ankle) and how far that reaches: `Measurements.fullness`
acts there.
"""


def add_arm(body: ImplicitBody, b: Build) -> None:
    m = b.m
    shoulder = b.joint("left_shoulder")
    rows, along = [], []
    for station, up, down, front, back in ARM:
        q = between_girths(station, ARM_GIRTHS, b.ratio_mid)
        q *= m.muscle ** (0.10 * bell(station, 0.2, 0.18))
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
    for station, lateral, medial, front, back in LEG:
        q = between_girths(station, LEG_GIRTHS, b.ratio_mid)
        q *= np.exp(m.fullness * sum(bell(station, *place) for place in BETWEEN_LEG_GIRTHS))
        at_knee = np.exp(-(((station - 1) / 0.35) ** 2))
        shift_x, shift_z = 0.004 * at_knee, 0.014 * at_knee
        out, inner, front, back = (q * radius for radius in (lateral, medial, front, back))
        t = station * b.thigh_m if station < 1 else b.thigh_m + (station - 1) * b.shank_m
        if station > -0.05:
            # Thighs never cross the midline: what the inside loses is given to the other sides.
            room = hip[0] + STANCE_M * t / length + shift_x - MIDLINE_GAP_M
            limited = room - 0.006 * np.log1p(np.exp((room - inner) / 0.006))
            lost, inner = inner - limited, limited
            out, front, back = out + 0.15 * lost, front + 0.4 * lost, back + 0.4 * lost
        exponent = 2.1 * np.exp(m.hip_squareness * bell(station, *HIP_OF_LEG))
        rows.append((station, shift_x, shift_z, out, inner, front, back, exponent, exponent))
        along.append(t)
    down = ankle - hip
    body.add(Loft(hip, down, (1, 0, 0), (0, 0, 1), rows, along, 0.045, (0.05, 0.02)))
    calf = m.calf / 0.382
    belly_of_calf = hip + down * (b.thigh_m + 0.32 * b.shank_m) / length + [-0.014, 0, -0.030]
    body.add(Ellipsoid(belly_of_calf, np.array([0.036, 0.085, 0.036]) * calf, 0.04))
    q = b.ratio_mid["knee"]
    patella = knee + np.array([0, 0.008, 0.034 * q])
    body.add(Ellipsoid(patella, np.array([0.026, 0.032, 0.020]) * q, 0.025))
    for outer in ((0.028, -0.004, -0.006), (-0.028, 0.006, 0.004)):  # malleoli
        body.add(Ellipsoid(ankle + outer, (0.010, 0.014, 0.012), 0.018))
