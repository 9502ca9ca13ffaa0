"""Pose correctives: what linear skinning lacks, made linear in the joint rotations (207 columns).

For every joint a ridge regression on the entries of R - I, weighed where it shows: in the posed skin, not at
rest. Elbows, knees, hips and shoulders learn from flesh settled on bones in bends of their natural range
(`bends`, `flesh`): creases open, bellies of muscle make way. Then the skin around each joint swells by the
few millimetres that keep volume in those bends, of the whole and of the segment around the joint: for the
mean body, a thin and a heavy one alike, as well as one set of correctives can. All joints learn from
dual-quaternion skinning over their range as well, which says what to do where no bend was tried.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import lsq_linear

from .bends import Bend, flesh_bends, plain_bends
from .dual_quaternions import blend_dual_quaternions
from .flesh import area_vectors
from .pose_prior import PosePrior
from .segments import Segment
from .skeleton import (
    JOINT,
    JOINT_NAMES,
    MIRROR,
    N_JOINTS,
    PARENTS,
    axis_angle_to_matrix,
    blend_linearly,
    world_from_rest,
)

N_ROTATIONS = 20  # dual-quaternion examples a joint, drawn over its range
FLESH_TRUST = 12.0  # of one settled bend against one such example, where flesh was simulated
RIDGE = 0.1
N_VOLUME_STEPS = 3
SWELLING_M = (-0.008, 0.025)
SEGMENT_SHARE = 0.4  # of a per cent of the segment against one of the body
HEAVINESS = (
    0.3  # a body counts as its volume to this power where limbs join the trunk: heavy ones overlap there
)
DAMPING = 2e-4  # against (share of the volume a metre of swelling brings) squared, 0.1 to 10


@dataclass(frozen=True)
class Build:
    """A body at rest: vertices and joints, m."""

    vertices: Float[np.ndarray, "v 3"]
    joints: Float[np.ndarray, "24 3"]


@dataclass(frozen=True)
class _Rest:
    """The mean body at rest, and others of the same mesh whose volume the correctives keep as well."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    weights: Float[np.ndarray, "v 24"]
    joints: Float[np.ndarray, "24 3"]
    builds: tuple[Build, ...]


def fit_pose_correctives(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    weights: Float[np.ndarray, "v 24"],
    joints: Float[np.ndarray, "24 3"],
    partner: Int[np.ndarray, "v"],
    others: tuple[Build, ...] = (),
    seed: int = 1,
) -> Float[np.ndarray, "v 3 207"]:
    """Corrective directions of the mean body, left-right symmetric; others: bodies besides the mean one whose
    volume counts as much.
    """
    directions = np.zeros((len(vertices), 3, 9 * (N_JOINTS - 1)))
    rng = np.random.default_rng(seed)
    rest = _Rest(vertices, faces, weights, joints, (Build(vertices, joints), *others))
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
    right = np.empty((n, n_features, 3, 1 + 2 * n_bends))
    right[..., 0] = (phi.T @ np.array(pulls)).reshape(n_features, n, 3).transpose(1, 0, 2)
    own = phi[len(phi) - n_bends :]
    near = rest.weights[:, _segment_joints(group)].sum(1)
    for k, swell in enumerate(swells):
        towards = own[k][None, :, None] * swell[:, None, :]
        right[..., 1 + k] = near[touched, None, None] * towards
        right[..., 1 + n_bends + k] = towards - right[..., 1 + k]
    solved = np.linalg.solve(matrix, right.reshape(n, size, -1)).reshape(n, n_features, 3, 1 + 2 * n_bends)
    moves = np.einsum("bf,nfak->bnak", own, solved)
    fitted = solved @ np.append(1.0, _swelling(rest, touched, group, bends, moves))
    for k, j in enumerate(group):
        directions[touched, :, 9 * (j - 1) : 9 * j] = fitted[:, 9 * k : 9 * k + 9].transpose(0, 2, 1)


def _swelling(
    rest: "_Rest",
    touched: Int[np.ndarray, "n"],
    group: tuple[int, ...],
    bends: list[Bend],
    moves: Float[np.ndarray, "b n 3 k"],
) -> Float[np.ndarray, "s"]:
    """How far (m) the skin must swell in each bend, first that of the segment, then that beside it, for all
    bodies to keep their volume: of the whole, and of the segment around the joints.
    """
    n = len(bends)
    amount = np.zeros(2 * n)
    owner = rest.weights.argmax(1)
    segments = (
        (Segment.of(rest.faces, np.ones(len(owner), dtype=bool)), 1.0),
        (Segment.of(rest.faces, np.isin(owner, _segment_joints(group))), SEGMENT_SHARE),
    )
    heaviness = HEAVINESS if {JOINT["left_hip"], JOINT["left_shoulder"]} & {*group} else 0.0
    volumes = [[segment.volume_m3(b.vertices) for segment, _ in segments] for b in rest.builds]
    for _ in range(N_VOLUME_STEPS):
        # A little damping of the amounts: bends that are nearly the same share what they need.
        rates, targets = [np.sqrt(DAMPING) * np.eye(2 * n)], [np.zeros(2 * n)]
        for bend, own in zip(bends, moves, strict=True):
            correction = own @ np.append(1.0, amount)
            for build, before in zip(rest.builds, volumes, strict=True):
                trust = (before[0] / volumes[0][0]) ** heaviness
                bones = world_from_rest(bend.rotations, build.joints)
                corrected = build.vertices.copy()
                corrected[touched] += correction
                posed, blended = blend_linearly(corrected, rest.weights, bones)
                swell = np.zeros((len(posed), 3, 2 * n))
                swell[touched] = blended[touched] @ own[:, :, 1:]
                counted = segments[:1] if bend.combined else segments
                for (segment, share), volume in zip(counted, before, strict=False):
                    outward = area_vectors(segment.closed(posed), segment.faces)
                    rate = np.einsum("na,nak->k", outward, segment.closed(swell)) / volume
                    lack = 1 - segment.volume_m3(posed) / volume
                    rates.append(trust * share * rate[None])
                    targets.append(trust * share * (lack + rate[None] @ amount))
        amount = lsq_linear(np.concatenate(rates), np.concatenate(targets), bounds=SWELLING_M).x
    return amount


def _segment_joints(group: tuple[int, ...]) -> list[int]:
    """The joints whose skin is the segment around these: they and their parents."""
    return sorted({*group, *(PARENTS[j] for j in group)})


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
