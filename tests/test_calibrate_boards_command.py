"""`bodyhull calibrate boards` from drawn pictures and films, as a user would call it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.board import Board
from capture.errors import RecordingError
from capture.formats.qualisys import read_qualisys
from capture.lens_file import load_lenses
from capture.rig import Rig
from tests.board_scenes import CHARUCO, CHECKERBOARD, LEGACY, film_board, held_board, ring
from tests.command_line import call

LOOKING_DOWN = ring(3, distance_m=1.6, height_m=2.2, aim_m=0.6)
BALANCING = Path(__file__).resolve().parents[1] / ".." / "shared" / "recordings" / "balancing"


def on_the_floor(board: Board, centre: tuple[float, float] = (0.2, 0.1)) -> np.ndarray:
    """world_from_board (4 4) of a board that lies face up, its columns along world x."""
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1, -1])
    pose[:3, 3] = np.array([*centre, 0]) - pose[:3, :3] @ board.corners.mean(axis=0)
    return pose


def film(
    folder: Path,
    rig: Rig,
    board: Board,
    n_boards: int,
    *,
    seed: int = 8,
    floor: bool = False,
    stem: str = "{name}_{k:04d}",
) -> None:
    """Pictures of boards held towards the middle camera (and others in turn), with the last one on the
    floor."""
    rng = np.random.default_rng(seed)
    poses = [
        held_board(board, rng, rig[(1, 0, 1, 2)[k % 4] % len(rig)].centre, spread_m=0.3)
        for k in range(n_boards)
    ]
    poses += [on_the_floor(board)] if floor else []
    for camera in rig:
        (folder / camera.name).mkdir(parents=True)
        for k, pose in enumerate(poses):
            picture = film_board(camera, board, pose, rng)
            cv2.imwrite(str(folder / camera.name / (stem.format(name=camera.name, k=k) + ".png")), picture)


def squares_of(board: Board) -> list[object]:
    return ["--squares", f"{board.columns}x{board.rows}", "--square-mm", 1000 * board.square_m]


def reprojection_px(found: Rig, truth: Rig) -> float:
    """RMS distance, px, of points in the volume through both rigs, after the rigid motion that fits best."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.4, -0.4, 0.6], [0.4, 0.4, 1.4], (100, 3))
    # Where the found rig sees them: triangulated from true pixels, then projected again.
    rays = [camera.rays(true.project(points)[0]) for camera, true in zip(found, truth, strict=True)]
    matrix = np.zeros((len(points), 3, 3))
    vector = np.zeros((len(points), 3))
    for origin, directions in rays:
        across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
        matrix += across
        vector += across @ origin
    placed = np.linalg.solve(matrix, vector[..., None])[..., 0]
    off = [
        camera.project(placed)[0] - true.project(points)[0] for camera, true in zip(found, truth, strict=True)
    ]
    return float(np.sqrt(np.mean(np.sum(np.array(off) ** 2, axis=2))))


@pytest.mark.parametrize("board", [CHECKERBOARD, CHARUCO, LEGACY], ids=["checkerboard", "charuco", "legacy"])
def test_pictures_to_a_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str], board: Board) -> None:
    truth = ring(3)
    film(tmp_path / "in", truth, board, 9)
    out = tmp_path / "rig.json"
    said = call(capsys, "calibrate", "boards", tmp_path / "in", "--out", out, *squares_of(board))
    assert said.code == 0, said.out + said.err
    kind = "checkerboard" if board.kind == "checkerboard" else "ChArUco board"
    assert said.out.startswith(f"board: {kind}, {board.columns}x{board.rows} squares")
    found = Rig.load(out)
    assert found.names == truth.names
    # Nine boards: hardly a tenth of what a lab shows.
    assert reprojection_px(found, truth) < 0.35
    for camera, true in zip(found, truth, strict=True):
        assert camera.intrinsics[0, 0] == pytest.approx(true.intrinsics[0, 0], rel=0.01)
        assert camera.up[2] > 0.5  # z is up, as the cameras are mounted
    between = [np.linalg.norm(rig[0].centre - rig[2].centre) for rig in (found, truth)]
    assert between[0] == pytest.approx(between[1], rel=0.01)
    report = json.loads((tmp_path / "rig.report.json").read_text())
    assert [row["camera"] for row in report["cameras"]] == list(truth.names)
    assert all(row["boards"] >= 6 and row["rms_px"] < 0.6 and row["placed"] for row in report["cameras"])


