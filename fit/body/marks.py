"""Named places on a body's mesh, besides parts and BODY_25: COCO's points, girth lines, usually bare skin,
the names of the shape components.

Read off the rest pose, parts and joints, so that they exist for every body of SMPL's structure; a saved body
carries them as plain arrays for other programs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from .local_variation import COMPONENTS
from .parts import BODY_25, region_mask
from .skeleton import JOINT, JOINT_NAMES

if TYPE_CHECKING:
    from .model import BodyModel

COCO_17: tuple[str, ...] = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
"""The points of COCO's keypoint task, in its order; all of them are BODY_25's as well."""
KEYS = (
    "part_names", "landmark_names", "coco_names", "coco_landmarks", "bare_skin", "shape_names",
    "girth_names", "girth_starts", "girth_edges", "girth_shares",
)  # fmt: skip
"""Arrays that `marks_of` gives."""


def coco_landmarks(model: BodyModel) -> Float[np.ndarray, "17 v"]:
    """COCO's 17 points as combinations of vertices (rows sum to one)."""
    return model.landmarks[[BODY_25.index(name) for name in COCO_17]]


def bare_skin(model: BodyModel) -> Bool[np.ndarray, "v"]:
    """Vertices where people usually wear nothing: hands from the wrist on, and the face.

    The face ends at the ears behind and at a hairline above the eyes, as high above them as the nose's tip
    is below; the neck is left out, since collars and hair cover it.
    """
    points = dict(zip(BODY_25, model.landmarks @ model.template, strict=True))
    nose, eyes = points["nose"], 0.5 * (points["left_eye"] + points["right_eye"])
    ears = 0.5 * (points["left_ear"] + points["right_ear"])
    hairline = eyes[1] + 1.2 * (eyes[1] - nose[1])
    v = model.template
    face = (model.parts == JOINT["head"]) & (v[:, 2] > ears[2]) & (v[:, 1] < hairline)
    return face | region_mask(model.parts, "hand")


def shape_names(model: BodyModel) -> tuple[str, ...]:
    """What each shape component is: measured people's, then named places, then smooth ones; for a body of
    another origin just its number."""
    n, measured = model.n_betas, model.n_anthropometric
    if not model.name.startswith("free:"):
        return tuple(f"component {k}" for k in range(n))
    local = tuple(COMPONENTS)
    names = [f"measured {k}" for k in range(measured)]
    names += [*local, *(f"smooth {k}" for k in range(max(n - measured - len(local), 0)))]
    return tuple(names[:n])


def marks_of(model: BodyModel) -> dict[str, np.ndarray]:
    """All names and places as arrays for a file (KEYS).

    girth_edges (N 2) and girth_shares (N) hold the corners of all girth lines one after another (see
    `sections.GirthLine`); girth_starts (G + 1) says where each of girth_names begins and ends. A body on
    which no tape can be laid has no girths.
    """
    from .girth_lines import girth_lines

    try:
        lines = girth_lines(model)
    except ValueError:
        lines = {}
    lengths = [len(line.shares) for line in lines.values()]
    return {
        "part_names": np.array(JOINT_NAMES),
        "landmark_names": np.array(BODY_25),
        "coco_names": np.array(COCO_17),
        "coco_landmarks": coco_landmarks(model),
        "bare_skin": bare_skin(model),
        "shape_names": np.array(shape_names(model)),
        "girth_names": np.array(list(lines), dtype=np.str_),
        "girth_starts": np.cumsum([0, *lengths]),
        "girth_edges": np.concatenate([np.zeros((0, 2), np.int64), *(line.edges for line in lines.values())]),
        "girth_shares": np.concatenate([np.zeros(0), *(line.shares for line in lines.values())]),
    }
