"""Pose and shape tracking (paper section 4.3): the fusion shape as regulariser, a detailed template every
frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fit.align import Alignment, as_scan_points, mean_distance
from fit.closest import Container, Depths
from fit.fuse import FusionShape
from fit.initialise import PoseFinder
from fit.settings import FitSettings
from fit.solver import Fitter, Objective, Unknowns, minimise
from fit.state import BodyState
from fit.thickness import smoothed_over_mesh
from hull.scan import Scan

#: How far outside the hull a vertex is brought back from, how deep inside it goes, and in how many rounds.
REACH_M, SKIN_DEPTH_M, HOLD_ROUNDS = 0.03, 0.0003, 6
#: Hulls trusted less than this do not bound the body.
TRUSTED = 0.5


@dataclass(frozen=True)
class TrackedFrame:
    """One frame of the track, in the body's upright frame: T_Est^k with its pose, and how it went."""

    frame_id: int
    state: BodyState
    distance_m: float
    status: str = "ok"
    message: str = ""


def track_frame(
    fitter: Fitter,
    finder: PoseFinder,
    fusion: FusionShape,
    alignment: Alignment,
    scan: Scan,
    settings: FitSettings,
    container: Container | None = None,
) -> BodyState:
    """Pose first with the fusion shape as it is, then the template, coupled to the fusion shape.

    container: the closed visual hull of the frame, if there is one: it contains the person, so the body stays
    inside.
    """
    state = BodyState(fusion.template, alignment.state.pose, alignment.state.translation, fusion.betas)
    points = as_scan_points(scan)
    stages = (
        (settings.track_pose, Unknowns(template=False, betas=False), None),
        (settings.track_template, Unknowns(pose=False, translation=False, betas=False), fusion.fit_scale),
    )
    for stage, unknowns, fit_scale in stages:
        # A hull that cannot be trusted neither contains the person nor knows his detail.
        weights = replace(
            stage,
            coupling=stage.coupling * settings.stiffness(fusion.trust),
            inside=stage.inside * fusion.trust,
        )
        objective = Objective(
            fitter,
            points,
            weights,
            unknowns,
            finder.prior.mean,
            finder.prior.precision,
            target=fusion.template,
            joints=fusion.joints,
            fit_scale=fit_scale,
            container=container,
        )
        state = minimise(objective, state, settings.max_iterations, settings.relative_drop).state
    if container is not None and fusion.trust > TRUSTED:
        state = held_inside(fitter, fusion, state, container)
    return state


def held_inside(fitter: Fitter, fusion: FusionShape, state: BodyState, container: Container) -> BodyState:
    """The same body with the vertices that still lie outside the hull moved just inside it, their neighbours
    along.

    A visual hull contains the person by construction, so nothing true is lost. Vertices farther out than
    REACH_M belong to something that the hull lacks (a part hidden from a camera by an error in its mask) and
    are left alone.
    """
    faces = fitter.model.faces
    depths: Depths | None = None
    for round_idx in range(HOLD_ROUNDS):
        body = fitter.body(state, fusion.joints)
        depths = Depths.of(container, body.vertices) if depths is None else depths.after(body.vertices, 0.0)
        beyond = (depths.distance > 0) & (depths.distance < REACH_M)
        if not beyond.any():
            break
        depth = np.where(beyond, depths.distance + SKIN_DEPTH_M, 0.0)
        move = -depth[:, None] * depths.closest.direction
        if round_idx < HOLD_ROUNDS - 2:  # at first softly, so that no dent stands alone; at last exactly
            shared = [smoothed_over_mesh(move[:, axis], faces, 2) for axis in range(3)]
            share = smoothed_over_mesh(beyond.astype(float), faces, 2)
            move = np.where(beyond[:, None], move, np.stack(shared, axis=1) / np.maximum(share, 0.3)[:, None])
        # The blended rotations turn template moves into posed ones; solve for the template's.
        step = np.linalg.solve(body.rotations, move[:, :, None])[:, :, 0]
        state = state.moved(template=state.template + step)
    return state


def track_sequence(
    fitter: Fitter,
    finder: PoseFinder,
    fusion: FusionShape,
    alignments: Sequence[Alignment],
    scan_of: Callable[[int], Scan] | Mapping[int, Scan],
    settings: FitSettings,
    report: Callable[[TrackedFrame], None] = lambda frame: None,
    container_of: Callable[[int], Container | None] = lambda frame_id: None,
) -> list[TrackedFrame]:
    """Track all aligned frames; each starts from its alignment's pose. A failed alignment stays failed, with
    its reason."""
    done = []
    for alignment in alignments:
        if alignment.status == "failed":
            frame = TrackedFrame(alignment.frame_id, alignment.state, np.inf, "failed", alignment.message)
        else:
            scan = (
                scan_of[alignment.frame_id] if isinstance(scan_of, Mapping) else scan_of(alignment.frame_id)
            )
            try:
                container = container_of(alignment.frame_id)
                state = track_frame(fitter, finder, fusion, alignment, scan, settings, container)
                distance = mean_distance(fitter, fitter.posed(state, fusion.joints), scan.points)
                frame = TrackedFrame(alignment.frame_id, state, distance, alignment.status, alignment.message)
            except (FloatingPointError, np.linalg.LinAlgError) as error:
                frame = TrackedFrame(
                    alignment.frame_id,
                    alignment.state,
                    np.inf,
                    "failed",
                    f"frame {alignment.frame_id:06d}: {error}",
                )
        done.append(frame)
        report(frame)
    return done


def posed_vertices(fitter: Fitter, fusion: FusionShape, frame: TrackedFrame) -> Float[np.ndarray, "v 3"]:
    """The naked body of a frame, posed, in the body's upright frame."""
    return fitter.posed(frame.state, fusion.joints)