def test_the_floor_is_where_the_board_lay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = LOOKING_DOWN
    film(tmp_path / "in", truth, CHECKERBOARD, 8, floor=True)
    out = tmp_path / "rig.json"
    said = call(
        capsys,
        "calibrate",
        "boards",
        tmp_path / "in",
        "--out",
        out,
        "--floor",
        "board:8",
        *squares_of(CHECKERBOARD),
    )
    assert said.code == 0, said.out + said.err
    assert "World: Floor from the board lying on it" in said.out and "irrored" not in said.out
    origin = on_the_floor(CHECKERBOARD)[:3, 3]
    for camera, true in zip(Rig.load(out), truth, strict=True):
        np.testing.assert_allclose(camera.centre, true.centre - origin, atol=0.03)


def test_mirrored_pictures_give_a_warning_that_the_ground_is_mirrored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # All pictures flipped top to bottom: reprojection is as good as ever.
    film(tmp_path / "in", LOOKING_DOWN, CHECKERBOARD, 8, floor=True)
    for path in (tmp_path / "in").glob("*/*.png"):
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path)), 0))
    said = call(
        capsys,
        "calibrate",
        "boards",
        tmp_path / "in",
        "--out",
        tmp_path / "rig.json",
        "--floor",
        "board:8",
        *squares_of(CHECKERBOARD),
    )
    assert "it is mirrored, or seen from below" in said.out
    assert said.code == 3


