"""A folder of scans through fit, evaluate and ground-truth; what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from bodyhull.config import RunConfig
from bodyhull.fit_input import scan_stage
from bodyhull.fitting import fit_stage
from bodyhull.folder import RunFolder
from fit.truth import load_shape_truth
from hull.mesh_file import load_mesh, save_mesh
from hull.scan_files import list_scans
from tests.command_line import call
from tests.tiny_run import GOOD, SETTINGS, TinyRun

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def scans(tiny: TinyRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny run's fitted bodies as scans in millimetres, z up, clothed by 4 mm; one file is broken."""
    folder = tmp_path_factory.mktemp("scans")
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    up = np.asarray(json.loads((tiny.config.out / "run.json").read_text())["recording"]["up"])
    for k in GOOD:
        vertices, faces = load_mesh(tiny.folder.mesh(k))
        upright = vertices if up[2] > 0.9 else vertices @ turn.T
        save_mesh(folder / f"walk.{k:06d}.ply", 1e3 * upright, faces)
    (folder / "walk.000007.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 900\n")
    return folder


@pytest.fixture(scope="module")
def fitted(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    config = RunConfig(scans, out)
    scan_stage(config)
    fit_stage(config, SETTINGS)
    return out


def test_scans_are_fitted_in_their_own_world(fitted: Path, scans: Path) -> None:
    state = RunFolder(fitted).read_state()
    assert state["recording"]["unit"] == "mm" and state["recording"]["up"] == [0, 0, 1]
    frames = state["stages"]["fit"]["frames"]
    assert frames["000007"]["status"] == "failed" and "cut short" in frames["000007"]["problems"][0]
    for k in GOOD:
        assert frames[f"{k:06d}"]["distance_mm"] < 6
        found, _ = load_mesh(RunFolder(fitted).mesh(k))
        scan, _ = load_mesh(list_scans(scans)[k])
        assert np.abs(found.mean(0) - 1e-3 * scan.mean(0)).max() < 0.02, "metres, the scans' own axes"


def test_evaluation_needs_no_hulls_and_overlay_says_what_it_needs(
    fitted: Path, scans: Path, tmp_path: Path, capsys: Capture
) -> None:
    meshes = [load_mesh(list_scans(scans)[k]) for k in GOOD]
    vertices = np.stack([1e-3 * v for v, _ in meshes])
    np.savez(tmp_path / "truth.npz", vertices=vertices, faces=meshes[0][1], frame_ids=np.array(GOOD))
    said = call(capsys, "evaluate", fitted, "--truth", tmp_path / "truth.npz")
    assert said.code == 0 and "scan inside the body, detailed" in said.out and "hull" not in said.out
    errors = json.loads(RunFolder(fitted).evaluation.read_text())
    assert errors["summary"]["detailed, direct"]["rms"] < 8 and errors["body_outside_hull_share"] is None
    assert 0 <= errors["scan_inside_body"]["detailed"]["share"] < 0.6
    assert "was made from scans, and films need cameras" in call(capsys, "overlay", fitted).complaint


def test_the_mean_of_alignments_is_a_truth(fitted: Path, tmp_path: Path, capsys: Capture) -> None:
    said = call(capsys, "ground-truth", fitted, "--out", tmp_path / "shape.npz")
    assert said.code == 0 and "mean of 2 frames" in said.out
    shape = load_shape_truth(tmp_path / "shape.npz")
    assert shape is not None and 1.2 < np.ptp(shape.template[:, 1]) < 2.2
    said = call(capsys, "evaluate", fitted, "--truth", tmp_path / "shape.npz")
    assert said.code == 0 and "direct" not in said.out
    rms = json.loads(RunFolder(fitted).evaluation.read_text())["summary"]["detailed, paper"]["rms"]
    assert rms < 6, f"the shape of the same scans is {rms:.1f} mm off"
    refused = call(capsys, "ground-truth", fitted, "--out", tmp_path / "shape.ply").complaint
    assert "written as an .npz file" in refused


def test_refusals(fitted: Path, scans: Path, tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    assert "bodyhull fit" in call(capsys, "fit", scans).complaint
    assert "are for scans: give the run folder" in call(capsys, "fit", fitted, "--units", "m").complaint
    assert (
        "units was 'auto', now 'mm'" in call(capsys, "fit", scans, "--out", fitted, "--units", "mm").complaint
    )
    assert (
        "which is no person (mm would be)"
        in call(capsys, "fit", scans, "--out", tmp_path / "a", "--units", "m").complaint
    )
    copy = tiny.copy(tmp_path / "run").out
    assert "made from silhouettes" in call(capsys, "fit", scans, "--out", copy).complaint
    assert (
        "give auto, colour, none, or a folder"
        in call(capsys, "fit", scans, "--out", tmp_path / "b", "--labels", tmp_path / "nowhere").complaint
    )
    assert (
        "--lambda-fit -1: weights are 0 or more" in call(capsys, "fit", fitted, "--lambda-fit=-1").complaint
    )
