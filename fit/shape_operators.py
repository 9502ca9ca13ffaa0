"""What the shape coefficients do to template and joints, prepared once so that many of them cost little.

Betas move the template by S (3V, B), and posed vertices also through the joints: a bone's offset is linear in
the joints, and a vertex follows at most four bones, so that part is K Q with a fixed K (3V, 3J) and a small Q
(3J, B) a pose. E_cpl and the tether are quadratic in S; their matrices do not depend on the state.
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
    """shape: S (3V B); stiff_shape: (L kron I) S; shape_stiff_shape, shape_shape: S^T (L kron I) S and S^T S;
    joint_shape: joints by betas (J 3 B); bone_spread: K (3V 3J); parents (J)."""

    shape: Float[np.ndarray, "w b"]
    stiff_shape: Float[np.ndarray, "w b"]
    shape_stiff_shape: Float[np.ndarray, "b b"]
    shape_shape: Float[np.ndarray, "b b"]
    joint_shape: Float[np.ndarray, "j 3 b"]
    bone_spread: Float[np.ndarray, "w m"]
    parents: tuple[int, ...]

    @staticmethod
    def of(model: BodyModel, laplacian: csr_matrix) -> ShapeOperators:
        """Prepare a model with the Laplacian of its coupling."""
        n, n_betas = len(model.template), model.n_betas
        shape = np.ascontiguousarray(model.shape_directions.reshape(3 * n, n_betas))
        stiff = np.ascontiguousarray((laplacian @ shape.reshape(n, -1)).reshape(3 * n, n_betas))
        return ShapeOperators(
            shape=shape,
            stiff_shape=stiff,
            shape_stiff_shape=shape.T @ stiff,
            shape_shape=shape.T @ shape,
            joint_shape=np.einsum("jv,vcb->jcb", model.joint_regressor, model.shape_directions),
            bone_spread=np.kron(model.weights, np.eye(3)),
            parents=tuple(int(p) for p in model.parents),
        )

    def pull(self, coupling: float, tether: float) -> Float[np.ndarray, "w b"]:
        """(coupling L + tether) S: the pull on the template of a unit of each coefficient."""
        return coupling * self.stiff_shape + tether * self.shape

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
