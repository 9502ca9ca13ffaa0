"""Corners of a board in one picture, to a tenth of a pixel.

Checkerboards: OpenCV's quick finder says where, its sector-based finder (Duda and Frese 2018) says exactly
where, on the board's part of the picture only, since it takes a second on a whole one. Both may start at any
end of the board and, on boards that the picture cuts, on the wrong square: the colours of the squares
decide. ChArUco: OpenCV's detector; views that its marker check drops for being steep are tried without, and
checked here.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from capture.board import Board
from capture.board_view import BoardView

_LEAST_CORNERS = 6  # fewer say too little about a pose
_SQUARES_RIGHT = 0.9  # share of neighbouring squares that must differ as they should
_WORST_MISFIT = 0.3  # of a square's side, after a homography: lenses bend less, wrong squares more
_STEPS = 25

Grey = UInt8[np.ndarray, "h w"]


def find_board(picture: Grey, board: Board, *, thorough: bool = True) -> BoardView | None:
    """The board's inner corners in a grey picture (h w), or None where fewer than six are seen for sure.

    thorough: look longer where the quick search of a checkerboard finds nothing (a second for 2 MP).
    """
    if board.kind == "charuco":
        found = _charuco_corners(picture, board)
    else:
        found = _checkerboard_corners(picture, board, thorough)
    if found is None:
        return None
    ids, pixels = found
    if len(ids) < _LEAST_CORNERS or _is_on_a_line(board, ids) or _misfit(board, ids, pixels) > _WORST_MISFIT:
        return None
    return BoardView(ids, pixels, edge_width(picture, board, ids, pixels))


# -- checkerboards -----------------------------------------------------------------------------------------


def _checkerboard_corners(
    picture: Grey, board: Board, thorough: bool
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]] | None:
    shape = (board.n_across, board.n_down)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, quick = cv2.findChessboardCorners(picture, shape, flags=flags)
    pixels = None
    if found:
        rough = quick.reshape(-1, 2).astype(np.float64)
        pixels = _ordered(picture, board, _exact(picture, board, rough))
    if pixels is None and thorough:
        pixels = _ordered(picture, board, _sector_corners(picture, shape))
    return None if pixels is None else (np.arange(board.n_corners), pixels)


def _exact(picture: Grey, board: Board, rough: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Corners found roughly, found again exactly in their part of the picture."""
    grid = rough.reshape(board.n_down, board.n_across, 2)
    pitch = _pitch(grid)
    margin = 1.6 * max(float(np.linalg.norm(np.diff(grid, axis=a), axis=-1).max()) for a in (0, 1))
    height, width = picture.shape
    low = np.maximum(np.floor(rough.min(axis=0) - margin), 0).astype(int)
    high = np.minimum(np.ceil(rough.max(axis=0) + margin) + 1, [width, height]).astype(int)
    part = np.ascontiguousarray(picture[low[1] : high[1], low[0] : high[0]])
    exact = _sector_corners(part, (board.n_across, board.n_down))
    if exact is not None:
        exact = exact + low
        # The same corners, from whichever end they are counted?
        nearest = np.linalg.norm(exact[:, None] - rough[None], axis=-1).min(axis=1)
        if nearest.max() < 0.5 * pitch:
            return exact
    half = int(np.clip(round(0.3 * pitch), 2, 15))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    refined = cv2.cornerSubPix(
        picture, np.ascontiguousarray(rough[:, None], np.float32), (half, half), (-1, -1), criteria
    )
    return refined.reshape(-1, 2).astype(np.float64)


def _sector_corners(picture: Grey, shape: tuple[int, int]) -> Float[np.ndarray, "n 2"] | None:
    if min(picture.shape) < 24:
        return None
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
    for more in (0, cv2.CALIB_CB_EXHAUSTIVE):  # the exhaustive search takes five times as long
        found, corners = cv2.findChessboardCornersSB(picture, shape, flags=flags | more)
        if found:
            return corners.reshape(-1, 2).astype(np.float64)
    return None


def _ordered(
    picture: Grey, board: Board, pixels: Float[np.ndarray, "n 2"] | None
) -> Float[np.ndarray, "n 2"] | None:
    """The corners counted so that the board is seen from its front and its first square is black.

    None where the squares between them are not black and white in turn. A board that looks alike after a
    half turn starts at the end that is nearer to the picture's first pixel.
    """
    if pixels is None:
        return None
    grid = pixels.reshape(board.n_down, board.n_across, 2)
    across, down = grid[:, -1].mean(0) - grid[:, 0].mean(0), grid[-1].mean(0) - grid[0].mean(0)
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    right = _squares_in_turn(picture, grid)
    if max(right, 1 - right) < _SQUARES_RIGHT:
        return None
    if board.looks_alike_turned:
        if right < 0.5:
            return None
        if grid[-1, -1].sum() < grid[0, 0].sum():
            grid = grid[::-1, ::-1]
    elif right < 0.5:
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid.reshape(-1, 2))


