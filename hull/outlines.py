"""The outline of a silhouette as a chain of points a pixel apart, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from skimage.measure import find_contours

from hull.tables import BACKGROUND, PERSON

# The steps of a binary outline are smoothed away, and little more: a rounded finger tip is a moved one.
_SMOOTH_PX = 0.7
# Pieces of a silhouette smaller than this share of the largest are specks; so are loops shorter than this.
_PIECE_SHARE = 0.03
_LEAST_LOOP_PX = 24.0
# Nearer than this to the picture's border, or to where nothing is known, an outline may be the border's.
_BORDER_PX = 4


@dataclass(frozen=True, eq=False)
class Outline:
    """The outline of one silhouette, of its pieces and holes. Pixels are the camera's pinhole's.

    loops : closed chains (N 2) of points about a pixel apart, the person on the right as the picture is seen.
    sure : for each loop (N,), whether the person ends there; not so at the picture's border, or beside
        unknown pixels.
    corners : (K,) which points, counted through all loops, are the corners of the convex hull.
    size_px : the larger side of the silhouette's box.
    """

    loops: tuple[Float[np.ndarray, "_n 2"], ...]
    sure: tuple[Bool[np.ndarray, " _n"], ...]
    corners: Int[np.ndarray, " k"]
    size_px: float


def outline_of(mask: UInt8[np.ndarray, "h w"]) -> Outline | None:
    """The outline of a silhouette (255 person, 0 background, 128 unknown); None where nobody is seen."""
    person = (mask == PERSON).astype(np.uint8)
    n_pieces, pieces, facts, _ = cv2.connectedComponentsWithStats(person, connectivity=8)
    if n_pieces < 2:
        return None
    area = facts[1:, cv2.CC_STAT_AREA]
    kept = np.flatnonzero(area >= _PIECE_SHARE * area.max()) + 1
    x_0, y_0 = facts[kept][:, :2].min(axis=0)
    x_1, y_1 = (facts[kept][:, :2] + facts[kept][:, 2:4]).max(axis=0)
    part = np.isin(pieces[y_0:y_1, x_0:x_1], kept).astype(np.float32)
    margin = int(np.ceil(4 * _SMOOTH_PX)) + 1
    framed = cv2.copyMakeBorder(part, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0.0)
    smooth = cv2.GaussianBlur(framed, (0, 0), _SMOOTH_PX)
    loops = []
    for contour in find_contours(smooth, 0.5):
        loop = _evenly_spaced(contour[:, ::-1] + [x_0 - margin, y_0 - margin])
        if loop is not None:
            loops.append(loop)
    if not loops:
        return None
    unknown = ((mask != PERSON) & (mask != BACKGROUND)).astype(np.uint8)
    doubtful = cv2.dilate(unknown, np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)) > 0
    for border in (doubtful[:_BORDER_PX], doubtful[-_BORDER_PX:]):
        border[:] = True
    for border in (doubtful[:, :_BORDER_PX], doubtful[:, -_BORDER_PX:]):
        border[:] = True
    height, width = mask.shape
    sure = []
    for loop in loops:
        column, row = np.rint(loop).astype(int).T
        sure.append(~doubtful[row.clip(0, height - 1), column.clip(0, width - 1)])
    points = np.ascontiguousarray(np.concatenate(loops), dtype=np.float32)
    corners = cv2.convexHull(points, returnPoints=False)[:, 0].astype(int)
    return Outline(tuple(loops), tuple(sure), corners, float(max(x_1 - x_0, y_1 - y_0)))


def _evenly_spaced(contour: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"] | None:
    """A closed contour (last point = first) as points about a pixel apart; None for one that is a speck."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(contour, axis=0), axis=1))])
    if along[-1] < _LEAST_LOOP_PX:
        return None
    at = np.linspace(0.0, along[-1], int(along[-1]), endpoint=False)
    return np.column_stack([np.interp(at, along, contour[:, axis]) for axis in (0, 1)])