def test_pictures_for_the_lenses_need_no_common_moments(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = ring(2)
    for k, camera in enumerate(truth):
        film(tmp_path / "in", Rig((camera,)), CHECKERBOARD, 9, seed=20 + k)
    out = tmp_path / "lenses.json"
    words = ["calibrate", "boards", tmp_path / "in", "--out", out, *squares_of(CHECKERBOARD)]
    alone = call(capsys, *words, "--intrinsics-only")
    assert alone.code == 0, alone.out + alone.err
    for lens, true in zip(load_lenses(out), truth, strict=True):
        assert lens.matrix[0, 0] == pytest.approx(true.intrinsics[0, 0], rel=0.01)
    # The same without saying so: the names agree, the boards do not.
    out.unlink()
    said = call(capsys, *words)
    assert said.code == 3
    assert "No extrinsics: no two cameras saw the board in one place at one moment" in said.out
    assert [lens.name for lens in load_lenses(out)] == ["cam1", "cam2"]
    with pytest.raises(RecordingError, match="lenses without places"):
        Rig.load(out)


def test_lenses_of_before_are_taken_with_few_boards_of_all_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = ring(3)
    film(tmp_path / "in" / "extrinsics", truth, CHECKERBOARD, 3)
    truth.save(tmp_path / "lenses.json")
    out = tmp_path / "rig.json"
    said = call(
        capsys,
        "calibrate",
        "boards",
        tmp_path / "in",
        "--out",
        out,
        "--lenses",
        tmp_path / "lenses.json",
        *squares_of(CHECKERBOARD),
    )
    assert said.code == 0, said.out + said.err
    assert "Too few shared boards to hold some out" in said.out
    found = Rig.load(out)
    assert reprojection_px(found, truth) < 0.5
    for camera, true in zip(found, truth, strict=True):
        np.testing.assert_allclose(camera.intrinsics, true.intrinsics, atol=1e-9)


def test_films_of_which_one_runs_late(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = ring(3, (480, 360), focal=465.0)
    rng = np.random.default_rng(2)
    phase = rng.uniform(0, 2 * np.pi, 6)
    middle = CHECKERBOARD.corners.mean(axis=0)
    late = 3
    (tmp_path / "in").mkdir()
    for c, camera in enumerate(truth):
        path = tmp_path / "in" / f"{camera.name}.avi"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, camera.size)
        assert writer.isOpened()
        for frame in range(34):
            t = frame - (late if c == 2 else 0)
            s = np.sin(0.05 * np.array([3, 4, 5, 4, 5, 3]) * t + phase)
            pose = held_board(CHECKERBOARD, np.random.default_rng(0), truth[1].centre, spread_m=0, tilt_deg=0)
            pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(0.4 * s[3:])[0]
            pose[:3, 3] = np.array([0, 0, 1.0]) + 0.25 * s[:3] - pose[:3, :3] @ middle
            picture = film_board(camera, CHECKERBOARD, pose, rng)
            writer.write(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
        writer.release()
    out = tmp_path / "rig.json"
    said = call(capsys, "calibrate", "boards", tmp_path / "in", "--out", out, *squares_of(CHECKERBOARD))
    assert "note: not synchronised, frames shifted and calibrated again: cam3 by 3" in said.out, said.out
    assert "BAD cam3: its frames run" in said.out and said.code == 3
    assert json.loads((tmp_path / "rig.report.json").read_text())["frame_shifts"] == {"cam3": 3}
    assert reprojection_px(Rig.load(out), truth) < 0.3


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--squares", "9by6", "--square-mm", 100], "--squares 9by6: give the board's squares as COLSxROWS"),
        (["--squares", "2x6", "--square-mm", 100], "a board has 3 to 60 squares each way"),
        (["--squares", "9x6", "--square-mm", 0], "larger than nought"),
        (["--squares", "9x6", "--square-mm", 100, "--floor", "feet"], "boards have no feet"),
        (["--squares", "9x6", "--square-mm", 100, "--floor", "wall"], "choose board:FRAME"),
        (
            ["--squares", "9x6", "--square-mm", 100],
            "no pictures or videos of a board; expected <camera>/*.jpg",
        ),
    ],
)
def test_mistakes_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[object], text: str
) -> None:
    (tmp_path / "in").mkdir()
    said = call(capsys, "calibrate", "boards", tmp_path / "in", "--out", tmp_path / "rig.json", *words)
    assert text in said.complaint
    assert not (tmp_path / "rig.json").exists()


def test_pictures_of_two_sizes_and_an_unknown_floor_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "in"
    (folder / "cam1").mkdir(parents=True)
    cv2.imwrite(str(folder / "cam1" / "1.png"), np.zeros((60, 80), np.uint8))
    cv2.imwrite(str(folder / "cam1" / "2.png"), np.zeros((80, 60), np.uint8))
    words = [
        "calibrate",
        "boards",
        folder,
        "--out",
        tmp_path / "rig.json",
        "--squares",
        "9x6",
        "--square-mm",
        100,
    ]
    said = call(capsys, *words)
    assert "2.png: a picture of 60x80 px, the other pictures of camera cam1 have 80x60 px" in said.complaint
    (folder / "cam1" / "2.png").unlink()
    said = call(capsys, *words)
    assert "no checkerboard of 9x6 squares (8x5 inner corners) in" in said.complaint


@pytest.mark.skipif(not BALANCING.is_dir(), reason="the real recording is not here")
def test_real_pictures_give_the_focal_length_of_their_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lenses.json"
    pictures = BALANCING / "calibration" / "checkerboard"
    said = call(
        capsys,
        "calibrate",
        "boards",
        pictures,
        "--out",
        out,
        "--squares",
        "5x8",
        "--square-mm",
        60,
        "--intrinsics-only",
    )
    assert said.code == 0, said.out + said.err
    file = read_qualisys(BALANCING / "calibration" / "Calib.qca.txt")
    for lens, camera in zip(load_lenses(out), file, strict=True):
        assert lens.name == camera.name
        focal = (lens.matrix[0, 0] + lens.matrix[1, 1]) / 2
        assert focal == pytest.approx(camera.intrinsics[0, 0], rel=0.01), f"{lens.name}: {focal:.1f} px"
