"""Intrinsics of one camera from views of a board (Zhang 2000, through OpenCV), and how well they are known.

OpenCV's time grows steeply with the number of views, so the few that differ most are taken: over the
picture, near and far, tilted every way. Views that do not fit the rest are left out. What few or alike views
cannot tell (principal point, then aspect ratio and distortion) is not asked of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from capture.board import Board
from capture.board_view import BoardView

_N_VIEWS = 20
_LEAST_VIEWS = 3
_FULL_MODEL_VIEWS = 5  # fewer leave the principal point where most cameras have it: in the middle
_SURE_PRINCIPAL_POINT = 0.04  # of the picture's width: a standard deviation beyond that is no knowledge
_UNSURE_FOCAL = 0.03  # of the focal length: the same
_GRID = 10


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """What one camera's lens does.

    matrix (3 3) px; distortion: k1 k2 p1 p2 of OpenCV (4), or with k3 to k6 (8); rms_px over the views used;
    focal_sd_px: standard deviation of the focal length as the views tell it; n_views: used of n_given;
    coverage: share of the picture where corners were seen; edge_px: median width of edges, NaN if unknown;
    sure: False where something had to be assumed; notes: what was assumed, a sentence each.
    """

    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " d"]
    rms_px: float
    focal_sd_px: float
    n_views: int
    n_given: int
    coverage: float
    edge_px: float
    notes: tuple[str, ...] = ()

    @property
    def focal_px(self) -> float:
        return float(self.matrix[0, 0] + self.matrix[1, 1]) / 2


def find_intrinsics(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], *, wide: bool = False
) -> Intrinsics | None:
    """The camera's intrinsics, or None where fewer than three views differ enough to tell anything.

    size: (width, height) px. wide: k3 to k6 as well, for lenses that bend strongly.
    """
    chosen = spread_views(sharp_views(views), board, size)
    if len(chosen) < _LEAST_VIEWS:
        return None
    notes: list[str] = []
    flags = cv2.CALIB_RATIONAL_MODEL if wide else cv2.CALIB_FIX_K3
    if len(chosen) < _FULL_MODEL_VIEWS:
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
        notes.append(f"only {len(chosen)} usable views: principal point assumed in the middle of the picture")
    result = _solved(chosen, board, size, flags)
    if result is None:
        return None
    if not flags & cv2.CALIB_FIX_PRINCIPAL_POINT:
        spread = float(result.deviations[2:4].max())
        unsure = float(result.deviations[:2].max()) > _UNSURE_FOCAL * result.matrix[0, 0]
        if unsure or not spread < _SURE_PRINCIPAL_POINT * max(size):
            flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
            again = _solved(chosen, board, size, flags)
            notes.append("views too alike to tell the principal point: assumed in the middle of the picture")
            result = again or result
    distortion = result.distortion[: 8 if wide else 4]
    edges = [view.edge_px for view in views]
    return Intrinsics(
        result.matrix,
        distortion,
        result.rms_px,
        float(result.deviations[:2].max()),
        result.n_views,
        len(views),
        coverage(views, size),
        float(np.nanmedian(edges)) if np.isfinite(edges).any() else float("nan"),
        tuple(notes),
    )


def coverage(views: Sequence[BoardView], size: tuple[int, int]) -> float:
    """Share of the picture, cut into 10 x 10 fields, whose field holds a corner of some view."""
    pixels = np.concatenate([view.pixels for view in views]) if views else np.zeros((0, 2))
    fields = np.floor((pixels + 0.5) / np.array(size) * _GRID).astype(int).clip(0, _GRID - 1)
    return len(np.unique(fields, axis=0)) / _GRID**2


def sharp_views(views: Sequence[BoardView]) -> list[BoardView]:
    """Without views more than twice as blurred as the sharper quarter, relative to the board's size in
    them."""
    if len(views) < 8:
        return list(views)
    edges = np.array([view.edge_px for view in views])
    limit = 2.0 * np.nanpercentile(edges, 25) + 2.0
    return [view for view, edge in zip(views, edges, strict=True) if not edge > limit]


def spread_views(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], n_views: int = _N_VIEWS
) -> list[BoardView]:
    """At most `n_views` that differ most in place, size and tilt, complete ones first."""
    if len(views) <= n_views:
        return list(views)
    described = np.array([_description(view, board, size) for view in views])
    chosen = spread_choice(described, n_views, first=int(np.argmax([len(view) for view in views])))
    return [views[k] for k in sorted(chosen)]


def spread_choice(described: Float[np.ndarray, "n d"], n_chosen: int, first: int) -> list[int]:
    """Rows far from each other: each next one is the farthest from those chosen before."""
    chosen = [first]
    distance = np.linalg.norm(described - described[first], axis=1)
    while len(chosen) < min(n_chosen, len(described)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(described - described[chosen[-1]], axis=1))
    return chosen


def _description(view: BoardView, board: Board, size: tuple[int, int]) -> Float[np.ndarray, " d"]:
    """Where in the picture, how large, how tilted: each about one unit from end to end."""
    flat = board.corners[view.ids, :2]
    homography, _ = cv2.findHomography(flat, view.pixels / max(size), 0)
    middle = view.pixels.mean(axis=0) / max(size)
    if homography is None:
        return np.array([*middle, 0, 0, 0, 0])
    homography = homography / homography[2, 2]
    extent = board.square_m * np.hypot(board.columns, board.rows)
    area = abs(np.linalg.det(homography[:2, :2])) ** 0.5 * extent
    tilt = np.clip(homography[2, :2] * extent, -1, 1)
    roll = np.arctan2(homography[1, 0], homography[0, 0])
    return np.array([*middle, 0.7 * area, *(1.5 * tilt), 0.1 * np.cos(roll), 0.1 * np.sin(roll)])


@dataclass(frozen=True, eq=False)
class _Solution:
    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " d"]
    deviations: Float[np.ndarray, " p"]
    rms_px: float
    n_views: int


def _solved(views: Sequence[BoardView], board: Board, size: tuple[int, int], flags: int) -> _Solution | None:
    """OpenCV's calibration, again without the views that fit much worse than the rest."""
    kept = list(views)
    found: _Solution | None = None
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-9)
    for _ in range(4):
        objects = [board.corners[view.ids].astype(np.float32) for view in kept]
        pixels = [view.pixels.astype(np.float32) for view in kept]
        try:
            start = _start_matrix(objects, pixels, size)
            rms, matrix, distortion, _, _, deviations, _, errors = cv2.calibrateCameraExtended(
                objects,
                pixels,
                size,
                start,
                np.zeros(8 if flags & cv2.CALIB_RATIONAL_MODEL else 5),
                flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
                criteria=criteria,
            )
        except cv2.error:
            return found
        if not (np.isfinite(matrix).all() and np.isfinite(distortion).all() and matrix[0, 0] > 0):
            return found
        deviations = np.nan_to_num(deviations.ravel(), nan=np.inf)
        found = _Solution(
            np.asarray(matrix, np.float64),
            distortion.ravel().astype(np.float64),
            deviations,
            float(rms),
            len(kept),
        )
        error = errors.ravel()
        good = error <= max(3 * float(np.median(error)), 0.3)
        if good.all() or good.sum() < _LEAST_VIEWS:
            return found
        kept = [view for view, is_good in zip(kept, good, strict=True) if is_good]
    return found


