"""Wrong silhouettes at the level of the command: marked frames, entries in run.json, a word at the end."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyhull.carving import compare_volumes, often_at_fault
from capture.layouts import dome_layout
from tests.capture_scenes import silhouette_path, write_inria
from tests.command_line import Said, call

Capture = pytest.CaptureFixture[str]
RIG = dome_layout(10, (240, 240))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_inria(tmp_path / "recording", RIG)


def carve(capsys: Capture, recording: Path, *words: object) -> Said:
    return call(capsys, "carve", recording, "--out", recording.parent / "run", "--voxel-mm", 25, *words)


def hull_stage(recording: Path) -> dict:
    return json.loads((recording.parent / "run" / "run.json").read_text())["stages"]["hull"]["frames"]


def change(recording: Path, camera_idx: int, frame_id: int, how: str) -> None:
    path = str(silhouette_path(recording, camera_idx, frame_id))
    image = cv2.imread(path, cv2.IMREAD_UNCHANGED)
    assert image is not None
    if how == "half":
        rows = np.flatnonzero(image.any(axis=1))
        image[int(rows.mean()) :] = 0
    elif how == "moved":
        image = np.roll(image, 14, axis=1)
    elif how == "inverted":
        image = 255 - image
    elif how == "empty":
        image[:] = 0
    else:
        image = cv2.GaussianBlur(image, (0, 0), 1.5)
    cv2.imwrite(path, image)


def test_a_wrong_silhouette_degrades_its_frame_and_is_named(recording: Path, capsys: Capture) -> None:
    assert carve(capsys, recording).code == 0
    clean = hull_stage(recording)
    assert all(entry["status"] == "ok" and entry["faults"] == [] for entry in clean.values())
    change(recording, 4, 1, "half")
    said = carve(capsys, recording, "--overwrite")
    assert said.code == 0
    frames = hull_stage(recording)
    assert [frames[k]["status"] for k in sorted(frames)] == ["ok", "degraded", "ok"]
    (fault,) = frames["000001"]["faults"]
    assert fault["camera"] == "cam-004"
    assert fault["kind"] == "part_missing"
    assert fault["action"] == "region_unknown"
    assert 0.1 < fault["missing"] < 0.7
    assert frames["000001"]["volume_m3"] == pytest.approx(clean["000001"]["volume_m3"], rel=0.03)
    assert any("camera cam-004: a part of the person is missing" in p for p in frames["000001"]["problems"])
    assert "warning: frame 000001: camera cam-004: a part of the person is missing" in said.err
    assert "look at its calibration" not in said.err


def test_a_camera_that_is_wrong_throughout_is_told_at_the_end(recording: Path, capsys: Capture) -> None:
    for frame_id in range(3):
        change(recording, 7, frame_id, "moved")
    said = carve(capsys, recording)
    assert (
        "warning: camera cam-007 contradicts the others in 3 of 3 frames; look at its calibration" in said.err
    )
    again = carve(capsys, recording)
    assert "camera cam-007 contradicts the others in 3 of 3 frames" in again.err, "a resumed run says it too"


def test_without_looking_for_faults_the_part_is_lost(recording: Path, capsys: Capture) -> None:
    carve(capsys, recording, "--frames", "1")
    whole = hull_stage(recording)["000001"]["volume_m3"]
    change(recording, 4, 1, "half")
    carve(capsys, recording, "--frames", "1", "--no-find-faults", "--overwrite")
    frame = hull_stage(recording)["000001"]
    assert frame["status"] == "ok"
    assert frame["volume_m3"] < 0.8 * whole
    carve(capsys, recording, "--frames", "1", "--no-find-faults", "--votes", 2, "--overwrite")
    assert hull_stage(recording)["000001"]["volume_m3"] > 0.97 * whole


def test_soft_silhouettes_from_files(recording: Path, capsys: Capture) -> None:
    carve(capsys, recording, "--frames", "0")
    masks = hull_stage(recording)["000000"]
    for camera_idx in range(len(RIG)):
        change(recording, camera_idx, 0, "blurred")
    assert carve(capsys, recording, "--frames", "0", "--soft", "--overwrite").code == 0
    soft = hull_stage(recording)["000000"]
    assert soft["status"] == "ok", soft["problems"]
    assert soft["volume_m3"] == pytest.approx(masks["volume_m3"], rel=0.06)
    assert min(soft["agreement"]) > 0.9


def test_other_ways_of_carving_are_refused_on_resume(recording: Path, capsys: Capture) -> None:
    carve(capsys, recording, "--frames", "0")
    said = carve(capsys, recording, "--frames", "0", "--votes", 2)
    assert "made with other settings (votes was 1, now 2); run with --overwrite" in said.complaint
    said = carve(capsys, recording, "--frames", "0", "--soft", "--no-find-faults")
    assert "soft was False, now True; find_faults was True, now False" in said.complaint


@pytest.mark.parametrize("words", [("--votes", 0), ("--votes", 2, "--soft")])
def test_impossible_votes(recording: Path, capsys: Capture, words: tuple[object, ...]) -> None:
    said = carve(capsys, recording, *words)
    assert f"--votes {words[1]}" in said.complaint
    assert "soft silhouettes are summed and need none" in said.complaint


def test_how_often_is_often() -> None:
    fault = {"camera": "cam-003"}

    def frames(n_wrong: int, n: int) -> dict:
        return {f"{k:06d}": {"status": "ok", "faults": [fault] if k < n_wrong else []} for k in range(n)}

    assert often_at_fault(frames(1, 1)) == []
    assert often_at_fault(frames(3, 10)) == []
    assert often_at_fault(frames(4, 10)) == [
        "camera cam-003 contradicts the others in 4 of 10 frames; look at its calibration"
    ]
    assert often_at_fault({"000000": {"status": "failed"}}) == []


def test_too_many_wrong_make_the_frame_suspect(recording: Path, capsys: Capture) -> None:
    """The hull is kept, the cameras are named, and the terminal says it; a resumed run says it again."""
    for camera_idx in range(0, 10, 2):
        change(recording, camera_idx, 1, "moved")
    for _ in range(2):
        said = carve(capsys, recording)
        assert said.code == 0, "the hull is there, and may be all that such a rig gives"
        assert "1 of 3 frames have a hull that is not to be trusted (see their problems" in said.err
        assert said.err.rstrip().endswith("in run.json): 000001")
    frame = hull_stage(recording)["000001"]
    assert frame["status"] == "suspect"
    assert any(p.startswith("the silhouettes contradict one another: ") for p in frame["problems"])
    assert (recording.parent / "run" / "hull" / "000001.ply").is_file()


@pytest.mark.parametrize("how", ["inverted", "empty"])
def test_a_frame_without_any_right_silhouette_fails(recording: Path, capsys: Capture, how: str) -> None:
    for camera_idx in range(10):
        change(recording, camera_idx, 2, how)
    said = carve(capsys, recording)
    assert said.code == 3
    assert "1 of 3 frames failed in stage hull: 000002" in said.err
    frame = hull_stage(recording)["000002"]
    assert frame["status"] == "failed"
    wrong = {"inverted": "silhouette looks inverted", "empty": "silhouette is empty"}[how]
    assert wrong in " ".join(frame["problems"])


def test_volumes_are_compared_over_the_frames() -> None:
    def frames(volumes: list[float]) -> dict:
        return {f"{k:06d}": {"status": "ok", "problems": [], "volume_m3": v} for k, v in enumerate(volumes)}

    steady = frames([0.080, 0.082, 0.079, 0.085, 0.081, 0.077])
    assert compare_volumes(steady, 16) == []
    assert compare_volumes(frames([0.08, 0.16]), 16) == [], "too few to know who is odd"
    odd = frames([0.080, 0.081, 0.150, 0.080, 0.079, 0.040])
    told = dict(compare_volumes(odd, 16))
    assert set(told) == {"000002", "000005"}
    assert told["000002"] == (
        "the hull holds 150 L, 188% of the median over the frames: a second person, or somebody's things?"
    )
    assert told["000005"].endswith("50% of the median over the frames: is a part missing?")
    assert [odd[k]["status"] for k in sorted(odd)] == ["ok", "ok", "suspect", "ok", "ok", "suspect"]
    assert dict(compare_volumes(odd, 16)) == told, "said once, however often it is asked"
    assert len(odd["000002"]["problems"]) == 1
    odd["000002"]["volume_m3"] = 0.081
    compare_volumes(odd, 16)
    assert odd["000002"]["status"] == "ok"
    assert odd["000002"]["problems"] == []
    wide = frames([0.080, 0.081, 0.115, 0.080, 0.079])
    assert compare_volumes(wide, 4) == [], "with few cameras volumes are less steady"
