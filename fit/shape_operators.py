"""What the shape coefficients do to template and joints, prepared once so that many of them cost little.

Betas move the template by S (3V, B), and posed vertices also through the joints: a bone's offset is linear in
the joints by a small Q (3J, B) a pose. E_cpl and the tether are quadratic in S; their matrices do not depend
on the state. Where S only steers an iteration it is kept in single precision: half the memory to read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_matrix

from fit.body.model import BodyModel
from fit.body.skeleton import axis_angle_to_matrix


@dataclass(frozen=True)
class ShapeOperators:
    """shape: S (3V B); single_shape, single_stiff_shape: S and (L kron I) S in single precision;
    shape_stiff_shape, shape_shape: S^T (L kron I) S and S^T S; joint_rest (J 3), joint_shape (J 3 B): joints
    and their dependence on the betas; parents (J)."""

    shape: Float[np.ndarray, "w b"]
    single_shape: Float[np.ndarray, "w b"]
    single_stiff_shape: Float[np.ndarray, "w b"]
    shape_stiff_shape: Float[np.ndarray, "b b"]
    shape_shape: Float[np.ndarray, "b b"]
    joint_rest: Float[np.ndarray, "j 3"]
    joint_shape: Float[np.ndarray, "j 3 b"]
    parents: tuple[int, ...]

    @staticmethod
    def of(model: BodyModel, laplacian: csr_matrix) -> ShapeOperators:
        """Prepare a model with the Laplacian of its coupling."""
        n, n_betas = len(model.template), model.n_betas
        shape = np.ascontiguousarray(model.shape_directions.reshape(3 * n, n_betas))
        stiff = np.ascontiguousarray((laplacian @ shape.reshape(n, -1)).reshape(3 * n, n_betas))
        return ShapeOperators(
            shape=shape,
            single_shape=shape.astype(np.float32),
            single_stiff_shape=stiff.astype(np.float32),
            shape_stiff_shape=shape.T @ stiff,
            shape_shape=shape.T @ shape,
            joint_rest=model.joint_regressor @ model.template,
            joint_shape=np.einsum("jv,vcb->jcb", model.joint_regressor, model.shape_directions),
            parents=tuple(int(p) for p in model.parents),
        )

    def pull(self, coupling: float, tether: float) -> Float[np.ndarray, "w b"]:
        """(coupling L + tether) S: the pull on the template of a unit of each coefficient (single
        precision)."""
        return np.float32(coupling) * self.single_stiff_shape + np.float32(tether) * self.single_shape

    def stiffness(self, coupling: float, tether: float) -> Float[np.ndarray, "b b"]:
        """S^T (coupling L + tether) S."""
        return coupling * self.shape_stiff_shape + tether * self.shape_shape

    def offsets_by_betas(self, pose: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "m b"]:
        """Q (3J B): how the bones' offsets change with the betas in a pose (they move the joints)."""
        own = axis_angle_to_matrix(pose)
        joints = self.joint_shape
        world, posed = [own[0]], [joints[0]]
        for j, parent in enumerate(self.parents[1:], start=1):
            world.append(world[parent] @ own[j])
            posed.append(posed[parent] + world[parent] @ (joints[j] - joints[parent]))
        offsets = np.stack(posed) - np.stack(world) @ joints
        return offsets.reshape(-1, joints.shape[2])