def _start_matrix(
    objects: list[Float[np.ndarray, "_n 3"]], pixels: list[Float[np.ndarray, "_n 2"]], size: tuple[int, int]
) -> Float[np.ndarray, "3 3"]:
    """Focal length from the views' vanishing points, as the median over single views: one bad view does not
    matter."""
    middle = (np.array(size, dtype=np.float64) - 1) / 2
    focals = []
    for flat, seen in zip(objects, pixels, strict=True):
        homography, _ = cv2.findHomography(
            flat[:, :2].astype(np.float64), seen.astype(np.float64) - middle, 0
        )
        if homography is None:
            continue
        focal = _focal_of(homography)
        if focal is not None and 0.3 * max(size) < focal < 10 * max(size):
            focals.append(focal)
    focal = float(np.median(focals)) if focals else 1.2 * max(size)
    return np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])


def _focal_of(homography: Float[np.ndarray, "3 3"]) -> float | None:
    """Focal length, px, that makes the two directions of a board's plane orthogonal and equally long."""
    a, b = homography[:, 0], homography[:, 1]
    # a' W b = 0 and a' W a = b' W b with W = diag(w, w, 1), w = 1 / focal^2.
    rows = np.array([a[0] * b[0] + a[1] * b[1], a[0] ** 2 + a[1] ** 2 - b[0] ** 2 - b[1] ** 2])
    right = -np.array([a[2] * b[2], a[2] ** 2 - b[2] ** 2])
    if rows @ rows < 1e-12:
        return None
    w = float(rows @ right / (rows @ rows))
    return float(1 / np.sqrt(w)) if w > 0 else None
