"""The head: skull, jaw and ears as solids, eyes and nose on them, and the face's forms as a relief.

Places are (x, fraction, z): x and z in metres on a head of average breadth and length, z forwards from the
line through the ears, the fraction from the chin (0) to the crown (1). So every form keeps its place in any
head, and the vertices that ride on the skull's loft meet the same forms again. Proportions are the usual
canon: eyes half-way up, a fifth of the head's breadth wide and as far apart, the nose's base half-way from
the eyes to the chin, the mouth a third of the way below it, the ears between the brow and the nose's base.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .implicit import Cone, Ellipsoid, ImplicitBody, Loft, unit
from .implicit_relief import Bump, Opening, Relief, Ridge, arcs_of
from .plan import Build, Vector

EAR_LINE_M = 0.018  # ahead of the shoulders

# Fraction of head height, z of the widest place, half width, z of the front and of the back, exponents.
SKULL = (
    (0.060, 0.055, 0.0270, 0.0890, 0.0300, 2.3, 2.0),
    (0.100, 0.044, 0.0370, 0.0910, 0.0140, 2.3, 2.0),
    (0.170, 0.022, 0.0490, 0.0910, -0.0140, 2.25, 2.1),
    (0.250, 0.010, 0.0555, 0.0920, -0.0420, 2.2, 2.2),
    (0.330, 0.002, 0.0610, 0.0905, -0.0680, 2.2, 2.3),
    (0.420, -0.004, 0.0660, 0.0875, -0.0840, 2.2, 2.3),
    (0.500, -0.008, 0.0700, 0.0850, -0.0930, 2.25, 2.25),
    (0.560, -0.010, 0.0720, 0.0870, -0.0975, 2.25, 2.2),
    (0.620, -0.012, 0.0735, 0.0905, -0.0995, 2.25, 2.15),
    (0.700, -0.014, 0.0750, 0.0920, -0.0990, 2.2, 2.1),
)


@dataclass(frozen=True)
class Head:
    """The frame of one head and what its face varies with."""

    chin: float
    height: float
    length: float  # over the average
    breadth: float
    sex: float
    fat: float

    @property
    def size(self) -> float:
        return self.height / 0.225

    def at(self, x: float, fraction: float, z: float) -> Vector:
        return np.array([x * self.breadth, self.chin + fraction * self.height, EAR_LINE_M + z * self.length])

    def line(self, *places: tuple[float, float, float]) -> Float[np.ndarray, "k 3"]:
        return np.stack([self.at(*place) for place in places])

    def lump(
        self,
        place: tuple[float, float, float],
        radii: tuple[float, float, float],
        blend_m: float,
        axes: np.ndarray | None = None,
    ) -> Ellipsoid:
        return Ellipsoid(self.at(*place), np.array(radii) * self.size, blend_m, axes)

    def cone(
        self,
        a: tuple[float, float, float],
        b: tuple[float, float, float],
        radius_a: float,
        radius_b: float,
        blend_m: float,
    ) -> Cone:
        return Cone(self.at(*a), self.at(*b), radius_a * self.size, radius_b * self.size, blend_m)

    def bump(
        self, place: tuple[float, float, float], sigma: tuple[float, float, float], height_m: float
    ) -> Bump:
        return Bump(self.at(*place), np.array(sigma) * self.size, height_m)


def head_of(b: Build) -> Head:
    m = b.m
    return Head(
        chin=m.stature - m.head_height,
        height=m.head_height,
        length=m.head_length / 0.194,
        breadth=m.head_breadth / 0.150,
        sex=m.sex,
        fat=m.fat,
    )


def add_head(body: ImplicitBody, b: Build) -> None:
    head = head_of(b)
    add_skull(body, head)
    add_nose(body, head)
    add_eye(body, head)
    body.add(head.cone((0.0, 0.125, 0.055), (0.0, 0.070, 0.016), 0.020, 0.022, 0.034))  # floor of the mouth
    body.add(Relief([*face_forms(head), *neck_forms(b, head)]))
    add_ear(body, head)


def add_skull(body: ImplicitBody, head: Head) -> None:
    rows, along = [], []
    for fraction, z, half, front, back, n_front, n_back in SKULL:
        jaw = 1 + 0.06 * (head.sex - 0.5) * (fraction < 0.3)
        cheeks = 1 + 0.16 * head.fat * np.exp(-(((fraction - 0.18) / 0.17) ** 2))
        width = half * jaw * cheeks * head.breadth
        centre = z * head.length
        rows.append(
            (
                fraction,
                0,
                centre,
                width,
                width,
                (front - z) * head.length,
                (z - back) * head.length,
                n_front,
                n_back,
            )
        )
        along.append(head.chin + fraction * head.height)
    caps = (0.055 * head.height, 0.30 * head.height)  # one tall cap: rows up to the crown would flatten it
    axes = (0, 1, 0), (1, 0, 0), (0, 0, 1)
    body.add(Loft((0, 0, EAR_LINE_M), *axes, rows, along, 0.020, caps, blur=0.012))


def add_nose(body: ImplicitBody, head: Head) -> None:
    big = 1 + 0.12 * (head.sex - 0.5)
    tip_z, tip = 0.1090 + 0.003 * (head.sex - 0.5), 0.345 + 0.012 * (0.5 - head.sex)
    body.add(head.cone((0.0, 0.545, 0.0835), (0.0, 0.410, 0.0975), 0.0060 * big, 0.0062 * big, 0.013))
    body.add(head.cone((0.0, 0.410, 0.0975), (0.0, tip, tip_z), 0.0062 * big, 0.0076 * big, 0.008))
    body.add(head.cone((0.0, 0.335, 0.1010), (0.0, 0.303, 0.0955), 0.0060, 0.0050, 0.006))  # columella
    body.add(head.lump((0.0110, 0.327, 0.0945), (0.0060 * big, 0.0072, 0.0105), 0.006))  # wing
    body.add(head.lump((0.0, 0.425, 0.0800), (0.0150, 0.0240, 0.0110), 0.012))  # flanks
    body.cut(head.lump((0.0058, 0.302, 0.0985), (0.0030, 0.0050, 0.0050), 0.003))  # nostril


def add_eye(body: ImplicitBody, head: Head) -> None:
    body.add(head.lump((0.0315, 0.495, 0.0690), (0.0155, 0.0140, 0.0135), 0.011))  # lids over the eyeball


def eye_opening(head: Head) -> Opening:
    corners = head.line((0.0165, 0.486, 0.079), (0.0465, 0.496, 0.072))
    return Opening(corners, 0.0065 * head.size, 0.0045 * head.size, 0.0024 * head.size, 0.0024 * head.size)


def lid_crease(head: Head) -> Float[np.ndarray, "k 3"]:
    """The fold of the upper lid."""
    return head.line(
        (0.0190, 0.516, 0.081), (0.0250, 0.539, 0.082), (0.0330, 0.546, 0.080), (0.0450, 0.527, 0.072)
    )


def feature_lines(head: Head) -> list[Float[np.ndarray, "_ 3"]]:
    """Lines that the mesh's vertices shall lie on: the rims of the lids and the line between the lips."""
    return [*arcs_of(eye_opening(head)), lid_crease(head), mouth_line(head)]


