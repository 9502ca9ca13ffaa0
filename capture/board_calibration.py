"""From corners of boards to a calibrated rig, and how far to trust it, camera by camera.

Intrinsics camera by camera, relative poses (`board_start`), one adjustment over all (`board_adjustment`).
Some boards are held out of a first adjustment: how well cameras agree on these, inside the volume where they
were held, is what the report tells, since the boards that were fitted hide errors that move focal length and
position together. The rig itself is then adjusted to all boards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from capture.board import Board
from capture.board_adjustment import Adjusted, adjust, residuals_px
from capture.board_agreement import Agreement, held_out_agreement
from capture.board_intrinsics import Intrinsics, find_intrinsics, spread_choice, spread_views
from capture.board_start import Pose, RigPose, board_poses, start_rig
from capture.board_view import BoardView, Sightings
from capture.camera import Camera
from capture.errors import RecordingError
from capture.rig import Rig

_MOST_CORNERS = 110_000  # in the adjustment: ten seconds of one core
_FEWEST_TO_HOLD_OUT = 8  # shared boards; with fewer, each is needed
_WRONG_VIEW = 6.0  # times the median residual
_WRONG_VIEW_PX = 1.5


@dataclass(frozen=True, eq=False)
class BoardCalibration:
    """What the boards gave.

    rig: the cameras that are placed, metres, world = the first one's axes (see `capture.world_frame` for a
    better one); None where only intrinsics could be had. intrinsics: by camera of `sightings`, None where
    nothing could be told. solution: cameras and boards in the rig's frame. placed: indices of the rig's
    cameras. agreement: on held-out boards, None where all were needed. rms_px: (C) over the views fitted,
    NaN where none. dropped: views that fit nothing, by camera and moment. method: what the start came from.
    """

    board: Board
    sightings: Sightings
    intrinsics: tuple[Intrinsics | None, ...]
    rig: Rig | None
    solution: RigPose | None
    placed: tuple[int, ...]
    agreement: Agreement | None
    rms_px: Float[np.ndarray, " c"]
    dropped: tuple[tuple[int, int], ...]
    method: str


def calibrate(
    sightings: Sightings,
    board: Board,
    *,
    known: Sequence[Intrinsics | None] | None = None,
    wide: bool = False,
    joint: bool = True,
    hold_out: bool = True,
    extrinsics: bool = True,
) -> BoardCalibration:
    """Calibrate all cameras that saw enough of the board.

    known: intrinsics by camera that are kept as they are. wide: lenses with k3 to k6. joint: try OpenCV's
    joint routine for the start. extrinsics: False: intrinsics only. Raises RecordingError where no camera
    saw enough.
    """
    fixed = known is not None
    intrinsics = [
        known[c]
        if known is not None and known[c] is not None
        else find_intrinsics(sightings.of(c), board, sightings.sizes[c], wide=wide)
        for c in range(sightings.n_cameras)
    ]
    if all(one is None for one in intrinsics):
        counts = ", ".join(f"{n} {len(sightings.of(c))}" for c, n in enumerate(sightings.names))
        raise RecordingError(
            f"no camera has three usable views of the board (found: {counts}); film the whole board "
            "nearer, tilted "
            "in turn to every side, and still"
        )
    start = start_rig(sightings, board, intrinsics, joint=joint) if extrinsics else None
    if start is None:
        return BoardCalibration(
            board,
            sightings,
            tuple(intrinsics),
            None,
            None,
            (),
            None,
            np.array([np.nan if one is None else one.rms_px for one in intrinsics]),
            (),
            "",
        )
    start, dropped = _without_wrong_views(_thinned(start, board), board, intrinsics)
    lone = _lone_views(start, board, intrinsics)
    agreement = None
    held = _to_hold_out(start) if hold_out else []
    first: Adjusted | None = None
    if held:
        kept = [m for m in start.rig_from_board if m not in set(held)]
        first = adjust(_at(start, kept), board, intrinsics, lone, fixed_intrinsics=fixed)
        fitted = replace(
            _at(start, kept), camera_from_rig=first.camera_from_rig, rig_from_board=first.rig_from_board
        )
        # Of distances, half the square is in u and half in v.
        scatter = float(np.nanmedian(fit_rms(fitted, board, first.intrinsics))) / np.sqrt(2)
        agreement = held_out_agreement(start.sightings, board, held, first, float(scatter))
        intrinsics = list(first.intrinsics)
        start = _moved(start, first, board)
    adjusted = adjust(start, board, intrinsics, lone, fixed_intrinsics=fixed)
    solution = replace(
        start, camera_from_rig=adjusted.camera_from_rig, rig_from_board=adjusted.rig_from_board
    )
    rms = fit_rms(solution, board, adjusted.intrinsics)
    return BoardCalibration(
        board,
        start.sightings,
        adjusted.intrinsics,
        rig_of(solution, adjusted.intrinsics),
        solution,
        solution.members,
        agreement,
        rms,
        tuple(dropped),
        start.method,
    )


def rig_of(solution: RigPose, intrinsics: Sequence[Intrinsics | None]) -> Rig:
    """The placed cameras, in the sightings' order, metres."""
    cameras = []
    for c in sorted(solution.members):
        one = intrinsics[c]
        assert one is not None
        name, size = solution.sightings.names[c], solution.sightings.sizes[c]
        cameras.append(Camera(name, size, one.matrix, _rotation(solution.camera_from_rig[c]), one.distortion))
    return Rig(tuple(cameras))


