"""Bad input: a clear error, or a frame that is marked and kept. Every text is asserted."""

import re
import struct

import cv2
import numpy as np
import pytest

from capture.recording import RecordingError, open_recording
from tests.capture_scenes import PERSON, ball_mask, silhouette_path, small_rig, write_inria

RIG = small_rig()


def marked(root, camera_idx, frame, words):
    """The recording opens; this camera's silhouette is None in this frame, one sentence says why; the rest
    is whole."""
    recording = open_recording(root)
    found = recording.silhouettes(frame)
    assert found.images[camera_idx] is None
    assert sum(image is not None for image in found.images) == 3
    assert len(found.problems) == 1
    sentence = found.problems[0]
    assert sentence.startswith(f"Camera cam-{camera_idx:03d}, frame {frame:06d}: ")
    assert f"cam-{camera_idx:03d}" in sentence.split("(")[-1], "the file is named"
    assert re.search(words, sentence), sentence
    others = [other for other in recording.frame_ids if other != frame]
    assert all(recording.silhouettes(other).problems == () for other in others)


def test_missing_camera_file(tmp_path):
    root = write_inria(tmp_path, RIG)
    (root / "setup" / "cam02.txt").unlink()
    with pytest.raises(
        RecordingError, match=r"cam02\.txt: missing, but camera cam-002 has pictures; restore the file"
    ):
        open_recording(root)


def test_camera_without_pictures_is_left_out(tmp_path):
    root = write_inria(tmp_path, RIG)
    np.savetxt(root / "setup" / "cam09.txt", RIG[0].projection_matrix)
    recording = open_recording(root)
    assert len(recording.rig) == 4
    assert any("calibrated but without pictures, left out: cam09.txt" in note for note in recording.notes)


def test_silhouette_of_another_size(tmp_path):
    root = write_inria(tmp_path, RIG)
    path = silhouette_path(root, 1, 2)
    cv2.imwrite(str(path), cv2.resize(ball_mask(RIG[1], PERSON), (60, 80), interpolation=cv2.INTER_NEAREST))
    marked(root, 1, 2, "silhouette is 60x80 px, this camera's others are 120x160 px")


def test_empty_silhouette(tmp_path):
    root = write_inria(tmp_path, RIG)
    cv2.imwrite(str(silhouette_path(root, 3, 0)), np.zeros((160, 120), np.uint8))
    marked(root, 3, 0, "silhouette is empty")


def test_full_silhouette(tmp_path):
    root = write_inria(tmp_path, RIG)
    cv2.imwrite(str(silhouette_path(root, 3, 1)), np.full((160, 120), 255, np.uint8))
    marked(root, 3, 1, "silhouette covers the whole picture")


def test_one_inverted_silhouette(tmp_path):
    root = write_inria(tmp_path, RIG)
    cv2.imwrite(str(silhouette_path(root, 0, 1)), 255 - ball_mask(RIG[0], PERSON))
    marked(root, 0, 1, "silhouette looks inverted")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.97])
def test_truncated_png(tmp_path, share):
    root = write_inria(tmp_path, RIG)
    path = silhouette_path(root, 2, 1)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    marked(root, 2, 1, "PNG is truncated|wrong signature")


def test_zero_byte_png(tmp_path):
    root = write_inria(tmp_path, RIG)
    silhouette_path(root, 2, 1).write_bytes(b"")
    marked(root, 2, 1, "file is empty")


def test_damaged_png(tmp_path):
    root = write_inria(tmp_path, RIG)
    path = silhouette_path(root, 2, 1)
    content = bytearray(path.read_bytes())
    position = (
        content.index(b"IDAT") + 4 + struct.unpack(">I", content[content.index(b"IDAT") - 4 :][:4])[0] // 2
    )
    content[position] ^= 0xFF
    path.write_bytes(bytes(content))
    marked(root, 2, 1, "PNG is damaged")


def test_frame_missing_in_one_camera(tmp_path):
    root = write_inria(tmp_path, RIG)
    silhouette_path(root, 1, 1).unlink()
    marked(root, 1, 1, "frame missing in this camera")


