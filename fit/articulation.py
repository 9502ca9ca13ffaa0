"""Skinning with derivatives as the solver needs them: which joints move which vertex, and how.

The same function as `body.skinning` (JAX), which is the reference in the tests. Here the derivative by the
pose is a list of 3x3 blocks a vertex, one for each joint above its bones (six of 24 on average), because
dense rows of all parameters cost most of a step's time. The betas act through the bones' offsets; see
`shape_operators`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fit.body.model import BodyModel
from fit.body.skeleton import axis_angle_to_matrix

#: As in `body.skinning`, which is not imported here because it starts JAX.
N_BONES, SMALLEST_CORRECTIVE_M = 4, 1e-7


def _descendants(parents: tuple[int, ...]) -> Float[np.ndarray, "j j"]:
    behind = np.eye(len(parents))
    for k, parent in enumerate(parents):
        if parent >= 0:
            behind[:, k] += behind[:, parent]
    return behind


def _cross_matrices(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    out = np.zeros((*vectors.shape, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    return out - np.swapaxes(out, -1, -2)


def left_jacobians(pose: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3 3"]:
    """Columns: the small rotation (rad, in the parent's axes) that a change of each vector entry causes."""
    t2 = (pose**2).sum(1)
    small = t2 < 1e-4
    safe = np.where(small, 1.0, t2)
    angle = np.sqrt(safe)
    versine = np.where(small, 0.5 - t2 / 24 + t2 * t2 / 720, (1 - np.cos(angle)) / safe)
    rest = np.where(small, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (angle - np.sin(angle)) / (safe * angle))
    cross = _cross_matrices(pose)
    return np.eye(3) + versine[:, None, None] * cross + rest[:, None, None] * (cross @ cross)


@dataclass(frozen=True)
class Chain:
    """own (J 3 3): each joint's rotation; frame (J 3 3): the axes it acts in; world (J 3 3): bone to body;
    posed_joints (J 3); offsets (J 3): a rest point x goes to world x + offset."""

    own: Float[np.ndarray, "j 3 3"]
    frame: Float[np.ndarray, "j 3 3"]
    world: Float[np.ndarray, "j 3 3"]
    posed_joints: Float[np.ndarray, "j 3"]
    offsets: Float[np.ndarray, "j 3"]


@dataclass(frozen=True)
class Articulation:
    """What skinning needs of a model, and which joints move which vertex.

    bone_idx, bone_weight (V 4); pairs (V + 1), pair_joint (C), correctives (C 3 9): the pose correctives,
    sorted by vertex; ptr (V + 1), joint (n): the joints that move each vertex, ascending; behind (n): bits of
    the vertex's bones that hang behind the joint; pair (n): its corrective or -1.
    """

    parents: tuple[int, ...]
    bone_idx: Int[np.ndarray, "v 4"]
    bone_weight: Float[np.ndarray, "v 4"]
    pairs: Int[np.ndarray, "_"]
    pair_joint: Int[np.ndarray, "c"]
    correctives: Float[np.ndarray, "c 3 9"]
    ptr: Int[np.ndarray, "_"]
    joint: Int[np.ndarray, "n"]
    behind: Int[np.ndarray, "n"]
    pair: Int[np.ndarray, "n"]

    @staticmethod
    def of(model: BodyModel) -> Articulation:
        """Prepare a model."""
        n, n_joints = model.n_vertices, model.n_joints
        parents = tuple(int(p) for p in model.parents)
        order = np.argsort(-model.weights, axis=1, kind="stable")[:, :N_BONES].astype(np.int64)
        strongest = np.take_along_axis(model.weights, order, 1)
        strongest = strongest / strongest.sum(1, keepdims=True)
        by_joint = model.pose_directions.reshape(n, 3, n_joints - 1, 9).transpose(0, 2, 1, 3)
        vertex, driver = np.nonzero(np.abs(by_joint).max((2, 3)) > SMALLEST_CORRECTIVE_M)
        pair_of = np.full((n, n_joints), -1, dtype=np.int64)
        pair_of[vertex, driver + 1] = np.arange(len(vertex))
        bits = np.zeros((n, n_joints), dtype=np.int64)
        hangs = _descendants(parents)  # [j, k]: k hangs behind j
        for k in range(order.shape[1]):
            bits += ((hangs[:, order[:, k]].T > 0) & (strongest[:, k, None] > 0)) * (1 << k)
        moved, joint = np.nonzero((bits > 0) | (pair_of >= 0))
        return Articulation(
            parents,
            order,
            strongest,
            np.searchsorted(vertex, np.arange(n + 1)),
            driver + 1,
            np.ascontiguousarray(by_joint[vertex, driver]),
            np.searchsorted(moved, np.arange(n + 1)),
            joint,
            bits[moved, joint],
            pair_of[moved, joint],
        )

    def chain(self, joints: Float[np.ndarray, "j 3"], pose: Float[np.ndarray, "j 3"]) -> Chain:
        """Where a pose takes the bones, without the translation."""
        own = axis_angle_to_matrix(pose)
        n_joints = len(own)
        world, posed_joints = np.empty((n_joints, 3, 3)), np.empty((n_joints, 3))
        frame = np.empty((n_joints, 3, 3))  # in which a joint's own rotation acts
        for j, parent in enumerate(self.parents):
            frame[j] = np.eye(3) if parent < 0 else world[parent]
            world[j] = frame[j] @ own[j]
            at = joints[j] if parent < 0 else joints[j] - joints[parent]
            posed_joints[j] = at if parent < 0 else posed_joints[parent] + frame[j] @ at
        offsets = posed_joints - np.einsum("jab,jb->ja", world, joints)
        return Chain(own, frame, world, posed_joints, offsets)

    def posed(
        self,
        template: Float[np.ndarray, "v 3"],
        joints: Float[np.ndarray, "j 3"],
        pose: Float[np.ndarray, "j 3"],
        translation: Float[np.ndarray, "3"],
    ) -> PosedBody:
        """Skin a template about these joints, with derivatives."""
        from fit import compiled_skin

        chain = self.chain(joints, pose)
        own, n_joints = chain.own, len(self.parents)
        turn = left_jacobians(pose)
        features = (own - np.eye(3)).reshape(-1, 9)
        d_rotation = np.einsum("jeab,jbc->jace", _cross_matrices(np.swapaxes(turn, 1, 2)), own)
        n = len(template)
        corrected, vertices = np.empty((n, 3)), np.empty((n, 3))
        turned, blocks = np.empty((n, 3, 3)), np.empty((len(self.joint), 3, 3))
        compiled_skin.pose_vertices(
            np.ascontiguousarray(template),
            self.bone_idx,
            self.bone_weight,
            self.pairs,
            self.pair_joint,
            self.correctives,
            features,
            chain.world,
            chain.offsets,
            corrected,
            turned,
            vertices,
        )
        compiled_skin.pose_blocks(
            corrected,
            turned,
            self.bone_idx,
            self.bone_weight,
            self.correctives,
            chain.world,
            chain.offsets,
            chain.posed_joints,
            chain.frame @ turn,
            np.ascontiguousarray(d_rotation.reshape(n_joints, 9, 3)),
            self.ptr,
            self.joint,
            self.behind,
            self.pair,
            blocks,
        )
        return PosedBody(self, vertices + translation, turned, blocks)


@dataclass(frozen=True)
class PosedBody:
    """A posed body: vertices (V 3); rotations (V 3 3), the derivative by the template; blocks (n 3 3), the
    derivative by the pose for the (vertex, joint) pairs of `articulation`."""

    articulation: Articulation
    vertices: Float[np.ndarray, "v 3"]
    rotations: Float[np.ndarray, "v 3 3"]
    blocks: Float[np.ndarray, "n 3 3"]

    def moved_by(
        self,
        template: Float[np.ndarray, "v 3"],
        pose: Float[np.ndarray, "j 3"],
        shift: Float[np.ndarray, "3"],
        bones: Float[np.ndarray, "j 3"],
    ) -> Float[np.ndarray, "v 3"]:
        """First-order move of the posed vertices by moves of template, pose, translation, and bone
        offsets."""
        from fit import compiled_skin

        at, out = self.articulation, np.empty_like(self.vertices)
        compiled_skin.moved_by(
            self.rotations,
            at.ptr,
            at.joint,
            self.blocks,
            at.bone_idx,
            at.bone_weight,
            template,
            pose,
            shift,
            bones,
            out,
        )
        return out

    def gathered(
        self, force: Float[np.ndarray, "v 3"]
    ) -> tuple[
        Float[np.ndarray, "v 3"], Float[np.ndarray, "j 3"], Float[np.ndarray, "3"], Float[np.ndarray, "j 3"]
    ]:
        """The transpose of `moved_by`: what forces on the vertices do to its four arguments."""
        from fit import compiled_skin

        at, n_joints = self.articulation, len(self.articulation.parents)
        on_template = np.empty_like(self.vertices)
        on_pose, on_shift, on_bones = np.zeros((n_joints, 3)), np.zeros(3), np.zeros((n_joints, 3))
        compiled_skin.gathered(
            self.rotations,
            at.ptr,
            at.joint,
            self.blocks,
            at.bone_idx,
            at.bone_weight,
            force,
            on_template,
            on_pose,
            on_shift,
            on_bones,
        )
        return on_template, on_pose, on_shift, on_bones

    def squared(self, lumped: Float[np.ndarray, "v 6"], with_bones: bool) -> Float[np.ndarray, "m m"]:
        """J^T H J over pose (3 J), translation (3) and bone offsets (3 J; zero unless with_bones), for a
        block-diagonal H."""
        from fit import compiled_skin

        at = self.articulation
        size = 3 + 6 * len(at.parents)
        out = np.zeros((size, size))
        compiled_skin.dense_of_moves(
            lumped, at.ptr, at.joint, self.blocks, at.bone_idx, at.bone_weight, with_bones, out
        )
        return np.triu(out) + np.triu(out, 1).T

    def jacobian(self) -> Float[np.ndarray, "m p"]:
        """dv / d(pose, translation), dense (3V, 3J + 3), for who wants all of it."""
        at = self.articulation
        n, n_joints = len(self.vertices), len(at.parents)
        out = np.zeros((n, 3, n_joints + 1, 3))
        out[np.repeat(np.arange(n), np.diff(at.ptr)), :, at.joint] = self.blocks
        out[:, :, n_joints] = np.eye(3)
        return out.reshape(3 * n, -1)
