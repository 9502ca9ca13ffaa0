"""How thick the cloth is, from how much it moves (between sections 4.2 and 4.3 of the paper).

The paper's fit term draws the body to the cloth with one constant, and that constant decides how fat the
result is: too thin without clothes, too fat under loose ones. Here the term expects the cloth at a distance,
and the distance comes from the data: cloth that hangs away from the body moves. The deviation over the frames
of the unposed alignments, less what the model itself may get wrong when the body bends, times a constant, is
the expected thickness; so it is nought where skin is bare and several centimetres under a baggy shirt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix

from fit.body.model import BodyModel
from fit.body.skeleton import JOINT_NAMES, axis_angle_to_matrix
from fit.outliers import robust_variance
from fit.settings import ThicknessSettings

#: Thickness over movement (both along the normal) of the cloth that lies over a bone, by SMPL joint. Cloth is
#: held at shoulders and collar, and there moves nearly as far as it stands away; at the waist and over the
#: seat, where a shirt hangs over trousers, two layers add up while their movements do not. Between what four
#: foreign and nine own sequences ask for, hulls and scans, single values from 2 to 6.
_PER_MOVEMENT = {
    "pelvis": 4.3, "spine1": 3.8, "spine2": 3.1, "spine3": 3.3, "neck": 2.5, "head": 2.5, "collar": 2.7,
    "shoulder": 2.4, "elbow": 2.5, "wrist": 2.5, "hand": 2.5, "hip": 3.4, "knee": 2.9, "ankle": 2.9,
    "foot": 2.5,
}  # fmt: skip


def thickness_per_movement(model: BodyModel) -> Float[np.ndarray, "v"]:
    """The ratio of cloth thickness to its movement over every vertex (V)."""
    by_joint = [_PER_MOVEMENT[name.removeprefix("left_").removeprefix("right_")] for name in JOINT_NAMES]
    return model.weights @ np.array(by_joint)


@dataclass(frozen=True)
class Thickness:
    """Of the cloth over every vertex, m.

    expected (V): mean distance of the cloth from the skin; tolerance (V): how far that may be off; movement
    (V): deviation of the cloth over the frames, the model's own errors taken off.
    """

    expected: Float[np.ndarray, "v"]
    tolerance: Float[np.ndarray, "v"]
    movement: Float[np.ndarray, "v"]


def smoothed_over_mesh(
    value: Float[np.ndarray, "v"], faces: Int[np.ndarray, "f 3"], rounds: int
) -> Float[np.ndarray, "v"]:
    """Repeated means over a vertex and its neighbours: after n rounds about sqrt(n) edges wide."""
    n = len(value)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    adjacency = coo_matrix((np.ones(len(edges)), edges.T), shape=(n, n)).tocsr()
    count = np.asarray(adjacency.sum(axis=1)).ravel() + 1.0
    for _ in range(rounds):
        value = (value + adjacency @ value) / count
    return value


def bending_noise(
    model: BodyModel, poses: Float[np.ndarray, "t j 3"], normals: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v"]:
    """What the model may get wrong when the body bends (V), m: the deviation over the frames of its own
    pose correctives along the normal.

    On naked people of another model the alignments deviate over the frames by about as much: 3-4 mm at the
    shoulders of somebody who lifts his arms, 0.3 mm on a leg that stands.
    """
    features = (axis_angle_to_matrix(poses)[:, 1:] - np.eye(3)).reshape(len(poses), -1)
    moves = (model.pose_directions.reshape(3 * model.n_vertices, -1) @ features.T).reshape(
        model.n_vertices, 3, -1
    )
    return np.einsum("vat,va->vt", moves, normals).std(axis=1, ddof=1)


def expected_thickness(
    offsets: Float[np.ndarray, "t v"],
    noise: Float[np.ndarray, "v"],
    ratio: Float[np.ndarray, "v"],
    faces: Int[np.ndarray, "f 3"],
    settings: ThicknessSettings,
    excess: Float[np.ndarray, "v"] | float = 0.0,
    lost: Bool[np.ndarray, "t v"] | None = None,
) -> Thickness:
    """From offsets of the cloth to the body along the normal (m, positive outwards) in all frames.

    noise: deviation (m) that is not cloth (`bending_noise`); ratio: `thickness_per_movement`; excess: how far
    what was measured stands off the cloth; lost: `lost_points`. Deviations are pooled over the neighbourhood
    before they are compared.
    """
    # One frame with an arm against the trunk must not pass for a coat.
    variance = np.minimum(robust_variance(offsets, lost), settings.largest_movement_m**2)
    variance = smoothed_over_mesh(variance, faces, settings.pooling_rounds)
    own = settings.noise_m**2 + smoothed_over_mesh(noise**2, faces, settings.pooling_rounds)
    movement = np.sqrt(np.maximum(variance - own, 0.0))
    # Cloth that swings by centimetres does not stand away in proportion.
    damped = movement / (1.0 + movement / settings.swing_m)
    cloth = settings.per_movement * ratio * damped
    on_skin, on_cloth = settings.excess_shares
    folded = np.minimum(cloth / settings.folded_m, 1.0)
    expected = cloth + (on_skin + (on_cloth - on_skin) * folded) * excess
    tolerance = np.sqrt(settings.tolerance_m**2 + own + (settings.tolerance_share * expected) ** 2)
    return Thickness(expected, tolerance, movement)


def undressed(
    thickness: Thickness,
    bare: Float[np.ndarray, "v"],
    settings: ThicknessSettings,
    excess: Float[np.ndarray, "v"] | float = 0.0,
) -> Thickness:
    """The clothes' thickness where a share (V) of the surface is known to be bare: there is none on it, and
    only what was measured stands off (excess, m, as in `expected_thickness`)."""
    return replace(
        thickness,
        expected=(1.0 - bare) * thickness.expected + bare * settings.excess_shares[0] * excess,
        tolerance=(1.0 - bare) * thickness.tolerance + bare * settings.tolerance_m,
    )
