"""Which points are bare skin, and how surely: labels given with the scans, or told by colour, and the g of
the paper's skin term (section 4.1).

Labels are carried to the alignment, since there the surface is whole and its parts are known; g comes from
distances along it and goes back to the scan's points by nearest distance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from fit.align import Alignment
from fit.body.parts import BODY_25, region_mask
from fit.energy import skin_share
from fit.geodesic import distance_from
from fit.settings import FitSettings
from fit.solver import Fitter
from hull.scan import Scan
from hull.skin_colour import skin_by_colour

#: The bare part of a face: around the nose, in the rest pose, m.
FACE_M = 0.06
#: A vertex takes the label, or the mean colour, of so many nearest points of the scan.
N_NEAREST = 4

Shares = dict[int, Float[np.ndarray, "_v"]]


def labelled(
    fitter: Fitter, scans: Mapping[int, Scan], alignments: Sequence[Alignment], settings: FitSettings
) -> tuple[dict[int, Scan], Shares | None]:
    """The scans with their skin labelled, and g of every vertex (V) of every alignment, by frame number.

    Labels that the scans bring come first; else colours decide, where all scans have any. None, and the scans
    as they are, where neither shows skin. A frame whose alignment failed stays all cloth.
    """
    usable = [a for a in alignments if a.status != "failed" and a.frame_id in scans]
    if not usable:
        return dict(scans), None
    posed = {a.frame_id: fitter.posed(a.state) for a in usable}
    near = {k: cKDTree(scans[k].points).query(posed[k], k=N_NEAREST)[1] for k in posed}
    given = any(scans[k].is_skin.any() for k in posed)
    bare: dict[int, Bool[np.ndarray, " _v"]]
    if given:
        bare = {k: scans[k].is_skin[near[k]].mean(axis=1) > 0.5 for k in posed}
    else:
        shades = [(scans[k].colours, near[k]) for k in posed]
        if any(colours is None for colours, _ in shades):
            return dict(scans), None
        mean = [np.round(c[idx].mean(axis=1)).astype(np.uint8) for c, idx in shades if c is not None]
        found = skin_by_colour(np.stack(mean), usually_bare(fitter), edges_of(fitter.model.faces))
        if found is None:
            return dict(scans), None
        bare = dict(zip(posed, found, strict=True))
    out, shares = dict(scans), {}
    for a in alignments:
        shares[a.frame_id] = np.zeros(fitter.model.n_vertices)
    for a in usable:
        k = a.frame_id
        far = distance_from(a.state.template, fitter.model.faces, ~bare[k])
        share = skin_share(far, settings.skin_edge_m, settings.skin_edge_width_m)
        shares[k] = share
        nearest = cKDTree(posed[k]).query(scans[k].points)[1]
        is_skin = scans[k].is_skin if given else bare[k][nearest]
        out[k] = replace(scans[k], is_skin=is_skin, skin_share=np.where(is_skin, share[nearest], 0.0))
    return out, shares


def usually_bare(fitter: Fitter) -> list[Bool[np.ndarray, " v"]]:
    """Face and hands, as groups of vertices."""
    model = fitter.model
    nose = model.landmarks[BODY_25.index("nose")] @ model.template
    head = region_mask(model.parts, "head")
    face = head & (np.linalg.norm(model.template - nose, axis=1) < FACE_M)
    return [face, region_mask(model.parts, "hand")]


def edges_of(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """(E 2) every edge of a mesh once."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(pairs, axis=1), axis=0)
