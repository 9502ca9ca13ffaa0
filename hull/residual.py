"""How far, in pixels of the full pictures, a camera's outline lies outside the hull of the other cameras."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from hull.reference import Moment, View, rest_of

# Nine tenths of the outline stick out by no more than what is told.
_QUANTILE = 0.9
_BORDER_PX = 2


def residuals(moments: Sequence[Moment], members: Sequence[int]) -> dict[int, float]:
    """Per camera: nine tenths of its outline lie inside the hull of the other members, or outside by no more
    than so many pixels; median over the moments. The picture's diagonal where the hull does not show at all;
    nothing for a camera without a hull of others. Clean silhouettes of a right camera: about half a pixel.
    """
    found: dict[int, list[float]] = {}
    for moment in moments:
        for i, view in enumerate(moment.views):
            if view is None:
                continue
            if moment.hull(rest_of(members, i)) is None:
                continue
            covered = moment.rest_mask(members, i)
            outside = np.zeros(0) if covered is None else _outside(covered, view)
            value = float(np.hypot(*view.mask.shape)) if not len(outside) else _told(outside)
            found.setdefault(i, []).append(value)
    return {i: float(np.median(values)) for i, values in found.items()}


def _told(outside: Float[np.ndarray, " n"]) -> float:
    return float(np.quantile(outside, _QUANTILE))


def _outside(covered: Bool[np.ndarray, "h w"], view: View) -> Float[np.ndarray, " n"]:
    """How far each pixel of the silhouette's outline is outside `covered`, px; 0 inside."""
    if not covered.any():
        return np.zeros(0)
    height, width = covered.shape
    rows, columns = np.flatnonzero(view.person.any(axis=1)), np.flatnonzero(view.person.any(axis=0))
    box = (
        slice(max(rows[0] - 1, 0), min(rows[-1] + 2, height)),
        slice(max(columns[0] - 1, 0), min(columns[-1] + 2, width)),
    )
    person = view.person[box].astype(np.uint8)
    inner = cv2.erode(person, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    outline = (person > 0) & (inner == 0)
    if view.known is not None:
        # Where the unknown begins nobody drew an outline.
        outline &= cv2.erode(view.known[box].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    whole = np.zeros((height, width), dtype=bool)
    whole[box] = outline
    b = _BORDER_PX
    whole[:b] = whole[-b:] = False
    whole[:, :b] = whole[:, -b:] = False
    away = cv2.distanceTransform((~covered).astype(np.uint8), cv2.DIST_L2, 5)
    # Between the centre of the outermost pixel that the hull covers and its edge.
    return np.maximum(away[whole].astype(np.float64) - 0.5, 0.0)