def face_forms(head: Head) -> list[Bump | Ridge | Opening]:
    """All that is raised above or sunk below skull, nose and eyeballs. Off-midline forms: the left one."""
    sex, fat = head.sex, head.fat
    ridge, bump = Ridge, head.bump
    flat = 0.25  # how much depth counts for lines on the face
    return [
        # Eye
        eye_opening(head),
        bump((0.0310, 0.494, 0.080), (0.0055, 0.0035, 0.02), 0.0016),  # cornea
        ridge(lid_crease(head), 0.0018, -0.0018, flat),
        bump((0.0160, 0.520, 0.086), (0.0065, 0.0090, 0.02), -0.0025),
        bump((0.0360, 0.552, 0.080), (0.0130, 0.0055, 0.02), -0.0015),
        # Brow and forehead
        ridge(
            head.line((0.0120, 0.594, 0.09), (0.0280, 0.610, 0.085), (0.0450, 0.590, 0.07)),
            0.0075,
            0.0018 + 0.0024 * sex,
            flat,
        ),
        bump((0.0, 0.600, 0.095), (0.014, 0.010, 0.02), 0.0010 + 0.0020 * sex),
        bump((0.0, 0.760, 0.085), (0.035, 0.022, 0.03), 0.0030 - 0.0030 * sex),
        bump((0.064, 0.570, 0.045), (0.014, 0.016, 0.022), -0.0025),
        # Cheeks
        bump((0.0480, 0.420, 0.058), (0.013, 0.010, 0.022), 0.0040),
        bump((0.0300, 0.400, 0.085), (0.010, 0.010, 0.020), 0.0015),
        bump((0.0440, 0.285, 0.060), (0.016, 0.020, 0.024), 0.0020 + 0.012 * fat),
        # Mouth
        bump((0.0, 0.210, 0.088), (0.0230, 0.0160, 0.03), 0.0048),
        ridge(
            head.line((0.0, 0.2205, 0.1), (0.0060, 0.2235, 0.1), (0.0235, 0.202, 0.088)),
            0.0034,
            0.0030 - 0.0006 * sex,
            flat,
        ),
        ridge(
            head.line((0.0, 0.173, 0.1), (0.0100, 0.175, 0.1), (0.0225, 0.192, 0.088)),
            0.0038,
            0.0038 - 0.0006 * sex,
            flat,
        ),
        ridge(mouth_line(head), 0.0024, -0.0040, flat),
        bump((0.0265, 0.196, 0.085), (0.0035, 0.0040, 0.02), -0.0018),
        bump((0.0, 0.258, 0.1), (0.0030, 0.0065, 0.02), -0.0012),
        ridge(
            head.line((0.0190, 0.305, 0.09), (0.0270, 0.255, 0.085), (0.0330, 0.205, 0.08)),
            0.0040,
            -0.0010,
            flat,
        ),
        # Chin and jaw
        bump((0.0, 0.128, 0.090), (0.0160, 0.0070, 0.02), -0.0040),
        bump((0.0, 0.064, 0.090), (0.0140 + 0.004 * sex, 0.0110, 0.02), 0.0040 + 0.001 * sex),
        ridge(
            head.line(
                (0.0540, 0.290, -0.006),
                (0.0530, 0.190, 0.004),
                (0.0430, 0.105, 0.034),
                (0.0260, 0.045, 0.070),
            ),
            0.0070,
            0.0022 + 0.0012 * sex,
        ),
        bump((0.0, -0.020, 0.050), (0.030, 0.016, 0.026), 0.030 * max(0.0, fat)),
    ]


