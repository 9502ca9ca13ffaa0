"""From one person's measurements to the left half of the body as an implicit surface, and to the 24 joints.

Frame while building: floor y = 0, +z front, +x the body's left, T-pose, palms down, metres. Trunk and limbs
are lofts, muscles and fat ellipsoids and cones, all joined by a smooth union whose radius is chosen part by
part.
"""

import numpy as np
from jaxtyping import Float

from .anthropometry import Measurements
from .foot import add_foot
from .girth_solver import modelled_for
from .hand import add_hand
from .head import add_head
from .implicit import ImplicitBody
from .limbs import add_arm, add_leg
from .plan import plan
from .trunk import add_breast, add_neck, add_seat, add_shoulder_girdle, add_torso, part_thighs


def assemble(m: Measurements) -> tuple[ImplicitBody, Float[np.ndarray, "24 3"]]:
    """The body and joints modelled with exactly these numbers, whatever a tape then reads on it.

    The order of the parts matters: a smooth union bulges where a later part meets an earlier one.
    """
    build = plan(m)
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
        add_seat,
        part_thighs,
        add_foot,
    ):
        add(body, build)
    return body, build.joints


def make_person(m: Measurements) -> tuple[ImplicitBody, Float[np.ndarray, "24 3"]]:
    """The implicit left half body and the joints of a person on whom a tape reads these measurements."""
    return assemble(modelled_for(m, assemble))
