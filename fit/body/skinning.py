"""Linear blend skinning with a free-form template, in JAX (Loper et al., SMPL, equations 2-4 and 9).

    v_i = A_i (T_i + P_i(pose)) + c_i + translation,   A_i = sum_k w_ik R_k,   at most four bones k a vertex

T is any template, not only the model's: that is what the paper's free-form unknown needs (Zhang et al. 2017,
section 3). Joints are given, so the caller decides whether they follow the betas or stay. Call
`fit.jax_setup.setup_jax` first (SkinningArrays.of does). Metres, radians; everything in the body's frame but
for the final translation.

The Jacobian is analytic: turning joint j by a small rotation moves everything behind it about the joint's
posed position, so one pass over (vertex, bone) pairs serves all pose parameters.
"""

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

if TYPE_CHECKING:
    from .model import BodyModel

N_BONES = 4
SMALLEST_CORRECTIVE_M = 1e-7  # correctives below it (a tenth of a micrometre at a right angle) are left out


@partial(
    jax.tree_util.register_dataclass,
    data_fields=[
        "template",
        "shape_directions",
        "joint_template",
        "joint_directions",
        "bone_idx",
        "bone_weight",
        "weights",
        "corrective_vertex",
        "corrective_joint",
        "correctives",
    ],
    meta_fields=["parents"],
)
class SkinningArrays:
    """A body model on the device, made once and passed to every function here (a JAX pytree).

    template (V 3), shape_directions (V 3 B), joint_template (J 3), joint_directions (J 3 B), bone_idx and
    bone_weight (V 4), weights (V J), and the correctives as C pairs of a vertex and a joint that moves it:
    corrective_vertex (C), corrective_joint (C), correctives (C 3 9); most vertices are touched by few joints.
    """

    def __init__(
        self,
        template: Float[Array, "v 3"],
        shape_directions: Float[Array, "v 3 b"],
        joint_template: Float[Array, "j 3"],
        joint_directions: Float[Array, "j 3 b"],
        bone_idx: Int[Array, "v 4"],
        bone_weight: Float[Array, "v 4"],
        weights: Float[Array, "v j"],
        corrective_vertex: Int[Array, "c"],
        corrective_joint: Int[Array, "c"],
        correctives: Float[Array, "c 3 9"],
        parents: tuple[int, ...],
    ) -> None:
        self.template, self.shape_directions = template, shape_directions
        self.joint_template, self.joint_directions = joint_template, joint_directions
        self.bone_idx, self.bone_weight, self.weights = bone_idx, bone_weight, weights
        self.corrective_vertex, self.corrective_joint = corrective_vertex, corrective_joint
        self.correctives, self.parents = correctives, parents

    @staticmethod
    def of(model: "BodyModel") -> "SkinningArrays":
        """Move a model to the device (starts JAX, in double precision)."""
        from fit.jax_setup import setup_jax

        setup_jax()
        order = np.argsort(-model.weights, axis=1, kind="stable")[:, :N_BONES]
        strongest = np.take_along_axis(model.weights, order, 1)
        strongest = strongest / strongest.sum(1, keepdims=True)
        compact = np.zeros_like(model.weights)
        np.put_along_axis(compact, order, strongest, 1)
        by_joint = model.pose_directions.reshape(model.n_vertices, 3, model.n_joints - 1, 9).transpose(
            0, 2, 1, 3
        )
        vertex, joint = np.nonzero(np.abs(by_joint).max((2, 3)) > SMALLEST_CORRECTIVE_M)
        if not len(vertex):  # a model without correctives keeps one that does nothing: shapes stay simple
            vertex, joint = np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)
        return SkinningArrays(
            template=jnp.asarray(model.template),
            shape_directions=jnp.asarray(model.shape_directions),
            joint_template=jnp.asarray(model.joint_regressor @ model.template),
            joint_directions=jnp.asarray(
                np.einsum("jv,vcb->jcb", model.joint_regressor, model.shape_directions)
            ),
            bone_idx=jnp.asarray(order, dtype=jnp.int32),
            bone_weight=jnp.asarray(strongest),
            weights=jnp.asarray(compact),
            corrective_vertex=jnp.asarray(vertex, dtype=jnp.int32),
            corrective_joint=jnp.asarray(joint + 1, dtype=jnp.int32),
            correctives=jnp.asarray(by_joint[vertex, joint]),
            parents=tuple(int(p) for p in model.parents),
        )