def neck_forms(b: Build, head: Head) -> list[Bump | Ridge | Opening]:
    """The muscle from behind the ear to the breastbone, the larynx, and the notch above the breastbone."""
    radius = 0.95 * b.m.neck / (2 * np.pi)
    low, high = np.array([0, b.y(0.826), -0.040]), np.array([0, head.chin + 0.20 * head.height, -0.010])
    lean = 1 - 0.5 * float(np.clip(head.fat / 0.3, -0.5, 1.5))  # fat hides it
    muscle = []
    for t in np.linspace(0, 1, 6):
        angle = np.radians(108 - 96 * t**0.9)
        muscle.append(high + (low - high) * t + radius * np.array([0.97 * np.sin(angle), 0, np.cos(angle)]))
    larynx_y = head.chin - 0.030 * head.size
    larynx_z = float(np.interp(larynx_y, [low[1], high[1]], [low[2], high[2]])) + radius
    return [
        Ridge(np.stack(muscle), 0.0100, 0.0034 * lean),
        Bump((0, larynx_y, larynx_z), (0.0090, 0.0140, 0.03), (0.0010 + 0.0042 * head.sex) * lean),
        Bump((0, low[1] - 0.006, low[2] + radius + 0.012), (0.0120, 0.0100, 0.03), -0.0050 * lean),
    ]


def mouth_line(head: Head) -> Float[np.ndarray, "k 3"]:
    return head.line((0.0, 0.198, 0.1), (0.006, 0.1965, 0.1), (0.015, 0.199, 0.095), (0.0255, 0.195, 0.087))


def add_ear(body: ImplicitBody, head: Head) -> None:
    outward, upward = unit([1, 0, 0.42]), unit([0, 1, -0.18])
    upward = unit(upward - np.dot(upward, outward) * outward)
    axes = np.stack([outward, upward, np.cross(outward, upward)])
    body.add(head.lump((0.0755, 0.490, -0.0150), (0.0068, 0.0210, 0.0175), 0.006, axes))
    body.add(head.lump((0.0725, 0.380, -0.0075), (0.0072, 0.0165, 0.0115), 0.010, axes))  # lobe
    body.cut(head.lump((0.0845, 0.440, -0.0060), (0.0085, 0.0130, 0.0085), 0.003, axes))  # concha
