"""The mask's border moved to the picture's edge: a guided filter, or GrabCut in a band.

Guided filter: He, Sun, Tang, ECCV 2010. GrabCut: Rother, Kolmogorov, Blake, SIGGRAPH 2004. Both are OpenCV's;
both look only near the border, and only in the subject's box.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

_GUIDED_SHARE = 1 / 250  # radius, of the picture's longer side
_GUIDED_EPSILON = 40.0
_BAND_SHARE = 1 / 150  # half width of GrabCut's band, of the picture's longer side
_MARGIN_SHARE = 1 / 30

Picture = UInt8[np.ndarray, "h w 3"]
Mask = UInt8[np.ndarray, "h w"]


def refined(mask: Mask, picture: Picture, how: str) -> Mask:
    """The mask (255, 0) with its border along the picture's edges. how : "guided", "grabcut", or "none"."""
    if how == "none" or not mask.any():
        return mask
    side = max(mask.shape)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = max(8, round(side * _MARGIN_SHARE))
    box = (
        slice(max(0, rows[0] - margin), rows[-1] + 1 + margin),
        slice(max(0, columns[0] - margin), columns[-1] + 1 + margin),
    )
    here, seen = np.ascontiguousarray(mask[box]), np.ascontiguousarray(picture[box])
    result = mask.copy()
    if how == "guided":
        radius = max(2, round(side * _GUIDED_SHARE))
        soft = cv2.ximgproc.guidedFilter(seen, (here > 0).astype(np.float32), radius, _GUIDED_EPSILON)
        fine = soft > 0.5
        # Farther from the old border than the filter looks, nothing changes.
        band = _band(here, radius)
        result[box] = np.where(band > 0, np.where(fine, 255, 0), here)
        return result
    assert how == "grabcut", how
    band = _band(here, max(3, round(side * _BAND_SHARE)))
    labels = np.where(here > 0, cv2.GC_FGD, cv2.GC_BGD).astype(np.uint8)
    labels[(band > 0) & (here > 0)] = cv2.GC_PR_FGD
    labels[(band > 0) & (here == 0)] = cv2.GC_PR_BGD
    if not ((labels == cv2.GC_FGD).any() and (labels == cv2.GC_BGD).any()):
        return mask
    # The rectangle is not looked at in this mode.
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(seen, labels, (0, 0, 1, 1), *models, 1, cv2.GC_INIT_WITH_MASK)
    result[box] = np.where((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD), 255, 0)
    return result


def _band(mask: Mask, radius: int) -> Mask:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.subtract(cv2.dilate(mask, kernel), cv2.erode(mask, kernel)).astype(np.uint8)
