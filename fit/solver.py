"""Gauss-Newton with Levenberg damping on template, pose, translation and shape together.

Normal equations are accumulated in vertex space (normal_equations.py), so the number of scan points hardly
matters. The joint step is solved inexactly by preconditioned conjugate gradients; the preconditioner is the
scalar factor of coupling * L + diag(trace H_ii / 3) + tether for the template and the dense block for the
parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

from fit import energy as terms
from fit.body.model import BodyModel
from fit.closest import ClosestPoints, Container, closest_points
from fit.normal_equations import MeshPattern, accumulate, edge_laplacian
from fit.settings import StageWeights
from fit.shape_operators import ShapeOperators
from fit.state import BodyState
from fit.surface import vertex_normals

PCG_ITERATIONS = 15
PCG_TOLERANCE = 0.05
#: Radians: a joint that turns farther in one step has left the region where the linearisation means anything.
LARGEST_ROTATION = 0.5


@dataclass(frozen=True)
class ScanPoints:
    """What the objective sees of a scan: points (N 3) m, outward normals (N 3), weight (N), 0 ignores a
    point."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, "n"]
    is_skin: np.ndarray


@dataclass(frozen=True)
class Unknowns:
    """Which unknowns a stage may change; n_betas: only the first so many coefficients (None: all)."""

    template: bool = True
    pose: bool = True
    translation: bool = True
    betas: bool = True
    n_betas: int | None = None


@dataclass(frozen=True)
class Outcome:
    """Result of one minimisation: the state, the energy a step, and whether it came to rest."""

    state: BodyState
    energies: tuple[float, ...]
    converged: bool


@dataclass
class _Linearised:
    energy: float
    hessian: csr_matrix  # data term, posed vertices (3V, 3V)
    rhs: Float[np.ndarray, "v 3"]
    rotations: Float[np.ndarray, "v 3 3"]
    jacobian: Float[np.ndarray, "m p"]  # posed vertices by pose and translation


