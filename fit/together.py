"""One shape and all poses at once, inside clothes of a thickness that is estimated along the way.

The paper aligns frame by frame and fuses afterwards, because solving for all frames' 150 000 points at once
was too much (section 4.2). Posed alignments make it cheap: each is 6890 points whose partner on the body is
known. A frame adds a small dense block, its pose is eliminated (Schur complement), and what remains is a
system of the size of the betas. Cloth then drags neither the pose of a frame nor the bones on its own: a
shape that has to serve all frames, with the cloth where its movement says it should be, decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

from fit.align import Alignment
from fit.articulation import PosedBody
from fit.body.parts import region_of_vertices
from fit.initialise import PoseFinder
from fit.outliers import lost_points
from fit.settings import FitSettings, TogetherSettings
from fit.solver import Fitter
from fit.state import BodyState
from fit.surface import vertex_areas, vertex_normals
from fit.thickness import Thickness, bending_noise, expected_thickness, thickness_per_movement, undressed

#: Parts that shoes, hair and coarse hulls make unreliable count this much.
VAGUE_PARTS, VAGUE_WEIGHT = ("hand", "foot", "head"), 0.3
#: Alignment and body whose normals differ more than this (cosine) are not the same part.
SAME_SIDE = 0.3
LARGEST_TURN, LARGEST_BETA_STEP = 0.3, 1.0
#: Fewer frames say nothing about movement; hulls trusted less move on their own.
ENOUGH_FRAMES, TRUSTED = 4, 0.5


@dataclass(frozen=True)
class Together:
    """poses (T J 3), translations (T 3) of the frames given; betas (B); the clothes over the body; the
    energy a round."""

    poses: Float[np.ndarray, "t j 3"]
    translations: Float[np.ndarray, "t 3"]
    betas: Float[np.ndarray, "b"]
    thickness: Thickness
    energies: tuple[float, ...]

    def realigned(self, fitter: Fitter, alignments: Sequence[Alignment]) -> list[Alignment]:
        """The same posed alignments with these poses and betas: their templates are unposed anew."""
        template, joints = fitter.shaped(self.betas), fitter.joints(self.betas)
        out = []
        for alignment, pose, translation in zip(alignments, self.poses, self.translations, strict=True):
            body = fitter.body(BodyState(template, pose, translation, self.betas), joints)
            gap = fitter.posed(alignment.state) - body.vertices
            own = template + np.linalg.solve(body.rotations, gap[:, :, None])[:, :, 0]
            out.append(replace(alignment, state=BodyState(own, pose, translation, self.betas)))
        return out


@dataclass
class _Frames:
    """What is iterated: poses and translations of all frames, one set of betas."""

    poses: Float[np.ndarray, "t j 3"]
    translations: Float[np.ndarray, "t 3"]
    betas: Float[np.ndarray, "b"]


@dataclass(frozen=True)
class _Cloth:
    """The posed alignments: vertices and normals (T V 3); part_weight, ratio, bare, excess (V): how much a
    vertex's part counts, `thickness_per_movement`, how surely it is known to be bare skin, and how far hulls
    stand off there (m)."""

    vertices: Float[np.ndarray, "t v 3"]
    normals: Float[np.ndarray, "t v 3"]
    part_weight: Float[np.ndarray, "v"]
    ratio: Float[np.ndarray, "v"]
    bare: Float[np.ndarray, "v"]
    excess: Float[np.ndarray, "v"]


def can_be_together(alignments: Sequence[Alignment], trust: float) -> bool:
    """Whether movement tells thickness: enough frames, and hulls that do not change on their own."""
    return len(alignments) >= ENOUGH_FRAMES and trust >= TRUSTED


def fit_together(
    fitter: Fitter,
    finder: PoseFinder,
    alignments: Sequence[Alignment],
    settings: FitSettings,
    bare: Float[np.ndarray, "v"] | None = None,
    excess: Float[np.ndarray, "v"] | None = None,
) -> Together:
    """Minimise over betas and all poses

        sum_frames sum_vertices n a w rho((n.(cloth - body) - thickness) / tolerance) + outside + priors

    a: the vertex's share of the area, w: less for hands, feet and head, n: independent observations a frame.
    The thickness is estimated anew every round from the same residuals. Shapes have to explain all frames, so
    at most `shape_frames` of them (evenly spread) take part in finding the betas; the others' poses follow.
    bare (V): share of the frames in which a vertex was seen to be bare skin: it holds pose and shape there.
    excess (V): how far the alignments stand off the cloth because hulls do (m).
    """
    from threadpoolctl import threadpool_limits

    weights = settings.together
    posed = np.stack([fitter.posed(a.state) for a in alignments])
    cloth = _Cloth(
        posed,
        np.stack([vertex_normals(v, fitter.model.faces) for v in posed]),
        np.where(np.isin(region_of_vertices(fitter.model), VAGUE_PARTS), VAGUE_WEIGHT, 1.0),
        thickness_per_movement(fitter.model),
        np.zeros(fitter.model.n_vertices) if bare is None else bare,
        np.zeros(fitter.model.n_vertices) if excess is None else excess,
    )
    at = _Frames(
        np.stack([a.state.pose for a in alignments]),
        np.stack([a.state.translation for a in alignments]),
        np.median([a.state.betas for a in alignments], axis=0),
    )
    n = len(alignments)
    few, chosen = (_evenly(n, k) for k in (weights.first_frames, weights.shape_frames))
    energies: list[float] = []
    thickness = None
    # The matrices are small: threads would only fight over them.
    with threadpool_limits(limits=1, user_api="blas"):
        # A few frames bring the betas near; the others' poses then have little left to go.
        if len(few) < len(chosen):
            for _ in range(weights.rounds):
                thickness, _, moved = _round(fitter, finder, cloth, at, few, settings, None)
                if moved < weights.near:
                    break
            for k in np.setdiff1d(chosen, few).tolist():
                _settle(fitter, finder, cloth, at, k, settings, thickness)
        for _ in range(weights.rounds):
            thickness, energy, moved = _round(fitter, finder, cloth, at, chosen, settings, None)
            energies.append(energy)
            if moved < weights.rest or _at_rest(energies, weights.relative_drop):
                break
        assert thickness is not None, "at least one round"
        for k in np.setdiff1d(np.arange(n), chosen).tolist():
            _settle(fitter, finder, cloth, at, k, settings, thickness)
    return Together(at.poses, at.translations, at.betas, thickness, tuple(energies))


def _evenly(n: int, most: int) -> Int[np.ndarray, "k"]:
    """At most so many of n frames, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))


