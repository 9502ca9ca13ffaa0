"""Which of a vertex's offsets over the frames are lost points, not cloth.

The paper's outside term is a square (section 4.1): one percent of points lost 20 to 60 mm inside ruins a
fusion. Frames agree about the same vertex far better than that.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

#: Offsets so many robust deviations from the others' median, and at least so far, are lost.
CLIP_MAD = 3.5
CLIP_FLOOR_M = 0.004


def allowance(
    offsets: Float[np.ndarray, "t v"], clip_mad: float = CLIP_MAD, floor_m: float = CLIP_FLOOR_M
) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """Median of every vertex's offsets (m) over the frames, and how far from it they may lie."""
    median = np.median(offsets, axis=0)
    spread = 1.4826 * np.median(np.abs(offsets - median), axis=0)
    return median, np.maximum(clip_mad * spread, floor_m)


def lost_points(offsets: Float[np.ndarray, "t v"]) -> Bool[np.ndarray, "t v"]:
    """Which unposed vertices lie implausibly far inside their fellows of the other frames.

    offsets: along the common normal, positive outwards, m. Only inward outliers are dropped: they alone pull
    the shape in, and the outside term has little resistance against them.
    """
    median, allowed = allowance(offsets)
    return offsets < median - allowed


def robust_variance(offsets: Float[np.ndarray, "t v"]) -> Float[np.ndarray, "v"]:
    """Variance over the frames of the offsets (m) that are plausible."""
    median, allowed = allowance(offsets)
    plausible = np.abs(offsets - median) <= allowed
    count = plausible.sum(axis=0)  # the median's neighbours are always among them
    mean = (offsets * plausible).sum(axis=0) / count
    return (plausible * (offsets - mean) ** 2).sum(axis=0) / count
