"""`bodyhull convert`, and recordings that come with any of the formats."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.calibration_file import find_calibrations, read_calibration
from capture.recording import RecordingError, open_recording
from capture.rig import Rig
from capture.rig_checks import guess_unit, lens_doubts, placement_doubts
from capture.rig_choice import read_rig
from capture.rig_formats import FORMATS, read_rig_of, write_rig
from tests.capture_scenes import PERSON, small_rig, write_inria, write_videos
from tests.command_line import call
from tests.rigs_for_formats import awkward_rig, worst_px

Capture = pytest.CaptureFixture[str]
RIG = small_rig(5)
POINTS = PERSON[:, :3].copy()


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    awkward_rig(5).save(tmp_path / "rig.json")
    return tmp_path / "rig.json"


def test_a_rig_goes_to_easymocap_and_back(rig_file: Path, capsys: Capture) -> None:
    out = rig_file.parent / "easymocap"
    said = call(capsys, "convert", rig_file, out, "--to", "easymocap")
    assert said.code == 0 and not said.err
    assert "4 cameras" in said.out and str(out / "intri.yml") in said.out
    said = call(capsys, "convert", out, rig_file.parent / "back.json", "--to", "bodyhull")
    assert said.code == 0 and not said.err
    assert worst_px(Rig.load(rig_file), Rig.load(rig_file.parent / "back.json")) < 1e-6


def test_a_chain_through_every_format_ends_where_it_began(tmp_path: Path, capsys: Capture) -> None:
    """Pinholes, each format read from the one before, sizes and units given where a format lost them."""
    rig = awkward_rig()
    same = Rig(tuple(replace(camera, size=(1280, 720)) for camera in rig))
    same.save(tmp_path / "0.json")
    here = tmp_path / "0.json"
    for k, name in enumerate([*FORMATS, "bodyhull"]):
        needs_size = any(camera.size is None for camera in read_rig_of(here).cameras)
        words = ("--size", "1280x720") if needs_size else ()
        said = call(capsys, "convert", here, tmp_path / f"{k + 1}", "--to", name, *words)
        assert said.code == 0, said.err
        here = tmp_path / f"{k + 1}"
    assert worst_px(same, Rig.load(here / "rig.json")) < 1e-6


def test_what_is_lost_is_told_or_refused(rig_file: Path, capsys: Capture) -> None:
    out = rig_file.parent / "a.csv"
    said = call(capsys, "convert", rig_file, out, "--to", "actorshq")
    assert "no lens distortion fits into ActorsHQ's calibration.csv, but cameras cam-000" in said.complaint
    assert "--undistorted" in said.complaint and not out.exists()
    said = call(capsys, "convert", rig_file, out, "--to", "actorshq", "--undistorted")
    assert said.code == 0
    assert worst_px(Rig.load(rig_file).pinholes(), read_rig_of(out).rig()) < 1e-6
    said = call(capsys, "convert", rig_file, out, "--to", "actorshq", "--undistorted")
    assert "a.csv: is there already; --overwrite replaces it" in said.complaint
    assert call(capsys, "convert", rig_file, rig_file.parent / "m", "--to", "colmap").err.startswith(
        "bodyhull: note: COLMAP states no unit: this model is in metres."
    )


def test_what_a_source_leaves_open_is_asked_for(tmp_path: Path, capsys: Capture) -> None:
    rig = Rig(tuple(replace(camera, size=(640, 480)) for camera in awkward_rig()))
    write_rig(rig, tmp_path / "matrices", "inria")
    out = tmp_path / "o.json"
    said = call(capsys, "convert", tmp_path / "matrices", out, "--to", "bodyhull")
    assert "does not say how large the pictures of cam-000" in said.complaint and "--size" in said.complaint
    said = call(capsys, "convert", tmp_path / "matrices", out, "--to", "bodyhull", "--size", "640x480")
    assert said.code == 0 and "states no unit: taken as m" in said.err
    assert worst_px(rig, Rig.load(out)) < 1e-6
    words = ("--size", "640x480", "--units", "mm", "--overwrite")
    said = call(capsys, "convert", tmp_path / "matrices", out, "--to", "bodyhull", *words)
    assert said.code == 0 and "check the unit" in said.err
    assert np.abs(Rig.load(out).centres - rig.centres * 1e-3).max() < 1e-9
    said = call(capsys, "convert", out, tmp_path / "p", "--to", "pose2sim", "--size", "320x240")
    assert "says itself that its pictures are 640x480 px; leave it out" in said.complaint
    odd = rig.with_world_scaled(200.0)  # 800 of something: centimetres or millimetres
    write_rig(odd, tmp_path / "odd", "inria")
    said = call(capsys, "convert", tmp_path / "odd", tmp_path / "q", "--to", "pose2sim", "--size", "640x480")
    assert "which does not tell; give --units m, cm or mm" in said.complaint


def test_poses_the_wrong_way_round_are_noticed_and_inverted(tmp_path: Path, capsys: Capture) -> None:
    rig = awkward_rig()
    wrong = Rig(tuple(replace(c, camera_from_world=np.linalg.inv(c.camera_from_world)) for c in rig))
    wrong.save(tmp_path / "wrong.json")
    said = call(capsys, "convert", tmp_path / "wrong.json", tmp_path / "a", "--to", "easymocap")
    assert said.code == 0 and "The poses look inverted" in said.err
    words = ("--to", "easymocap", "--invert-poses", "--overwrite")
    said = call(capsys, "convert", tmp_path / "wrong.json", tmp_path / "a", *words)
    assert said.code == 0 and not said.err
    assert worst_px(rig, read_rig_of(tmp_path / "a").rig()) < 1e-6


def test_what_is_no_calibration_is_named(tmp_path: Path, capsys: Capture) -> None:
    def complaint(source: Path) -> str:
        return call(capsys, "convert", source, tmp_path / "out", "--to", "easymocap").complaint

    assert "nowhere: no such calibration" in complaint(tmp_path / "nowhere")
    (tmp_path / "a.json").write_text('{"people": []}')
    assert "a.json: unknown calibration format; known are a rig .json, a folder of camNN.txt" in complaint(
        tmp_path / "a.json"
    )
    (tmp_path / "half.json").write_text('{"format": "bodyhull-rig", "cam')
    assert "half.json: not a JSON file" in complaint(tmp_path / "half.json")
    (tmp_path / "b.xml").write_text("<calibration><cameras>")
    assert "the XML does not parse" in complaint(tmp_path / "b.xml")
    (tmp_path / "empty").mkdir()
    assert "empty: unknown calibration format" in complaint(tmp_path / "empty")
    assert not (tmp_path / "out").exists()


def test_matrices_are_converted_as_the_silhouettes_beside_them_tell(tmp_path: Path, capsys: Capture) -> None:
    root = write_inria(tmp_path / "recording", RIG, unit_m=0.001)
    for k, camera in enumerate(RIG):
        path = root / "setup" / f"cam{k:02d}.txt"
        bottom = np.array([[1.0, 0, 0], [0, -1, camera.size[1] - 1], [0, 0, 1]])
        np.savetxt(path, bottom @ np.loadtxt(path), fmt="%.17g")
    said = call(capsys, "convert", root / "setup", tmp_path / "rig.json", "--to", "bodyhull")
    assert said.code == 0, said.err
    assert "Unit of the calibration: mm" in said.err and "rows counted from the bottom" in said.err
    for camera, found in zip(RIG, Rig.load(tmp_path / "rig.json"), strict=True):
        assert np.abs(camera.project(POINTS)[0] - found.project(POINTS)[0]).max() < 1e-6


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("inria", "colmap-text")])
def test_recordings_open_with_every_format(tmp_path: Path, name: str) -> None:
    """In `calibration/` of an image recording and given by --calibration; names are paired by number."""
    root = write_inria(tmp_path / "images", RIG, n_frames=1)
    for file in (root / "setup").iterdir():
        file.unlink()
    (root / "setup").rmdir()
    write_rig(RIG, root / "calibration", name)
    found = open_recording(root)
    given = open_recording(root, calibration=root / "calibration")
    for camera, one, other in zip(RIG, found.rig, given.rig, strict=True):
        assert one == other
        assert np.abs(camera.project(POINTS)[0] - one.project(POINTS)[0]).max() < 1e-6
    assert found.unit == ("mm" if name in ("qualisys", "vicon", "zju-mocap") else "m")


def test_videos_take_a_calibration_in_another_format(tmp_path: Path) -> None:
    rig = small_rig(4)
    write_videos(tmp_path, rig, n_frames=2)
    write_rig(rig, tmp_path / "calibration", "easymocap")
    with pytest.raises(RecordingError, match=r"several calibrations \(rig.json, calibration/intri.yml\)"):
        open_recording(tmp_path)
    (tmp_path / "rig.json").unlink()
    opened = open_recording(tmp_path)
    assert worst_px(rig, opened.rig) < 1e-6
    assert find_calibrations(tmp_path) == [tmp_path / "calibration" / "intri.yml"]
    write_rig(rig, tmp_path / "zju", "zju-mocap")
    sized = read_calibration(tmp_path / "zju", dict.fromkeys(rig.names, (120, 160)))
    assert sized.unit == "mm" and sized.rig[0].size == (120, 160), "sizes come from the pictures"


def test_a_rig_study_takes_a_foreign_calibration(tmp_path: Path) -> None:
    rig = awkward_rig()
    write_rig(rig, tmp_path / "c.toml", "pose2sim")
    found, unit = read_rig(tmp_path / "c.toml")
    assert unit == "m" and worst_px(rig, found) < 1e-6
    write_rig(rig, tmp_path / "annots.npy", "zju-mocap")
    with pytest.raises(RecordingError, match="this calibration does not say how large the pictures are"):
        read_rig(tmp_path / "annots.npy")
    assert read_rig(tmp_path / "annots.npy", (640, 480))[0][0].size == (640, 480)


def test_odd_cameras_are_told_in_a_sentence_each() -> None:
    rig = awkward_rig()
    assert not lens_doubts(rig) and not placement_doubts(rig, 1.0)
    tele = replace(rig[0], intrinsics=rig[0].intrinsics * [[20, 1, 1], [1, 20, 1], [1, 1, 1]])
    assert "field of view of" in lens_doubts(Rig((tele,)))[0]
    cropped = replace(rig[1], size=(300, 800))
    assert "principal point at (307, 395) px, 52 % of the picture off" in lens_doubts(Rig((cropped,)))[0]
    assert "m from where they aim: check the unit" in placement_doubts(rig, 1000.0)[0]
    about = np.eye(4)
    about[:3, :3] = cv2.Rodrigues(np.array([0, np.pi, 0]))[0]
    away = Rig((*rig.cameras[:3], replace(rig[3], camera_from_world=about @ rig[3].camera_from_world)))
    assert "Cameras cam-003 look away from where the others aim" in placement_doubts(away, 1.0)[0]
    assert guess_unit(rig) == ("m", pytest.approx(4, abs=0.2))
    assert guess_unit(rig.with_world_scaled(200.0))[0] is None


def test_other_files_in_a_recording_are_no_calibrations(tmp_path: Path) -> None:
    rig = small_rig(4)
    write_videos(tmp_path, rig, n_frames=2)
    np.save(tmp_path / "offsets.npy", np.zeros(4))
    (tmp_path / "settings.xml").write_text("<settings><gain>3</gain></settings>")
    (tmp_path / "notes.yml").write_text("%YAML:1.0\n---\nplace: 3\n")
    (tmp_path / "config.toml").write_text("[project]\nname = 'x'\n")
    (tmp_path / "people.json").write_text('{"annotations": []}')
    assert find_calibrations(tmp_path) == [tmp_path / "rig.json"]
    assert open_recording(tmp_path).calibration == rig
