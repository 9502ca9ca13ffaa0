"""Keypoints: the right person in every view, wrong views overruled, both of OpenPose's orders."""

import json
from pathlib import Path

import numpy as np
import pytest

from capture.camera import Camera
from capture.keypoints import read_keypoints, triangulate_keypoints
from capture.layouts import ring_layout
from capture.recording import RecordingError, open_recording
from capture.rig import Rig

BALANCING = Path(__file__).resolve().parents[1] / ".." / "shared" / "recordings" / "balancing"
# A standing person in BODY_25 order, metres, z up, facing +x (left is +y).
BODY = np.array(
    [
        [0.12, 0, 1.62], [0, 0, 1.45],
        [0, -0.19, 1.44], [0.05, -0.24, 1.15], [0.15, -0.25, 0.92],
        [0, 0.19, 1.44], [-0.05, 0.24, 1.15], [0.05, 0.27, 0.9],
        [0, 0, 0.95], [0, -0.1, 0.95], [0.03, -0.11, 0.5], [0, -0.11, 0.09],
        [0, 0.1, 0.95], [0.08, 0.11, 0.5], [0.02, 0.12, 0.09],
        [0.1, -0.03, 1.66], [0.1, 0.03, 1.66], [0.02, -0.07, 1.63], [0.02, 0.07, 1.63],
        [0.2, 0.14, 0.02], [0.18, 0.19, 0.02], [-0.04, 0.12, 0.04],
        [0.18, -0.12, 0.02], [0.16, -0.17, 0.02], [-0.06, -0.11, 0.04],
    ]
)  # fmt: skip
FROM_25 = [0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11, 1, 0, 19, 20, 21, 22, 23, 24]


def lensed_rig(n_cameras: int = 4) -> Rig:
    lens = np.array([-0.1, 0.04, 1e-3, -1e-3])
    return Rig(
        tuple(Camera(c.name, c.size, c.intrinsics, c.camera_from_world, lens) for c in ring_layout(n_cameras))
    )


def detected(camera: Camera, points: np.ndarray, score: float = 0.8) -> np.ndarray:
    return np.column_stack([camera.project(points)[0], np.full(25, score)])


def test_joints_come_back_through_the_lens():
    rig = lensed_rig()
    joints = triangulate_keypoints(rig, [detected(c, BODY)[None] for c in rig], None)
    assert np.abs(joints[:, :3] - BODY).max() < 1e-5
    assert np.allclose(joints[:, 3], 0.8)


@pytest.mark.parametrize("with_silhouettes", [False, True])
def test_the_subject_is_found_among_others(with_silhouettes):
    """A passer-by in two views, listed first and with higher scores; in view 2 nobody but a third person is
    seen."""
    rig = lensed_rig()
    passer_by, third = BODY + np.array([1.2, 0.9, 0]), BODY + np.array([-0.9, -0.8, 0])
    views = [detected(c, BODY)[None] for c in rig]
    for camera_idx in (0, 1):
        views[camera_idx] = np.stack([detected(rig[camera_idx], passer_by, 0.95), views[camera_idx][0]])
    views[2] = detected(rig[2], third)[None]
    silhouettes = None
    if with_silhouettes:
        silhouettes = []
        for camera in rig:
            mask = np.zeros(camera.size[::-1], np.uint8)
            for u, v in camera.pinhole().project(BODY)[0]:
                mask[int(v) - 20 : int(v) + 20, int(u) - 20 : int(u) + 20] = 255
            silhouettes.append(mask)
    joints = triangulate_keypoints(rig, views, silhouettes)
    expected = BODY
    if not with_silhouettes:
        # Without silhouettes three views of the subject still outvote two of the passer-by.
        assert sum(np.abs(joints[:, :3] - BODY).max(axis=1) < 1e-4) == 25
    assert np.abs(joints[:, :3] - expected).max() < 1e-4


def test_one_wrong_view_of_a_joint_is_overruled():
    rig = lensed_rig(6)
    views = [detected(c, BODY)[None] for c in rig]
    views[1][0, 4, :2] += [90, -60]  # a wrist found on the passer-by
    views[3][0, 7] = [0.0, 0.0, 0.9]  # OpenPose's way of saying: not found
    views[4][0, 11, 2] = 0.02
    joints = triangulate_keypoints(rig, views, None)
    assert np.abs(joints[:, :3] - BODY).max() < 1e-4
    assert joints[4, 3] < joints[5, 3], "a view disagreed"


