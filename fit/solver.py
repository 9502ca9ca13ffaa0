"""Gauss-Newton with Levenberg damping on template, pose, translation and shape together.

Normal equations are summed up on the mesh (mesh_blocks.py), so that only the search for closest points knows
how many points the scan has; steps.py solves them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from fit import energy as terms
from fit.articulation import Articulation, PosedBody
from fit.body.model import BodyModel
from fit.closest import ClosestPoints, Container, Depths
from fit.mesh_blocks import MeshEdges, sum_over_points
from fit.moving_mesh import MovingMesh
from fit.normal_equations import edge_laplacian
from fit.settings import StageWeights
from fit.shape_operators import ShapeOperators
from fit.state import BodyState
from fit.steps import Linearised, Steps

#: Radians: a joint that turns farther in one step has left the region where the linearisation means anything.
LARGEST_ROTATION = 0.5
#: Side of the cubes by which points are sorted for the search.
CELL_M = 0.03
#: More points than twice these first come to rest on so many of them.
FIRST_POINTS = 60_000


@dataclass(frozen=True)
class ScanPoints:
    """What the objective sees of a scan: points (N 3) m, outward normals (N 3), weight (N), 0 ignores a
    point; is_skin (N): g of the skin term, 0 (false) for cloth."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    weight: Float[np.ndarray, "n"]
    is_skin: np.ndarray

    def chosen(self, idx: Int[np.ndarray, "m"] | slice) -> ScanPoints:
        """These points, in this order."""
        return ScanPoints(**{f.name: getattr(self, f.name)[idx] for f in fields(self)})

    def cell_by_cell(self) -> ScanPoints:
        """The same points, those of one small cube of space after those of another."""
        if not np.isfinite(self.points).all():
            return self
        cell = ((self.points - self.points.min(0)) / CELL_M).astype(np.int64)
        n = cell.max(0) + 1
        return self.chosen(np.argsort((cell[:, 0] * n[1] + cell[:, 1]) * n[2] + cell[:, 2], kind="stable"))

    def drawn(self, about: int) -> ScanPoints:
        """About so many of the points, drawn at random (the same ones every time)."""
        kept = np.random.default_rng(0).random(len(self.points)) * len(self.points) < about
        return self.chosen(np.flatnonzero(kept))

    def thinned(self, most: int) -> ScanPoints:
        """Every so many-th point, so that about `most` are left: the points of a scan are even in area."""
        return self.chosen(slice(None, None, max(1, len(self.points) // most)))


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


@dataclass(frozen=True)
class Fitter:
    """A body model ready for fitting: skinning, edges, search tree. Made once, used for every frame."""

    model: BodyModel
    coupling_weight: Float[np.ndarray, "v"]
    articulation: Articulation = field(repr=False)
    mesh: MeshEdges = field(repr=False)
    surface: MovingMesh = field(repr=False)
    laplacian: csr_matrix = field(repr=False)
    shape: ShapeOperators = field(repr=False)

    @staticmethod
    def of(model: BodyModel) -> Fitter:
        """Prepare a model."""
        from fit.body.parts import region_of_vertices

        region = region_of_vertices(model)
        # The paper's w: hands and feet, where scans are noisy (and hulls hardly resolve fingers), hold on to
        # the model.
        weight = np.where(np.isin(region, ("hand", "foot", "head")), 3.0, 1.0)
        laplacian = edge_laplacian(model.faces, len(model.template), weight)
        return Fitter(
            model=model,
            coupling_weight=weight,
            articulation=Articulation.of(model),
            mesh=MeshEdges.of(model.faces, len(model.template), weight),
            surface=MovingMesh.of(model.template, model.faces),
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
        return self.shape.joint_rest + self.shape.joint_shape @ betas

    def posed(
        self, state: BodyState, joints: Float[np.ndarray, "j 3"] | None = None
    ) -> Float[np.ndarray, "v 3"]:
        """W(T, J, pose) + translation. Joints come from the betas unless given."""
        return self.body(state, joints).vertices

    def body(self, state: BodyState, joints: Float[np.ndarray, "j 3"] | None = None) -> PosedBody:
        """The posed body with its derivatives by template and pose."""
        joints = self.joints(state.betas) if joints is None else joints
        return self.articulation.posed(state.template, joints, state.pose, state.translation)

    def posed_joints(self, state: BodyState, joints: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3"]:
        """Where the joints of the zero pose go in this state."""
        return self.articulation.chain(joints, state.pose).posed_joints + state.translation

    def linearised(
        self, state: BodyState, joints: Float[np.ndarray, "j 3"] | None
    ) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3 3"], Float[np.ndarray, "m p"]]:
        """Posed vertices, dv/dT (V 3 3), and dv/d(pose, translation) (3V, 3J + 3), dense."""
        body = self.body(state, joints)
        return body.vertices, body.rotations, body.jacobian()


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
        self, vertices: Float[np.ndarray, "v 3"], before: Depths | None = None
    ) -> tuple[float, Depths, Float[np.ndarray, "v"], Float[np.ndarray, "v"]] | None:
        """E_inside: vertices outside a closed scan (a visual hull contains the person) are drawn in.

        Returns energy, depths, and pull and weight a vertex; before: the depths at a state close by.
        """
        if self.container is None or self.weights.inside == 0.0:
            return None
        margin = self.weights.margin_m
        depths = Depths.of(self.container, vertices) if before is None else before.after(vertices, margin)
        beyond = depths.distance + margin
        energy, weight = terms.huber(beyond, self.weights.inside_m)
        scale = self.weights.inside * (beyond > 0)
        return float((scale * energy).sum()), depths, scale * weight * beyond, scale * weight

    def point_terms(self, closest: ClosestPoints) -> terms.PerPoint:
        """Energy and weight of every scan point: skin, or outside + fit."""
        w, d = self.weights, closest.distance
        scale = len(self.fitter.model.template) / max(len(d), 1) * self.scan.weight
        if w.gate:
            # A point whose normal opposes the body's belongs to another part (inner thighs, arm beside
            # trunk).
            cosine = (self.scan.normals * closest.normals).sum(1)
            scale = scale * np.clip((cosine + 0.2) / 0.6, 0.0, 1.0)
        if not w.cloth:
            energy, weight = terms.skin(d, w.sigma_m)
            return w.skin * scale * energy, w.skin * scale * weight
        fit = np.full(len(d), w.fit)
        if self.fit_scale is not None:
            corners = self.fitter.model.faces[closest.triangle_idx]
            fit = fit * (closest.barycentric * self.fit_scale[corners]).sum(1)
        energy, weight = terms.cloth(d, w.outside, w.outside_m, fit, w.sigma_m)
        if self.scan.is_skin.any():
            g = self.scan.is_skin.astype(float)
            is_cloth = 1.0 - g if w.boundary_as_cloth else g == 0.0
            skin_energy, skin_weight = terms.skin(d, w.sigma_m, g)
            energy = w.skin * skin_energy + is_cloth * energy
            weight = w.skin * skin_weight + is_cloth * weight
        return scale * energy, scale * weight

    def difference(self, state: BodyState) -> Float[np.ndarray, "v 3"]:
        """T_Est minus what it is coupled to; zeros where nothing is."""
        if not (self.weights.coupling or self.weights.tether):
            return np.zeros_like(state.template)
        target = self.fitter.shaped(state.betas) if self.target is None else self.target
        return state.template - target

    def prior_energy(self, state: BodyState, difference: Float[np.ndarray, "v 3"]) -> float:
        """E_cpl, tether and E_prior with their weights; difference: `difference` of the state."""
        w, total = self.weights, 0.0
        if w.coupling or w.tether:
            total += w.coupling * terms.coupling(difference, self.fitter.laplacian)[0]
            total += w.tether * terms.tether(difference)[0]
        total += (
            w.pose_prior
            * terms.gaussian_prior(state.pose[1:].ravel(), self.pose_mean, self.pose_precision)[0]
        )
        total += w.shape_prior * float(state.betas @ state.betas)
        return total

    def linearise(self, state: BodyState, before: Linearised | None = None) -> Linearised:
        """Energy and Gauss-Newton quantities at a state; before: those at a state close by."""
        body = self.fitter.body(state, self.joints)
        nearest = None if before is None else before.nearest
        closest = self.fitter.surface.closest(body.vertices, self.scan.points, nearest)
        point_energy, weight = self.point_terms(closest)
        matrix, rhs = sum_over_points(self.fitter.mesh, closest, weight)
        difference = self.difference(state)
        energy, depths = float(point_energy.sum()) + self.prior_energy(state, difference), None
        held = self.container_terms(body.vertices, None if before is None else before.depths)
        if held is not None:
            inside, depths, pull, hold = held
            energy += inside
            matrix = matrix.with_vertex_blocks(hold, depths.closest.direction)
            rhs = rhs - pull[:, None] * depths.closest.direction
        return Linearised(energy, matrix, rhs, body, difference, closest.triangle_idx, depths)

    def energy(self, state: BodyState) -> float:
        """E alone."""
        vertices = self.fitter.posed(state, self.joints)
        closest = self.fitter.surface.closest(vertices, self.scan.points)
        held = self.container_terms(vertices)
        return (
            float(self.point_terms(closest)[0].sum())
            + self.prior_energy(state, self.difference(state))
            + (held[0] if held else 0.0)
        )

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


def minimise(
    objective: Objective, state: BodyState, max_iterations: int = 15, relative_drop: float = 5e-3
) -> Outcome:
    """Levenberg-Marquardt: a step that raises the energy is taken back and damped more.

    Of very many points (the union of hundreds of frames) some are taken first, then all. Raises
    FloatingPointError when the energy is not finite at the start (NaN in scan or state).
    """
    from threadpoolctl import threadpool_limits

    if len(objective.scan.points) > 2 * FIRST_POINTS:
        fewer = replace(objective, scan=objective.scan.drawn(FIRST_POINTS))
        state = minimise(fewer, state, max_iterations, relative_drop).state
    # Two thread pools fighting for the same cores cost a factor of two to seven: BLAS keeps to one.
    with threadpool_limits(limits=1, user_api="blas"):
        # Neighbours one after the other find what they need of the body in the processor's cache.
        objective = replace(objective, scan=objective.scan.cell_by_cell())
        steps, lin = Steps(objective), objective.linearise(state)
        if not np.isfinite(lin.energy):
            raise FloatingPointError("the objective is not finite at the start: check the scan for NaN")
        energies = [lin.energy]
        damping = 0.3
        small = 0
        for _ in range(max_iterations):
            trial = objective.moved(state, *steps(lin, state, damping))
            trial_lin = objective.linearise(trial, lin)
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