def _at_rest(energies: Sequence[float], relative_drop: float) -> bool:
    """Whether the last round gained next to nothing; a round that moved the thickness may lose."""
    return len(energies) > 1 and abs(energies[-2] - energies[-1]) < relative_drop * energies[-1]


def _settle(
    fitter: Fitter,
    finder: PoseFinder,
    cloth: _Cloth,
    at: _Frames,
    k: int,
    settings: FitSettings,
    thickness: Thickness | None,
) -> None:
    """The pose of frame k alone, under clothes whose thickness is known."""
    for _ in range(settings.together.rounds):
        _, _, moved = _round(fitter, finder, cloth, at, np.array([k]), settings, thickness)
        if moved < settings.together.near:
            return


def _round(
    fitter: Fitter,
    finder: PoseFinder,
    cloth: _Cloth,
    at: _Frames,
    chosen: Int[np.ndarray, "k"],
    settings: FitSettings,
    held: Thickness | None,
) -> tuple[Thickness, float, float]:
    """One Gauss-Newton step of the chosen frames' poses and, unless the thickness is held, of the betas.

    Returns thickness, energy before the step, and the largest move (rad or betas)."""
    weights, model = settings.together, fitter.model
    template, joints = fitter.shaped(at.betas), fitter.joints(at.betas)
    frames = []
    for k in chosen:
        state = BodyState(template, at.poses[k], at.translations[k], at.betas)
        body = fitter.body(state, joints)
        normals = vertex_normals(body.vertices, model.faces)
        offset = np.einsum("va,va->v", cloth.vertices[k] - body.vertices, normals)
        same = np.einsum("va,va->v", cloth.normals[k], normals) > SAME_SIDE
        frames.append((body, normals, offset, same))
    thickness = held
    lost = np.zeros((len(chosen), model.n_vertices), dtype=bool)
    if thickness is None:
        noise = bending_noise(model, at.poses[chosen], vertex_normals(template, model.faces))
        offsets = np.stack([f[2] for f in frames])
        lost = lost_points(offsets, fitter.laplacian)
        thickness = expected_thickness(
            offsets, noise, cloth.ratio, model.faces, settings.thickness, cloth.excess, lost
        )
        thickness = undressed(thickness, cloth.bare, settings.thickness, cloth.excess)
    n_betas = 0 if held is not None else model.n_betas
    shape_prior = weights.shape_prior * len(chosen)
    reduced, pull = shape_prior * np.eye(n_betas), -shape_prior * at.betas[:n_betas]
    energy = shape_prior * float(at.betas @ at.betas)
    eliminated = []
    # What many frames say together needs fewer vertices of each.
    stride = weights.every_vertex * max(1, round(len(chosen) / weights.first_frames / 2))
    for k, (body, normals, offset, same), gone in zip(chosen, frames, lost, strict=True):
        area = vertex_areas(body.vertices, model.faces)
        share = weights.n_independent * cloth.part_weight * (same & ~gone) * area / area.sum()
        residual, weight, data = _data_term(offset, thickness, share, weights)
        energy += data
        used = np.flatnonzero(weight > 0)[::stride]
        weight = stride * weight[used]
        own, rhs = _by_pose(body, normals, used, weight, residual[used])
        cross, corner, rhs_betas = _by_betas(
            fitter, at.poses[k], body, normals, used, weight, residual[used], n_betas
        )
        n_pose = len(rhs)
        away = at.poses[k].ravel()[3:] - finder.prior.mean
        own[3:-3, 3:-3] += weights.pose_prior * finder.prior.precision
        rhs[3:-3] -= weights.pose_prior * finder.prior.precision @ away
        own[np.diag_indices(n_pose)] += 1e-3 * weights.n_independent
        energy += weights.pose_prior * float(away @ finder.prior.precision @ away)
        factor = cho_factor(own)
        reduced += corner - cross.T @ cho_solve(factor, cross)
        pull += rhs_betas - cross.T @ cho_solve(factor, rhs)
        eliminated.append((k, factor, cross, rhs))
    step = np.linalg.solve(reduced, pull)
    moved = float(np.abs(step).max(initial=0.0))
    step = step * min(1.0, LARGEST_BETA_STEP / max(moved, 1e-12))
    if n_betas:
        at.betas = at.betas + step
    for k, factor, cross, rhs in eliminated:
        move = cho_solve(factor, rhs - cross @ step)
        turn = float(np.abs(move[:-3]).max())
        move = move * min(1.0, LARGEST_TURN / max(turn, 1e-12))
        moved = max(moved, turn)
        at.poses[k] += move[:-3].reshape(-1, 3)
        at.translations[k] += move[-3:]
    return thickness, energy, moved


