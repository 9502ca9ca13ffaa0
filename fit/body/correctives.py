"""Pose correctives: what linear skinning lacks, made linear in the joint rotations (207 columns).

For every joint a ridge regression on the entries of R - I, weighed where it shows: in the posed skin, not at
rest. Elbows, knees, hips and shoulders learn from flesh settled on bones in bends of their natural range
(`bends`, `flesh`): creases open, bellies of muscle make way. Then the skin around each joint swells by the
few millimetres that keep the body's volume in those bends. All joints learn from dual-quaternion skinning
over their range as well, which says what to do where no bend was tried.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import lsq_linear

from .bends import Bend, flesh_bends, plain_bends
from .dual_quaternions import blend_dual_quaternions
from .flesh import area_vectors
from .pose_prior import PosePrior
from .sections import volume_m3
from .skeleton import JOINT_NAMES, MIRROR, N_JOINTS, axis_angle_to_matrix, blend_linearly, world_from_rest

N_ROTATIONS = 20  # dual-quaternion examples a joint, drawn over its range
FLESH_TRUST = 12.0  # of one settled bend against one such example, where flesh was simulated
RIDGE = 0.1
N_VOLUME_STEPS = 3
SWELLING_M = (-0.008, 0.025)
DAMPING = 2e-4  # against (share of the volume a metre of swelling brings) squared, 0.1 to 10


@dataclass(frozen=True)
class _Rest:
    """The mean body at rest."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    weights: Float[np.ndarray, "v 24"]
    joints: Float[np.ndarray, "24 3"]


def fit_pose_correctives(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    weights: Float[np.ndarray, "v 24"],
    joints: Float[np.ndarray, "24 3"],
    partner: Int[np.ndarray, "v"],
    seed: int = 1,
) -> Float[np.ndarray, "v 3 207"]:
    """Corrective directions of the mean body, left-right symmetric."""
    directions = np.zeros((len(vertices), 3, 9 * (N_JOINTS - 1)))
    rng = np.random.default_rng(seed)
    rest = _Rest(vertices, faces, weights, joints)
    examples = flesh_bends(vertices, faces, weights, joints)
    done = {j for group in examples for j in group}
    for j in range(1, N_JOINTS):
        if j not in done and not JOINT_NAMES[j].startswith("right_"):
            examples[j,] = plain_bends(j, vertices, faces, weights, joints)
    for group, bends in examples.items():
        _fit_group(directions, group, bends, rest, rng)
    mirrored = mirror_correctives(directions, partner)
    on_midline = np.repeat(MIRROR[1:] == np.arange(1, N_JOINTS), 9)
    return np.where(on_midline, 0.5, 1.0) * (directions + mirrored)


def _fit_group(
    directions: Float[np.ndarray, "v 3 207"],
    group: tuple[int, ...],
    bends: list[Bend],
    rest: "_Rest",
    rng: np.random.Generator,
) -> None:
    """Fill the columns of the joints of a group, together."""
    mixed = np.zeros(len(rest.vertices), dtype=bool)
    for j in group:
        mixed |= (rest.weights[:, j] > 0.002) & (rest.weights[:, j] < 0.998)
    for bend in bends:
        mixed[bend.skin] = True
    touched = np.flatnonzero(mixed)
    n, every = len(touched), np.arange(len(touched))
    place = np.full(len(rest.vertices), -1)
    place[touched] = every
    vertices, weights = rest.vertices[touched], rest.weights[touched]

    features, normals, pulls, swells = [], [], [], []

    def learn(rotations: np.ndarray, bend: Bend | None) -> None:
        bones = world_from_rest(rotations, rest.joints)
        linear, blended = blend_linearly(vertices, weights, bones)
        skin, trust = every, 1.0
        if bend is None:
            wanted = blend_dual_quaternions(vertices, weights, bones)
        else:
            skin, trust, wanted = place[bend.skin], FLESH_TRUST, bend.wanted
        weighed = np.zeros((n, 3, 3))
        weighed[skin] = trust * blended[skin].transpose(0, 2, 1)
        gap = np.zeros((n, 3, 1))
        gap[skin, :, 0] = wanted - linear[skin]
        features.append((rotations[list(group)] - np.eye(3)).ravel())
        normals.append((weighed @ blended).ravel())
        pulls.append((weighed @ gap).ravel())
        if bend is not None:
            gap[skin, :, 0] = bend.swell
            swells.append((weighed @ gap)[:, :, 0])

    for rotations in _over_the_range(group, rng):
        learn(rotations, None)
    for bend in bends:
        learn(bend.rotations, bend)

    # Sums over the examples of feature x feature x (A^T A) and feature x (A^T gap), all vertices at once.
    phi = np.array(features)
    n_features, size, n_bends = phi.shape[1], 3 * phi.shape[1], len(bends)
    products = (phi[:, :, None] * phi[:, None, :]).reshape(len(phi), -1)
    square = (products.T @ np.array(normals)).reshape(n_features, n_features, n, 3, 3)
    matrix = square.transpose(2, 0, 3, 1, 4).reshape(n, size, size) + RIDGE * np.eye(size)
    right = np.empty((n, n_features, 3, 1 + n_bends))
    right[..., 0] = (phi.T @ np.array(pulls)).reshape(n_features, n, 3).transpose(1, 0, 2)
    for k, swell in enumerate(swells):
        right[..., 1 + k] = phi[len(phi) - n_bends + k][None, :, None] * swell[:, None, :]
    solved = np.linalg.solve(matrix, right.reshape(n, size, -1)).reshape(n, n_features, 3, 1 + n_bends)
    fitted = solved @ np.append(1.0, _swelling(rest, touched, bends, solved, phi[len(phi) - n_bends :]))
    for k, j in enumerate(group):
        directions[touched, :, 9 * (j - 1) : 9 * j] = fitted[:, 9 * k : 9 * k + 9].transpose(0, 2, 1)