class _Bones(NamedTuple):
    rotations: Float[Array, "j 3 3"]  # each joint's own, relative to its parent
    world: Float[Array, "j 3 3"]  # bone to body frame
    posed_joints: Float[Array, "j 3"]
    offsets: Float[Array, "j 3"]  # a rest point x goes to world @ x + offset


def _cross_matrix(vectors: Float[Array, "... 3"]) -> Float[Array, "... 3 3"]:
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    zero = jnp.zeros_like(x)
    return jnp.stack(
        [jnp.stack([zero, -z, y], -1), jnp.stack([z, zero, -x], -1), jnp.stack([-y, x, zero], -1)], -2
    )


def _series(
    squared_angle: Float[Array, "n"],
) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "n"]]:
    """sin t / t, (1 - cos t) / t2, (t - sin t) / t3; a series near zero, where quotients lose digits."""
    small = squared_angle < 1e-4
    safe = jnp.where(small, 1.0, squared_angle)
    angle = jnp.sqrt(safe)
    t2 = squared_angle
    return (
        jnp.where(small, 1 - t2 / 6 + t2 * t2 / 120, jnp.sin(angle) / angle),
        jnp.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, (1 - jnp.cos(angle)) / safe),
        jnp.where(small, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (angle - jnp.sin(angle)) / (safe * angle)),
    )


