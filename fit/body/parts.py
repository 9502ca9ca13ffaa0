"""Names on the mesh: a part per vertex, coarse regions, and OpenPose's 25 points as combinations of vertices.

Everything is read off the rest pose, the weights and the joint regressor, so that it works on any file of
SMPL's structure: no vertex numbers of a particular mesh. Frame: T-pose, y up, +z front, +x the body's left.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from .skeleton import JOINT, JOINT_NAMES

if TYPE_CHECKING:
    from .model import BodyModel

REGIONS: dict[str, tuple[str, ...]] = {
    "torso": ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar"),
    "arm": ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    "leg": ("left_hip", "right_hip", "left_knee", "right_knee"),
    "neck": ("neck",),
    "hand": ("left_wrist", "right_wrist", "left_hand", "right_hand"),
    "foot": ("left_ankle", "right_ankle", "left_foot", "right_foot"),
    "head": ("head",),
}
BODY_25: tuple[str, ...] = (
    "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow",
    "left_wrist", "mid_hip", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee",
    "left_ankle", "right_eye", "left_eye", "right_ear", "left_ear", "left_big_toe", "left_small_toe",
    "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
N_NEAREST = 6  # vertices averaged around a point of the skin: steadier under a free-form template than one


def part_labels(weights: Float[np.ndarray, "v j"]) -> Int[np.ndarray, "v"]:
    """The bone that moves each vertex most."""
    return weights.argmax(1).astype(np.int64)


def region_mask(parts: Int[np.ndarray, "v"], *regions: str) -> np.ndarray:
    """Whether each vertex lies in one of these regions (keys of REGIONS)."""
    wanted = [JOINT[name] for region in regions for name in REGIONS[region]]
    return np.isin(parts, wanted)


def region_of_vertices(model: "BodyModel") -> np.ndarray:
    """The region (key of REGIONS) of each vertex, as an array of strings (V,)."""
    of_joint = {JOINT[name]: region for region, names in REGIONS.items() for name in names}
    return np.array([of_joint[j] for j in range(len(JOINT_NAMES))])[model.parts]


def around(
    template: Float[np.ndarray, "v 3"], allowed: Int[np.ndarray, "k"], point: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "v"]:
    """A regressor row: the allowed vertices nearest to a point, near ones more."""
    distance = np.linalg.norm(template[allowed] - point, axis=1)
    nearest = np.argsort(distance, kind="stable")[:N_NEAREST]
    share = 1 / (distance[nearest] + 0.003)
    row = np.zeros(len(template))
    row[allowed[nearest]] = share / share.sum()
    return row


def _face_points(
    template: Float[np.ndarray, "v 3"], head: Int[np.ndarray, "k"]
) -> dict[str, Float[np.ndarray, "3"]]:
    """Nose tip, eyes and ears of a head in the rest pose, from its extents and common proportions."""
    v = template[head]
    middle = np.median(v[:, 0])
    crown = v[:, 1].max()
    central = v[np.abs(v[:, 0] - middle) < 0.015]
    nose = central[central[:, 2].argmax()]
    nose = np.array([middle, nose[1], nose[2]])
    above_nose = crown - nose[1]  # about 0.145 m in an adult; the eyes lie a quarter of it above the nose tip
    ear_level = nose[1] + 0.12 * above_nose
    band = v[np.abs(v[:, 1] - ear_level) < 0.20 * above_nose]
    half_breadth = np.abs(band[:, 0] - middle).max()
    beside = band[np.abs(band[:, 0] - middle) > 0.85 * half_breadth]
    points = {"nose": nose}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        points[f"{side}_eye"] = nose + above_nose * np.array([sign * 0.216, 0.25, -0.20])
        points[f"{side}_ear"] = np.array([middle + sign * half_breadth, ear_level, np.median(beside[:, 2])])
    return points


def _foot_points(
    template: Float[np.ndarray, "v 3"],
    foot: Int[np.ndarray, "f"],
    toes: Int[np.ndarray, "t"],
    outwards: float,
) -> dict[str, Float[np.ndarray, "3"]]:
    """Big toe, small toe and heel of one foot in the rest pose; `outwards` is +1 on the left."""
    v = template[toes]
    floor = v[:, 1].min()
    forward = v[:, 2]
    spread = outwards * v[:, 0]
    inner, outer = spread.min(), spread.max()
    length = forward.max() - forward.min()
    big = v[(spread - inner) < 0.35 * (outer - inner)]
    small = v[(outer - spread) < 0.15 * (outer - inner)]
    sole = template[foot]
    low = sole[sole[:, 1] < floor + 0.045]
    heel = low[low[:, 2].argmin()]
    return {
        "big_toe": big[big[:, 2].argmax()] - [0, 0, 0.05 * length],
        "small_toe": small[small[:, 2].argmax()] - [0, 0, 0.05 * length],
        "heel": heel,
    }


def body_25_regressor(
    template: Float[np.ndarray, "v 3"],
    parts: Int[np.ndarray, "v"],
    joint_regressor: Float[np.ndarray, "j v"],
) -> Float[np.ndarray, "25 v"]:
    """OpenPose BODY_25 points from vertices, rows summing to one.

    Limb joints are the skeleton's; the neck is the middle of the shoulders and the mid-hip that of the hips,
    as annotators place them. Face and feet come from the skin of the rest pose.
    """
    for name in ("head", "left_ankle", "right_ankle", "left_foot", "right_foot"):
        if not (parts == JOINT[name]).any():
            raise ValueError(f"no vertex follows the {name} joint, so its landmarks cannot be placed.")
    rows = {name: joint_regressor[JOINT[name]] for name in BODY_25 if name in JOINT and name != "neck"}
    rows["neck"] = 0.5 * (rows["left_shoulder"] + rows["right_shoulder"])
    rows["mid_hip"] = 0.5 * (rows["left_hip"] + rows["right_hip"])
    head = np.flatnonzero(parts == JOINT["head"])
    for name, point in _face_points(template, head).items():
        rows[name] = around(template, head, point)
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        toes = np.flatnonzero(parts == JOINT[f"{side}_foot"])
        foot = np.flatnonzero((parts == JOINT[f"{side}_ankle"]) | (parts == JOINT[f"{side}_foot"]))
        for name, point in _foot_points(template, foot, toes, outwards).items():
            rows[f"{side}_{name}"] = around(template, foot, point)
    return np.stack([rows[name] for name in BODY_25])
