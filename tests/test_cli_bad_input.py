"""What a user can get wrong, at the level of the command: a line that says what to do, or a marked frame."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.capture_scenes import silhouette_path, small_rig, write_inria
from tests.command_line import Said, call
from tests.tiny_run import TinyRun

Capture = pytest.CaptureFixture[str]
RIG = small_rig()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_inria(tmp_path / "recording", RIG)


def carve(capsys: Capture, recording: Path, *words: object) -> Said:
    return call(capsys, "carve", recording, "--out", recording.parent / "run", "--voxel-mm", 30, *words)


def frame(recording: Path, frame_id: int) -> dict:
    state = json.loads((recording.parent / "run" / "run.json").read_text())
    return state["stages"]["hull"]["frames"][f"{frame_id:06d}"]


def carved(recording: Path) -> list[str]:
    """The meshes in the run; what their vertices know lies beside each."""
    folder = recording.parent / "run" / "hull"
    meshes = sorted(path.name for path in folder.glob("*.ply"))
    assert sorted(path.stem for path in folder.glob("*.npz")) == [name[:-4] for name in meshes]
    return meshes


def blank(recording: Path, camera_idx: int, frame_id: int) -> None:
    cv2.imwrite(str(silhouette_path(recording, camera_idx, frame_id)), np.zeros((160, 120), np.uint8))


def marks_one_camera(capsys: Capture, recording: Path, camera_idx: int, frame_id: int, words: str) -> None:
    """The frame is carved from the other cameras, marked with a sentence that is shown and kept."""
    said = carve(capsys, recording)
    assert said.code == 0, said.err
    entry = frame(recording, frame_id)
    sentence = entry["problems"][0]
    assert entry["status"] == "degraded"
    assert sentence.startswith(f"Camera cam-{camera_idx:03d}, frame {frame_id:06d}: ")
    assert re.search(words, sentence), sentence
    assert f"warning: {sentence}" in said.err
    assert entry["agreement"][camera_idx] is None
    assert carved(recording) == ["000000.ply", "000001.ply", "000002.ply"]
    assert all(frame(recording, other)["status"] == "ok" for other in range(3) if other != frame_id)


# ---- the list of the first issue: refused, or marked


def test_a_missing_camera_file(recording: Path, capsys: Capture) -> None:
    (recording / "setup" / "cam02.txt").unlink()
    said = carve(capsys, recording)
    assert re.search(
        r"cam02\.txt: missing, but camera cam-002 has pictures; restore the file", said.complaint
    )
    assert not (recording.parent / "run").exists()


def test_a_3x3_matrix_where_3x4_is_due(recording: Path, capsys: Capture) -> None:
    np.savetxt(recording / "setup" / "cam01.txt", RIG[1].intrinsics)
    assert (
        "cam01.txt: a 3x3 matrix found where a 3x4 projection matrix is due"
        in carve(capsys, recording).complaint
    )


def test_a_mirrored_calibration(tmp_path: Path, capsys: Capture) -> None:
    recording = write_inria(tmp_path / "recording", RIG, world_change=np.diag([-1.0, 1.0, 1.0, 1.0]))
    assert "mirrored calibration" in carve(capsys, recording).complaint


def test_a_silhouette_of_another_size(recording: Path, capsys: Capture) -> None:
    path = silhouette_path(recording, 1, 2)
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert mask is not None
    cv2.imwrite(str(path), cv2.resize(mask, (60, 80), interpolation=cv2.INTER_NEAREST))
    marks_one_camera(capsys, recording, 1, 2, "silhouette is 60x80 px, this camera's others are 120x160 px")


def test_an_empty_silhouette(recording: Path, capsys: Capture) -> None:
    blank(recording, 3, 1)
    marks_one_camera(capsys, recording, 3, 1, "silhouette is empty")


def test_a_truncated_png(recording: Path, capsys: Capture) -> None:
    path = silhouette_path(recording, 2, 0)
    path.write_bytes(path.read_bytes()[:150])
    marks_one_camera(capsys, recording, 2, 0, "PNG is truncated")


def test_a_frame_missing_in_one_camera(recording: Path, capsys: Capture) -> None:
    silhouette_path(recording, 0, 2).unlink()
    marks_one_camera(capsys, recording, 0, 2, "frame missing in this camera")


def test_a_frame_that_shows_nobody_is_kept_and_told_by_the_exit_code(
    recording: Path, capsys: Capture
) -> None:
    for camera_idx in range(4):
        blank(recording, camera_idx, 1)
    said = carve(capsys, recording)
    assert said.code == 3
    assert "1 of 3 frames failed in stage hull: 000001" in said.err
    assert frame(recording, 1)["status"] == "failed" and frame(recording, 1)["problems"]
    assert carved(recording) == ["000000.ply", "000002.ply"]
    said = carve(capsys, recording)
    assert said.code == 3, "told again where nothing is left to do"


def test_a_recording_that_shows_nobody(recording: Path, capsys: Capture) -> None:
    for camera_idx in range(4):
        for frame_id in range(3):
            blank(recording, camera_idx, frame_id)
    assert "carve" not in carve(capsys, recording).complaint  # a sentence, whatever room it comes from


# ---- options that cannot be


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--frames", "first"), r"--frames first: not understood; write START:STOP:STEP"),
        (("--frames", "50:60"), r"--frames 50:60: selects nothing; the recording has 3 frames, 0 to 2"),
        (("--frames", "0:3:0"), r"--frames 0:3:0: the step must be 1 or more"),
        (("--voxel-mm", "0"), r"--voxel-mm 0: choose a grid spacing between 0\.5 and 100 mm"),
        (("--voxel-mm", "nan"), r"--voxel-mm nan: choose a grid spacing"),
        (("--voxel-mm", "-8"), r"--voxel-mm -8: choose a grid spacing"),
        (("--sequence", "walk"), r"no sequence 'walk'"),
        (("--calibration", "nowhere.json"), r"nowhere\.json"),
    ],
)
def test_options_that_cannot_be(words: tuple[str, str], what: str, recording: Path, capsys: Capture) -> None:
    said = call(capsys, "carve", recording, "--out", recording.parent / "run", *words)
    assert re.search(what, said.complaint), said.complaint
    assert not (recording.parent / "run").exists(), "nothing is left behind by what was refused"


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--size", "big"), r"--size big: give WIDTHxHEIGHT in pixels"),
        (("--size", "640"), r"--size 640: give WIDTHxHEIGHT"),
        (("--size", "640x-2"), r"at least 1 camera and 8 pixels|--size"),
        (("--cameras", "0"), r"at least 1 camera"),
        (("--frames", "0"), r"at least 1 frame"),
        (("--seed", "-3"), r"a seed of 0 or more"),
        (("--motion", "fly"), r"--motion fly: there is no such motion; there are: .*walk"),
        (("--garment", "armour"), r"--garment armour: there is no such garment; there are: .*tshirt-shorts"),
        (("--body", "free:other"), r"free:other: there is no such free body"),
        (("--body", "nobody.npz"), r"nobody\.npz: no such body file"),
    ],
)
def test_films_that_cannot_be(words: tuple[str, str], what: str, tmp_path: Path, capsys: Capture) -> None:
    said = call(capsys, "synth", tmp_path / "film", *words)
    assert re.search(what, said.complaint), said.complaint
    assert not (tmp_path / "film").exists()


def test_a_film_is_not_written_over(tiny: TinyRun, capsys: Capture) -> None:
    said = call(capsys, "synth", tiny.recording, "--cameras", 2, "--size", "16x16", "--frames", 1)
    assert "holds a recording already" in said.complaint and "--overwrite" in said.complaint


# ---- folders that are not there, or not what they should be


def test_recordings_that_are_not_there(tmp_path: Path, capsys: Capture) -> None:
    said = call(capsys, "run", tmp_path / "nowhere", "--out", tmp_path / "run")
    assert said.complaint.endswith("nowhere: no such folder")
    said = call(capsys, "run", tmp_path, "--out", tmp_path / "run")
    assert "no recording here: neither [SEQUENCE/]SilhouettesPictures/ nor videos/ in it" in said.complaint


@pytest.mark.parametrize("command", ["fit", "overlay", "evaluate"])
def test_runs_that_are_not_there(command: str, tmp_path: Path, capsys: Capture) -> None:
    words = ("--truth", tmp_path) if command == "evaluate" else ()
    said = call(capsys, command, tmp_path / "nowhere", *words)
    assert "no run.json there; make the run first: bodyhull carve RECORDING --out" in said.complaint


def test_an_unknown_body(recording: Path, capsys: Capture) -> None:
    carve(capsys, recording)
    run = recording.parent / "run"
    assert "there are free:neutral, free:female and free:male" in call(
        capsys, "fit", run, "--body", "free:elf"
    ).complaint.replace("There are", "there are")
    assert "no such body file" in call(capsys, "fit", run, "--body", "nobody.npz").complaint
    trap = recording.parent / "smpl.pkl"
    for content, complaint in (
        (b"pickle", "smpl.pkl: this pickle "),
        (
            b"cos\nsystem\n(S'touch ran'\ntR.",
            "smpl.pkl: this pickle names os.system, which no body file needs",
        ),
        (
            b"}.",
            "smpl.pkl: no v_template, f, shapedirs, posedirs, weights, J_regressor, kintree_table in this",
        ),
    ):
        trap.write_bytes(content)
        assert complaint in call(capsys, "fit", run, "--body", trap).complaint


def test_truths_that_are_not_there(tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    run = tiny.copy(tmp_path / "run").out
    said = call(capsys, "evaluate", run, "--truth", tmp_path / "nowhere")
    assert said.complaint.endswith("nowhere: no such truth file or folder")
    (tmp_path / "empty").mkdir()
    assert (
        "no truth for sequence '' (found no .npz file)"
        in call(capsys, "evaluate", run, "--truth", tmp_path / "empty").complaint
    )
    np.savez(tmp_path / "thin.npz", faces=np.zeros((1, 3), int))
    assert (
        "the truth file lacks vertices"
        in call(capsys, "evaluate", run, "--truth", tmp_path / "thin.npz").complaint
    )
    for damaged in (b"", b"no archive", (tmp_path / "thin.npz").read_bytes()[:-40]):
        (tmp_path / "cut.npz").write_bytes(damaged)
        said = call(capsys, "evaluate", run, "--truth", tmp_path / "cut.npz")
        assert "cut.npz: cannot be read as a truth file" in said.complaint
    np.savez(
        tmp_path / "later.npz", vertices=np.zeros((1, 4, 3)), faces=np.array([[0, 1, 2]]), frame_ids=[900]
    )
    assert (
        "the truth holds none of the run's fitted frames"
        in call(capsys, "evaluate", run, "--truth", tmp_path / "later.npz").complaint
    )


def test_a_recording_that_went_away(tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    config = tiny.copy(tmp_path / "run")
    state = json.loads((config.out / "run.json").read_text())
    state["configuration"]["recording"] = str(tmp_path / "gone")
    (config.out / "run.json").write_text(json.dumps(state))
    assert call(capsys, "overlay", config.out).complaint.endswith("gone: no such folder")


def test_a_place_that_cannot_be_written(recording: Path, capsys: Capture) -> None:
    (recording.parent / "run").write_text("a file where a folder should be")
    said = carve(capsys, recording)
    assert "run" in said.complaint


def test_the_doctor_tells_what_is_there(capsys: Capture) -> None:
    said = call(capsys, "doctor")
    assert said.code == 0, said.out
    for name in (
        "python",
        "numpy",
        "OpenGL off-screen",
        "cores",
        "memory",
        "free disk",
        "JAX devices",
        "H.264",
    ):
        assert re.search(rf"^ok +{name}", said.out, re.MULTILINE), said.out
    assert "drew a triangle" in said.out
