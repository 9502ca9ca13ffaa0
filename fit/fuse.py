"""The fusion shape (paper section 4.2): one naked template inside all unposed clothed templates.

The union of the unposed alignments is the fusion scan; since every frame carves away from the outside, the
same objective in the zero pose, all points cloth, gives the person's shape.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fit.align import Alignment
from fit.initialise import PoseFinder
from fit.outliers import lost_points
from fit.settings import FitSettings
from fit.solver import Fitter, Objective, ScanPoints, Unknowns, minimise
from fit.state import BodyState
from fit.surface import vertex_normals
from fit.thickness import Thickness, smoothed_over_mesh
from fit.together import ENOUGH_FRAMES, Together, can_be_together, fit_together

#: More points of unposed alignments than this add time and nothing else.
MOST_POINTS = 250_000


@dataclass(frozen=True)
class FusionShape:
    """T_Fu: template (V 3) m in the zero pose, betas of the model coupled to it, joints (J 3) m.

    thickness: of the clothes, where it could be told; confidence (V), 0 to 1: how well the place of the skin
    is known, as the tolerance of bare skin over that found here. spread (V): deviation of the unposed
    alignments along the normal, m (the paper's figure 2 colours by it). fit_scale (V): factor on lambda_fit
    that was derived from it; trust: how far the hulls could be trusted, 0 to 1.
    """

    template: Float[np.ndarray, "v 3"]
    betas: Float[np.ndarray, "b"]
    joints: Float[np.ndarray, "j 3"]
    spread: Float[np.ndarray, "v"]
    fit_scale: Float[np.ndarray, "v"]
    trust: float = 1.0
    thickness: Thickness | None = None
    confidence: Float[np.ndarray, "v"] | None = None


def trust_in_spread(alignments: Sequence[Alignment], settings: FitSettings) -> float:
    """How far the spread may be read as cloth, 0 to 1.

    Hulls of few or badly calibrated cameras have phantom volume that comes and goes; the alignments then stay
    away from their scans, and spread between them tells of the hulls, not of the clothes.
    """
    doubt = float(np.median([a.distance_m for a in alignments])) - settings.trusted_distance_m
    return 1.0 / (1.0 + (max(doubt, 0.0) / settings.doubt_m) ** 2)


def fit_scale_from_spread(
    spread: Float[np.ndarray, "v"], faces: Int[np.ndarray, "f 3"], trust: float, settings: FitSettings
) -> Float[np.ndarray, "v"]:
    """Factor on lambda_fit a vertex, from how much the cloth there moves about.

    One constant makes bare or tight regions too thin and loosely covered ones too fat. Loose cloth
    moves: the spread of the unposed alignments along the normal, pooled over the neighbourhood, grows
    with the thickness of what is worn. The exponent is lowered where the spread cannot be trusted
    (`trust_in_spread`).
    """
    pooled = np.sqrt(smoothed_over_mesh(spread**2, faces, settings.spread_rounds))
    scale = (settings.spread_m / np.maximum(pooled, 1e-6)) ** (trust * settings.spread_power)
    # In doubt the tightest alignment is no evidence: the outside term must lose its lead, or the body
    # shrivels.
    return np.clip(scale, *settings.fit_scale_limits) * settings.doubtful_fit ** ((1.0 - trust) ** 2)


def usable(alignments: Sequence[Alignment]) -> list[Alignment]:
    """Those that are in order, or else all that did not fail. Raises ValueError when there is none."""
    good = [a for a in alignments if a.status == "ok"] or [a for a in alignments if a.status != "failed"]
    if not good:
        raise ValueError("no frame could be aligned, so there is nothing to fuse")
    return good


def fused(
    fitter: Fitter,
    finder: PoseFinder,
    alignments: Sequence[Alignment],
    settings: FitSettings,
    skin_shares: Mapping[int, Float[np.ndarray, "_v"]] | None = None,
    excess: Float[np.ndarray, "_v"] | None = None,
) -> tuple[FusionShape, list[Alignment]]:
    """The fusion shape, and the alignments with the poses to track from.

    skin_shares: g of every vertex (V) by frame number, where skin was told from cloth; excess: `hull_excess`.

    Where the clothes' movement can be read, one shape and all poses are found at once; else every frame keeps
    the pose it was aligned with. Raises ValueError when no frame was aligned.
    """
    good = usable(alignments)
    if not settings.at_once or not can_be_together(good, trust_in_spread(good, settings)):
        return fuse(fitter, alignments, settings, skin_shares), list(alignments)
    bare = None if skin_shares is None else np.mean([skin_shares[a.frame_id] for a in good], axis=0)
    together = fit_together(fitter, finder, good, settings, bare, excess)
    again = together.realigned(fitter, good)
    by_frame = {a.frame_id: a for a in again}
    # A suspect frame does not speak for the shape, but it is tracked like the others.
    return (
        fuse_together(fitter, again, together, settings),
        [by_frame.get(a.frame_id, a) for a in alignments],
    )


def fuse_together(
    fitter: Fitter, alignments: Sequence[Alignment], together: Together, settings: FitSettings
) -> FusionShape:
    """The fusion shape where pose and betas are known from all frames, and the clothes' thickness with them.

    E_outside keeps the template inside all unposed clothed templates (as `fuse`); in place of E_fit, which
    draws it to the cloth, it is drawn to where the skin is expected under their mean, as tightly as
    the thickness is known. Coupled to M(betas); the joints stay.
    """
    model = fitter.model
    template, joints = fitter.shaped(together.betas), fitter.joints(together.betas)
    clothed = np.stack([a.state.template for a in alignments])
    normals = vertex_normals(template, model.faces)
    certainty = (settings.thickness.tolerance_m / together.thickness.tolerance) ** 2
    # Where the skin is seen, the person counts and the model's coupling does not.
    pull = certainty * (1.0 + settings.sure_pull * certainty**2)
    offsets = np.einsum("tva,va->tv", clothed - clothed.mean(0), normals)
    speak = ~lost_points(offsets, fitter.laplacian)
    mean = (speak[:, :, None] * clothed).sum(0) / np.maximum(speak.sum(0), 1)[:, None]
    expected = mean - together.thickness.expected[:, None] * normals
    if offsets.size > MOST_POINTS:  # the union of hundreds of frames: a part of each says the same
        speak &= np.random.default_rng(0).random(offsets.shape) * offsets.size < MOST_POINTS
    frame_normals = np.stack([vertex_normals(t, model.faces) for t in clothed])
    n_cloth, n_vertices = int(speak.sum()), model.n_vertices
    # Both terms are means over their points times the number of vertices, whatever the number of frames.
    n_points = n_cloth + n_vertices
    scan = ScanPoints(
        np.concatenate([clothed[speak], expected]),
        np.concatenate([frame_normals[speak], normals]),
        np.concatenate([np.full(n_cloth, n_points / n_cloth), pull * n_points / n_vertices]),
        np.repeat([False, True], [n_cloth, n_vertices]),
    )
    state = BodyState(template, np.zeros((model.n_joints, 3)), np.zeros(3), together.betas)
    pose_size = 3 * (model.n_joints - 1)
    for stage in settings.fuse_together:
        objective = Objective(
            fitter,
            scan,
            stage,
            Unknowns(pose=False, translation=False, betas=False),
            np.zeros(pose_size),
            np.zeros((pose_size, pose_size)),
            target=template,
            joints=joints,
        )
        state = minimise(objective, state, settings.max_iterations, settings.relative_drop).state
    return FusionShape(
        state.template,
        together.betas,
        joints,
        offsets.std(axis=0),
        settings.sure_fit * certainty**3,
        thickness=together.thickness,
        confidence=np.sqrt(certainty),
    )


def fuse(
    fitter: Fitter,
    alignments: Sequence[Alignment],
    settings: FitSettings,
    skin_shares: Mapping[int, Float[np.ndarray, "_v"]] | None = None,
) -> FusionShape:
    """Estimate the fusion shape from all alignments that did not fail.

    skin_shares: g of every vertex (V) by frame number, where skin was told from cloth. Raises ValueError when
    there is no such alignment.
    """
    good = usable(alignments)
    templates = np.stack([a.state.template for a in good])
    betas = np.median([a.state.betas for a in good], axis=0)
    mean = templates.mean(0)
    normals = vertex_normals(mean, fitter.model.faces)
    offsets = np.einsum("tva,va->tv", templates - mean, normals)
    keep = (
        ~lost_points(offsets, fitter.laplacian)
        if len(good) >= ENOUGH_FRAMES
        else np.ones(offsets.shape, dtype=bool)
    )
    points = templates.reshape(-1, 3)
    scan = ScanPoints(
        points,
        np.concatenate([vertex_normals(t, fitter.model.faces) for t in templates]),
        keep.ravel().astype(float),
        np.zeros(len(points))
        if skin_shares is None
        else np.concatenate([skin_shares[a.frame_id] for a in good]),
    )
    spread = offsets.std(axis=0)
    enough = len(good) >= ENOUGH_FRAMES
    fit_scale, trust = np.ones(len(spread)), 1.0
    if enough:
        trust = trust_in_spread(good, settings)
        fit_scale = fit_scale_from_spread(spread, fitter.model.faces, trust, settings)
    n_joints = len(fitter.model.parents)
    state = BodyState(fitter.shaped(betas), np.zeros((n_joints, 3)), np.zeros(3), betas)
    pose_size = 3 * (n_joints - 1)
    for stage in settings.fuse:
        weights = replace(
            stage,
            sigma_m=stage.sigma_m * (2.0 - trust),
            coupling=stage.coupling * settings.stiffness(trust),
            skin=stage.skin * settings.fuse_skin,
            shape_prior=stage.shape_prior * settings.stiffness(trust),
        )
        objective = Objective(
            fitter,
            scan,
            weights,
            Unknowns(pose=False, translation=False),
            np.zeros(pose_size),
            np.zeros((pose_size, pose_size)),
            fit_scale=fit_scale,
        )
        state = minimise(objective, state, settings.max_iterations, settings.relative_drop).state
    return FusionShape(state.template, state.betas, fitter.joints(state.betas), spread, fit_scale, trust)
