"""Boards drawn through lenses: every kind and layout is told and its corners are found to a fraction of a
pixel."""

import cv2
import numpy as np
import pytest

from capture.board import Board
from capture.board_choice import BoardWish, choose_board
from capture.board_detection import find_board
from capture.board_mirror import flipped_back
from capture.errors import RecordingError
from tests.board_scenes import CHARUCO, CHECKERBOARD, LEGACY, film_board, held_board, ring


def pictures_of(board: Board, n: int, seed: int = 3, **spoil: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """(picture, true corners) of boards held towards the camera."""
    rng = np.random.default_rng(seed)
    camera = ring(1)[0]
    out = []
    for _ in range(n):
        pose = held_board(board, rng, camera.centre, spread_m=0.2)
        picture = film_board(camera, board, pose, rng, **spoil)
        points = board.corners @ pose[:3, :3].T + pose[:3, 3]
        out.append((picture, camera.project(points)[0]))
    return out


@pytest.mark.parametrize("board", [CHECKERBOARD, CHARUCO, LEGACY], ids=["checkerboard", "charuco", "legacy"])
def test_corners_are_found_where_they_are(board: Board) -> None:
    off = []
    for picture, corners in pictures_of(board, 4):
        view = find_board(picture, board)
        assert view is not None
        assert len(view) >= 0.8 * board.n_corners
        assert (np.diff(view.ids) > 0).all()
        off.append(np.linalg.norm(view.pixels - corners[view.ids], axis=1))
    distance = np.concatenate(off)
    assert np.median(distance) < 0.12, f"median {np.median(distance):.3f} px"
    assert distance.max() < 1.5, f"worst {distance.max():.2f} px"


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_a_checkerboard_is_counted_from_the_same_square_however_it_is_held(quarter_turns: int) -> None:
    picture, corners = pictures_of(CHECKERBOARD, 1)[0]
    turned = np.ascontiguousarray(np.rot90(picture, quarter_turns))
    height, width = picture.shape
    centre = np.array([width - 1, height - 1]) / 2
    turn = np.linalg.matrix_power(np.array([[0.0, 1], [-1, 0]]), quarter_turns)
    expected = (corners - centre) @ turn.T + np.array(turned.shape[::-1]) / 2 - 0.5
    view = find_board(turned, CHECKERBOARD)
    assert view is not None
    assert np.abs(view.pixels - expected).max() < 1.0


def test_blur_is_measured_as_the_width_of_edges() -> None:
    sharp = find_board(pictures_of(CHECKERBOARD, 1, blur_px=0.0)[0][0], CHECKERBOARD)
    blurred = find_board(pictures_of(CHECKERBOARD, 1, blur_px=2.5)[0][0], CHECKERBOARD)
    assert sharp is not None and blurred is not None
    assert sharp.edge_px < 3.5
    assert blurred.edge_px == pytest.approx(2.5 * 2.5, rel=0.25)


def test_no_board_is_seen_in_noise_nor_from_behind() -> None:
    rng = np.random.default_rng(0)
    camera = ring(1)[0]
    noise = rng.integers(0, 255, (240, 320), dtype=np.uint8)
    away = held_board(CHECKERBOARD, rng, 2 * np.array([0, 0, 1.0]) - camera.centre)
    for picture in (noise, film_board(camera, CHECKERBOARD, away, rng)):
        for board in (CHECKERBOARD, CHARUCO):
            assert find_board(picture, board, thorough=False) is None


@pytest.mark.parametrize("board", [CHECKERBOARD, CHARUCO, LEGACY], ids=["checkerboard", "charuco", "legacy"])
def test_the_board_is_told_from_pictures(board: Board) -> None:
    pictures = [picture for picture, _ in pictures_of(board, 3)]
    found, notes = choose_board(pictures, BoardWish(board.columns, board.rows, board.square_m))
    assert (found.kind, found.columns, found.rows, found.legacy) == (
        board.kind,
        board.columns,
        board.rows,
        board.legacy,
    )
    assert found.dictionary == board.dictionary
    assert abs(found.marker_m - board.marker_m) < 0.06 * board.square_m
    assert notes == ()


def test_columns_and_rows_of_a_charuco_board_may_be_given_the_other_way_round() -> None:
    pictures = [picture for picture, _ in pictures_of(CHARUCO, 2)]
    found, notes = choose_board(pictures, BoardWish(CHARUCO.rows, CHARUCO.columns, CHARUCO.square_m))
    assert (found.columns, found.rows) == (CHARUCO.columns, CHARUCO.rows)
    assert notes == (
        "--squares 6x7: the board has 7 columns and 6 rows as its markers are numbered; taken so.",
    )


def test_inner_corners_given_for_squares_are_told() -> None:
    pictures = [picture for picture, _ in pictures_of(CHECKERBOARD, 2)]
    with pytest.raises(RecordingError, match=r"inner corners were given.*: give --squares 9x6"):
        choose_board(pictures, BoardWish(8, 5, 0.1, "checkerboard"))


def test_a_wrong_dictionary_is_told_with_the_one_that_is_seen() -> None:
    pictures = [picture for picture, _ in pictures_of(CHARUCO, 1)]
    with pytest.raises(RecordingError, match=r"no ChArUco board of 7x6 squares .*markers of 5X5 were seen"):
        choose_board(pictures, BoardWish(7, 6, 0.12, dictionary="6X6_250"))
    with pytest.raises(RecordingError, match="OpenCV has no such marker dictionary"):
        choose_board(pictures, BoardWish(7, 6, 0.12, dictionary="8X8_1"))


def test_a_mirrored_charuco_board_is_no_board() -> None:
    picture, _ = pictures_of(CHARUCO, 1)[0]
    assert find_board(cv2.flip(picture, 1), CHARUCO) is None


@pytest.mark.parametrize("board", [CHECKERBOARD, Board("checkerboard", 8, 5, 0.1)], ids=["9x6", "8x5"])
def test_a_mirrored_checkerboard_is_counted_as_is_undone_by_flipping_back(board: Board) -> None:
    picture, _ = pictures_of(board, 1)[0]
    straight, mirrored = find_board(picture, board), find_board(cv2.flip(picture, 1), board)
    assert straight is not None and mirrored is not None
    back = flipped_back(mirrored, board, picture.shape[1])
    np.testing.assert_array_equal(back.ids, straight.ids)
    assert np.abs(back.pixels - straight.pixels).max() < 0.5


def test_boards_that_look_alike_after_half_a_turn_are_known_and_told() -> None:
    assert Board("checkerboard", 8, 6, 0.1).looks_alike_turned
    assert Board("checkerboard", 7, 5, 0.1).looks_alike_turned
    assert not CHECKERBOARD.looks_alike_turned and not CHARUCO.looks_alike_turned
    board = Board("checkerboard", 8, 6, 0.1)
    pictures = [picture for picture, _ in pictures_of(board, 2)]
    _, notes = choose_board(pictures, BoardWish(8, 6, 0.1, "checkerboard"))
    assert "looks alike after half a turn" in notes[0]


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (("checkerboard", 2, 6, 0.1), "at least 3x3 squares"),
        (("checkerboard", 5, 6, -0.1), "their side must be positive"),
        (("charuco", 5, 6, 0.1, 0.1, "DICT_4X4_50"), "a marker is smaller than its square"),
    ],
)
def test_impossible_boards_are_refused(wrong: tuple, text: str) -> None:
    with pytest.raises(RecordingError, match=text):
        Board(*wrong)
