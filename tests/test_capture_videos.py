"""Videos with plates: frames by number, the subject segmented though somebody stands on the plates;
refusals."""

import pickle
import shutil
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import ring_layout
from capture.recording import RecordingError, open_recording
from capture.rig import Rig
from capture.silhouette_files import undistort_silhouette
from capture.video_file import VideoFile
from tests.capture_scenes import PERSON, write_videos

SIZE = (240, 320)
LENS = np.array([-0.08, 0.02, 5e-4, -5e-4])
RIG = Rig(
    tuple(
        Camera(f"cam{idx:02d}", c.size, c.intrinsics, c.camera_from_world, LENS)
        for idx, c in enumerate(ring_layout(4, SIZE, camera_height_m=1.6))
    )
)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    root = tmp_path_factory.mktemp("videos") / "recording"
    return root, write_videos(root, RIG, ghost=PERSON + np.array([0.3, 1.3, 0, 0]))


def test_the_subject_is_segmented_before_a_wrong_plate(filmed):
    root, truth = filmed
    recording = open_recording(root, frames="0:24:3")
    assert recording.unit == "m" and recording.frame_ids == tuple(range(0, 24, 3))
    assert recording.calibration == RIG and all(camera.is_pinhole for camera in recording.rig)
    agreement = []
    for frame_id in recording.frame_ids:
        found = recording.silhouettes(frame_id)
        assert found.problems == ()
        for camera_idx, (camera, image) in enumerate(zip(RIG, found.images, strict=True)):
            assert image is not None and set(np.unique(image)) <= {0, 128, 255}
            true = undistort_silhouette(camera, truth[camera_idx, frame_id]) == 255
            agreement.append(((image == 255) & true).sum() / ((image == 255) | true).sum())
    assert np.median(agreement) > 0.93, f"a 320 px picture, median {np.median(agreement):.3f}"
    assert min(agreement) > 0.85, f"worst {min(agreement):.3f}"
    again = pickle.loads(pickle.dumps(recording))
    assert all(
        np.array_equal(a, b)
        for a, b in zip(again.silhouettes(6).images, recording.silhouettes(6).images, strict=True)
    )


def test_forgotten_masks_are_made_again(filmed, monkeypatch):
    """A long recording remembers so many bytes of masks and no more."""
    root, _ = filmed
    recording = open_recording(root, frames="0:8:2")
    first = recording.silhouettes(0)
    limit = 3 * recording.source._masks_bytes // 2
    monkeypatch.setattr("capture.video_sequence._MOST_MASKS_BYTES", limit)
    for frame_id in (2, 4, 6):
        recording.silhouettes(frame_id)
        assert recording.source._masks_bytes <= limit
    assert list(recording.source._masks) == [6]
    again = recording.silhouettes(0)
    assert all(np.array_equal(a, b) for a, b in zip(first.images, again.images, strict=True))


def test_frames_are_found_by_number_in_any_order(filmed):
    root, truth = filmed
    video = VideoFile(root / "videos" / "cam01.mp4")
    assert video.size == SIZE and video.n_frames == 24
    sequential = [video.read(idx) for idx in range(24)]
    for idx in (20, 3, 4, 4, 23, 0):
        assert np.array_equal(video.read(idx), sequential[idx])
    assert video.read(24) is None and video.read(500) is None
    assert np.array_equal(video.read(5), sequential[5]), "still usable after its end"
    # Two threads at once, one ahead of the other, as when silhouettes are read while pictures are looked up.
    with ThreadPoolExecutor(2) as pool:
        ahead = pool.map(video.read, range(1, 24))
        behind = pool.map(video.read, range(23))
        assert all(np.array_equal(a, b) for a, b in zip(ahead, sequential[1:], strict=True))
        assert all(np.array_equal(a, b) for a, b in zip(behind, sequential[:-1], strict=True))
    # Red and blue are not swapped: skin is red.
    skin = sequential[0][truth[1, 0] > 0].mean(axis=0)
    assert skin[0] > skin[2] + 20


def test_a_shorter_video_marks_its_last_frames(filmed, tmp_path):
    root = tmp_path / "copy"
    shutil.copytree(filmed[0], root)
    video = VideoFile(root / "videos" / "cam02.mp4")
    writer = cv2.VideoWriter(str(tmp_path / "short.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, SIZE)
    for idx in range(20):
        writer.write(video.read(idx)[..., ::-1].copy())
    writer.release()
    shutil.move(tmp_path / "short.mp4", root / "videos" / "cam02.mp4")
    recording = open_recording(root, frames="15:24:8")
    assert any(
        "videos differ in length (cam00 24, cam01 24, cam02 20, cam03 24 frames)" in n
        for n in recording.notes
    )
    found = recording.silhouettes(23)
    assert [image is None for image in found.images] == [False, False, True, False]
    assert found.problems[0].startswith(
        "Camera cam02, frame 000023: frame missing in this camera, the video has 20 frames ("
    )
    assert recording.picture(2, 23) is None and recording.picture(1, 23) is not None
    assert recording.silhouettes(15).problems == ()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda r: (r / "videos/cam01.mp4").write_bytes(b"no video"),
            r"cam01\.mp4: cannot be opened as a video",
        ),
        (
            lambda r: (r / "background/cam03.png").unlink(),
            r"cam03\.png: background plate missing; .* --background DIR",
        ),
        (
            lambda r: (r / "background/cam03.png").write_bytes(b"x"),
            r"cam03\.png: background plate cannot be decoded",
        ),
        (
            lambda r: cv2.imwrite(str(r / "background/cam00.png"), np.zeros((32, 24, 3), np.uint8)),
            r"cam00\.png: background plate of 24x32 px, but cam00\.mp4 is 240x320 px",
        ),
        (lambda r: (r / "rig.json").unlink(), "no calibration here or in calibration/"),
        (
            lambda r: shutil.copy(r / "rig.json", r / "other.json"),
            r"several calibrations \(other\.json, rig\.json\); choose one with --calibration FILE",
        ),
        (
            lambda r: shutil.move(r / "videos/cam01.mp4", r / "videos/extra.mp4"),
            "camera extra has pictures but is not",
        ),
        (lambda r: [p.unlink() for p in (r / "videos").iterdir()], "no video here"),
    ],
)
def test_what_is_missing_is_named(filmed, tmp_path, damage, words):
    root = tmp_path / "copy"
    shutil.copytree(filmed[0], root)
    damage(root)
    with pytest.raises(RecordingError, match=words):
        open_recording(root)


def test_plates_may_lie_elsewhere_and_a_sequence_is_refused(filmed, tmp_path):
    root = tmp_path / "copy"
    shutil.copytree(filmed[0], root)
    shutil.move(root / "background", tmp_path / "plates")
    assert len(open_recording(root, background=tmp_path / "plates").rig) == 4
    with pytest.raises(
        RecordingError, match="a folder of videos holds one sequence; leave out --sequence walk"
    ):
        open_recording(root, background=tmp_path / "plates", sequence="walk")


def test_the_fingerprint_follows_videos_and_plates(filmed, tmp_path):
    root = tmp_path / "copy"
    shutil.copytree(filmed[0], root)
    before = open_recording(root).fingerprint()
    assert open_recording(filmed[0]).fingerprint() == before, "the same files elsewhere"
    plate = root / "background" / "cam00.png"
    cv2.imwrite(str(plate), cv2.imread(str(plate)) // 2)
    assert open_recording(root).fingerprint() != before
