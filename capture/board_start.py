"""Where the cameras stand to each other, from the boards that they saw together: the start of the adjustment.

Every view gives the board's pose in its camera, two of them where the board is nearly flat on (Schweighofer
and Pinz 2006), and the turned ones too where a board looks alike after half a turn. A pair of cameras that
saw the same boards has one relative pose that most of these agree on; the surest pairs are chained to a
tree. Cameras that agree with no other stay outside, and so does a group that shares no board with the rest.

OpenCV's own joint routine (`calibrateMultiview`, since 5.0) is run on the same views, and whichever fits
better starts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array, sparray
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from capture.board import Board
from capture.board_intrinsics import Intrinsics
from capture.board_view import BoardView, Sightings

_SURE_RATIO = 2.0  # of the two poses' reprojection errors: beyond, only the better one is kept
_AGREE_DEG = 3.0
_AGREE_SHARE = 0.05  # of the distance to the board
_LEAST_SHARE = 0.3  # of the shared boards that must agree, for a pair to be believed

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class RigPose:
    """Cameras and boards in the frame of the first camera of `members`.

    members: cameras that are placed, by their index in the sightings; camera_from_rig: (4 4) each, by index;
    rig_from_board: (4 4) a moment; sightings: the views, turned where a board that looks alike had been
    taken the other way round; pairs: (first, second) -> boards that agree, boards shared; method: what made
    it.
    """

    members: tuple[int, ...]
    camera_from_rig: Mapping[int, Pose]
    rig_from_board: Mapping[int, Pose]
    sightings: Sightings
    pairs: Mapping[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    groups: tuple[tuple[int, ...], ...] = ()
    method: str = "pairs"


@dataclass(frozen=True, eq=False)
class _Candidate:
    pose: Pose  # camera_from_board
    turned: bool


def start_rig(
    sightings: Sightings, board: Board, intrinsics: Sequence[Intrinsics | None], *, joint: bool = True
) -> RigPose | None:
    """The largest group of cameras that agree; None where no two cameras do.

    joint: try OpenCV's joint routine as well, where it is there.
    """
    candidates = [
        {} if known is None else {m: board_poses(view, board, known) for m, view in views.items()}
        for views, known in zip(sightings.views, intrinsics, strict=True)
    ]
    relative, pairs = pair_poses(candidates)
    n = sightings.n_cameras
    if not relative:
        return None
    first, second = np.array(list(relative)).T
    cost = np.array([1.0 / pairs[pair][0] for pair in relative])
    tree = minimum_spanning_tree(coo_array((cost, (first, second)), shape=(n, n)))
    _, label = connected_components(tree, directed=False)
    groups = sorted((tuple(np.flatnonzero(label == k).tolist()) for k in np.unique(label)), key=len)[::-1]
    members = groups[0]
    weight = np.zeros(n)
    for pair in relative:
        weight[list(pair)] += pairs[pair][0]
    root = max(members, key=lambda c: weight[c])
    placed = _chained(root, tree, relative)
    chain = _with_boards(placed, candidates, sightings, board)
    if chain is None:
        return None
    best = RigPose(members, chain[0], chain[1], chain[2], pairs, tuple(groups))
    if joint and len(members) > 1:
        other = joint_start(best, board, intrinsics)
        if other is not None and misfit_px(other, board, intrinsics) < misfit_px(best, board, intrinsics):
            return other
    return best


def board_poses(view: BoardView, board: Board, known: Intrinsics) -> list[_Candidate]:
    """camera_from_board as one view gives it: one pose, or two where the view does not tell which."""
    pixels = cv2.undistortPoints(view.pixels[:, None], known.matrix, known.distortion).reshape(-1, 2)
    out: list[_Candidate] = []
    for turned in (False, True) if board.looks_alike_turned else (False,):
        points = board.corners[(view.turned(board).ids[::-1] if turned else view.ids)]
        count, rotations, translations, _ = cv2.solvePnPGeneric(
            points, pixels[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
        found = []
        for k in range(count):
            # IPPE is exact for exact corners only: a few steps towards the least squares.
            rotation, translation = cv2.solvePnPRefineLM(
                points, pixels[:, None], np.eye(3), None, rotations[k], translations[k]
            )
            pose = np.eye(4)
            pose[:3, :3] = cv2.Rodrigues(rotation)[0]
            pose[:3, 3] = translation.ravel()
            if not np.isfinite(pose).all():
                continue
            seen = points @ pose[:3, :3].T + pose[:3, 3]
            error = np.sqrt(np.mean((seen[:, :2] / seen[:, 2:] - pixels) ** 2))
            if (seen[:, 2] > 0).all():
                found.append((float(error), pose))
        found.sort(key=lambda one: one[0])
        out += [_Candidate(pose, turned) for error, pose in found if error <= _SURE_RATIO * found[0][0]]
    return out


def pair_poses(
    candidates: Sequence[Mapping[int, list[_Candidate]]],
) -> tuple[dict[tuple[int, int], Pose], dict[tuple[int, int], tuple[int, int]]]:
    """(first, second) -> second_from_first that most shared boards agree on; and how many do, of how many."""
    relative: dict[tuple[int, int], Pose] = {}
    pairs: dict[tuple[int, int], tuple[int, int]] = {}
    inverses = [
        {m: [np.linalg.inv(one.pose) for one in found] for m, found in views.items()} for views in candidates
    ]
    for one, other in combinations(range(len(candidates)), 2):
        shared = sorted(m for m in candidates[one].keys() & candidates[other].keys())
        poses, distances, moments = [], [], []
        for moment in shared:
            for second in candidates[other][moment]:
                for first, inverse in zip(candidates[one][moment], inverses[one][moment], strict=True):
                    poses.append(second.pose @ inverse)
                    distances.append(np.linalg.norm(first.pose[:3, 3]) + np.linalg.norm(second.pose[:3, 3]))
                    moments.append(moment)
        if not poses:
            continue
        pose, n_agreeing = _agreed(np.array(poses), np.array(distances) / 2, np.array(moments))
        pairs[one, other] = (n_agreeing, len(shared))
        single = len(shared) == 1 and len(poses) == 1
        if single or (n_agreeing >= 2 and n_agreeing >= _LEAST_SHARE * len(shared)):
            relative[one, other] = pose
    return relative, pairs


def _agreed(
    poses: Float[np.ndarray, "n 4 4"], distances: Float[np.ndarray, " n"], moments: np.ndarray
) -> tuple[Pose, int]:
    """The pose that poses of most moments lie near, averaged over those; and of how many moments."""
    turn = np.einsum("nij,mij->nm", poses[:, :3, :3], poses[:, :3, :3])
    angle = np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1)))
    shift = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1)
    near = (angle < _AGREE_DEG) & (shift < _AGREE_SHARE * (distances[:, None] + distances[None]))
    _, moment = np.unique(moments, return_inverse=True)
    by_moment = np.zeros((len(poses), moment.max() + 1), dtype=bool)
    for k in range(len(poses)):
        by_moment[:, moment[k]] |= near[:, k]
    n_agreeing = by_moment.sum(axis=1)
    best = int(np.lexsort(((angle * near).sum(axis=1), -n_agreeing))[0])
    return mean_pose(poses[near[best]]), int(n_agreeing[best])


def mean_pose(poses: Float[np.ndarray, "n 4 4"]) -> Pose:
    """Mean rotation (chordal) and median translation of poses that lie close together."""
    left, _, right = np.linalg.svd(poses[:, :3, :3].sum(axis=0))
    out = np.eye(4)
    out[:3, :3] = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    out[:3, 3] = np.median(poses[:, :3, 3], axis=0)
    return out


def _chained(root: int, tree: sparray, relative: Mapping[tuple[int, int], Pose]) -> dict[int, Pose]:
    order, before = breadth_first_order(tree + tree.T, root, directed=False)
    placed = {root: np.eye(4)}
    for camera_idx in order[1:]:
        c, p = int(camera_idx), int(before[camera_idx])
        step = relative[p, c] if (p, c) in relative else np.linalg.inv(relative[c, p])
        placed[c] = step @ placed[p]
    return placed


def _with_boards(
    placed: Mapping[int, Pose],
    candidates: Sequence[Mapping[int, list[_Candidate]]],
    sightings: Sightings,
    board: Board,
) -> tuple[dict[int, Pose], dict[int, Pose], Sightings] | None:
    """Cameras, rig_from_board of every moment that a placed camera saw, and the views turned as they
    agree."""
    boards: dict[int, Pose] = {}
    views = [dict(v) for v in sightings.views]
    for moment in sightings.moments:
        seen = [c for c in placed if candidates[c].get(moment)]
        if not seen:
            continue
        every = [(c, one, np.linalg.inv(placed[c]) @ one.pose) for c in seen for one in candidates[c][moment]]
        poses = np.array([pose for _, _, pose in every])
        owner = np.array([c for c, _, _ in every])
        apart = _apart(poses)
        # Distance to the nearest candidate of every camera: the pose that suits the middle camera best.
        per_camera = np.stack([apart[:, owner == c].min(axis=1) for c in seen])
        best = int(np.argmin(per_camera.mean(axis=0)))
        boards[moment] = poses[best]
        if board.looks_alike_turned:
            for c in seen:
                mine = np.flatnonzero(owner == c)
                nearest = every[mine[int(np.argmin(apart[best, mine]))]][1]
                if nearest.turned:
                    views[c][moment] = views[c][moment].turned(board)
    if not boards:
        return None
    turned = Sightings(sightings.names, sightings.sizes, tuple(views), sightings.alone, sightings.labels)
    return dict(placed), boards, turned


def _apart(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n n"]:
    """Differences of poses: radians of turn plus metres of shift."""
    turn = np.einsum("nij,mij->nm", poses[:, :3, :3], poses[:, :3, :3])
    angle = np.arccos(np.clip((turn - 1) / 2, -1, 1))
    return angle + np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1)


def joint_start(chain: RigPose, board: Board, intrinsics: Sequence[Intrinsics | None]) -> RigPose | None:
    """The same from OpenCV's `calibrateMultiview`, intrinsics given; None where OpenCV lacks it or it
    fails."""
    if not hasattr(cv2, "calibrateMultiview"):
        return None
    members = list(chain.members)
    views = chain.sightings.of_cameras(members)
    moments = joint_moments(views)
    if len(moments) < 2:
        return None
    objects = [board.corners.astype(np.float32) for _ in moments]
    pixels, mask = [], np.zeros((len(members), len(moments)), np.uint8)
    for c in range(len(members)):
        of_camera = []
        for k, moment in enumerate(moments):
            full = np.full((board.n_corners, 2), -1, np.float32)
            view = views.views[c].get(moment)
            if view is not None:
                full[view.ids] = view.pixels
                mask[c, k] = 255
            of_camera.append(full)
        pixels.append(of_camera)
    known = [intrinsics[c] for c in members]
    try:
        _, _, _, rotations, translations = cv2.calibrateMultiview(  # type: ignore[call-overload]
            objects,
            pixels,
            list(views.sizes),
            mask,
            np.zeros(len(members), np.uint8),
            [one.matrix.copy() for one in known if one is not None],
            [one.distortion.copy() for one in known if one is not None],
            None,
            None,
            np.full(len(members), cv2.CALIB_FIX_K3, np.int32),
            cv2.CALIB_USE_INTRINSIC_GUESS,
        )
    except cv2.error:
        return None
    placed = {}
    for c, rotation, translation in zip(members, rotations, translations, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = rotation if rotation.size == 9 else cv2.Rodrigues(rotation)[0]
        pose[:3, 3] = translation.ravel()
        if not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3]) - 1) > 1e-3:
            return None
        placed[c] = pose
    candidates = [
        {} if one is None else {m: board_poses(view, board, one) for m, view in of_camera.items()}
        for of_camera, one in zip(chain.sightings.views, intrinsics, strict=True)
    ]
    made = _with_boards(placed, candidates, chain.sightings, board)
    if made is None:
        return None
    return RigPose(
        chain.members, made[0], made[1], made[2], chain.pairs, chain.groups, "OpenCV's calibrateMultiview"
    )


def joint_moments(views: Sightings, n_most: int = 40) -> list[int]:
    """Moments for OpenCV's joint routine: those that most cameras share, until every camera has enough of
    them."""
    shared = sorted(views.shared_moments(), key=lambda m: (-len(views.seen_at(m)), m))
    chosen = shared[:n_most]
    for c in range(views.n_cameras):
        lacking = 6 - sum(m in views.views[c] for m in chosen)
        chosen += [m for m in shared if m in views.views[c] and m not in chosen][: max(lacking, 0)]
    return sorted(chosen)


def misfit_px(rig: RigPose, board: Board, intrinsics: Sequence[Intrinsics | None]) -> float:
    """Median over the views of their RMS distance from where the rig puts the corners, px."""
    errors = []
    for c in rig.members:
        known = intrinsics[c]
        assert known is not None
        for moment, view in rig.sightings.views[c].items():
            pose = rig.camera_from_rig[c] @ rig.rig_from_board[moment]
            seen, _ = cv2.projectPoints(
                board.corners[view.ids],
                cv2.Rodrigues(pose[:3, :3])[0],
                pose[:3, 3],
                known.matrix,
                known.distortion,
            )
            errors.append(float(np.sqrt(np.mean(np.sum((seen.reshape(-1, 2) - view.pixels) ** 2, axis=1)))))
    return float(np.median(errors))
