"""`bodyhull silhouettes`: what it writes can be run, is kept, and nothing made is lost."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyhull.masking import area_jumps
from capture.camera import Camera
from capture.layouts import ring_layout
from capture.recording import open_recording
from capture.rig import Rig
from capture.silhouette_files import undistort_silhouette
from capture.silhouette_folder import folder_numbers
from tests.capture_scenes import write_videos
from tests.command_line import call
from tests.silhouette_scenes import balls, iou, write_scene

RIG = ring_layout(5, (120, 160), camera_height_m=1.5)
N_FRAMES = 4
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    root = tmp_path_factory.mktemp("filmed") / "recording"
    return write_scene(root, RIG, balls(N_FRAMES), "studio", n_frames=N_FRAMES, n_empty=4, seed=2)


@pytest.fixture
def recording(filmed, tmp_path) -> Path:
    shutil.copytree(filmed.root, tmp_path / "recording")
    return tmp_path / "recording"


def silhouettes(capsys: Capture, recording: Path, *words: object, method: str = "plate"):
    out = recording.parent / "out"
    return call(capsys, "silhouettes", recording, "--out", out, "--method", method, "--jobs", 2, *words)


def written(out: Path) -> dict[str, int]:
    """Silhouette -> when it was written, ns."""
    files = sorted((out / "SilhouettesPictures").glob("*/*"))
    return {f"{path.parent.name}/{path.name}": path.stat().st_mtime_ns for path in files}


def state(out: Path) -> dict:
    return json.loads((out / "silhouettes.json").read_text())


def test_what_is_written_can_be_carved(capsys, filmed, recording):
    said = silhouettes(capsys, recording)
    out = recording.parent / "out"
    assert said.code == 0, said.err
    assert f"go on with:  bodyhull run {out} --out RUN" in said.out
    assert len(written(out)) == 5 * N_FRAMES and (out / "silhouettes.jpg").is_file()
    for camera_idx in range(5):
        given, kept = (root / "setup" / f"cam{camera_idx:02d}.txt" for root in (recording, out))
        assert np.array_equal(np.loadtxt(given), np.loadtxt(kept)), (
            "in the calibration's own unit, every digit"
        )
        for frame in range(N_FRAMES):
            path = out / "SilhouettesPictures" / f"cam-{camera_idx:03d}" / f"silh_{frame:06d}.png"
            mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert mask.dtype == np.uint8 and set(np.unique(mask)) <= {0, 128, 255}
            assert iou(mask, filmed.truth[camera_idx, frame]) > 0.85
    carved = call(capsys, "carve", out, "--out", recording.parent / "run", "--voxel-mm", 30)
    assert carved.code == 0, carved.err
    assert len(list((recording.parent / "run" / "hull").glob("*.ply"))) == N_FRAMES


def test_finished_frames_are_kept(capsys, recording):
    out = recording.parent / "out"
    assert silhouettes(capsys, recording).code == 0
    before = written(out)
    said = silhouettes(capsys, recording)
    assert said.code == 0 and written(out) == before and "(0 made now)" in said.out
    # A file that was lost, or cut short by a full disk, is made again, and no other.
    (out / "SilhouettesPictures/cam-001/silh_000002.png").unlink()
    cut = out / "SilhouettesPictures/cam-003/silh_000001.png"
    cut.write_bytes(cut.read_bytes()[:-20])
    assert "(2 made now)" in silhouettes(capsys, recording).out
    after = written(out)
    changed = {name for name in before if before[name] != after.get(name)}
    assert changed == {f"cam-{c:03d}/silh_{f:06d}.png" for c in range(5) for f in (1, 2)}
    # Another method or another input is refused, until it is asked for.
    complaint = silhouettes(capsys, recording, method="mog2").complaint
    assert "made with other settings (method was 'plate', now 'mog2'); pass --overwrite" in complaint
    cv2.imwrite(str(recording / "Pictures/cam-000/img_000001.png"), np.zeros((160, 120, 3), np.uint8))
    assert (
        "made from another input or calibration; pass --overwrite" in silhouettes(capsys, recording).complaint
    )
    assert silhouettes(capsys, recording, "--overwrite", method="mog2").code == 0


def test_other_peoples_silhouettes_and_calibrations_are_not_replaced(capsys, recording):
    out = recording.parent / "out"
    theirs = out / "SilhouettesPictures/cam-000/silh_000000.png"
    theirs.parent.mkdir(parents=True)
    cv2.imwrite(str(theirs), np.zeros((160, 120), np.uint8))
    complaint = silhouettes(capsys, recording).complaint
    assert "holds 1 silhouettes that this command did not make; choose another --out" in complaint
    theirs.unlink()
    shutil.copytree(recording / "setup", out / "setup")
    (out / "setup/cam02.txt").write_text((out / "setup/cam03.txt").read_text())
    assert "setup: holds another calibration" in silhouettes(capsys, recording).complaint


def test_the_recordings_own_folder_may_be_the_place(capsys, recording):
    before = {path.name: path.stat().st_mtime_ns for path in (recording / "setup").iterdir()}
    said = call(capsys, "silhouettes", recording, "--out", recording, "--method", "plate", "--jobs", 1)
    assert said.code == 0, said.err
    assert {path.name: path.stat().st_mtime_ns for path in (recording / "setup").iterdir()} == before
    opened = open_recording(recording)
    assert opened.picture(0, 0) is not None and opened.silhouettes(0).problems == ()


def test_bad_pictures_are_marked_and_stop_nothing(capsys, recording):
    bad = recording / "Pictures/cam-001/img_000001.png"
    bad.write_bytes(bad.read_bytes()[:200])
    cv2.imwrite(str(recording / "Pictures/cam-002/img_000001.png"), np.zeros((80, 60, 3), np.uint8))
    (recording / "Pictures/cam-003/img_000001.png").unlink()
    said = silhouettes(capsys, recording)
    out = recording.parent / "out"
    assert said.code == 0, said.err
    problems = state(out)["frames"]["000001"]["problems"]
    assert [p.split(":")[0] for p in problems] == [f"Camera cam-00{c}, frame 000001" for c in (1, 2, 3)]
    assert "PNG is truncated" in problems[0] and "cam-001/img_000001.png" in problems[0]
    assert "picture is 60x80 px, this camera's others are 120x160 px" in problems[1]
    assert "frame missing in this camera" in problems[2]
    assert all(f"warning: {problem}" in said.err for problem in problems)
    for camera_idx in (1, 2, 3):
        path = out / f"SilhouettesPictures/cam-{camera_idx:03d}/silh_000001.png"
        assert (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) == 128).all(), "unknown all over"
    found = open_recording(out).silhouettes(1)
    assert [image is None for image in found.images] == [False, True, True, True, False]
    # A frame that no camera has anything of is told by the exit code.
    for camera_idx in range(5):
        path = recording / f"Pictures/cam-{camera_idx:03d}/img_000003.png"
        path.write_bytes(b"")
    said = silhouettes(capsys, recording, "--overwrite")
    assert said.code == 3 and "1 of 4 frames have no silhouette at all: 000003" in said.err


def test_a_stop_loses_nothing(capsys, recording, monkeypatch):
    out = recording.parent / "out"
    from capture.silhouette_maker import SilhouetteMaker

    read = SilhouetteMaker.read

    asked = []

    def stopped(self, frame_id):
        asked.append(frame_id)
        if asked.count(3) == 2:  # the first time, who the subject is was found out
            raise KeyboardInterrupt
        return read(self, frame_id)

    monkeypatch.setattr(SilhouetteMaker, "read", stopped)
    said = silhouettes(capsys, recording, "--no-repair")
    assert said.code == 130 and "what is finished is kept" in said.err
    done = sorted(state(out)["frames"])
    before = written(out)
    assert done and {name.split("silh_")[1][:6] for name in before} == set(done)
    monkeypatch.undo()
    said = silhouettes(capsys, recording, "--no-repair")
    assert said.code == 0 and f"({N_FRAMES - len(done)} made now)" in said.out
    assert all(written(out)[name] == before[name] for name in before)


def test_a_full_disk_is_told_in_a_line(capsys, recording, monkeypatch):
    import capture.silhouette_folder as place

    write = place.write_silhouette
    n_written = []

    def full(path, mask):
        if len(n_written) >= 7:
            raise OSError(28, "No space left on device", str(path))
        n_written.append(path)
        write(path, mask)

    monkeypatch.setattr(place, "write_silhouette", full)
    said = call(
        capsys, "silhouettes", recording, "--out", recording.parent / "out", "--method", "plate", "--jobs", 1
    )
    assert "No space left on device" in said.complaint
    assert list(state(recording.parent / "out")["frames"]) == ["000000"]
    monkeypatch.undo()
    assert "(3 made now)" in silhouettes(capsys, recording).out


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--jobs", -1), "--jobs -1: give 0"),
        (("--key", "0,200,50"), "--key is for --method chroma"),
        (("--method", "chroma", "--key", "green"), "--key green: give R,G,B, 0 to 255 each"),
        (("--method", "chroma", "--key", "0,300,0"), "--key 0,300,0: give R,G,B, 0 to 255 each"),
        (("--method", "chroma", "--key", "90,90,90"), "too near to grey"),
        (("--frames", "9:12"), "selects nothing; the recording has 4 frames"),
        (("--sequence", "walk"), "no sequence 'walk' with pictures"),
        (("--background", "/nowhere"), "/nowhere: no such folder of background plates"),
        (("--calibration", "/nowhere.json"), "no such calibration"),
    ],
)
def test_mistakes_are_told_in_a_line(capsys, recording, words, complaint):
    assert complaint in silhouettes(capsys, recording, *words).complaint


def test_a_plate_of_another_size_is_named(capsys, recording):
    shutil.rmtree(recording / "background")
    (recording / "background").mkdir()
    for camera_idx in range(5):
        size = (160, 120, 3) if camera_idx != 2 else (150, 120, 3)
        cv2.imwrite(str(recording / f"background/cam-{camera_idx:03d}.png"), np.full(size, 170, np.uint8))
    complaint = silhouettes(capsys, recording).complaint
    assert "cam-002.png: background plate of 120x150 px, but camera cam-002 films 120x160 px" in complaint
    assert (
        "no pictures here"
        in call(capsys, "silhouettes", recording / "setup", "--out", recording.parent / "o").complaint
    )


def test_videos_are_undistorted_unless_asked_otherwise(capsys, tmp_path):
    lens = np.array([-0.1, 0.03, 5e-4, -5e-4])
    rig = Rig(
        tuple(
            Camera(f"cam{idx + 1:02d}", c.size, c.intrinsics, c.camera_from_world, lens)
            for idx, c in enumerate(ring_layout(4, (120, 160), camera_height_m=1.5))
        )
    )
    root = tmp_path / "recording"
    truth = write_videos(root, rig, n_frames=24)
    frames = ("--frames", "0:24:12")
    assert silhouettes(capsys, root, *frames, "--pictures", method="auto").code == 0
    opened = open_recording(tmp_path / "out")
    assert opened.rig.names == ("cam-001", "cam-002", "cam-003", "cam-004"), "numbers in names are kept"
    said = call(capsys, "silhouettes", root, "--out", tmp_path / "raw", *frames, "--as-filmed")
    assert (
        f"bodyhull run {tmp_path / 'raw'} --out RUN --calibration {tmp_path / 'raw' / 'rig.json'}" in said.out
    )
    lensed = open_recording(tmp_path / "raw", calibration=tmp_path / "raw" / "rig.json")
    for camera_idx, camera in enumerate(rig):
        for frame in (0, 12):
            straight = undistort_silhouette(camera, truth[camera_idx, frame])
            for found in (opened, lensed):
                mask = found.silhouettes(frame).images[camera_idx]
                assert mask is not None and iou(mask, straight) > 0.8
            path = tmp_path / "raw" / f"SilhouettesPictures/cam-{camera_idx + 1:03d}/silh_{frame:06d}.png"
            assert iou(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), truth[camera_idx, frame]) > 0.8
            picture = opened.picture(camera_idx, frame)
            assert picture is not None
    for a, b in zip(opened.rig, rig, strict=True):
        assert np.allclose(a.projection_matrix, b.pinhole().projection_matrix)


def test_a_jump_in_one_camera_alone_is_told():
    def frames(areas):
        return {f"{k:06d}": {"person_px": dict(zip("abc", row, strict=True))} for k, row in enumerate(areas)}

    steady = np.full((9, 3), 1000)
    assert area_jumps(frames(steady.tolist())) == []
    jump = steady.copy()
    jump[4, 1] = 500
    told = area_jumps(frames(jump.tolist()))
    assert len(told) == 1 and told[0].startswith("Camera b, frame 000004: this silhouette alone is 50 %")
    together = steady.copy()
    together[4:] = 600
    assert area_jumps(frames(together.tolist())) == [], "all cameras see the subject crouch"


def test_folders_are_numbered_like_the_cameras():
    assert folder_numbers(["cam01", "cam02"]) == {"cam01": 1, "cam02": 2}
    assert folder_numbers(["left", "right"]) == {"left": 0, "right": 1}
    assert folder_numbers(["a1", "b1"]) == {"a1": 0, "b1": 1}
