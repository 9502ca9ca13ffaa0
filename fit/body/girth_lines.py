"""Named girth lines on a body model, and the measures of any of its shapes.

A line is found on the mean body and then rides on the mesh: its corners are points of mesh edges, so it
follows every shape and pose. Measuring a shape lays the tape anew, at the levels of that shape.
"""

import numpy as np
from jaxtyping import Float

from .model import BodyModel
from .sections import GirthLine
from .tape import Subject, measures_of


def girth_lines(model: BodyModel) -> dict[str, GirthLine]:
    """The girths of `anthropometry.GIRTHS` and the one under the chest, on the left side of limbs.

    For any body with SMPL's 24 joints. Raises ValueError, naming the girth, where the body has none there.
    """
    joints = model.joint_regressor @ model.template
    return Subject(model.template, model.faces, joints, model.parts).girth_lines()


def measure_body(model: BodyModel, betas: Float[np.ndarray, "b"]) -> dict[str, float]:
    """What a tape reads on this shape in the T-pose (see `tape.measures_of`): metres, litres, kilograms.

    The sex that the density needs is the model's gender; midway where that is neutral or unknown.
    """
    template = model.shaped(betas)
    sex = {"female": 0.0, "male": 1.0}.get(model.gender, 0.5)
    return measures_of(template, model.faces, model.joint_regressor @ template, model.parts, sex)
