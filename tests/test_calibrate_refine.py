"""`bodyhull calibrate refine`: what it writes, prints and refuses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyhull.calibrate_refine import held_out_frames, spread
from capture.layouts import dome_layout
from capture.recording import open_recording
from capture.rig import Rig
from render.spoil import displaced_rig
from tests.command_line import call
from tests.moving_figure import filmed, moments, pixels_apart

N_CAMERAS, N_FRAMES, SIDE_PX = 6, 6, 320
Capture = pytest.CaptureFixture[str]


def write_recording(root: Path, rig: Rig, frames: list[list[np.ndarray]]) -> Path:
    """An INRIA recording of these silhouettes, calibrated by the rig."""
    (root / "setup").mkdir(parents=True)
    for k, camera in enumerate(rig):
        np.savetxt(root / "setup" / f"cam{k:02d}.txt", camera.projection_matrix, fmt="%.17g")
        folder = root / "SilhouettesPictures" / f"cam-{k:03d}"
        folder.mkdir(parents=True)
        for frame, images in enumerate(frames):
            assert cv2.imwrite(str(folder / f"silh_{frame:06d}.png"), images[k])
    return root


@pytest.fixture(scope="module")
def off(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose calibration is off."""
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    given = displaced_rig(truth, (0.5, 1.0), (0.01, 0.02), 31)
    return write_recording(tmp_path_factory.mktemp("refine") / "off", given, frames)


def test_a_rig_is_refined_written_and_taken_as_a_calibration(off: Path, tmp_path: Path, capsys: Capture):
    out = tmp_path / "new" / "rig.json"
    said = call(capsys, "calibrate", "refine", off, "--out", out, "--units", "m", "--up", "z")
    assert said.code == 0, said.err
    rows = [line.split() for line in said.out.splitlines() if line.startswith("cam-")]
    assert len(rows) == N_CAMERAS and all(row.count("->") == 2 for row in rows)
    for row in rows:
        before, after = float(row[3]), float(row[5])
        assert after < before / 3, row
        assert 0.3 < float(row[1]) < 1.6 and 3 < float(row[2]) < 60, row
    assert "from outlines of 4 frames, judged on 2 others" in said.out
    truth, _ = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    opened = open_recording(off, calibration=out, units="m", up="z")
    assert pixels_apart(opened.rig, truth).max() < 0.5
    assert [p.name for p in out.parent.iterdir()] == ["rig.json"]


def test_a_rig_that_is_right_already_is_not_replaced(tmp_path: Path, capsys: Capture):
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    root = write_recording(tmp_path / "right", truth, frames)
    # One camera's silhouettes of the frames refined from are moved, those held out are not: refining errs.
    for path in sorted((root / "SilhouettesPictures" / "cam-001").glob("*.png")):
        if int(path.stem[-6:]) not in held_out_frames(N_FRAMES):
            moved = np.roll(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 3, axis=0)
            assert cv2.imwrite(str(path), moved)
    out = tmp_path / "rig.json"
    said = call(capsys, "calibrate", "refine", root, "--out", out, "--units", "m", "--up", "z")
    assert (
        "rig.json: not written, since on the frames held out the refined rig is no better" in said.complaint
    )
    assert "keep the given calibration" in said.complaint
    assert not out.exists()


def test_keypoints_beside_the_recording_are_found_and_lenses_kept(tmp_path: Path, capsys: Capture):
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    given = displaced_rig(truth, (0.5, 1.0), (0.01, 0.02), 32)
    root = write_recording(tmp_path / "with keypoints", given, frames)
    joints = np.linspace(0, len(moments(1)[0].centres) - 1, 25).astype(int)
    for frame, subject in enumerate(moments(N_FRAMES)):
        for camera, true in zip(given, truth, strict=True):
            pixels = true.project(subject.centres[joints])[0]
            row = np.column_stack([pixels, np.full(25, 0.9)]).ravel().tolist()
            name = f"cam-{int(camera.name[-2:]):03d}"
            path = root / "keypoints" / name / f"{frame:06d}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": row}]}))
    out = tmp_path / "rig.json"
    said = call(capsys, "calibrate", "refine", root, "--out", out, "--units", "m", "--up", "z", "--focal")
    assert said.code == 0, said.err
    assert "from keypoints and outlines of" in said.out and "focal, %" in said.out
    assert pixels_apart(Rig.load(out), truth).max() < 0.5
    nowhere = tmp_path / "elsewhere"
    said = call(capsys, "calibrate", "refine", root, "--out", out, "--keypoints", nowhere)
    assert said.complaint == f"--keypoints {nowhere}: no such folder"


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--out", "rig.toml"), "--out rig.toml: give the name of a .json file"),
        (("--out", "rig.json", "--frames", "0"), "1 frame chosen; refining needs 2 at least"),
        (("--out", "rig.json", "--sequence", "walk"), "walk"),
    ],
)
def test_mistakes_are_told(off: Path, capsys: Capture, options: tuple[str, ...], complaint: str):
    said = call(capsys, "calibrate", "refine", off, "--units", "m", "--up", "z", *options)
    assert complaint in said.complaint


def test_what_is_held_out_is_a_quarter_in_stretches():
    assert held_out_frames(2) == {1}
    assert held_out_frames(16) == {4, 5, 12, 13}
    for n in range(2, 40):
        held = held_out_frames(n)
        assert 0 < len(held) < n and len(held) <= n / 2
    assert spread([1, 2, 3, 4, 5], 3) == [1, 3, 5] and spread([7, 9], 3) == [7, 9]


def test_a_dome_s_names_pair_with_the_recording_s(off: Path):
    assert open_recording(off, units="m", up="z").rig.names == tuple(
        f"cam-{k:03d}" for k in range(len(dome_layout(N_CAMERAS)))
    )
