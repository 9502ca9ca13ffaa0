"""A camera that films another moment than the rest: found from a moving board.

The other cameras say where the board was at each moment, and between two of them by interpolation. If some
delay makes one pose of the late camera explain all its views, it is late by that much; at no delay, it
explains hardly any.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from capture.board import Board
from capture.board_intrinsics import Intrinsics
from capture.board_start import Pose
from capture.board_view import BoardView

_LEAST_VIEWS = 6
_CORNERS_A_VIEW = 6
_MUCH_BETTER = 0.5
_GOOD_RAD = 0.004  # misfit that boards moving between two known moments leave, as an angle
_WIDEST_GAP = 3  # times the usual step between moments


@dataclass(frozen=True)
class Delay:
    """frames: its frame number less this is the others' moment; before_px, after_px: median misfit without
    and with it."""

    frames: float
    before_px: float
    after_px: float


def find_delay(
    views: Mapping[int, BoardView],
    board: Board,
    lens: Intrinsics,
    world_from_board: Mapping[int, Pose],
    *,
    most_frames: int = 40,
) -> Delay | None:
    """The delay, in frames, that explains a camera's views; None where none explains them much better than
    nought."""
    moments = np.array(sorted(world_from_board))
    if len(moments) < 4 or len(views) < _LEAST_VIEWS:
        return None
    path = _BoardPath(moments, [world_from_board[int(m)] for m in moments])
    step = max(1, int(np.median(np.diff(moments))))
    scores = {0.0: _misfit(0.0, views, board, lens, path)}
    for coarse in range(-most_frames, most_frames + 1, max(1, step // 2)):
        scores[float(coarse)] = _misfit(float(coarse), views, board, lens, path)
    best = min(scores, key=lambda s: scores[s])
    for width in (1.0, 0.5, 0.25):
        for shift in (best - width, best + width):
            scores[shift] = _misfit(shift, views, board, lens, path)
        best = min(scores, key=lambda s: scores[s])
    before, after = scores[0.0], scores[best]
    good = _GOOD_RAD * lens.focal_px
    if abs(best) < 0.5 or not after < min(_MUCH_BETTER * before, good):
        return None
    return Delay(best, before, after)


class _BoardPath:
    """Board poses between the moments at which they are known."""

    def __init__(self, moments: np.ndarray, poses: Sequence[Pose]) -> None:
        self._moments = moments.astype(np.float64)
        self._turn = Slerp(self._moments, Rotation.from_matrix(np.array([pose[:3, :3] for pose in poses])))
        self._place = np.array([pose[:3, 3] for pose in poses])
        self._widest = _WIDEST_GAP * float(np.median(np.diff(moments)))

    def at(self, moment: float) -> Pose | None:
        if not self._moments[0] <= moment <= self._moments[-1]:
            return None
        after = int(np.searchsorted(self._moments, moment))
        if self._moments[after] - self._moments[max(after - 1, 0)] > self._widest:
            return None
        pose = np.eye(4)
        pose[:3, :3] = self._turn(moment).as_matrix()
        pose[:3, 3] = [np.interp(moment, self._moments, self._place[:, k]) for k in range(3)]
        return pose


def _misfit(
    shift: float, views: Mapping[int, BoardView], board: Board, lens: Intrinsics, path: _BoardPath
) -> float:
    """Median distance, px, from the corners of the camera placed best for this shift; infinite for too few
    views."""
    points: list[Float[np.ndarray, "_n 3"]] = []
    pixels: list[Float[np.ndarray, "_n 2"]] = []
    for frame, view in views.items():
        pose = path.at(frame - shift)
        if pose is None:
            continue
        chosen = np.unique(np.linspace(0, len(view) - 1, _CORNERS_A_VIEW).round().astype(int))
        points.append(board.corners[view.ids[chosen]] @ pose[:3, :3].T + pose[:3, 3])
        pixels.append(view.pixels[chosen])
    if len(points) < max(_LEAST_VIEWS, len(views) // 3):
        return float("inf")
    seen = np.concatenate(pixels)
    places = np.concatenate(points)
    flat = cv2.undistortPoints(seen[:, None], lens.matrix, lens.distortion).reshape(-1, 2)
    found, turn, place = cv2.solvePnP(places, flat, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        return float("inf")
    turn, place = cv2.solvePnPRefineLM(places, flat, np.eye(3), None, turn, place)
    expected, _ = cv2.projectPoints(places, turn, place, lens.matrix, lens.distortion)
    return float(np.median(np.linalg.norm(expected.reshape(-1, 2) - seen, axis=1)))
