"""Which of a vertex's offsets over the frames are lost points, not cloth.

The paper's outside term is a square (section 4.1): one percent of points lost 20 to 60 mm inside ruins a
fusion. Frames agree about the same vertex far better than that.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_matrix

#: Offsets so many robust deviations from the others' median, and at least so far, are lost.
CLIP_MAD = 3.5
CLIP_FLOOR_M = 0.004
ENOUGH_FRAMES = 8
#: A vertex this far inside the mean of its neighbours, a centimetre or two away, is no fold.
DENT_M = 0.008


def allowance(
    offsets: Float[np.ndarray, "t v"], clip_mad: float = CLIP_MAD, floor_m: float = CLIP_FLOOR_M
) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """Median of every vertex's offsets (m) over the frames, and how far from it they may lie."""
    median = np.median(offsets, axis=0)
    spread = 1.4826 * np.median(np.abs(offsets - median), axis=0)
    return median, np.maximum(clip_mad * spread, floor_m)


def lost_points(
    offsets: Float[np.ndarray, "t v"], laplacian: csr_matrix | None = None
) -> Bool[np.ndarray, "t v"]:
    """Which unposed vertices lie implausibly far inside their fellows of the other frames, or, with the
    mesh's laplacian (V V), inside their neighbours of the same frame.

    offsets: along the common normal, positive outwards, m. Only inward outliers are dropped: they alone pull
    the shape in, and the outside term has little resistance against them.
    """
    median, allowed = allowance(offsets)
    lost = offsets < median - allowed
    if laplacian is not None:
        lost |= ((laplacian @ offsets.T) / laplacian.diagonal()[:, None]).T < -DENT_M
    return lost


def robust_variance(
    offsets: Float[np.ndarray, "t v"], lost: Bool[np.ndarray, "t v"] | None = None
) -> Float[np.ndarray, "v"]:
    """Unbiased variance over the frames of the offsets (m) that are plausible, and not known to be lost.

    What is plausible is told from ENOUGH_FRAMES on: among fewer, the one that differs is most of what moves.
    """
    plausible = np.ones(offsets.shape, dtype=bool) if lost is None else ~lost
    if len(offsets) >= ENOUGH_FRAMES:
        median, allowed = allowance(offsets)
        plausible &= np.abs(offsets - median) <= allowed
    count = np.maximum(plausible.sum(axis=0), 1)
    mean = (offsets * plausible).sum(axis=0) / count
    return (plausible * (offsets - mean) ** 2).sum(axis=0) / np.maximum(count - 1, 1)
