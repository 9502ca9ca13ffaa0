"""Opening a recording in the INRIA layout: what is found, chosen, kept, and told."""

import pickle
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.recording import RecordingError, open_recording
from tests.capture_scenes import PERSON, ball_mask, silhouette_path, small_rig, write_inria

RIG = small_rig()
PEOPLE = Path(__file__).resolve().parents[1] / ".." / "shared" / "recordings" / "people"


def test_silhouettes_come_back_as_they_were_seen(tmp_path):
    recording = open_recording(write_inria(tmp_path, RIG))
    assert recording.name == "" and recording.frame_ids == (0, 1, 2)
    assert recording.rig.names == ("cam-000", "cam-001", "cam-002", "cam-003")
    found = recording.silhouettes(2)
    assert found.frame_id == 2 and found.problems == ()
    for camera, image in zip(RIG, found.images, strict=True):
        assert np.array_equal(image, ball_mask(camera, PERSON + np.array([0.1, 0, 0, 0])))
    assert recording.picture(0, 2) is None
    with pytest.raises(KeyError, match="frame 7 is not among the chosen frames"):
        recording.silhouettes(7)


def test_pictures_are_rgb(tmp_path):
    root = write_inria(tmp_path, RIG)
    folder = root / "Pictures" / "cam-001"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "img_000001.png"), np.full((160, 120, 3), (10, 20, 200), np.uint8))
    recording = open_recording(root)
    picture = recording.picture(1, 1)
    assert picture is not None and picture.shape == (160, 120, 3) and tuple(picture[5, 5]) == (200, 20, 10)
    assert recording.picture(1, 0) is None and recording.picture(0, 1) is None


def test_one_sequence_is_taken_and_several_are_listed(tmp_path):
    root = write_inria(tmp_path, RIG, sequence="walk", n_frames=1)
    assert open_recording(root).name == "walk"
    assert open_recording(root / "walk").name == "walk", "the sequence's own folder, calibration beside it"
    write_inria(tmp_path, RIG, sequence="run", n_frames=2)
    with pytest.raises(RecordingError, match="several sequences, choose one with --sequence: run, walk"):
        open_recording(root)
    assert open_recording(root, sequence="run").frame_ids == (0, 1)
    with pytest.raises(RecordingError, match="no sequence 'jump'; it has: run, walk"):
        open_recording(root, sequence="jump")


def test_frames_are_the_union_over_cameras(tmp_path):
    root = write_inria(tmp_path, RIG, n_frames=4)
    silhouette_path(root, 1, 3).unlink()
    for camera_idx in range(4):
        silhouette_path(root, camera_idx, 2).unlink()
    recording = open_recording(root)
    assert recording.frame_ids == (0, 1, 3)
    assert any("Camera cam-001 lacks 1 of the 3 frames: 3." in note for note in recording.notes)
    assert any("No camera has frame 2." in note for note in recording.notes)


def test_another_calibration_can_be_given(tmp_path):
    root = write_inria(tmp_path, RIG)
    lensed = open_recording(root).calibration
    lensed.save(tmp_path / "mine.json")
    shutil.rmtree(root / "setup")
    with pytest.raises(RecordingError, match="setup: no such calibration; give one with --calibration FILE"):
        open_recording(root)
    recording = open_recording(root, calibration=tmp_path / "mine.json")
    assert recording.calibration == lensed and recording.unit == "m"


def test_a_lens_is_taken_out_of_silhouettes(tmp_path):
    """Filmed through a lens, the silhouettes handed out are those of the pinhole."""
    bent = type(RIG)(
        tuple(
            type(c)(c.name, c.size, c.intrinsics, c.camera_from_world, np.array([-0.2, 0.05, 0, 0]))
            for c in RIG
        )
    )
    root = write_inria(tmp_path, RIG, n_frames=1)
    for camera_idx, camera in enumerate(bent):
        cv2.imwrite(str(silhouette_path(root, camera_idx, 0)), ball_mask(camera, PERSON))
    bent.save(tmp_path / "bent.json")
    recording = open_recording(root, calibration=tmp_path / "bent.json")
    assert all(camera.is_pinhole for camera in recording.rig) and recording.calibration == bent
    for camera, image in zip(RIG, recording.silhouettes(0).images, strict=True):
        straight = ball_mask(camera, PERSON) > 0
        agreement = ((image == 255) & straight).sum() / ((image == 255) | straight).sum()
        assert agreement > 0.95, "a 160 px picture: the outline is within a fraction of a pixel"


def test_black_on_white_throughout_is_repaired_and_told(tmp_path):
    root = write_inria(tmp_path, RIG)
    for frame in range(3):
        path = silhouette_path(root, 2, frame)
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    recording = open_recording(root)
    assert any(
        "Silhouettes are black on white, swapped on reading: cam-002." in note for note in recording.notes
    )
    assert np.array_equal(recording.silhouettes(0).images[2], ball_mask(RIG[2], PERSON))


def test_the_fingerprint_follows_the_inputs(tmp_path):
    root = write_inria(tmp_path, RIG)
    before = open_recording(root).fingerprint()
    assert open_recording(root).fingerprint() == before
    assert open_recording(root, frames="0:2").fingerprint() != before
    path = silhouette_path(root, 0, 2)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    image[0, 0] = 255
    cv2.imwrite(str(path), image)
    changed = open_recording(root).fingerprint()
    assert changed != before
    matrix = np.loadtxt(root / "setup" / "cam01.txt")
    matrix[0, 3] += 1e-9
    np.savetxt(root / "setup" / "cam01.txt", matrix, fmt="%.17g")
    assert open_recording(root).fingerprint() != changed


def test_a_recording_travels_to_another_process(tmp_path):
    recording = open_recording(write_inria(tmp_path, RIG))
    again = pickle.loads(pickle.dumps(recording))
    assert again.rig == recording.rig and again.fingerprint() == recording.fingerprint()
    assert np.array_equal(again.silhouettes(1).images[0], recording.silhouettes(1).images[0])


@pytest.mark.skipif(not PEOPLE.is_dir(), reason="../shared/recordings/people is not here")
@pytest.mark.parametrize("sequence", ["f11_bare", "f11_lunge", "m11_mill", "m12_lunge"])
def test_true_bodies_lie_inside_the_silhouettes(sequence):
    recording = open_recording(PEOPLE, sequence=sequence)
    assert recording.unit == "m" and np.array_equal(recording.up, [0, 0, 1]) and len(recording.rig) == 16
    with np.load(PEOPLE / "truth" / f"{sequence}.npz") as truth:
        vertices = truth["vertices"].astype(float)
    for time_idx in (0, 6):
        found = recording.silhouettes(recording.frame_ids[time_idx])
        assert found.problems == ()
        for camera, image in zip(recording.rig, found.images, strict=True):
            pixels, depth = camera.project(vertices[time_idx])
            column, row = np.rint(pixels).astype(int).T
            near = cv2.dilate(
                image, np.ones((3, 3), np.uint8)
            )  # an outline vertex may round to the next pixel
            assert (depth > 0).all() and (near[row, column] == 255).all(), camera.name
