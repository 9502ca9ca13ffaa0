"""`evaluate`: closed forms (a result against itself, a truth that is thinner), and the synthetic truth."""

from pathlib import Path

import numpy as np
import pytest

from bodyhull.evaluating import error_text, evaluate_stage
from fit.surface import vertex_normals
from hull.mesh_file import load_mesh
from tests.command_line import call
from tests.tiny_run import FAILED, GOOD, TinyRun


def write_truth(path: Path, tiny: TinyRun, shrunk_m: float) -> None:
    """A truth made of the run's own bodies, drawn inwards along their normals."""
    meshes = [load_mesh(tiny.folder.mesh(k)) for k in GOOD]
    vertices = np.stack([v - shrunk_m * vertex_normals(v, f) for v, f in meshes])
    np.savez(path, vertices=vertices, faces=meshes[0][1], frame_ids=np.array(GOOD))


def test_a_run_has_no_error_against_itself(tiny: TinyRun, tmp_path: Path) -> None:
    config = tiny.copy(tmp_path / "run")
    write_truth(tmp_path / "truth.npz", tiny, 0.0)
    errors = evaluate_stage(config, tmp_path / "truth.npz")
    assert errors["frames"] == len(GOOD) and FAILED in errors["frames_without_truth_or_fit"]
    assert errors["summary"]["detailed, direct"]["rms"] < 1e-3
    assert errors["summary"]["detailed, paper"]["rms"] < 0.05
    assert errors["summary"]["hull, direct"]["bias"] > 2.0, "the hull is fatter than the body in it"


def test_a_result_that_is_too_fat_has_a_positive_bias(tiny: TinyRun, tmp_path: Path) -> None:
    config = tiny.copy(tmp_path / "run")
    write_truth(tmp_path / "truth.npz", tiny, 0.004)
    errors = evaluate_stage(config, tmp_path / "truth.npz")
    assert errors["summary"]["detailed, direct"]["bias"] == pytest.approx(4.0, abs=0.3)
    # Posing the truth may lessen the error, but cannot make a thin body fat.
    assert 3.0 < errors["summary"]["detailed, paper"]["bias"] < 4.3


def test_against_the_synthetic_truth(
    tiny: TinyRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny.copy(tmp_path / "run")
    said = call(capsys, "evaluate", config.out, "--truth", tiny.truth)
    assert said.code == 0, said.err
    from bodyhull.drawing import current_errors
    from bodyhull.folder import RunFolder

    folder = RunFolder(config.out)
    errors = current_errors(folder)
    assert errors is not None and errors["frames"] == 3
    assert errors["frames_without_truth_or_fit"] == [FAILED]
    summary = errors["summary"]
    rms = {name: entry["rms"] for name, entry in summary.items()}
    assert all(np.isfinite(value) for entry in summary.values() for value in entry.values())
    assert rms["detailed, direct"] < rms["hull, direct"], f"the fit is worse than the hull: {rms}"
    assert rms["detailed, paper"] < rms["detailed, direct"] + 0.3, f"re-posing made it worse: {rms}"
    # A coarse fit to a few small pictures: far from the truth, but not from the person.
    assert 0.5 < rms["detailed, paper"] < 16, rms
    assert set(errors["parts"]) == {"torso", "arm", "leg", "neck"}
    assert said.out.strip() == error_text(errors)
    assert "Errors against the true body, mm" in folder.report.read_text()
    # Another fit's errors must not appear in this fit's report.
    folder.update_stage("fit", key="another")
    assert current_errors(folder) is None