@dataclass(frozen=True)
class Fitter:
    """A body model ready for fitting: device arrays, sparsity, Laplacian. Made once, used for every frame."""

    model: BodyModel
    coupling_weight: Float[np.ndarray, "v"]
    arrays: object = field(repr=False)
    pattern: MeshPattern = field(repr=False)
    laplacian: csr_matrix = field(repr=False)
    shape: ShapeOperators = field(repr=False)

    @staticmethod
    def of(model: BodyModel) -> Fitter:
        """Prepare a model (starts JAX)."""
        from fit.body.parts import region_of_vertices
        from fit.body.skinning import SkinningArrays
        from fit.jax_setup import setup_jax

        setup_jax()
        region = region_of_vertices(model)
        # The paper's w: hands and feet, where scans are noisy (and hulls hardly resolve fingers), hold on to
        # the model.
        weight = np.where(np.isin(region, ("hand", "foot", "head")), 3.0, 1.0)
        laplacian = edge_laplacian(model.faces, len(model.template), weight)
        return Fitter(
            model=model,
            coupling_weight=weight,
            # Without betas: `shape` knows what they do, and a Jacobian by each of them would cost most of the
            # time.
            arrays=SkinningArrays.of(model.with_betas(0)),
            pattern=MeshPattern.of(model.faces, len(model.template)),
            laplacian=laplacian,
            shape=ShapeOperators.of(model, laplacian),
        )

    @property
    def n_pose(self) -> int:
        """Number of pose parameters (3 J)."""
        return 3 * len(self.model.parents)

    def shaped(self, betas: Float[np.ndarray, "b"]) -> Float[np.ndarray, "v 3"]:
        """M(beta, 0): the model's template of these coefficients."""
        return self.model.template + self.model.shape_directions @ betas

    def joints(self, betas: Float[np.ndarray, "b"]) -> Float[np.ndarray, "j 3"]:
        """J(beta): joints of the zero pose."""
        return self.model.joint_regressor @ self.shaped(betas)

    def posed(
        self, state: BodyState, joints: Float[np.ndarray, "j 3"] | None = None
    ) -> Float[np.ndarray, "v 3"]:
        """W(T, J, pose) + translation. Joints come from the betas unless given."""
        from fit.body.skinning import skin

        joints = self.joints(state.betas) if joints is None else joints
        return np.asarray(skin(self.arrays, state.template, joints, state.pose, state.translation))

    def posed_joints(self, state: BodyState, joints: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3"]:
        """Where the joints of the zero pose go in this state."""
        from fit.body.skinning import posed_joints

        return np.asarray(posed_joints(self.arrays, joints, state.pose, state.translation))

    def linearised(
        self, state: BodyState, joints: Float[np.ndarray, "j 3"] | None
    ) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3 3"], Float[np.ndarray, "m p"]]:
        """Posed vertices, dv/dT (V 3 3), and dv/d(pose, translation) (3V, 3J + 3)."""
        from fit.body.skinning import skin_with_jacobian

        joints = self.joints(state.betas) if joints is None else joints
        vertices, rotations, jacobian = skin_with_jacobian(
            self.arrays, state.template, joints, state.pose, state.translation
        )
        return (
            np.asarray(vertices),
            np.asarray(rotations),
            np.asarray(jacobian).reshape(3 * len(state.template), -1),
        )


@dataclass(frozen=True)
class Objective:
    """The single-frame objective E(T, M(beta, 0), pose; scan) for one scan and one set of weights.

    target: what E_cpl pulls the template to: None couples to M(beta, 0) (paper 4.1), a fixed template (V 3)
    couples to that (paper 4.3). fit_scale (V): factor on lambda_fit a vertex of the body. container: the
    closed surface the body must stay inside of. joints: fixed joints (J 3), or None for J(beta). pose_mean,
    pose_precision: of the Gaussian pose prior over all joints but the root.
    """

    fitter: Fitter
    scan: ScanPoints
    weights: StageWeights
    unknowns: Unknowns
    pose_mean: Float[np.ndarray, "m"]
    pose_precision: Float[np.ndarray, "m m"]
    target: Float[np.ndarray, "v 3"] | None = None
    joints: Float[np.ndarray, "j 3"] | None = None
    fit_scale: Float[np.ndarray, "v"] | None = None
    container: Container | None = None

    def container_terms(
        self, vertices: Float[np.ndarray, "v 3"]
    ) -> tuple[float, ClosestPoints, Float[np.ndarray, "v"]] | None:
        """E_inside: vertices outside a closed scan (a visual hull contains the person) are drawn in."""
        if self.container is None or self.weights.inside == 0.0:
            return None
        closest = self.container.closest(vertices)
        depth = closest.distance + self.weights.margin_m
        energy, weight = terms.huber(depth, self.weights.inside_m)
        scale = self.weights.inside * (depth > 0)
        return float((scale * energy).sum()), replace(closest, distance=depth), scale * weight

    def point_terms(self, closest: ClosestPoints) -> terms.PerPoint:
        """Energy and weight of every scan point: skin, or outside + fit."""
        w, d = self.weights, closest.distance
        scale = len(self.fitter.model.template) / max(len(d), 1) * self.scan.weight
        if w.gate:
            # A point whose normal opposes the body's belongs to another part (inner thighs, arm beside
            # trunk).
            cosine = (self.scan.normals * closest.normals).sum(1)
            scale = scale * np.clip((cosine + 0.2) / 0.6, 0.0, 1.0)
        skin_energy, skin_weight = terms.skin(d, w.sigma_m)
        if not w.cloth:
            return scale * skin_energy, scale * skin_weight
        outside_energy, outside_weight = terms.outside(d, w.outside_m)
        fit_energy, fit_weight = terms.fit(d, w.sigma_m)
        fit = np.full(len(d), w.fit)
        if self.fit_scale is not None:
            corners = self.fitter.model.faces[closest.triangle_idx]
            fit = fit * (closest.barycentric * self.fit_scale[corners]).sum(1)
        energy = outside_energy + fit * fit_energy
        weight = outside_weight + fit * fit_weight
        if self.scan.is_skin.any():
            energy = np.where(self.scan.is_skin, skin_energy, energy)
            weight = np.where(self.scan.is_skin, skin_weight, weight)
        return scale * energy, scale * weight

    def difference(self, state: BodyState) -> Float[np.ndarray, "v 3"]:
        """T_Est minus what it is coupled to."""
        target = self.fitter.shaped(state.betas) if self.target is None else self.target
        return state.template - target

    def prior_energy(self, state: BodyState) -> float:
        """E_cpl, tether and E_prior with their weights."""
        w = self.weights
        difference = self.difference(state)
        total = w.coupling * terms.coupling(difference, self.fitter.laplacian)[0]
        total += w.tether * terms.tether(difference)[0]
        total += (
            w.pose_prior
            * terms.gaussian_prior(state.pose[1:].ravel(), self.pose_mean, self.pose_precision)[0]
        )
        total += w.shape_prior * float(state.betas @ state.betas)
        return total

    def linearise(self, state: BodyState) -> _Linearised:
        """Energy and Gauss-Newton quantities at a state."""
        vertices, rotations, jacobian = self.fitter.linearised(state, self.joints)
        closest = closest_points(vertices, self.fitter.model.faces, self.scan.points)
        point_energy, weight = self.point_terms(closest)
        hessian, rhs = accumulate(self.fitter.pattern, self.fitter.model.faces, closest, weight)
        energy = float(point_energy.sum()) + self.prior_energy(state)
        held = self.container_terms(vertices)
        if held is not None:
            energy += held[0]
            blocks = held[2][:, None, None] * held[1].direction[:, :, None] * held[1].direction[:, None, :]
            hessian = self.fitter.pattern.with_vertex_blocks(hessian, blocks)
            rhs = rhs - (held[2] * held[1].distance)[:, None] * held[1].direction
        return _Linearised(energy, hessian, rhs, rotations, jacobian)

    def energy(self, state: BodyState) -> float:
        """E alone."""
        vertices = self.fitter.posed(state, self.joints)
        closest = closest_points(vertices, self.fitter.model.faces, self.scan.points)
        held = self.container_terms(vertices)
        return (
            float(self.point_terms(closest)[0].sum()) + self.prior_energy(state) + (held[0] if held else 0.0)
        )

    def _active(self) -> tuple[Int[np.ndarray, "a"], int]:
        """Which columns of (pose, translation) may change, and how many of the first betas."""
        u = self.unknowns
        columns = np.flatnonzero(np.r_[np.full(self.fitter.n_pose, u.pose), np.full(3, u.translation)])
        n_betas = self.fitter.model.n_betas
        return columns, (min(n_betas, n_betas if u.n_betas is None else u.n_betas) if u.betas else 0)

    def _parameter_priors(
        self, state: BodyState, columns: Int[np.ndarray, "a"], n_betas: int
    ) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p"]]:
        """Hessian and right-hand side of the priors on the active (pose, translation) and betas."""
        w, n_pose = self.weights, self.fitter.n_pose
        hessian, rhs = np.zeros((n_pose + 3, n_pose + 3)), np.zeros(n_pose + 3)
        hessian[3:n_pose, 3:n_pose] = w.pose_prior * self.pose_precision
        half = terms.gaussian_prior(state.pose[1:].ravel(), self.pose_mean, self.pose_precision)[1]
        rhs[3:n_pose] = -w.pose_prior * half
        return (
            block_diag(hessian[np.ix_(columns, columns)], w.shape_prior * np.eye(n_betas)),
            np.concatenate([rhs[columns], -w.shape_prior * state.betas[:n_betas]]),
        )

    def _by_joints(self, state: BodyState, n_betas: int) -> Float[np.ndarray, "m b"]:
        """Q of the active betas: zero where the joints are held."""
        if self.joints is not None or n_betas == 0:
            return np.zeros((self.fitter.n_pose, n_betas))
        return self.fitter.shape.offsets_by_betas(state.pose)[:, :n_betas]

    def parameter_step(self, lin: _Linearised, state: BodyState, damping: float) -> tuple[None, np.ndarray]:
        """Step of pose, translation and betas alone; the template moves with M(beta)."""
        shape, (columns, n_betas) = self.fitter.shape, self._active()
        by_betas = shape.bone_spread @ self._by_joints(state, n_betas)
        if n_betas and self.target is None:
            template_moves = shape.shape[:, :n_betas].reshape(-1, 3, n_betas)
            by_betas += (lin.rotations @ template_moves).reshape(len(by_betas), n_betas)
        jacobian = np.concatenate([lin.jacobian[:, columns], by_betas], 1)
        hessian, rhs = self._parameter_priors(state, columns, n_betas)
        hessian += jacobian.T @ (lin.hessian @ jacobian)
        rhs += jacobian.T @ lin.rhs.ravel()
        hessian[np.diag_indices_from(hessian)] += damping
        return None, self._whole_step(cho_solve(cho_factor(hessian), rhs), columns, n_betas)

    def _whole_step(
        self, active_step: Float[np.ndarray, "a"], columns: Int[np.ndarray, "c"], n_betas: int
    ) -> Float[np.ndarray, "p"]:
        """A step of the active parameters, written into one of all (pose, translation, betas)."""
        n_before = self.fitter.n_pose + 3
        step = np.zeros(n_before + self.fitter.model.n_betas)
        step[columns] = active_step[: len(columns)]
        step[n_before : n_before + n_betas] = active_step[len(columns) :]
        return step

    def joint_step(
        self, lin: _Linearised, state: BodyState, damping: float
    ) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "p"]]:
        """Inexact Gauss-Newton step of template and parameters together."""
        fitter, w, shape = self.fitter, self.weights, self.fitter.shape
        n = len(fitter.model.template)
        columns, n_betas = self._active()
        n_columns = len(columns)
        by_joints = self._by_joints(state, n_betas)
        coupled = n_betas > 0 and self.target is None
        shape_pull = shape.pull(w.coupling, w.tether)[:, :n_betas] if coupled else None

        def pull(x: np.ndarray) -> np.ndarray:  # gradient of coupling and tether per template difference
            return w.coupling * (fitter.laplacian @ x) + w.tether * x

        prior_hessian, rhs_parameters = self._parameter_priors(state, columns, n_betas)
        prior_hessian[np.diag_indices_from(prior_hessian)] += damping
        if coupled:
            prior_hessian[n_columns:, n_columns:] += shape.stiffness(w.coupling, w.tether)[:n_betas, :n_betas]
        difference = self.difference(state)
        rhs_template = np.einsum("vba,vb->va", lin.rotations, lin.rhs) - pull(difference)
        # Moves of posed vertices: by pose and translation, and by the bones' offsets (K), which betas change.
        moves = lin.jacobian[:, columns]
        if n_betas:
            moves = np.concatenate([moves, shape.bone_spread], 1)

        def narrowed(x: np.ndarray) -> np.ndarray:  # from moves to parameters
            return np.concatenate([x[:n_columns], by_joints.T @ x[n_columns:]]) if n_betas else x

        rhs_parameters += narrowed(moves.T @ lin.rhs.ravel())
        if shape_pull is not None:
            rhs_parameters[n_columns:] += shape_pull.T @ difference.ravel()

        of_moves = moves.T @ (lin.hessian @ moves)
        dense = prior_hessian + narrowed(narrowed(of_moves).T).T
        dense_factor = cho_factor(dense)
        trace = lin.hessian.diagonal().reshape(n, 3).mean(1)
        scalar = splu(
            (w.coupling * fitter.laplacian + diags(trace + w.tether + 1e-9)).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

        def product(x: np.ndarray) -> np.ndarray:
            xt, xp, betas = x[: 3 * n].reshape(n, 3), x[3 * n :], x[3 * n + n_columns :]
            widened = np.concatenate([xp[:n_columns], by_joints @ betas]) if n_betas else xp
            moved = np.einsum("vab,vb->va", lin.rotations, xt).ravel() + moves @ widened
            force = lin.hessian @ moved
            out_t = np.einsum("vba,vb->va", lin.rotations, force.reshape(n, 3)) + pull(xt)
            out_p = prior_hessian @ xp + narrowed(moves.T @ force)
            if shape_pull is not None:
                out_t -= (shape_pull @ betas).reshape(n, 3)
                out_p[n_columns:] -= shape_pull.T @ xt.ravel()
            return np.concatenate([out_t.ravel(), out_p])

        def precondition(r: np.ndarray) -> np.ndarray:
            return np.concatenate(
                [scalar.solve(r[: 3 * n].reshape(n, 3)).ravel(), cho_solve(dense_factor, r[3 * n :])]
            )

        solution = conjugate_gradients(
            product, precondition, np.concatenate([rhs_template.ravel(), rhs_parameters])
        )
        return solution[: 3 * n].reshape(n, 3), self._whole_step(solution[3 * n :], columns, n_betas)

    def moved(
        self, state: BodyState, template_step: Float[np.ndarray, "v 3"] | None, step: Float[np.ndarray, "p"]
    ) -> BodyState:
        """The state after a step; without a template step the template follows the betas."""
        n_pose = self.fitter.n_pose
        largest = np.linalg.norm(step[:n_pose].reshape(-1, 3), axis=1).max(initial=0.0)
        shorten = min(1.0, LARGEST_ROTATION / max(largest, 1e-12))
        step = shorten * step
        betas = state.betas + step[n_pose + 3 :]
        if template_step is not None:
            template = state.template + shorten * template_step
        elif self.target is None:
            template = state.template + self.fitter.model.shape_directions @ step[n_pose + 3 :]
        else:
            template = state.template
        return BodyState(
            template,
            state.pose + step[:n_pose].reshape(-1, 3),
            state.translation + step[n_pose : n_pose + 3],
            betas,
        )


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


def minimise(
    objective: Objective, state: BodyState, max_iterations: int = 15, relative_drop: float = 5e-3
) -> Outcome:
    """Levenberg-Marquardt: a step that raises the energy is taken back and damped more.

    Raises FloatingPointError when the energy is not finite at the start (NaN in scan or state).
    """
    from threadpoolctl import threadpool_limits

    # Two thread pools fighting for the same cores cost a factor of two to seven: BLAS keeps to one.
    with threadpool_limits(limits=1, user_api="blas"):
        lin = objective.linearise(state)
        if not np.isfinite(lin.energy):
            raise FloatingPointError("the objective is not finite at the start: check the scan for NaN")
        energies = [lin.energy]
        damping = 0.3
        small = 0
        for _ in range(max_iterations):
            step = objective.joint_step if objective.unknowns.template else objective.parameter_step
            trial = objective.moved(state, *step(lin, state, damping))
            trial_lin = objective.linearise(trial)
            if trial_lin.energy < energies[-1]:
                drop = (energies[-1] - trial_lin.energy) / max(energies[-1], 1e-30)
                state, lin = trial, trial_lin
                energies.append(lin.energy)
                damping = max(damping * 0.4, 1e-3)
                small = small + 1 if drop < relative_drop else 0
                if small >= 1:
                    return Outcome(state, tuple(energies), True)
            else:
                damping *= 8.0
                if damping > 1e4:
                    return Outcome(state, tuple(energies), True)
    return Outcome(state, tuple(energies), False)


def scan_points(points: np.ndarray, normals: np.ndarray | None = None) -> ScanPoints:
    """All-cloth points of weight one; normals default to zeros (which the gate must then not use)."""
    n = len(points)
    return ScanPoints(
        points,
        np.zeros((n, 3)) if normals is None else normals,
        np.ones(n),
        np.zeros(n, dtype=bool),
    )


def mesh_as_scan(vertices: np.ndarray, faces: np.ndarray) -> ScanPoints:
    """The vertices of a mesh with their normals."""
    return scan_points(vertices, vertex_normals(vertices, faces))
