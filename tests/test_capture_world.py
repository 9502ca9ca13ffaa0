"""Unit, up axis, signs and handedness are read off the silhouettes."""

import numpy as np
import pytest

from capture.recording import RecordingError, open_recording
from capture.world import UP_AXES
from tests.capture_scenes import PERSON, small_rig, write_inria

RIG = small_rig()


def turned_to(axis: str) -> np.ndarray:
    """A rotation (4 4) that takes z to this axis."""
    up = UP_AXES[axis]
    right = np.array([0.0, 1, 0]) if axis.endswith("x") else np.array([1.0, 0, 0])
    change = np.eye(4)
    change[:3, :3] = np.column_stack([right, np.cross(up, right), up])
    assert np.isclose(np.linalg.det(change), 1)
    return change


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
def test_the_unit_is_recognised_and_removed(tmp_path, unit, metres):
    recording = open_recording(write_inria(tmp_path, RIG, unit_m=metres))
    assert (recording.unit, recording.metres_per_unit) == (unit, metres)
    for given, found in zip(RIG, recording.rig, strict=True):
        assert np.allclose(given.centre, found.centre, atol=1e-9)
        pixels, depth = found.project(PERSON[:, :3].copy())
        expected, expected_depth = given.project(PERSON[:, :3].copy())
        assert np.allclose(pixels, expected, atol=1e-8) and np.allclose(depth, expected_depth)
    assert any(f"Unit of the calibration: {unit}" in note for note in recording.settled)
    assert set(recording.settled) <= set(recording.notes)


@pytest.mark.parametrize("axis", list(UP_AXES))
def test_the_up_axis_is_recognised(tmp_path, axis):
    recording = open_recording(write_inria(tmp_path, RIG, world_change=turned_to(axis)))
    assert np.array_equal(recording.up, UP_AXES[axis])


def test_what_the_user_says_goes_before_what_is_seen(tmp_path):
    root = write_inria(tmp_path, RIG)
    recording = open_recording(root, units="mm", up="-y")
    assert recording.unit == "mm" and np.array_equal(recording.up, [0, -1, 0])
    assert any("which is no person" in note for note in recording.notes)
    assert not recording.settled, "a doubt was taken for settled"
    with pytest.raises(RecordingError, match="--units inch: unknown; choose auto, m, cm or mm"):
        open_recording(root, units="inch")
    with pytest.raises(RecordingError, match="--up w: unknown; choose auto or one of x, y, z, -x, -y, -z"):
        open_recording(root, up="w")


def test_the_sign_of_a_matrix_means_nothing(tmp_path):
    root = write_inria(tmp_path, RIG)
    for camera_idx in (0, 2):
        path = root / "setup" / f"cam{camera_idx:02d}.txt"
        np.savetxt(path, -0.3 * np.loadtxt(path), fmt="%.17g")
    recording = open_recording(root)
    for given, found in zip(RIG, recording.rig, strict=True):
        assert np.allclose(given.centre, found.centre, atol=1e-9)
        assert (found.project(PERSON[:, :3].copy())[1] > 0).all()


def test_cameras_that_agree_on_no_up_axis_need_to_be_told(tmp_path):
    tilt = np.eye(4)
    tilt[:3, :3] = turned_to("x")[:3, :3]
    axis = np.ones(3) / np.sqrt(3)  # up along the diagonal of the world: as near to x as to y and z
    right = np.array([1.0, -1, 0]) / np.sqrt(2)
    tilt[:3, :3] = np.column_stack([right, np.cross(axis, right), axis])
    root = write_inria(tmp_path, RIG, world_change=tilt)
    with pytest.raises(RecordingError, match=r"agree on no up axis .* say which one it is with --up"):
        open_recording(root)
    assert np.array_equal(open_recording(root, up="z").up, [0, 0, 1])


def test_inverted_poses_are_noticed(tmp_path):
    root = write_inria(tmp_path, RIG)
    for camera_idx, camera in enumerate(RIG):
        inverse = np.linalg.inv(camera.camera_from_world)
        np.savetxt(root / "setup" / f"cam{camera_idx:02d}.txt", camera.intrinsics @ inverse[:3], fmt="%.17g")
    with pytest.raises(RecordingError, match="camera-to-world given where world-to-camera is due"):
        open_recording(root)
