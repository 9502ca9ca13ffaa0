"""How well each camera agrees with the hull of the others: what one may trust of a rig without any truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from capture.rig import Rig
from hull.bounds import find_bounds
from hull.errors import HullError
from hull.quality import silhouette_agreement
from hull.visual_hull import HullOptions, build_hull

_FEWEST_OTHERS = 2


def agreement_with_others(
    rig: Rig,
    images: Sequence[UInt8[np.ndarray, "_h _w"] | None],
    use: Bool[np.ndarray, " c"],
    voxel_m: float,
) -> Float[np.ndarray, " c"]:
    """IoU (C,) of each camera's silhouette and the hull carved from the other cameras in use.

    images : silhouettes of one frame, as `build_hull` takes them. 0 where the others leave no hull, NaN where
    the camera gave no evidence or fewer than two others did. The hull of a few cameras is larger than the
    person, so the number is below 1 even for a perfect rig.
    """
    scores = np.full(len(rig), np.nan)
    shown = [image if use[k] else None for k, image in enumerate(images)]
    options = HullOptions(find_faults=False)
    for camera_idx, image in enumerate(images):
        others = [None if k == camera_idx else each for k, each in enumerate(shown)]
        if image is None or sum(each is not None for each in others) < _FEWEST_OTHERS:
            continue
        try:
            hull = build_hull(rig, others, voxel_m, find_bounds(rig, others), options)
        except HullError:
            scores[camera_idx] = 0.0
            continue
        only = [image if k == camera_idx else None for k in range(len(rig))]
        scores[camera_idx] = silhouette_agreement(hull.vertices, hull.faces, rig, only)[camera_idx]
    return scores
