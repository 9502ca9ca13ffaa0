"""How the accuracy tables score a result: pure functions of bodies, markers and confidences.

Shape by the paper's measure and directly, with the functions of `bodyhull evaluate` (`fit.evaluate`). Pose as
the paper did on INRIA's data (section 6.1): markers on the true body are tied to the nearest vertex of the
result in 10 frames, evenly of the first 50; every such set of ties is then followed through all frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from fit.body.skeleton import JOINT
from fit.closest import closest_points
from fit.evaluate import (
    ErrorSummary,
    Surface,
    pose_truth_to,
    signed_error_mm,
    summarise,
    transfer_rig,
)
from fit.surface import vertex_areas, vertex_normals

#: The share of the frames that may lie inside the naive quantile.
LOW_QUANTILE = 0.1
N_TIES, TIED_FRAMES = 10, 50
#: Distances at which the share of landmarks is told, mm.
DISTANCES_MM = np.arange(0, 101)
N_GROUPS = 5
#: A marker: the joint it is near, and the way from there to the skin in the zero pose (x: the body's left, y
#: up, z front; on the right side x is mirrored).
MARKERS = {
    "shoulder": (0.0, 1.0, 0.0), "elbow": (0.0, 0.0, -1.0), "wrist": (0.0, 1.0, 0.0),
    "hip": (1.0, 0.0, 0.0), "knee": (0.0, 0.0, 1.0), "ankle": (1.0, 0.0, 0.0),
}  # fmt: skip
MIDDLE_MARKERS = {
    "forehead": ("head", (0.0, 0.5, 1.0)), "nape": ("neck", (0.0, 0.0, -1.0)),
    "sternum": ("spine3", (0.0, 0.0, 1.0)), "back": ("spine2", (0.0, 0.0, -1.0)),
    "sacrum": ("pelvis", (0.0, 0.0, -1.0)),
}  # fmt: skip


@dataclass(frozen=True)
class Posed:
    """A result in one frame: its surface, skin weights (V J), posed joints (J 3) and parents (J)."""

    surface: Surface
    weights: Float[np.ndarray, "v j"]
    joints: Float[np.ndarray, "j 3"]
    parents: Int[np.ndarray, "j"]


@dataclass(frozen=True)
class Score:
    """One result in one frame: errors (mm) by the paper's measure, and of that what lies under cloth and what
    is bare; errors as it stands; the re-posed truth (V 3)."""

    paper: ErrorSummary
    under_cloth: ErrorSummary
    bare: ErrorSummary
    direct: ErrorSummary
    reposed: Float[np.ndarray, "v 3"]


def score(
    result: Posed,
    truth: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    scored: Bool[np.ndarray, "v"],
    under_cloth: Bool[np.ndarray, "v"],
    bare: Bool[np.ndarray, "v"],
) -> Score:
    """Score a result against the true naked body (V 3, m) of the same frame; masks over the true vertices."""
    area = vertex_areas(truth, faces)
    direct = signed_error_mm(truth[scored], result.surface)
    rig = transfer_rig(truth, result.surface, result.weights, result.joints, result.parents)
    reposed = pose_truth_to(truth, faces, scored, rig, result.surface)
    shape = signed_error_mm(reposed[scored], result.surface)
    again = vertex_areas(reposed, faces)[scored]
    parts = [summarise(shape[mask[scored]], again[mask[scored]]) for mask in (under_cloth, bare)]
    return Score(
        summarise(shape, again),
        *parts,
        summarise(direct, area[scored]),
        reposed,
    )


def mean_shape(templates: Float[np.ndarray, "t v 3"]) -> Float[np.ndarray, "v 3"]:
    """The mean of unposed alignments: what a bare person's fusion must not be worse than."""
    return templates.mean(axis=0)