def _swelling(
    rest: "_Rest",
    touched: Int[np.ndarray, "n"],
    bends: list[Bend],
    solved: Float[np.ndarray, "n f 3 k"],
    phi: Float[np.ndarray, "b f"],
) -> Float[np.ndarray, "b"]:
    """How far (m) the skin must swell in each bend for the body to keep its volume in all of them."""
    amount = np.zeros(len(bends))
    whole = volume_m3(rest.vertices, rest.faces)
    for _ in range(N_VOLUME_STEPS):
        lacks, rates = np.zeros(len(bends)), np.zeros((len(bends), len(bends)))
        for s, bend in enumerate(bends):
            moves = np.einsum("f,nfak->nak", phi[s], solved)
            corrected = rest.vertices.copy()
            corrected[touched] += moves @ np.append(1.0, amount)
            bones = world_from_rest(bend.rotations, rest.joints)
            posed, blended = blend_linearly(corrected, rest.weights, bones)
            lacks[s] = (whole - volume_m3(posed, rest.faces)) / whole
            outward = area_vectors(posed, rest.faces)[touched]
            rates[s] = np.einsum("na,nab,nbk->k", outward, blended[touched], moves[:, :, 1:]) / whole
        # A little damping of the amounts: bends that are nearly the same share what they need.
        stacked = np.concatenate([rates, np.sqrt(DAMPING) * np.eye(len(bends))])
        target = np.concatenate([lacks + rates @ amount, np.zeros(len(bends))])
        amount = lsq_linear(stacked, target, bounds=SWELLING_M).x
    return amount


def _over_the_range(group: tuple[int, ...], rng: np.random.Generator) -> Float[np.ndarray, "n 24 3 3"]:
    """Rotations of one joint of the group at a time, evenly over its natural range."""
    prior = PosePrior.standard()
    low, high = (np.concatenate([np.zeros(3), r]).reshape(-1, 3) for r in (prior.low, prior.high))
    turns = np.zeros((N_ROTATIONS * len(group), N_JOINTS, 3))
    for k, j in enumerate(group):
        rows = slice(k * N_ROTATIONS, (k + 1) * N_ROTATIONS)
        turns[rows, j] = rng.uniform(low[j], high[j], (N_ROTATIONS, 3))
    return axis_angle_to_matrix(turns)


def mirror_correctives(
    directions: Float[np.ndarray, "v 3 207"], partner: Int[np.ndarray, "v"]
) -> Float[np.ndarray, "v 3 207"]:
    """The correctives seen in the mirror: joints swap sides, and a rotation's xy, xz, yx, zx entries change
    sign.
    """
    flip = np.array([-1.0, 1.0, 1.0])
    per_joint = directions.reshape(len(directions), 3, N_JOINTS - 1, 3, 3)
    swapped = per_joint[partner][:, :, MIRROR[1:] - 1]
    signs = flip[:, None, None, None] * np.outer(flip, flip)[None, None]
    return (swapped * signs[None]).reshape(directions.shape)