def fit_rms(
    solution: RigPose, board: Board, intrinsics: Sequence[Intrinsics | None]
) -> Float[np.ndarray, " c"]:
    """RMS distance (C) px of the corners from where the rig expects them; NaN for cameras outside the rig."""
    out = np.full(solution.sightings.n_cameras, np.nan)
    for c in solution.members:
        one = intrinsics[c]
        assert one is not None
        squares = [
            np.sum(residuals_px(view, board, one, solution.camera_from_rig[c] @ pose) ** 2, axis=1)
            for moment, pose in solution.rig_from_board.items()
            if (view := solution.sightings.views[c].get(moment)) is not None
        ]
        if squares:
            out[c] = float(np.sqrt(np.concatenate(squares).mean()))
    return out


def _rotation(pose: Pose) -> Pose:
    """A pose whose rotation is one to the last bit."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    out = pose.copy()
    out[:3, :3] = left @ right
    return out


def _at(rig: RigPose, moments: Sequence[int]) -> RigPose:
    boards = {m: rig.rig_from_board[m] for m in moments}
    return replace(rig, rig_from_board=boards, sightings=rig.sightings.at(moments))


def _thinned(rig: RigPose, board: Board) -> RigPose:
    """At most as many boards as the adjustment takes in some seconds: those seen by most, spread over the
    volume."""
    moments = list(rig.rig_from_board)
    n_corners = {
        m: sum(len(rig.sightings.views[c][m]) for c in rig.members if m in rig.sightings.views[c])
        for m in moments
    }
    shared = [m for m in moments if sum(m in rig.sightings.views[c] for c in rig.members) > 1]
    lone = [m for m in moments if m not in set(shared)]
    total = sum(n_corners[m] for m in shared)
    if total > _MOST_CORNERS:
        middle = np.append(board.corners.mean(axis=0), 1)
        described = np.array(
            [
                np.append((rig.rig_from_board[m] @ middle)[:3], 0.5 * rig.rig_from_board[m][:3, 2])
                for m in shared
            ]
        )
        n_kept = max(int(len(shared) * _MOST_CORNERS / total), 8)
        first = int(np.argmax([n_corners[m] for m in shared]))
        shared = [shared[k] for k in spread_choice(described, n_kept, first)]
    # Boards that one camera alone saw come in as views for its intrinsics, see `_lone_views`.
    return (
        replace(rig, rig_from_board={m: rig.rig_from_board[m] for m in sorted(shared)})
        if shared
        else _at(rig, lone)
    )


def _lone_views(
    rig: RigPose, board: Board, intrinsics: Sequence[Intrinsics | None]
) -> dict[int, list[tuple[BoardView, Pose]]]:
    """Views that no other camera shares, with camera_from_board: a few a camera, for its intrinsics."""
    out: dict[int, list[tuple[BoardView, Pose]]] = {}
    for c in rig.members:
        one = intrinsics[c]
        assert one is not None
        views = list(rig.sightings.alone[c])
        views += [
            view
            for m, view in rig.sightings.views[c].items()
            if m not in rig.rig_from_board and len(rig.sightings.seen_at(m)) == 1
        ]
        out[c] = []
        for view in spread_views(views, board, rig.sightings.sizes[c]):
            found = board_poses(view, board, one)
            if found:
                residual = residuals_px(view, board, one, found[0].pose)
                if found[0].turned is False and np.sqrt(np.mean(residual**2)) < 3 * max(one.rms_px, 0.3):
                    out[c].append((view, found[0].pose))
    return out


def _to_hold_out(rig: RigPose) -> list[int]:
    """Every fifth of the boards that most cameras saw; none where there are few, or a camera would lose too
    many."""
    shared = [
        m for m in rig.rig_from_board if len([c for c in rig.members if m in rig.sightings.views[c]]) > 1
    ]
    if len(shared) < _FEWEST_TO_HOLD_OUT:
        return []
    chosen = shared[2::5]
    left = set(shared) - set(chosen)
    enough = all(sum(m in left for m in rig.sightings.views[c]) >= 3 for c in rig.members)
    return chosen if enough else []


def _moved(rig: RigPose, adjusted: Adjusted, board: Board) -> RigPose:
    """The start of the last adjustment: cameras as adjusted; boards adjusted where they took part."""
    # The first camera of the members is the origin after an adjustment; it may not have been at the start.
    change = rig.camera_from_rig[rig.members[0]]
    boards = {m: adjusted.rig_from_board.get(m, change @ pose) for m, pose in rig.rig_from_board.items()}
    return replace(rig, camera_from_rig=adjusted.camera_from_rig, rig_from_board=boards)


def _without_wrong_views(
    rig: RigPose, board: Board, intrinsics: Sequence[Intrinsics | None]
) -> tuple[RigPose, list[tuple[int, int]]]:
    """Leave out views that lie far off after a first, quick adjustment: a wrong board, a picture of another
    moment."""
    moments = list(rig.rig_from_board)
    few = moments if len(moments) <= 40 else moments[:: len(moments) // 40 + 1]
    adjusted = adjust(_at(rig, few), board, intrinsics, fixed_intrinsics=True)
    moved = _moved(rig, adjusted, board)
    error: dict[tuple[int, int], float] = {}
    for c in rig.members:
        one = adjusted.intrinsics[c]
        assert one is not None
        for m, view in rig.sightings.views[c].items():
            if m in moved.rig_from_board:
                pose = adjusted.camera_from_rig[c] @ moved.rig_from_board[m]
                error[c, m] = float(
                    np.sqrt(np.mean(np.sum(residuals_px(view, board, one, pose) ** 2, axis=1)))
                )
    usual = float(np.median(list(error.values())))
    checked = {key: e for key, e in error.items() if key[1] in adjusted.rig_from_board}
    wrong = [key for key, e in checked.items() if e > max(_WRONG_VIEW * usual, _WRONG_VIEW_PX)]
    # A camera that is wrong throughout is told as such, not emptied.
    for c in rig.members:
        mine = [key for key in checked if key[0] == c]
        bad = [key for key in wrong if key[0] == c]
        if len(bad) > 0.5 * len(mine):
            wrong = [key for key in wrong if key[0] != c]
    if not wrong:
        return rig, []
    views = [dict(v) for v in rig.sightings.views]
    for c, m in wrong:
        del views[c][m]
    sightings = Sightings(
        rig.sightings.names, rig.sightings.sizes, tuple(views), rig.sightings.alone, rig.sightings.labels
    )
    seen = {m: sum(m in views[c] for c in rig.members) for m in moments}
    boards = {m: pose for m, pose in rig.rig_from_board.items() if seen[m] > 0}
    return replace(rig, sightings=sightings, rig_from_board=boards), wrong
