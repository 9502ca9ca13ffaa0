"""From corners to a rig: truth comes back, and what is wrong with cameras or moments is told by name."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.board import Board
from capture.board_agreement import locate_board
from capture.board_calibration import BoardCalibration, calibrate
from capture.board_findings import find_delays, find_faults
from capture.board_intrinsics import find_intrinsics
from capture.board_mirror import flipped_back
from capture.board_start import joint_start, misfit_px, start_rig
from capture.board_view import BoardView, Sightings
from capture.errors import RecordingError
from capture.rig import Rig
from tests.board_scenes import CHECKERBOARD, corners_of, held_board, ring

TWIN = Board("checkerboard", 8, 6, 0.1)  # looks alike after half a turn


def scene(
    board: Board = CHECKERBOARD,
    *,
    n_cameras: int = 4,
    n_boards: int = 24,
    seed: int = 5,
    noise_px: float = 0.2,
) -> tuple[Rig, list[np.ndarray], Sightings]:
    rng = np.random.default_rng(seed)
    rig = ring(n_cameras)
    poses = [held_board(board, rng, rig[k % n_cameras].centre) for k in range(n_boards)]
    return rig, poses, corners_of(rig, board, poses, rng, noise_px)


def off_px(result: BoardCalibration, truth: Rig, board: Board, seed: int = 99) -> float:
    """RMS distance, px, of the corners of new boards between the true cameras and the calibrated ones, after
    the board's pose is fitted: what held-out boards without any noise say."""
    rng = np.random.default_rng(seed)
    poses = [held_board(board, rng, truth[k % len(truth)].centre) for k in range(8)]
    exact = corners_of(truth, board, poses, rng, 0.0)
    assert result.solution is not None
    squares = []
    for moment in exact.shared_moments():
        seen = {c: exact.views[c][moment] for c in exact.seen_at(moment) if c in result.placed}
        if len(seen) < 2:
            continue
        pose = locate_board(seen, board, result.intrinsics, result.solution.camera_from_rig)
        assert pose is not None
        for c, view in seen.items():
            lens = result.intrinsics[c]
            assert lens is not None
            place = result.solution.camera_from_rig[c] @ pose
            expected, _ = cv2.projectPoints(
                board.corners[view.ids],
                cv2.Rodrigues(place[:3, :3])[0],
                place[:3, 3],
                lens.matrix,
                lens.distortion,
            )
            squares.append(np.sum((expected.reshape(-1, 2) - view.pixels) ** 2, axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def test_a_rig_comes_back_from_noisy_corners() -> None:
    rig, _, sightings = scene()
    result = calibrate(sightings, CHECKERBOARD)
    assert result.rig is not None and result.rig.names == rig.names
    assert off_px(result, rig, CHECKERBOARD) < 0.1
    assert np.nanmax(result.rms_px) == pytest.approx(0.2 * np.sqrt(2), rel=0.15)
    assert result.agreement is not None and result.agreement.overall_px < 0.2
    for camera, true in zip(result.rig, rig, strict=True):
        assert camera.intrinsics[0, 0] == pytest.approx(true.intrinsics[0, 0], rel=0.01)
    # Metres come from the board.
    between = np.linalg.norm(result.rig[0].centre - result.rig[1].centre)
    assert between == pytest.approx(np.linalg.norm(rig[0].centre - rig[1].centre), rel=0.01)
    assert not find_delays(result)
    assert not [fault for fault in find_faults(result, {}) if fault.grave]


def test_exact_corners_give_the_exact_rig() -> None:
    rig, _, sightings = scene(noise_px=0.0, n_boards=16)
    result = calibrate(sightings, CHECKERBOARD, hold_out=False)
    assert off_px(result, rig, CHECKERBOARD) < 2e-3


def test_both_starts_agree_and_the_better_one_is_taken() -> None:
    _, _, sightings = scene(n_boards=12)
    lenses = [find_intrinsics(sightings.of(c), CHECKERBOARD, sightings.sizes[c]) for c in range(4)]
    chain = start_rig(sightings, CHECKERBOARD, lenses, joint=False)
    assert chain is not None and chain.members == (0, 1, 2, 3)
    assert misfit_px(chain, CHECKERBOARD, lenses) < 5
    if not hasattr(cv2, "calibrateMultiview"):
        pytest.skip("this OpenCV has no calibrateMultiview")
    joint = joint_start(chain, CHECKERBOARD, lenses)
    assert joint is not None
    chosen = start_rig(sightings, CHECKERBOARD, lenses)
    assert chosen is not None
    assert misfit_px(chosen, CHECKERBOARD, lenses) == min(
        misfit_px(one, CHECKERBOARD, lenses) for one in (chain, joint)
    )


def test_a_board_that_looks_alike_turned_is_brought_together() -> None:
    rig, _, sightings = scene(TWIN, noise_px=0.2)
    rng = np.random.default_rng(1)
    views = tuple(
        {m: view.turned(TWIN) if rng.random() < 0.5 else view for m, view in of_camera.items()}
        for of_camera in sightings.views
    )
    result = calibrate(replace(sightings, views=views), TWIN)
    assert result.placed == (0, 1, 2, 3)
    assert off_px(result, rig, TWIN) < 0.12


def test_known_lenses_are_kept() -> None:
    _, _, sightings = scene(n_boards=12)
    lenses = [find_intrinsics(sightings.of(c), CHECKERBOARD, sightings.sizes[c]) for c in range(4)]
    result = calibrate(sightings, CHECKERBOARD, known=lenses)
    for before, after in zip(lenses, result.intrinsics, strict=True):
        assert before is not None and after is not None
        np.testing.assert_array_equal(before.matrix, after.matrix)


def test_views_that_are_plainly_wrong_are_left_out_and_told() -> None:
    rig, _, sightings = scene()
    wrong_moment = next(m for m in sightings.views[1] if len(sightings.seen_at(m)) > 2)
    shifted = sightings.views[1][wrong_moment]
    views = {**sightings.views[1], wrong_moment: BoardView(shifted.ids, shifted.pixels + 25.0, 1.0)}
    result = calibrate(sightings.replaced(1, views), CHECKERBOARD)
    assert (1, wrong_moment) in result.dropped
    assert off_px(result, rig, CHECKERBOARD) < 0.12


def test_a_camera_without_shared_boards_and_a_separate_group_are_named() -> None:
    _, _, sightings = scene(n_cameras=5, n_boards=30)
    moments = sightings.moments
    first, second = set(moments[: len(moments) // 2]), set(moments[len(moments) // 2 :])
    # Cameras 1 to 3 film the first half, 4 and 5 the second: two groups.
    views = tuple(
        {m: v for m, v in of_camera.items() if m in (first if c < 3 else second)}
        for c, of_camera in enumerate(sightings.views)
    )
    result = calibrate(replace(sightings, views=views), CHECKERBOARD)
    assert result.placed == (0, 1, 2)
    faults = {fault.kind: fault for fault in find_faults(result, {}) if fault.grave}
    assert (
        "cam4, cam5 agree with each other but share no board with cam1" in faults["separate group"].sentence
    )


def test_a_camera_that_saw_too_little_is_named() -> None:
    _, _, sightings = scene()
    few = dict(list(sightings.views[2].items())[:2])
    result = calibrate(sightings.replaced(2, few), CHECKERBOARD)
    faults = [fault for fault in find_faults(result, {}) if fault.camera == "cam3"]
    assert faults[0].kind == "too few views" and faults[0].grave
    assert "cam3: the board was found 2 times" in faults[0].sentence
    assert result.rig is not None and "cam3" not in result.rig.names


@pytest.mark.parametrize(("columns", "rows"), [(9, 6), (8, 7)])
def test_a_camera_with_mirrored_pictures_is_named(columns: int, rows: int) -> None:
    board = Board("checkerboard", columns, rows, 0.1)
    _, _, sightings = scene(board)
    width = sightings.sizes[1][0]
    # Flipping back undoes flipping: what a detector makes of mirrored pictures.
    mirrored = {m: flipped_back(view, board, width) for m, view in sightings.views[1].items()}
    for m, view in mirrored.items():
        again = flipped_back(view, board, width)
        np.testing.assert_array_equal(again.ids, sightings.views[1][m].ids)
        np.testing.assert_allclose(again.pixels, sightings.views[1][m].pixels)
    result = calibrate(sightings.replaced(1, mirrored), board)
    assert result.placed == (0, 2, 3)
    told = [fault for fault in find_faults(result, find_delays(result)) if fault.camera == "cam2"]
    assert [fault.kind for fault in told if fault.grave] == ["mirrored"]
    assert "cam2: its pictures are mirrored" in told[0].sentence


def walked_board(board: Board, rig: Rig, n_frames: int, seed: int) -> list[np.ndarray]:
    """A board that is carried about: smooth poses, one a frame."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi, 6)
    poses = []
    for t in range(n_frames):
        s = np.sin(0.06 * np.arange(1, 7) * t * 0.5 + phase)
        pose = held_board(
            board,
            np.random.default_rng(0),
            rig[1].centre + np.array([0, 1.2 * s[3], 0.5 * s[4]]),
            spread_m=0,
            tilt_deg=0,
        )
        turn = cv2.Rodrigues(0.35 * s[3:])[0]
        pose[:3, :3] = pose[:3, :3] @ turn
        middle = np.array([board.columns, board.rows, 0]) * board.square_m / 2
        pose[:3, 3] = np.array([0, 0, 1.0]) + 0.3 * s[:3] - pose[:3, :3] @ middle
        poses.append(pose)
    return poses


@pytest.mark.parametrize("late", [7, -4])
def test_an_unsynchronised_camera_is_named_with_its_delay(late: int) -> None:
    rig = ring(4)
    poses = walked_board(CHECKERBOARD, rig, 240, 2)
    rng = np.random.default_rng(4)
    every = corners_of(rig, CHECKERBOARD, poses, rng, 0.2)
    step = range(10, 230, 3)
    views = [{m: v for m, v in of_camera.items() if m in step} for of_camera in every.views]
    # The frame that this camera calls m is the others' m - late.
    views[2] = {m: every.views[2][m - late] for m in step if m - late in every.views[2]}
    result = calibrate(replace(every, views=tuple(views)), CHECKERBOARD)
    delays = find_delays(result)
    assert set(delays) == {"cam3"}
    assert delays["cam3"].frames == pytest.approx(late, abs=0.5)
    told = [fault for fault in find_faults(result, delays) if fault.kind == "not synchronised"]
    assert told[0].camera == "cam3" and told[0].grave
    assert (
        f"cam3: its frames run {delays['cam3'].frames.__abs__():g} {'late' if late > 0 else 'early'}"
        in told[0].sentence
    )


def test_no_camera_with_three_views_is_an_error() -> None:
    _, _, sightings = scene(n_boards=2)
    with pytest.raises(RecordingError, match=r"no camera has three usable views of the board \(found: cam1 "):
        calibrate(sightings, CHECKERBOARD)


def test_views_that_do_not_tell_the_principal_point_leave_it_in_the_middle() -> None:
    rig = ring(1)
    rng = np.random.default_rng(0)
    # Flat on, always at the same distance: nothing tells focal length from distance.
    poses = [held_board(CHECKERBOARD, rng, rig[0].centre, spread_m=0.02, tilt_deg=1) for _ in range(10)]
    sightings = corners_of(rig, CHECKERBOARD, poses, rng, 0.3)
    lens = find_intrinsics(sightings.of(0), CHECKERBOARD, sightings.sizes[0])
    assert lens is not None
    assert lens.notes == (
        "views too alike to tell the principal point: assumed in the middle of the picture",
    )
    np.testing.assert_allclose(lens.matrix[:2, 2], (np.array(sightings.sizes[0]) - 1) / 2, atol=1)