def rotation_matrices(axis_angle: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Rodrigues' formula, smooth (and differentiable) through zero."""
    sine, versine, _ = _series((axis_angle**2).sum(-1))
    cross = _cross_matrix(axis_angle)
    return jnp.eye(3) + sine[:, None, None] * cross + versine[:, None, None] * cross @ cross


def left_jacobians(axis_angle: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Columns: the small rotation (rad, in the parent's axes) that a change of each vector entry causes."""
    _, versine, rest = _series((axis_angle**2).sum(-1))
    cross = _cross_matrix(axis_angle)
    return jnp.eye(3) + versine[:, None, None] * cross + rest[:, None, None] * cross @ cross


def _bones(joints: Float[Array, "j 3"], pose: Float[Array, "j 3"], parents: tuple[int, ...]) -> _Bones:
    rotations = rotation_matrices(pose)
    world, posed = [rotations[0]], [joints[0]]
    for j, parent in enumerate(parents[1:], start=1):
        world.append(world[parent] @ rotations[j])
        posed.append(posed[parent] + world[parent] @ (joints[j] - joints[parent]))
    stacked, posed_joints = jnp.stack(world), jnp.stack(posed)
    offsets = posed_joints - jnp.einsum("jab,jb->ja", stacked, joints)
    return _Bones(rotations, stacked, posed_joints, offsets)


def _corrected(
    arrays: SkinningArrays, template: Float[Array, "v 3"], rotations: Float[Array, "j 3 3"]
) -> Float[Array, "v 3"]:
    """The template with its pose correctives (SMPL, equation 9)."""
    features = (rotations - jnp.eye(3)).reshape(-1, 9)[arrays.corrective_joint]
    moves = jnp.einsum("cak,ck->ca", arrays.correctives, features)
    return template.at[arrays.corrective_vertex].add(moves, indices_are_sorted=True)


def _blend(arrays: SkinningArrays, bones: _Bones) -> tuple[Float[Array, "v 3 3"], Float[Array, "v 3"]]:
    n_joints = len(arrays.parents)
    rotations = (arrays.weights @ bones.world.reshape(n_joints, 9)).reshape(-1, 3, 3)
    return rotations, arrays.weights @ bones.offsets


@jax.jit
def shape_template(arrays: SkinningArrays, betas: Float[Array, "b"]) -> Float[Array, "v 3"]:
    """M(beta, 0): the model's own template of these shape coefficients."""
    return arrays.template + arrays.shape_directions @ betas


@jax.jit
def joints_from_betas(arrays: SkinningArrays, betas: Float[Array, "b"]) -> Float[Array, "j 3"]:
    """J(beta): the rest joints of these shape coefficients."""
    return arrays.joint_template + arrays.joint_directions @ betas


@jax.jit
def skin(
    arrays: SkinningArrays,
    template: Float[Array, "v 3"],
    joints: Float[Array, "j 3"],
    pose: Float[Array, "j 3"],
    translation: Float[Array, "3"],
) -> Float[Array, "v 3"]:
    """Posed vertices of a free-form template; `pose`: rotation vectors, the root's about its own joint."""
    bones = _bones(joints, pose, arrays.parents)
    rotations, offsets = _blend(arrays, bones)
    corrected = _corrected(arrays, template, bones.rotations)
    return jnp.einsum("vab,vb->va", rotations, corrected) + offsets + translation


@jax.jit
def posed_joints(
    arrays: SkinningArrays,
    joints: Float[Array, "j 3"],
    pose: Float[Array, "j 3"],
    translation: Float[Array, "3"],
) -> Float[Array, "j 3"]:
    """Where the joints of the rest pose go."""
    return _bones(joints, pose, arrays.parents).posed_joints + translation


@jax.jit
def skin_with_jacobian(
    arrays: SkinningArrays,
    template: Float[Array, "v 3"],
    joints: Float[Array, "j 3"],
    pose: Float[Array, "j 3"],
    translation: Float[Array, "3"],
) -> tuple[Float[Array, "v 3"], Float[Array, "v 3 3"], Float[Array, "v 3 p"]]:
    """Posed vertices, dv/dT (V 3 3: the blended rotations), and dv/d(pose, translation, betas) (V 3 P).

    P = 3 J + 3 + B: pose joint by joint, translation, then the betas as far as they move the JOINTS; what
    they do to the template is not in it, since the template is an unknown of its own (add rotations @
    shape_directions for the model's own template).
    """
    parents = arrays.parents
    n_vertices, n_joints = template.shape[0], len(parents)
    bones = _bones(joints, pose, parents)
    rotations, offsets = _blend(arrays, bones)
    corrected = _corrected(arrays, template, bones.rotations)
    vertices = jnp.einsum("vab,vb->va", rotations, corrected) + offsets

    # Where each of a vertex's bones would take it, times its weight; and which bones lie behind each joint.
    taken = (
        jnp.einsum("vkab,vb->vka", bones.world[arrays.bone_idx], corrected) + bones.offsets[arrays.bone_idx]
    )
    taken = taken * arrays.bone_weight[:, :, None]
    behind = jnp.asarray(_descendants(parents))[:, arrays.bone_idx]  # (J V 4)
    share = (behind * arrays.bone_weight).sum(-1)  # (J V)
    arm = jnp.einsum("jvk,vka->jva", behind, taken) - share[:, :, None] * bones.posed_joints[:, None]

    # Small world rotations per pose entry: the parent's frame carries the joint's left Jacobian.
    turn = left_jacobians(pose)
    parent_world = jnp.concatenate([jnp.eye(3)[None], bones.world[jnp.asarray(parents[1:])]])
    axes = parent_world @ turn  # (J 3 3): column a is the axis of entry a
    cross_axes = _cross_matrix(jnp.swapaxes(axes, 1, 2))  # (J entry 3 3)
    by_pose = jnp.einsum("jeab,jvb->vaje", cross_axes, arm)

    # The correctives' own share: d(R - I) = [column of the left Jacobian] x R.
    d_rotation = jnp.einsum("jeab,jbc->jace", _cross_matrix(jnp.swapaxes(turn, 1, 2)), bones.rotations)
    d_features = d_rotation.reshape(n_joints, 9, 3)
    moves = jnp.einsum("cak,cke->cae", arrays.correctives, d_features[arrays.corrective_joint])
    moves = rotations[arrays.corrective_vertex] @ moves
    by_pose = by_pose.at[arrays.corrective_vertex, :, arrays.corrective_joint].add(moves)

    # Betas move joints; a bone's offset is its posed joint minus its turned rest joint.
    d_joints = arrays.joint_directions
    d_posed = [d_joints[0]]
    for j, parent in enumerate(parents[1:], start=1):
        d_posed.append(d_posed[parent] + bones.world[parent] @ (d_joints[j] - d_joints[parent]))
    d_offsets = jnp.stack(d_posed) - jnp.einsum("jab,jbk->jak", bones.world, d_joints)
    by_betas = (arrays.weights @ d_offsets.reshape(n_joints, -1)).reshape(n_vertices, 3, -1)

    by_translation = jnp.broadcast_to(jnp.eye(3), (n_vertices, 3, 3))
    jacobian = jnp.concatenate([by_pose.reshape(n_vertices, 3, -1), by_translation, by_betas], -1)
    return vertices + translation, rotations, jacobian


def _descendants(parents: tuple[int, ...]) -> Float[np.ndarray, "j j"]:
    """[j, k] is 1 where bone k hangs behind joint j or is its own."""
    behind = np.eye(len(parents))
    for k, parent in enumerate(parents):
        if parent >= 0:
            behind[:, k] += behind[:, parent]
    return behind