def _data_term(
    offset: Float[np.ndarray, "v"],
    thickness: Thickness,
    share: Float[np.ndarray, "v"],
    weights: TogetherSettings,
) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"], float]:
    """Residual (m), weight of its square, and energy: cloth at its expected distance (Geman-McClure on
    residual over tolerance), and never inside the body (quadratic)."""
    residual = offset - thickness.expected
    scaled = (residual / (weights.outlier * thickness.tolerance)) ** 2
    fit_weight = share / thickness.tolerance**2 / (1.0 + scaled) ** 2
    energy = share * (residual / thickness.tolerance) ** 2 / (1.0 + scaled)
    inside = offset < 0
    outside_weight = np.where(inside, share / weights.outside_m**2, 0.0)
    energy = energy + outside_weight * offset**2
    # Both pull along the same normal: one residual with their summed weight.
    weight = fit_weight + outside_weight
    return (
        (fit_weight * residual + outside_weight * offset) / np.maximum(weight, 1e-30),
        weight,
        float(energy.sum()),
    )


def _by_pose(
    body: PosedBody,
    normals: Float[np.ndarray, "v 3"],
    used: Int[np.ndarray, "n"],
    weight: Float[np.ndarray, "n"],
    residual: Float[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "p"]]:
    """Matrix and right-hand side, over pose and translation, of residuals along the vertices' normals."""
    row, column = np.triu_indices(3)
    lumped, force = np.zeros((len(normals), 6)), np.zeros_like(normals)
    normal = normals[used]
    lumped[used] = weight[:, None] * normal[:, row] * normal[:, column]
    force[used] = (weight * residual)[:, None] * normal
    _, on_pose, on_shift, _ = body.gathered(force)
    rhs = np.concatenate([on_pose.ravel(), on_shift])
    return body.squared(lumped, with_bones=False)[: len(rhs), : len(rhs)], rhs


def _by_betas(
    fitter: Fitter,
    pose: Float[np.ndarray, "j 3"],
    body: PosedBody,
    normals: Float[np.ndarray, "v 3"],
    used: Int[np.ndarray, "n"],
    weight: Float[np.ndarray, "n"],
    residual: Float[np.ndarray, "n"],
    n_betas: int,
) -> tuple[Float[np.ndarray, "p b"], Float[np.ndarray, "b b"], Float[np.ndarray, "b"]]:
    """The same, between (pose, translation) and betas, and of the betas: matrix and right-hand side."""
    from fit import compiled_skin

    at, n_pose = body.articulation, 3 * len(body.articulation.parents)
    cross = np.zeros((n_pose + 3, n_betas))
    if not n_betas:
        return cross, np.zeros((0, 0)), np.zeros(0)
    # Single precision: many rows, summed up into a matrix that a prior keeps well conditioned.
    moves = np.empty((len(used), n_betas), dtype=np.float32)
    offsets = fitter.shape.offsets_by_betas(pose).reshape(-1, 3, n_betas)
    compiled_skin.betas_along_normals(
        used,
        normals,
        body.rotations,
        fitter.model.shape_directions,
        at.bone_idx,
        at.bone_weight,
        offsets,
        moves,
    )
    root = np.sqrt(weight).astype(np.float32)
    rooted = moves * root[:, None]
    rhs = (moves.T @ (weight * residual).astype(np.float32)).astype(np.float64)
    moves *= weight[:, None].astype(np.float32)
    compiled_skin.pose_by_columns(
        used, normals, at.ptr, at.joint, body.blocks, moves, cross[:n_pose], cross[n_pose:]
    )
    return cross, (rooted.T @ rooted).astype(np.float64), rhs