def test_what_is_seen_once_is_not_found():
    rig = lensed_rig()
    views = [detected(c, BODY)[None] for c in rig]
    for camera_idx in (0, 1, 2):
        views[camera_idx][0, 8, 2] = 0.0
    joints = triangulate_keypoints(rig, views, None)
    assert np.isnan(joints[8, :3]).all() and joints[8, 3] == 0
    assert np.isfinite(np.delete(joints, 8, axis=0)).all()
    nothing = triangulate_keypoints(rig, [np.zeros((0, 25, 3)) for _ in rig], None)
    assert np.isnan(nothing[:, :3]).all() and (nothing[:, 3] == 0).all()


def write_frame(path: Path, people: list[np.ndarray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps({"people": [{"pose_keypoints_2d": person.ravel().tolist()} for person in people]})
    )


@pytest.mark.parametrize("name", ["000007.json", "walk_000000000007_keypoints.json"])
def test_files_are_found_and_missing_ones_are_nobody(tmp_path, name):
    rig = lensed_rig(2)
    write_frame(tmp_path / "cam-000" / name, [detected(rig[0], BODY)])
    found = read_keypoints(tmp_path, ("cam-000", "cam-001"), 7)
    assert [people.shape for people in found] == [(1, 25, 3), (0, 25, 3)]
    assert np.allclose(found[0][0], detected(rig[0], BODY))
    assert [len(people) for people in read_keypoints(tmp_path, ("cam-000", "cam-001"), 8)] == [0, 0]


def test_body_25b_is_recognised_and_put_in_order(tmp_path):
    rig = lensed_rig(3)
    upper_neck = (BODY[2] + BODY[5]) / 2 + [0, 0, 0.05]
    body_25b = BODY[FROM_25].copy()
    body_25b[17], body_25b[18] = upper_neck, [0, 0, 1.8]
    for camera in rig:
        write_frame(tmp_path / camera.name / "000000.json", [detected(camera, body_25b)])
    joints = triangulate_keypoints(rig, read_keypoints(tmp_path, rig.names, 0), None)
    # The two points that BODY_25B lacks are made of shoulders and hips.
    made = [1, 8]
    assert np.abs(np.delete(joints[:, :3] - BODY, made, axis=0)).max() < 1e-4
    assert np.linalg.norm(joints[made, :3] - BODY[made], axis=1).max() < 0.02


def test_what_is_no_detection_is_named(tmp_path):
    with pytest.raises(RecordingError, match="no keypoints for any camera; expected a folder a camera"):
        read_keypoints(tmp_path, ("cam-000",), 0)
    path = tmp_path / "cam-000" / "000000.json"
    write_frame(path, [np.zeros((15, 3))])
    with pytest.raises(
        RecordingError, match=r"000000\.json: a person with 45 numbers, BODY_25 has 75 and COCO 54"
    ):
        read_keypoints(tmp_path, ("cam-000",), 0)
    path.write_text('{"people": [')
    with pytest.raises(RecordingError, match=r"000000\.json: cannot be read as JSON"):
        read_keypoints(tmp_path, ("cam-000",), 0)
    path.write_text('{"people": [{"face": []}]}')
    with pytest.raises(RecordingError, match=r"000000\.json: no OpenPose output \(KeyError"):
        read_keypoints(tmp_path, ("cam-000",), 0)
    path.write_text('{"version": 1.3}')
    with pytest.raises(
        RecordingError,
        match=r"neither OpenPose's output \(people\) nor COCO's keypoints \(a list, or annotations\); "
        "found keys version",
    ):
        read_keypoints(tmp_path, ("cam-000",), 0)


@pytest.mark.skipif(not BALANCING.is_dir(), reason="../shared/recordings/balancing is not here")
def test_the_real_recording():
    """The published residual with the calibration as delivered: about 13 px; and a person of human
    proportions."""
    recording = open_recording(BALANCING, frames="0:100:10")
    errors, thighs = [], []
    for frame_id in recording.frame_ids:
        people = read_keypoints(BALANCING / "keypoints", recording.rig.names, frame_id)
        joints = triangulate_keypoints(recording.calibration, people, None)
        found = np.isfinite(joints[:, 0])
        assert found.sum() >= 23
        assert np.linalg.norm(joints[8, :3] - [-1.0, 0.0, 0.95]) < 0.7, "hips near the treadmill's middle"
        assert joints[0, 2] > joints[8, 2] > joints[[11, 14], 2].min()
        thighs += [np.linalg.norm(joints[a, :3] - joints[b, :3]) for a, b in ((9, 10), (12, 13))]
        for camera, detections in zip(recording.calibration, people, strict=True):
            seen = found & (detections[0, :, 2] > 0.1)
            errors.append(
                np.linalg.norm(camera.project(joints[seen, :3])[0] - detections[0, seen, :2], axis=1)
            )
    assert 9 < np.median(np.concatenate(errors)) < 16
    assert 0.33 < np.median(thighs) < 0.5
