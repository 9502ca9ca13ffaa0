"""Gauss-Newton steps of the single-frame objective: of the parameters alone, and with the template.

The data term is a matrix over vertices and edges (mesh_blocks.py), the derivatives by the pose are short
lists (articulation.py), so a product with the whole matrix costs a millisecond. The joint step is solved
inexactly by preconditioned conjugate gradients; the preconditioner is the scalar factor of
coupling * L + diag(trace H_ii / 3) + tether for the template and the dense block for the parameters. Dense
blocks take the data term lumped on the vertices: the same to a percent, and never smaller, so steps stay
safe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from fit import energy as terms
from fit.articulation import PosedBody
from fit.closest import Depths
from fit.mesh_blocks import MeshMatrix
from fit.state import BodyState

if TYPE_CHECKING:
    from fit.solver import Objective

PCG_ITERATIONS = 15
PCG_TOLERANCE = 0.05
#: The template's factor serves so many steps: the weights of the points change little from one to the next.
STEPS_A_FACTOR = 3


@dataclass(frozen=True)
class Linearised:
    """An objective at a state: energy; data term's matrix and right-hand side (V 3) over posed vertices; the
    posed body with its derivatives; difference (V 3): of template and target; nearest (N): the triangle of
    every point; depths: of the vertices in a container."""

    energy: float
    matrix: MeshMatrix
    rhs: Float[np.ndarray, "v 3"]
    body: PosedBody
    difference: Float[np.ndarray, "v 3"]
    nearest: Int[np.ndarray, "n"]
    depths: Depths | None


class Steps:
    """The steps of one minimisation; holds what does not change between them."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        fitter, unknowns, weights = objective.fitter, objective.unknowns, objective.weights
        self.n_joints = len(fitter.model.parents)
        n_pose = 3 * self.n_joints
        #: Which columns of (pose, translation) may change, and how many of the first betas.
        self.columns = np.flatnonzero(np.r_[np.full(n_pose, unknowns.pose), np.full(3, unknowns.translation)])
        n_betas = fitter.model.n_betas
        wanted = n_betas if unknowns.n_betas is None else unknowns.n_betas
        self.n_betas = min(n_betas, wanted) if unknowns.betas else 0
        #: Whether the template is coupled to the betas, and whether the joints follow them.
        self.coupled = self.n_betas > 0 and objective.target is None
        self.jointed = self.n_betas > 0 and objective.joints is None
        self._pull = (
            np.ascontiguousarray(fitter.shape.pull(weights.coupling, weights.tether)[:, : self.n_betas])
            if self.coupled and unknowns.template
            else None
        )
        self._factor: Any = None
        self._age = 0

    def __call__(
        self, lin: Linearised, state: BodyState, damping: float
    ) -> tuple[Float[np.ndarray, "v 3"] | None, Float[np.ndarray, "p"]]:
        """Step of the template (None where it is held) and of (pose, translation, betas)."""
        if self.objective.unknowns.template:
            return self._joint_step(lin, state, damping)
        return None, self._parameter_step(lin, state, damping)

    def _by_joints(self, state: BodyState) -> Float[np.ndarray, "m b"]:
        """Q of the active betas: zero where the joints are held."""
        if not self.jointed:
            return np.zeros((3 * self.n_joints, self.n_betas))
        return self.objective.fitter.shape.offsets_by_betas(state.pose)[:, : self.n_betas]

    def _priors(self, state: BodyState) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p"]]:
        """Hessian and right-hand side of the priors on the active (pose, translation) and betas."""
        at, w, n_pose = self.objective, self.objective.weights, 3 * self.n_joints
        hessian, rhs = np.zeros((n_pose + 3, n_pose + 3)), np.zeros(n_pose + 3)
        hessian[3:n_pose, 3:n_pose] = w.pose_prior * at.pose_precision
        half = terms.gaussian_prior(state.pose[1:].ravel(), at.pose_mean, at.pose_precision)[1]
        rhs[3:n_pose] = -w.pose_prior * half
        columns, n = self.columns, self.n_betas
        return (
            block_diag(hessian[np.ix_(columns, columns)], w.shape_prior * np.eye(n)),
            np.concatenate([rhs[columns], -w.shape_prior * state.betas[:n]]),
        )

    def _parameter_step(self, lin: Linearised, state: BodyState, damping: float) -> Float[np.ndarray, "p"]:
        """Step of pose, translation and betas alone; the template moves with M(beta)."""
        from fit import compiled_skin

        hessian, rhs = self._priors(state)
        columns, n_columns, n = self.columns, len(self.columns), self.n_betas
        n_pose, lumped, body = 3 * self.n_joints, lin.matrix.lumped, lin.body
        of_pose = body.squared(lumped, with_bones=False)
        hessian[:n_columns, :n_columns] += of_pose[np.ix_(columns, columns)]
        _, on_pose, on_shift, _ = body.gathered(lin.rhs)
        rhs[:n_columns] += np.concatenate([on_pose.ravel(), on_shift])[columns]
        if n:
            limbs = body.articulation
            shape = self.objective.fitter.shape.shape.reshape(len(lumped), 3, -1)[:, :, :n]
            if not self.coupled:
                shape = np.zeros_like(shape)
            moves, weighted = np.empty((len(lumped), 3, n)), np.empty((len(lumped), 3, n))
            compiled_skin.shape_moves(
                body.rotations,
                np.ascontiguousarray(shape),
                limbs.bone_idx,
                limbs.bone_weight,
                self._by_joints(state).reshape(-1, 3, n),
                moves,
            )
            compiled_skin.weighted_moves(lumped, moves, weighted)
            across = np.zeros((n_pose + 3, n))
            compiled_skin.gathered_columns(
                limbs.ptr, limbs.joint, body.blocks, weighted, across[:n_pose], across[n_pose:]
            )
            flat = moves.reshape(-1, n)
            hessian[n_columns:, n_columns:] += flat.T @ weighted.reshape(-1, n)
            hessian[:n_columns, n_columns:] += across[columns]
            hessian[n_columns:, :n_columns] += across[columns].T
            rhs[n_columns:] += flat.T @ lin.rhs.ravel()
        hessian[np.diag_indices_from(hessian)] += damping
        return self._whole_step(cho_solve(cho_factor(hessian), rhs))

    def _whole_step(self, active_step: Float[np.ndarray, "a"]) -> Float[np.ndarray, "p"]:
        """A step of the active parameters, written into one of all (pose, translation, betas)."""
        n_before = 3 * self.n_joints + 3
        step = np.zeros(n_before + self.objective.fitter.model.n_betas)
        step[self.columns] = active_step[: len(self.columns)]
        step[n_before : n_before + self.n_betas] = active_step[len(self.columns) :]
        return step

    def _template_factor(self, lin: Linearised) -> Any:
        """Factor of the template's part for one axis, in single precision: it only steers the iteration."""
        if self._factor is None or self._age >= STEPS_A_FACTOR:
            w = self.objective.weights
            matrix = w.coupling * self.objective.fitter.laplacian + diags(
                lin.matrix.mean_diagonal + w.tether + 1e-9
            )
            self._factor = splu(
                matrix.astype(np.float32).tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            self._age = 0
        self._age += 1
        return self._factor

    def _joint_step(
        self, lin: Linearised, state: BodyState, damping: float
    ) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "p"]]:
        """Inexact Gauss-Newton step of template and parameters together."""
        from fit import compiled_skin

        fitter, w, body = self.objective.fitter, self.objective.weights, lin.body
        n, n_pose = len(fitter.model.template), 3 * self.n_joints
        columns, n_columns, n_betas = self.columns, len(self.columns), self.n_betas
        by_joints, shape_pull = self._by_joints(state), self._pull
        strength = w.coupling * fitter.mesh.strength

        def narrowed(on_pose: np.ndarray, on_shift: np.ndarray, on_bones: np.ndarray) -> np.ndarray:
            own = np.concatenate([on_pose.ravel(), on_shift])[columns]
            return np.concatenate([own, by_joints.T @ on_bones.ravel()])

        hessian, rhs_parameters = self._priors(state)
        hessian[np.diag_indices_from(hessian)] += damping
        if self.coupled:
            hessian[n_columns:, n_columns:] += fitter.shape.stiffness(w.coupling, w.tether)[
                :n_betas, :n_betas
            ]
        pulled = np.zeros_like(lin.difference)
        compiled_skin.add_coupling(fitter.mesh.edges, strength, w.tether, lin.difference, pulled)
        on_template, *on_others = body.gathered(lin.rhs)
        rhs_template = on_template - pulled
        rhs_parameters += narrowed(*on_others)
        if self.coupled:
            rhs_parameters[n_columns:] += fitter.shape.shape[:, :n_betas].T @ pulled.ravel()

        of_moves = body.squared(lin.matrix.lumped, with_bones=self.jointed)
        across = of_moves[columns, n_pose + 3 :] @ by_joints
        corner = by_joints.T @ of_moves[n_pose + 3 :, n_pose + 3 :] @ by_joints
        dense = hessian + np.block([[of_moves[np.ix_(columns, columns)], across], [across.T, corner]])
        dense_factor = cho_factor(dense)
        scalar = self._template_factor(lin)

        def product(x: np.ndarray) -> np.ndarray:
            xt, xp, betas = x[: 3 * n].reshape(n, 3), x[3 * n :], x[3 * n + n_columns :]
            own = np.zeros(n_pose + 3)
            own[columns] = xp[:n_columns]
            bones = (by_joints @ betas).reshape(-1, 3)
            moved = body.moved_by(xt, own[:n_pose].reshape(-1, 3), own[n_pose:], bones)
            out_t, *others = body.gathered(lin.matrix @ moved)
            compiled_skin.add_coupling(fitter.mesh.edges, strength, w.tether, xt, out_t)
            out_p = hessian @ xp + narrowed(*others)
            if shape_pull is not None:
                from_betas, on_betas = np.empty(3 * n, np.float32), np.empty(n_betas, np.float32)
                compiled_skin.both_ways(
                    shape_pull, betas.astype(np.float32), xt.ravel().astype(np.float32), from_betas, on_betas
                )
                out_t -= from_betas.reshape(n, 3)
                out_p[n_columns:] -= on_betas
            return np.concatenate([out_t.ravel(), out_p])

        def precondition(r: np.ndarray) -> np.ndarray:
            of_template = scalar.solve(r[: 3 * n].reshape(n, 3).astype(np.float32))
            return np.concatenate([of_template.ravel(), cho_solve(dense_factor, r[3 * n :])])

        solution = conjugate_gradients(
            product, precondition, np.concatenate([rhs_template.ravel(), rhs_parameters])
        )
        return solution[: 3 * n].reshape(n, 3), self._whole_step(solution[3 * n :])


def conjugate_gradients(
    product: Callable[[np.ndarray], np.ndarray],
    precondition: Callable[[np.ndarray], np.ndarray],
    rhs: np.ndarray,
    iterations: int = PCG_ITERATIONS,
    tolerance: float = PCG_TOLERANCE,
) -> np.ndarray:
    """Preconditioned conjugate gradients, stopped early: an inexact step costs Gauss-Newton nothing."""
    x = np.zeros_like(rhs)
    r = rhs
    z = precondition(r)
    p = z
    rz = float(r @ z)
    start = rz
    for _ in range(iterations):
        if rz <= tolerance**2 * start or rz <= 0.0:
            break
        ap = product(p)
        alpha = rz / float(p @ ap)
        x = x + alpha * p
        r = r - alpha * ap
        z = precondition(r)
        rz, previous = float(r @ z), rz
        p = z + (rz / previous) * p
    return x