def low_quantile_shape(
    templates: Float[np.ndarray, "t v 3"], faces: Int[np.ndarray, "f 3"], share: float = LOW_QUANTILE
) -> Float[np.ndarray, "v 3"]:
    """The naive fusion: every vertex of the mean moved along its normal to a low quantile over the frames."""
    mean = templates.mean(axis=0)
    normals = vertex_normals(mean, faces)
    offsets = np.einsum("tva,va->tv", templates - mean, normals)
    return mean + np.quantile(offsets, share, axis=0)[:, None] * normals


def markers_of(template: Float[np.ndarray, "v 3"], joints: Float[np.ndarray, "j 3"]) -> dict[str, int]:
    """Name -> vertex of a body in the zero pose (m)."""
    found = {}
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        for name, (x, y, z) in MARKERS.items():
            at = joints[JOINT[f"{side}_{name}"]]
            found[f"{side} {name}"] = vertex_towards(template, at, np.array([mirror * x, y, z]))
    for name, (joint, way) in MIDDLE_MARKERS.items():
        found[name] = vertex_towards(template, joints[JOINT[joint]], np.array(way))
    return found


def vertex_towards(
    template: Float[np.ndarray, "v 3"], start: Float[np.ndarray, "3"], way: Float[np.ndarray, "3"]
) -> int:
    """The vertex nearest to a half line, of those not 30 cm from its start."""
    way = way / np.linalg.norm(way)
    along = (template - start) @ way
    aside = np.linalg.norm(template - start - along[:, None] * way, axis=1)
    return int(np.where((along > 0) & (along < 0.3), aside, np.inf).argmin())


def tied_frames(n_frames: int) -> Int[np.ndarray, "s"]:
    """The frames whose ties are taken: N_TIES evenly of the first TIED_FRAMES."""
    last = min(n_frames, TIED_FRAMES) - 1
    return np.unique(np.linspace(0, last, N_TIES).round().astype(int))


def marker_errors_mm(
    markers: Float[np.ndarray, "t m 3"], result: Float[np.ndarray, "t v 3"]
) -> Float[np.ndarray, "s t m"]:
    """Distance (mm) of every marker to its vertex of the result, for every set of ties (s) in every frame.

    markers (T M 3), result (T V 3): m, frame by frame.
    """
    errors = []
    for frame in tied_frames(len(markers)):
        tie = cKDTree(result[frame]).query(markers[frame])[1]
        errors.append(1e3 * np.linalg.norm(result[:, tie] - markers, axis=2))
    return np.stack(errors)


def error_by_frame(errors: Float[np.ndarray, "s t m"]) -> Float[np.ndarray, "t"]:
    """Mean over ties and markers."""
    return errors.mean(axis=(0, 2))


def share_within(
    errors: Float[np.ndarray, "s t m"], distances_mm: np.ndarray = DISTANCES_MM
) -> Float[np.ndarray, "d"]:
    """Share of all landmarks (ties, frames, markers) whose error is at most each distance."""
    return np.searchsorted(np.sort(errors.ravel()), distances_mm, side="right") / errors.size


def value_at(
    value: Float[np.ndarray, "w"], result: Surface, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """A value a vertex of the result (W), at the places of its surface nearest to points (N 3)."""
    closest = closest_points(result.vertices, result.faces, points)
    return (closest.barycentric * value[result.faces[closest.triangle_idx]]).sum(1)


def rms_by_confidence(
    confidence: Float[np.ndarray, "n"], error_mm: Float[np.ndarray, "n"], area: Float[np.ndarray, "n"]
) -> list[tuple[float, float]]:
    """(mean confidence, RMS error in mm) of five parts of the surface, equal in area, the least sure first.

    One part only where the confidence is the same everywhere.
    """
    order = np.argsort(confidence, kind="stable")
    running = np.cumsum(area[order]) - 0.5 * area[order]
    group = np.minimum((N_GROUPS * running / area.sum()).astype(int), N_GROUPS - 1)
    if np.ptp(confidence) == 0.0:
        group[:] = 0
    out = []
    for k in np.unique(group):
        chosen = order[group == k]
        weight = area[chosen] / area[chosen].sum()
        out.append((float(weight @ confidence[chosen]), float(np.sqrt(weight @ error_mm[chosen] ** 2))))
    return out