def _squares_in_turn(picture: Grey, grid: Float[np.ndarray, "r c 2"]) -> float:
    """Share of neighbouring squares between the corners where the one with an even count is the darker.

    Square (1, 1) of the board, the first between four inner corners, is black where square (0, 0) is.
    """
    centres = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    smooth = cv2.blur(picture, (3, 3))
    map_xy = centres.astype(np.float32)
    grey = cv2.remap(
        smooth, map_xy[..., 0], map_xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    grey = grey.reshape(centres.shape[:2]).astype(np.float64)
    down, across = np.indices(grey.shape)
    sign = np.where((down + across) % 2 == 0, 1.0, -1.0)
    steps = [(np.diff(grey, axis=axis) * (sign[:, :-1] if axis else sign[:-1])).ravel() for axis in (0, 1)]
    every = np.concatenate(steps)
    return float((every > 0).mean()) if every.size else 1.0


# -- ChArUco -----------------------------------------------------------------------------------------------


def _charuco_corners(
    picture: Grey, board: Board
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]] | None:
    markers = cv2.aruco.DetectorParameters()
    markers.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    for check in (True, False):
        parameters = cv2.aruco.CharucoParameters()
        parameters.checkMarkers = check
        detector = cv2.aruco.CharucoDetector(board.charuco(), parameters, markers)
        corners, ids, _, marker_ids = detector.detectBoard(picture)
        if ids is not None and len(ids) >= _LEAST_CORNERS:
            order = np.argsort(ids.ravel())
            return ids.ravel()[order].astype(int), corners.reshape(-1, 2)[order].astype(np.float64)
        if marker_ids is None or len(marker_ids) < 4:
            return None
    return None


# -- checks ------------------------------------------------------------------------------------------------


def _is_on_a_line(board: Board, ids: Int[np.ndarray, " n"]) -> bool:
    row, column = np.divmod(ids, board.n_across)
    centred = np.column_stack([row, column]) - [row.mean(), column.mean()]
    return bool(np.linalg.svd(centred, compute_uv=False)[-1] < 0.5)


def _misfit(board: Board, ids: Int[np.ndarray, " n"], pixels: Float[np.ndarray, "n 2"]) -> float:
    """Worst distance from where a homography of the whole board puts a corner, in sides of a square there."""
    flat = board.corners[ids, :2]
    homography, _ = cv2.findHomography(flat, pixels, 0)
    if homography is None:
        return float("inf")
    seen = cv2.perspectiveTransform(flat[:, None], homography).reshape(-1, 2)
    aside = flat + np.array([board.square_m, 0])
    below = flat + np.array([0, board.square_m])
    side = np.minimum(
        *(
            np.linalg.norm(cv2.perspectiveTransform(p[:, None], homography).reshape(-1, 2) - seen, axis=1)
            for p in (aside, below)
        )
    )
    return float((np.linalg.norm(seen - pixels, axis=1) / np.maximum(side, 1e-9)).max())


def _pitch(grid: Float[np.ndarray, "r c 2"]) -> float:
    """Shortest distance of neighbouring corners, px."""
    return min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))


def edge_width(
    picture: Grey, board: Board, ids: Int[np.ndarray, " n"], pixels: Float[np.ndarray, "n 2"]
) -> float:
    """Median width of the edges between neighbouring corners, px: the step's height over its steepest slope.

    About 1 for a sharp picture, 2.5 times the standard deviation of a Gaussian blur. NaN without neighbours.
    """
    where = {int(i): k for k, i in enumerate(ids)}
    pairs = [
        (where[i], where[i + step])
        for i in where
        for step in (1, board.n_across)
        if i + step in where and (step > 1 or (i + 1) % board.n_across)
    ]
    if not pairs:
        return float("nan")
    first, second = (pixels[[pair[k] for pair in pairs]] for k in (0, 1))
    along = second - first
    length = np.linalg.norm(along, axis=1)
    # Beside an edge lies a marker's white margin, or nothing until the next corner.
    inset = 0.3 if board.kind == "checkerboard" else 0.4 * (1 - board.marker_m / board.square_m)
    reach = inset * length
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(length, 1e-9)[:, None]
    offset = np.linspace(-1, 1, _STEPS)[None] * reach[:, None]
    line = ((first + second) / 2)[:, None] + offset[..., None] * normal[:, None]
    sampled = cv2.remap(
        picture,
        line[..., 0].astype(np.float32),
        line[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    height = np.abs(sampled[:, -3:].mean(axis=1) - sampled[:, :3].mean(axis=1))
    slope = np.abs(np.diff(sampled, axis=1)).max(axis=1) / np.maximum(
        np.diff(offset, axis=1).mean(axis=1), 1e-9
    )
    return float(np.median(height / np.maximum(slope, 1e-9)))