def test_non_binary_silhouette_is_used_and_told(tmp_path):
    root = write_inria(tmp_path, RIG)
    path = silhouette_path(root, 1, 1)
    cv2.imwrite(str(path), cv2.GaussianBlur(ball_mask(RIG[1], PERSON), (0, 0), 2.5))
    found = open_recording(root).silhouettes(1)
    assert found.images[1] is not None and set(np.unique(found.images[1])) == {0, 255}
    assert re.match(
        r"Camera cam-001, frame 000001: not binary \(.* in between\), cut at half", found.problems[0]
    )


def test_3x3_where_3x4_is_due(tmp_path):
    root = write_inria(tmp_path, RIG)
    np.savetxt(root / "setup" / "cam01.txt", RIG[1].intrinsics)
    with pytest.raises(
        RecordingError, match=r"cam01\.txt: a 3x3 matrix found where a 3x4 projection matrix is due"
    ):
        open_recording(root)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 3 4 5", "5 numbers found, a 3x4 projection matrix has 12"),
        ("1 2 3 x", "'x' is no number"),
        ("nan " * 12, "nan in row 1, column 1; every value of the projection matrix must be a finite number"),
        ("1 0 0 0  1 0 0 0  0 0 1 5", "no projection matrix .the left 3x3 block is singular"),
        ("1 0 0 0  0 1 0 0  0 0 0 1", "no projection matrix .the third row begins with three zeros"),
        ("", "0 numbers found"),
    ],
)
def test_what_is_no_projection_matrix(tmp_path, text, words):
    root = write_inria(tmp_path, RIG)
    (root / "setup" / "cam00.txt").write_text(text)
    with pytest.raises(RecordingError, match=r"cam00\.txt: .*" + words):
        open_recording(root)


def test_nan_in_one_value_is_located(tmp_path):
    root = write_inria(tmp_path, RIG)
    matrix = RIG[3].projection_matrix.copy()
    matrix[1, 2] = np.nan
    np.savetxt(root / "setup" / "cam03.txt", matrix)
    with pytest.raises(RecordingError, match=r"cam03\.txt: nan in row 2, column 3"):
        open_recording(root)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_mirrored_world(tmp_path, axis):
    mirror = np.eye(4)
    mirror[axis, axis] = -1
    root = write_inria(tmp_path, RIG, world_change=mirror)
    with pytest.raises(
        RecordingError, match=r"mirrored calibration: .*cam-000, cam-001, cam-002, cam-003 .*Negate one"
    ):
        open_recording(root)


def test_rows_counted_from_the_bottom_where_silhouettes_cannot_tell(tmp_path):
    root = write_inria(tmp_path, RIG)
    for camera_idx in (2, 3):
        for frame in range(3):
            path = silhouette_path(root, camera_idx, frame)
            cv2.imwrite(str(path), np.zeros((160, 120), np.uint8))
    flip = np.array([[1.0, 0, 0], [0, -1, 159], [0, 0, 1]])
    for camera_idx, camera in enumerate(RIG):
        np.savetxt(root / "setup" / f"cam{camera_idx:02d}.txt", flip @ camera.projection_matrix, fmt="%.17g")
    with pytest.raises(RecordingError, match=r"mirrored calibration: .*\(height - 1\) x row 3 - row 2"):
        open_recording(root)


def test_one_mirrored_camera_is_named(tmp_path):
    root = write_inria(tmp_path, RIG)
    np.savetxt(root / "setup" / "cam02.txt", RIG[2].projection_matrix @ np.diag([-1.0, 1, 1, 1]), fmt="%.17g")
    with pytest.raises(
        RecordingError, match=r"1 of 4 cameras have the subject behind them .cam-002.: .*mirrored"
    ):
        open_recording(root)


def test_no_recording_at_all(tmp_path):
    with pytest.raises(RecordingError, match="nowhere: no such folder"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match="no recording here"):
        open_recording(tmp_path)


def test_no_silhouette_of_a_camera_opens(tmp_path):
    root = write_inria(tmp_path, RIG)
    for frame in range(3):
        silhouette_path(root, 1, frame).write_bytes(b"no picture")
    with pytest.raises(RecordingError, match="cam-001: none of the first silhouettes can be opened"):
        open_recording(root)
