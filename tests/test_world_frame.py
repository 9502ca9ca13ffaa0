"""Floor, up axis and scale come back from cameras, boards and feet; mirrored worlds are told."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.errors import RecordingError
from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from capture.shared_space import extent_along
from capture.world_frame import (
    feet_of_joints,
    ground_from_board,
    ground_from_cameras,
    ground_from_feet,
    scaled_to_height,
    settle_ground,
    up_of_cameras,
)
from tests.board_scenes import CHECKERBOARD
from tests.capture_scenes import PERSON, ball_mask, small_rig, write_inria
from tests.command_line import call

HEIGHT_M = 1.85  # of the balls' person, with the arm raised


def thrown(rig: Rig, seed: int, scale: float = 1.0) -> tuple[Rig, np.ndarray]:
    """The rig in another world frame, and thrown_from_upright (4 4), without the scale."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rng.uniform(-2, 2, 3))[0]
    pose[:3, 3] = rng.uniform(-3, 3, 3)
    back = np.linalg.inv(pose)
    cameras = [replace(camera, camera_from_world=camera.camera_from_world @ back) for camera in rig]
    return Rig(tuple(cameras)).with_world_scaled(scale), pose


def off_deg(rig: Rig, truth: Rig) -> float:
    """Angle between the two worlds' up axes, by the first camera."""
    up, true_up = rig[0].camera_from_world[:3, 2], truth[0].camera_from_world[:3, 2]
    return float(np.degrees(np.arccos(np.clip(up @ true_up, -1, 1))))


@pytest.mark.parametrize("layout", [ring_layout, dome_layout])
def test_up_comes_from_cameras_however_they_look_down(layout: object) -> None:
    truth = layout(8, (160, 200))  # type: ignore[operator]
    rig, pose = thrown(truth, 1)
    np.testing.assert_allclose(up_of_cameras(rig), pose[:3, 2], atol=1e-6)
    ground = ground_from_cameras(rig)
    assert off_deg(ground.rig, truth) < 1e-4
    assert ground.doubts == () and ground.scale == 1.0
    # Moving is rigid, and `world_from_before` is what moved it.
    for before, after in zip(rig, ground.rig, strict=True):
        moved = ground.world_from_before @ np.append(before.centre, 1)
        np.testing.assert_allclose(moved[:3], after.centre, atol=1e-9)


def test_one_rolled_camera_does_not_tilt_the_world() -> None:
    truth = ring_layout(8, (160, 200))
    first = truth[0]
    roll = np.eye(4)
    roll[:2, :2] = [[0, -1], [1, 0]]
    rolled = replace(first, camera_from_world=roll @ first.camera_from_world)
    up = up_of_cameras(Rig((rolled, *truth.cameras[1:])))
    assert np.degrees(np.arccos(up[2])) < 0.5


def test_feet_of_silhouettes_give_the_floor() -> None:
    truth = ring_layout(8, (200, 260), camera_height_m=1.6)
    rig, _ = thrown(truth, 3)
    rng = np.random.default_rng(0)
    masks = []
    for _ in range(8):
        balls = PERSON.copy()
        balls[:, :2] += rng.uniform(-0.5, 0.5, 2)
        masks.append([ball_mask(camera, balls) for camera in truth])
    ground = settle_ground(rig, "feet", masks=masks)
    assert ground.doubts == ()
    assert off_deg(ground.rig, truth) < 1.5
    for found, true in zip(ground.rig, truth, strict=True):
        assert found.centre[2] == pytest.approx(true.centre[2], abs=0.05)


def joints_of_a_walk(n_frames: int, rng: np.random.Generator) -> list[np.ndarray]:
    """BODY_25 of somebody who walks about: one foot stands, the other is up to 25 cm above the floor."""
    out = []
    for frame in range(n_frames):
        joints = np.full((25, 4), np.nan)
        place = 0.8 * np.array([np.cos(0.3 * frame), np.sin(0.2 * frame)])
        for side, toes in ((0, (19, 20, 21)), (1, (22, 23, 24))):
            lifted = 0.25 * abs(np.sin(frame)) if side == frame % 2 else 0.0
            for k in toes:
                joints[k] = [*(place + rng.normal(0, 0.08, 2)), 0.02 + lifted + rng.normal(0, 0.006), 0.9]
        out.append(joints)
    return out


