"""How well the cameras of a rig agree on boards that did not take part in its calibration.

For each held-out board and each camera that saw it, the other cameras say where the board is and so where
its corners should be in this one. Corners that were found imprecisely scatter about that; a rig that is off
shifts, turns and scales the whole board. So two numbers: the distance of the corners (which the detector's
noise is part of), and that of the board as a whole, from which most of the noise is averaged away; what
noise must be left there, with few cameras to say where the board is, is known from the corners' own scatter
and taken off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from capture.board import Board
from capture.board_adjustment import Adjusted, residuals_px
from capture.board_intrinsics import Intrinsics
from capture.board_start import Pose, board_poses
from capture.board_view import BoardView, Sightings


@dataclass(frozen=True, eq=False)
class Agreement:
    """On held-out boards, by camera (C), px RMS; NaN for a camera that saw none of them with another.

    corners_px: of single corners, noise included; boards_px: of whole boards (their affine motion in the
    picture), the corners' noise taken off; overall_px: that over all cameras. n_boards: (C) held-out boards
    that the camera saw with others.
    """

    corners_px: Float[np.ndarray, " c"]
    boards_px: Float[np.ndarray, " c"]
    overall_px: float
    n_boards: tuple[int, ...]


def held_out_agreement(
    sightings: Sightings, board: Board, held: Sequence[int], adjusted: Adjusted, scatter: float
) -> Agreement:
    """Agreement of the adjusted cameras on these moments. scatter: of corners, px, standard deviation of u
    and of v."""
    n = sightings.n_cameras
    corners: list[list[float]] = [[] for _ in range(n)]
    boards: list[list[float]] = [[] for _ in range(n)]
    for moment in held:
        seen = {
            c: sightings.views[c][moment] for c in adjusted.camera_from_rig if moment in sightings.views[c]
        }
        if len(seen) < 2:
            continue
        whole = locate_board(seen, board, adjusted.intrinsics, adjusted.camera_from_rig)
        if whole is None:
            continue
        parts = _normal_parts(whole, seen, board, adjusted.intrinsics, adjusted.camera_from_rig)
        matrix = np.sum([part.matrix for part in parts.values()], axis=0)
        vector = np.sum([part.vector for part in parts.values()], axis=0)
        for c, view in seen.items():
            # Where the board is without this camera: a Newton step from where it is with all.
            step = np.linalg.lstsq(matrix - parts[c].matrix, vector - parts[c].vector)[0]
            one = adjusted.intrinsics[c]
            assert one is not None
            off = residuals_px(view, board, one, adjusted.camera_from_rig[c] @ _stepped(whole, step))
            corners[c].append(float(np.mean(np.sum(off**2, axis=1))))
            noise = _expected_square(view, parts[c], matrix - parts[c].matrix) * scatter**2
            boards[c].append(float(np.mean(np.sum(_affine_part(view, off) ** 2, axis=1))) - noise)

    def root(values: list[float]) -> float:
        return float(np.sqrt(max(float(np.mean(values)), 0.0))) if values else float("nan")

    return Agreement(
        np.array([root(values) for values in corners]),
        np.array([root(values) for values in boards]),
        root([value for values in boards for value in values]),
        tuple(len(values) for values in boards),
    )


def _affine_space(view: BoardView) -> Float[np.ndarray, "n 3"]:
    """Orthonormal basis (N 3) of what a shift, a turn or a stretch does to one coordinate of the corners."""
    design = np.column_stack([np.ones(len(view)), view.pixels - view.pixels.mean(axis=0)])
    return np.linalg.qr(design)[0]


def _expected_square(view: BoardView, part: _NormalPart, rest: Float[np.ndarray, "6 6"]) -> float:
    """Mean square of the affine part where corners scatter by one pixel: this view's own, and that of the
    board's pose as the rest tells it (their normal matrix, 6 6)."""
    basis = _affine_space(view)
    moved = np.stack([basis.T @ part.jacobian[k::2] for k in (0, 1)])
    pose = np.linalg.pinv(rest)
    return float(6 + np.einsum("aij,jk,aik->", moved, pose, moved)) / len(view)


def _affine_part(view: BoardView, off: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """What of these residuals is a shift, a turn or a stretch of the whole board."""
    basis = _affine_space(view)
    return basis @ (basis.T @ off)


def locate_board(
    seen: Mapping[int, BoardView],
    board: Board,
    intrinsics: Sequence[Intrinsics | None],
    camera_from_rig: Mapping[int, Pose],
) -> Pose | None:
    """rig_from_board (4 4) that fits the views of these cameras best, px; None where none gives a start."""
    options = []
    for c, view in seen.items():
        one = intrinsics[c]
        assert one is not None
        options += [
            np.linalg.inv(camera_from_rig[c]) @ found.pose
            for found in board_poses(view, board, one)
            if not found.turned
        ]
    if not options:
        return None
    costs = [_cost(pose, seen, board, intrinsics, camera_from_rig) for pose in options]
    pose, best = options[int(np.argmin(costs))], float(min(costs))
    for _ in range(10):
        parts = _normal_parts(pose, seen, board, intrinsics, camera_from_rig)
        matrix = np.sum([part.matrix for part in parts.values()], axis=0)
        vector = np.sum([part.vector for part in parts.values()], axis=0)
        stepped = _stepped(pose, np.linalg.lstsq(matrix, vector)[0])
        cost = _cost(stepped, seen, board, intrinsics, camera_from_rig)
        if cost < best:
            pose = stepped
        if not cost < best * (1 - 1e-6):
            break
        best = cost
    return pose


@dataclass(frozen=True, eq=False)
class _NormalPart:
    """One camera's share of the normal equations of a board's pose: matrix (6 6), vector (6); jacobian (2N
    6)."""

    jacobian: Float[np.ndarray, "m 6"]
    matrix: Float[np.ndarray, "6 6"]
    vector: Float[np.ndarray, " 6"]


def _normal_parts(
    pose: Pose,
    seen: Mapping[int, BoardView],
    board: Board,
    intrinsics: Sequence[Intrinsics | None],
    camera_from_rig: Mapping[int, Pose],
) -> dict[int, _NormalPart]:
    tiny = 1e-5 * np.eye(6)
    parts = {}
    for c, view in seen.items():
        one = intrinsics[c]
        assert one is not None
        off = residuals_px(view, board, one, camera_from_rig[c] @ pose).ravel()
        jacobian = np.stack(
            [
                (residuals_px(view, board, one, camera_from_rig[c] @ _stepped(pose, step)).ravel() - off)
                / 1e-5
                for step in tiny
            ],
            axis=1,
        )
        parts[c] = _NormalPart(jacobian, jacobian.T @ jacobian, -jacobian.T @ off)
    return parts


def _stepped(pose: Pose, step: Float[np.ndarray, " 6"]) -> Pose:
    """The pose turned (rad, in the board's axes) and shifted (m) by a small step (6)."""
    out = pose.copy()
    out[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(step[:3])[0]
    out[:3, 3] = pose[:3, 3] + step[3:]
    return out


def _cost(
    pose: Pose,
    seen: Mapping[int, BoardView],
    board: Board,
    intrinsics: Sequence[Intrinsics | None],
    camera_from_rig: Mapping[int, Pose],
) -> float:
    """Sum over the cameras of the RMS distance, px."""
    total = 0.0
    for c, view in seen.items():
        one = intrinsics[c]
        assert one is not None
        off = residuals_px(view, board, one, camera_from_rig[c] @ pose)
        total += float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return total
