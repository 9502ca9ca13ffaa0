"""A camera whose pictures are mirrored: its boards contradict the other cameras' until they are flipped back.

A mirrored checkerboard is a checkerboard, and its lens can be calibrated as well as any; a mirrored ChArUco
board is not found at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from capture.board import Board
from capture.board_intrinsics import Intrinsics
from capture.board_start import board_poses, pair_poses
from capture.board_view import BoardView, Sightings

_LEAST_SHARED = 3
_AGREE_SHARE = 0.6


def flipped_back(view: BoardView, board: Board, width: int) -> BoardView:
    """The view as an unmirrored picture would have given it.

    Detection counts a mirrored board from its front and from a black square all the same: what it took for
    the columns' order is the other way round where that keeps the colours, and the rows' order where it does
    not.
    """
    row, column = np.divmod(view.ids, board.n_across)
    if board.columns % 2:
        column = board.n_across - 1 - column
    else:
        row = board.n_down - 1 - row
    ids = row * board.n_across + column
    order = np.argsort(ids)
    pixels = view.pixels * [-1.0, 1.0] + [width - 1.0, 0.0]
    return BoardView(ids[order], pixels[order], view.edge_px)


def flipped_lens(lens: Intrinsics, width: int) -> Intrinsics:
    """The intrinsics that belong to the pictures flipped back."""
    matrix, distortion = lens.matrix.copy(), lens.distortion.copy()
    matrix[0, 2] = width - 1 - matrix[0, 2]
    distortion[3] = -distortion[3]
    return replace(lens, matrix=matrix, distortion=distortion)


def shared_when_flipped(
    sightings: Sightings,
    board: Board,
    intrinsics: Sequence[Intrinsics | None],
    camera_idx: int,
    others: Sequence[int],
) -> tuple[int, int] | None:
    """How many of how many shared boards agree with another camera's once the pictures are flipped back.

    None where too few do for the pictures to be mirrored. others: cameras that agree with each other.
    """
    lens = intrinsics[camera_idx]
    if lens is None or board.kind != "checkerboard":
        return None
    width = sightings.sizes[camera_idx][0]
    mended = flipped_lens(lens, width)
    mine = {
        m: board_poses(flipped_back(view, board, width), board, mended)
        for m, view in sightings.views[camera_idx].items()
    }
    best: tuple[int, int] | None = None
    for other in others:
        known = intrinsics[other]
        if known is None or other == camera_idx:
            continue
        theirs = {
            m: board_poses(view, board, known) for m, view in sightings.views[other].items() if m in mine
        }
        _, pairs = pair_poses([mine, theirs])
        n_agreeing, n_shared = pairs.get((0, 1), (0, 0))
        if (
            n_shared >= _LEAST_SHARED
            and n_agreeing >= _AGREE_SHARE * n_shared
            and n_agreeing > (best or (0, 0))[0]
        ):
            best = (n_agreeing, n_shared)
    return best