def test_feet_of_keypoints_give_the_floor_and_a_lifted_foot_does_not_raise_it() -> None:
    truth = ring_layout(4, (160, 200))
    rig, pose = thrown(truth, 5)
    joints = joints_of_a_walk(40, np.random.default_rng(1))
    for frame in joints:
        frame[:, :3] = frame[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    ground = settle_ground(rig, "feet", joints=joints)
    assert ground.doubts == ()
    assert off_deg(ground.rig, truth) < 0.7
    for found, true in zip(ground.rig, truth, strict=True):
        assert found.centre[2] == pytest.approx(true.centre[2], abs=0.025)


def test_ankles_stand_in_where_no_foot_was_detected() -> None:
    joints = [np.full((25, 4), np.nan) for _ in range(6)]
    for frame in joints:
        frame[11], frame[14] = [0.1, 0, 0.08, 1], [-0.1, 0, 0.2, 1]
    points, above_m = feet_of_joints(joints, np.array([0.0, 0, 1]))
    assert above_m == 0.08
    np.testing.assert_allclose(points, np.tile([0.1, 0, 0.08], (6, 1)))


def test_a_known_height_gives_the_scale() -> None:
    truth = ring_layout(8, (200, 260), camera_height_m=1.6)
    rig, _ = thrown(truth, 7, scale=3.1)
    masks = [[ball_mask(camera, PERSON) for camera in truth]]
    ground = settle_ground(rig, "cameras", masks=masks, height_m=HEIGHT_M)
    between = [np.linalg.norm(r[0].centre - r[4].centre) for r in (ground.rig, truth)]
    assert between[0] == pytest.approx(between[1], rel=0.02)
    assert ground.scale == pytest.approx(1 / 3.1, rel=0.02)


def test_the_shared_space_is_as_tall_as_the_person() -> None:
    rig = ring_layout(8, (200, 260), camera_height_m=1.6)
    span = extent_along(rig, [ball_mask(camera, PERSON) for camera in rig], np.array([0.0, 0, 1]))
    assert span is not None
    assert span[0] == pytest.approx(0.0, abs=0.04) and span[1] == pytest.approx(HEIGHT_M, abs=0.04)
    assert extent_along(rig, [None] * 8, np.array([0.0, 0, 1])) is None


def test_a_board_on_the_floor_is_the_floor() -> None:
    truth = ring_layout(5, (160, 200))
    rig, pose = thrown(truth, 9)
    board = np.eye(4)
    board[:3, :3] = np.diag([1.0, -1, -1])  # face up: its z points into the floor
    ground = ground_from_board(rig, CHECKERBOARD, pose @ board)
    assert ground.doubts == ()
    for found, true in zip(ground.rig, truth, strict=True):
        np.testing.assert_allclose(found.centre, true.centre, atol=1e-9)


def test_a_mirrored_ground_is_told() -> None:
    truth = ring_layout(5, (160, 200))
    # The board's other pose: its face looks into the floor, every camera lies under it.
    ground = ground_from_board(truth, CHECKERBOARD, np.eye(4))
    assert "Mirrored ground frame: 5 of 5 cameras lie under the floor" in ground.doubts[0]
    # Of two poses that fit, the one that suits upright cameras is taken, with a word.
    face_up = np.diag([1.0, -1, -1, 1])
    ground = ground_from_board(truth, CHECKERBOARD, np.eye(4), mirrored_pose=face_up)
    assert "seen by one camera" in ground.doubts[0] and len(ground.doubts) == 1


def test_a_mirrored_world_is_told_by_the_feet() -> None:
    # Cameras that hang upside down under the feet: what a flipped pair of camera poses makes.
    truth = ring_layout(5, (160, 200))
    feet = np.random.default_rng(0).uniform([-1, -1, 3.0], [1, 1, 3.01], (20, 3))
    ground = ground_from_feet(truth, feet)
    assert "Mirrored world: 5 of 5 cameras lie under the feet" in ground.doubts[0]


@pytest.mark.parametrize(
    ("floor", "height_m", "text"),
    [
        ("ceiling", None, "--floor ceiling: unknown; choose keep, cameras or feet"),
        ("feet", None, "needs keypoints or silhouettes"),
        ("keep", 1.8, "--height-m: needs silhouettes"),
    ],
)
def test_what_cannot_be_told_is_refused(floor: str, height_m: float | None, text: str) -> None:
    with pytest.raises(RecordingError, match=text):
        settle_ground(small_rig(), floor, height_m=height_m)


def test_no_person_is_three_metres_tall() -> None:
    with pytest.raises(RecordingError, match=r"--height-m 3.2: give the person's height in metres"):
        scaled_to_height(small_rig(), 1.0, 3.2)
    with pytest.raises(RecordingError, match="in 2 frames only"):
        ground_from_feet(small_rig(), np.zeros((2, 3)))


def test_the_command_moves_a_rig_to_its_floor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = ring_layout(6, (200, 260), camera_height_m=1.6)
    write_inria(tmp_path / "recording", truth, n_frames=6)
    out = tmp_path / "rig.json"
    words = ["calibrate", "world", tmp_path / "recording", "--out", out]
    said = call(capsys, *words, "--floor", "cameras", "--height-m", 1.85)
    assert said.code == 0, said.out + said.err
    assert "World: Scaled by" in said.out
    found = Rig.load(out)
    assert found.names == tuple(f"cam-{k:03d}" for k in range(6))
    between = [np.linalg.norm(rig[0].centre - rig[3].centre) for rig in (found, truth)]
    assert between[0] == pytest.approx(between[1], rel=0.05)
    still = call(capsys, *words)
    assert "Floor from 6 places of feet." in still.out
    assert Rig.load(out)[0].centre[2] == pytest.approx(1.6, abs=0.06)
