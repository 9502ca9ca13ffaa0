"""Marks on a frame: a second subject, or one that leaves what the cameras see. Each names the cameras.

The hull of two people is no scan of one, and a hull that ends where the pictures do is no end of a person;
both come out looking well, so they have to be said.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from hull.bounds import Bounds
from hull.cleaning import compacted, face_pieces, piece_volumes
from hull.evidence import MissedLines
from hull.tables import NO_EVIDENCE, SilhouetteTable

# A separate piece of this share of the largest is another subject, not a hand, if it is as long as this.
SUBJECT_SHARE, SUBJECT_M = 0.3, 0.6
# Something else is there when this share of a camera's lines of sight, in this share of cameras, needs it.
_ELSEWHERE_LINES, _ELSEWHERE_CAMERAS = 0.08, 0.5
# The hull may end so much, square metres, for want of witnesses (a wrist's cross-section).
_OPEN_M2 = 0.005
_OUTWARD_M = 0.03
_MOST_NAMES = 8
# Litres that a hull of one person does not leave: the most with very many cameras, and what so many times one
# over their number adds (people of 110 kg in loose clothes stay a third below), and a small child.
_MOST_L, _MORE_L, _LEAST_L = 170.0, 440.0, 8.0


def one_subject(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Bool[np.ndarray, " v"], Int[np.ndarray, "f2 3"], tuple[str, ...]]:
    """Which vertices (V,) stay, faces that count those only, and a sentence where a subject was left out.

    The largest piece stays, with the small ones that are nearer to it than to another subject.
    """
    label = face_pieces(faces, len(vertices))
    volumes = piece_volumes(vertices, faces, label)
    largest = int(np.argmax(volumes))
    pieces = [vertices[np.unique(faces[label == k])] for k in range(len(volumes))]
    others = [
        k
        for k, piece in enumerate(pieces)
        if k != largest
        and volumes[k] >= SUBJECT_SHARE * volumes[largest]
        and np.ptp(piece, axis=0).max() >= SUBJECT_M
    ]
    if not others:
        return np.ones(len(vertices), dtype=bool), faces, ()
    middles = np.array([piece.mean(axis=0) for piece in pieces])
    to_largest = np.linalg.norm(middles - middles[largest], axis=1)
    to_others = np.min([np.linalg.norm(middles - middles[k], axis=1) for k in others], axis=0)
    keep = to_largest < to_others
    used, faces = compacted(faces[keep[label]], len(vertices))
    told = " and ".join(f"{1000 * volumes[k]:.0f} L near {_place(middles[k])}" for k in others)
    return (
        used,
        faces,
        (
            f"there is more than one subject: the largest ({1000 * volumes[largest]:.0f} L near "
            f"{_place(middles[largest])}) is kept, {told} left out",
        ),
    )


def elsewhere_mark(
    vertices: Float[np.ndarray, "v 3"],
    voxel_m: float,
    bounds: Bounds,
    tables: Sequence[SilhouetteTable],
    n_lines: Int[np.ndarray, " c"],
    missed: MissedLines,
) -> tuple[str, ...]:
    """A sentence where many cameras show something outside the box that was carved.

    Not where the hull itself is cut off by the box: then it is the same subject that goes on there.
    """
    margin = 2.0 * voxel_m
    if (vertices < bounds.low + margin).any() or (vertices > bounds.high - margin).any():
        return ()
    share = (
        missed.scale
        * np.bincount(missed.table[missed.elsewhere], minlength=len(tables))
        / np.maximum(n_lines, 1)
    )
    showing = np.flatnonzero(share > _ELSEWHERE_LINES).tolist()
    if len(showing) < max(3, _ELSEWHERE_CAMERAS * len(tables)):
        return ()
    place = np.median(missed.place[missed.elsewhere], axis=0)
    return (
        f"something else stands near {_place(place)}, outside the space that was carved (a second person?); "
        f"{_names([tables[k].name for k in showing])} show it",
    )


def leaving_mark(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    cut_by: Int[np.ndarray, " v"],
    voxel_m: float,
    bounds: Bounds,
    tables: Sequence[SilhouetteTable],
) -> tuple[str, ...]:
    """A sentence where the hull ends for want of witnesses. `cut_by` (V,): -1 where no camera ends it."""
    # At the box's sides it is the box that ends it.
    margin = 2.0 * voxel_m
    within = ((vertices > bounds.low + margin) & (vertices < bounds.high - margin)).all(axis=1)
    open_ = np.flatnonzero((cut_by < 0) & within)
    area_m2 = len(open_) * voxel_m**2
    if area_m2 < _OPEN_M2:
        return ()
    beyond = (vertices[open_] + _OUTWARD_M * normals[open_]).T
    blind = [t.name for t in tables if (t.ask_points(beyond) == NO_EVIDENCE).mean() > 0.5]
    place = np.median(vertices[open_], axis=0)
    return (
        f"the subject leaves what enough cameras see, near {_place(place)}: the hull ends there over about "
        f"{1e4 * area_m2:.0f} cm2 without an outline; {_names(blind)} do not see that place",
    )


def size_mark(volume_m3: float, n_cameras: int) -> tuple[str, ...]:
    """A sentence where a hull from so many cameras is larger or smaller than any one person's."""
    litres, most = 1e3 * volume_m3, _MOST_L + _MORE_L / max(n_cameras, 1)
    if litres > most:
        return (
            f"the hull holds {litres:.0f} L, more than one person does (up to {most:.0f} L with {n_cameras} "
            "cameras): two people who touch, or a wrong unit?",
        )
    if litres < _LEAST_L:
        return (
            f"the hull holds {litres:.1f} L, less than a person does: silhouettes or calibration are wrong",
        )
    return ()


def _place(point: Float[np.ndarray, " 3"]) -> str:
    return "({:.1f}, {:.1f}, {:.1f}) m".format(*(float(v) + 0.0 for v in np.round(point, 1)))


def _names(names: Sequence[str]) -> str:
    if not names:
        return "single cameras"
    shown = ", ".join(names[:_MOST_NAMES])
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"camera{'s' * (len(names) > 1)} {shown}{more}"
