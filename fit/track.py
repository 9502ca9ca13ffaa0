"""Pose and shape tracking (paper section 4.3): the fusion shape as regulariser, a detailed template every frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fit.align import Alignment, as_scan_points, mean_distance
from fit.fuse import FusionShape
from fit.initialise import PoseFinder
from fit.settings import FitSettings
from fit.solver import Fitter, Objective, Unknowns, minimise
from fit.state import BodyState
from hull.scan import Scan


@dataclass(frozen=True)
class TrackedFrame:
    """One frame of the track, in the body's upright frame: T_Est^k with its pose, and how it went."""

    frame_id: int
    state: BodyState
    distance_m: float
    status: str = "ok"
    message: str = ""


def track_frame(
    fitter: Fitter, finder: PoseFinder, fusion: FusionShape, alignment: Alignment, scan: Scan, settings: FitSettings
) -> BodyState:
    """Pose first with the fusion shape as it is, then pose and template together, coupled to the fusion shape."""
    state = BodyState(fusion.template, alignment.state.pose, alignment.state.translation, fusion.betas)
    points = as_scan_points(scan)
    for weights, template in ((settings.track_pose, False), (settings.track_joint, True)):
        objective = Objective(
            fitter,
            points,
            weights,
            Unknowns(template=template, betas=False),
            finder.prior.mean,
            finder.prior.precision,
            target=fusion.template,
            joints=fusion.joints,
        )
        state = minimise(objective, state, settings.max_iterations, settings.relative_drop).state
    return state


def track_sequence(
    fitter: Fitter,
    finder: PoseFinder,
    fusion: FusionShape,
    alignments: Sequence[Alignment],
    scan_of: Callable[[int], Scan] | Mapping[int, Scan],
    settings: FitSettings,
    report: Callable[[TrackedFrame], None] = lambda frame: None,
) -> list[TrackedFrame]:
    """Track all aligned frames; each starts from its alignment's pose. A failed alignment stays failed, with its reason."""
    done = []
    for alignment in alignments:
        if alignment.status == "failed":
            frame = TrackedFrame(alignment.frame_id, alignment.state, np.inf, "failed", alignment.message)
        else:
            scan = scan_of[alignment.frame_id] if isinstance(scan_of, Mapping) else scan_of(alignment.frame_id)
            try:
                state = track_frame(fitter, finder, fusion, alignment, scan, settings)
                distance = mean_distance(fitter.posed(state, fusion.joints), fitter.model.faces, scan.points)
                frame = TrackedFrame(alignment.frame_id, state, distance, alignment.status, alignment.message)
            except (FloatingPointError, np.linalg.LinAlgError) as error:
                frame = TrackedFrame(
                    alignment.frame_id, alignment.state, np.inf, "failed", f"frame {alignment.frame_id:06d}: {error}"
                )
        done.append(frame)
        report(frame)
    return done


def posed_vertices(fitter: Fitter, fusion: FusionShape, frame: TrackedFrame) -> Float[np.ndarray, "v 3"]:
    """The naked body of a frame, posed, in the body's upright frame."""
    return fitter.posed(frame.state, fusion.joints)
