"""Skinning weights: ramps across a tilted plane at each joint, from the root outwards, then diffusion.

Hips, knees and elbows have narrow ramps: linear blending loses volume with the ramp's width times the body's
own section, and what the correctives give back is the same length for thin and heavy bodies. The less is
lost, the less they differ.
"""

import numpy as np
from jaxtyping import Float, Int

from .anthropometry import Measurements
from .correspondence import neighbour_mean
from .implicit import unit
from .plan import height_map
from .ramp import smooth_step
from .skeleton import JOINT, MIRROR

MOST_BONES = 4  # a vertex may follow, as in SMPL
DIFFUSION_ROUNDS = 2


class _Handing:
    """Weights under construction: each joint hands a share of its parents' skin on to the child."""

    def __init__(self, n_vertices: int) -> None:
        self.weights = np.zeros((n_vertices, len(JOINT)))
        self.weights[:, JOINT["pelvis"]] = 1

    def on(self, parents: tuple[str, ...], child: str, share: Float[np.ndarray, "v"]) -> None:
        for parent in parents:
            moved = self.weights[:, JOINT[parent]] * share
            self.weights[:, JOINT[child]] += moved
            self.weights[:, JOINT[parent]] -= moved


def make_skin_weights(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    partner: Int[np.ndarray, "v"],
    joints: Float[np.ndarray, "24 3"],
    person: Measurements,
) -> Float[np.ndarray, "v 24"]:
    """Weights of the mean body (pelvis joint at the origin); rows sum to one, at most four bones each.

    `person` gives the landmark heights of the mean body.
    """
    y_of = height_map(person)

    def level(fraction: float) -> float:
        return y_of(fraction) - y_of(0.545)

    def joint(name: str) -> Float[np.ndarray, "3"]:
        return joints[JOINT[name]]

    def across(name: str, normal: np.ndarray, low: float, high: float, offset: float = 0.0) -> np.ndarray:
        return smooth_step(low, high, (p - joint(name)) @ normal - offset)

    p = np.stack([np.abs(vertices[:, 0]), vertices[:, 1], vertices[:, 2]], 1)  # everything as if on the left
    x, y = p[:, 0], p[:, 1]
    hand = _Handing(len(vertices))

    # In front the lowest plane goes down, the highest up: between them the belly moves in one piece, and
    # those with a large one lose hardly more of their volume than others when they bow.
    for parent, child, slope, offset, half in (
        ("pelvis", "spine1", -0.6, 0.0, 0.065),
        ("spine1", "spine2", 0.0, 0.0, 0.055),
        ("spine2", "spine3", 0.4, 0.005, 0.050),
    ):
        plane = joint(child)[1] + slope * (p[:, 2] - joint(child)[2]) + offset
        hand.on((parent,), child, smooth_step(-half, half, y - plane))
    hand.on(("spine3",), "neck", across("neck", np.array([0, 0.88, 0.47]), -0.035, 0.035, 0.002))
    hand.on(("neck",), "head", across("head", np.array([0, 0.80, 0.60]), -0.032, 0.032, 0.012))

    collar = smooth_step(0.015, 0.135, x) * smooth_step(level(0.742), level(0.805), y) * (y < level(0.87))
    # The side of the chest must not follow a raised arm: the arm's zone fades out below the armpit.
    past_armpit = smooth_step(0.0, 0.05, x - joint("left_shoulder")[0])
    arm_zone = np.maximum(smooth_step(level(0.728), level(0.795), y), past_armpit)
    shoulder = smooth_step(-0.060, 0.055, x - joint("left_shoulder")[0] - 0.004) * arm_zone
    elbow = smooth_step(-0.008, 0.008, x - joint("left_elbow")[0])
    wrist = smooth_step(-0.022, 0.022, x - joint("left_wrist")[0])
    fingers = smooth_step(-0.016, 0.016, x - joint("left_hand")[0])

    # The groin's plane runs from the crotch up to outside the hip joint; at the midline both legs pull half.
    below_groin = (p - joint("left_hip")) @ np.array([0.42, -0.907, 0.0])
    # Narrow in front, where the skin folds, wider behind, where it goes round the buttock.
    behind = smooth_step(-0.03, 0.05, joint("left_hip")[2] - p[:, 2])
    hip = smooth_step(-0.075, 0.065, below_groin / (0.3 + 0.25 * behind))
    # Between the thighs the skin stays with the pelvis, down to the crotch and a little into the thighs.
    crotch = y[(partner == np.arange(len(y))) & (np.abs(below_groin) < 0.15)].min()
    hip *= 1 - 0.95 * smooth_step(-0.05, 0.0, y - crotch) * smooth_step(-0.06, 0.0, -x)
    hip *= (y < level(0.60)) & (x < 0.5)
    leg_down = unit(joint("left_ankle") - joint("left_hip"))
    knee = across("left_knee", leg_down, -0.025, 0.025)
    ankle = across("left_ankle", np.array([0, -0.86, 0.51]), -0.032, 0.032, 0.004)
    forward = unit((joint("left_foot") - joint("left_ankle")) * [1, 0, 1])
    toes = across("left_foot", forward, -0.022, 0.022, 0.004)

    on_left = (vertices[:, 0] >= 0).astype(np.float64)
    for side, here in (("left_", on_left), ("right_", 1 - on_left)):
        hand.on(("spine2", "spine3"), side + "collar", collar * here)
        hand.on(("neck",), side + "collar", 0.8 * collar * here)
        hand.on(
            ("spine1", "spine2", "spine3", "neck", "head", side + "collar"),
            side + "shoulder",
            shoulder * here,
        )
        hand.on((side + "shoulder",), side + "elbow", elbow * here)
        hand.on((side + "elbow",), side + "wrist", wrist * here)
        hand.on((side + "wrist",), side + "hand", fingers * here)
        hand.on(("pelvis", "spine1"), side + "hip", hip * here)
        hand.on((side + "hip",), side + "knee", knee * here)
        hand.on((side + "knee",), side + "ankle", ankle * here)
        hand.on((side + "ankle",), side + "foot", toes * here)

    weights = hand.weights
    weights = 0.5 * (weights + weights[partner][:, MIRROR])  # seam vertices share both sides
    smooth = neighbour_mean(faces, len(vertices))
    for _ in range(DIFFUSION_ROUNDS):
        weights = 0.5 * weights + 0.5 * (smooth @ weights)
    return keep_strongest(weights, partner)


def keep_strongest(
    weights: Float[np.ndarray, "v 24"], partner: Int[np.ndarray, "v"]
) -> Float[np.ndarray, "v 24"]:
    """At most MOST_BONES bones a vertex, the same on both sides, rows summing to one.

    A seam vertex may hold left and right bones in equal parts: where a pair does not fit whole, both go.
    """
    ranked = np.sort(weights, 1)[:, ::-1]
    threshold = ranked[:, MOST_BONES - 1]
    tie = ranked[:, MOST_BONES] > threshold * (1 - 1e-6)
    limit = np.where(tie, threshold * (1 + 1e-6), threshold * (1 - 1e-6))
    limit = np.maximum(limit, 0.004)  # smaller shares are diffusion's dust
    limit = np.maximum(limit, limit[partner])
    kept = np.where(weights >= limit[:, None], weights, 0)
    return kept / kept.sum(1, keepdims=True)
