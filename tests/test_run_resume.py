"""Resume: finished work is kept, lost or damaged work is redone, another input or setting is refused."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyhull import cli
from bodyhull.config import RunConfig
from bodyhull.errors import UserError
from bodyhull.fitting import fit_stage, keypoints_print
from bodyhull.folder import RunFolder, load_arrays
from fit.body.pose_prior import PosePrior
from hull.hull_file import facts_file
from hull.mesh_file import load_mesh
from tests.command_line import call
from tests.tiny_run import DEGRADED, SETTINGS, VOXEL_MM, TinyRun, silhouette, times

Capture = pytest.CaptureFixture[str]
HULL_FILES = ("hull/000000.ply", "hull/000000.npz", "hull/000001.ply", "hull/000001.npz")


def remade(root: Path, before: dict[str, int]) -> set[str]:
    """Files that were written since."""
    return {name for name, when in times(root).items() if before.get(name) != when}


def test_a_finished_run_is_left_alone(tiny: TinyRun, tmp_path: Path) -> None:
    config = tiny.copy(tmp_path / "run")
    before = times(config.out)
    assert cli.run(config, SETTINGS) == 3, "the failed frame is still failed"
    assert remade(config.out, before) == {"run.json"}


def test_what_was_lost_or_damaged_is_redone_and_nothing_else(tiny: TinyRun, tmp_path: Path) -> None:
    """As after a killed run, a full disk, a file deleted by hand."""
    config = tiny.copy(tmp_path / "run")
    folder = RunFolder(config.out)
    folder.hull(0).unlink()
    facts = facts_file(folder.hull(1)).read_bytes()
    facts_file(folder.hull(1)).write_bytes(facts[: len(facts) // 2])
    alignment = folder.alignment(DEGRADED).read_bytes()
    folder.alignment(DEGRADED).write_bytes(alignment[: len(alignment) // 2])
    folder.track.unlink()
    folder.mesh(1).unlink()
    folder.overlay("cam-003").unlink()
    folder.report.unlink()
    before = times(config.out)
    assert cli.run(config, SETTINGS) == 3
    new = remade(config.out, before)
    assert new == {
        "run.json", *HULL_FILES, f"fit/alignments/{DEGRADED:06d}.npz",
        "fit/fusion.npz", "fit/fusion.ply", "fit/track.npz", "render/overlay/cam-003.mp4",
        "render/report.html",
        *(f"fit/meshes/{k:06d}.ply" for k in (0, 1, DEGRADED)),
    }  # fmt: skip
    for k in (0, 1):
        np.testing.assert_array_equal(load_mesh(folder.hull(k))[0], load_mesh(tiny.folder.hull(k))[0])
    again, first = load_arrays(folder.track), load_arrays(tiny.folder.track)
    assert again is not None and first is not None
    for name in ("pose", "translation", "templates", "betas"):
        np.testing.assert_allclose(again[name], first[name], atol=1e-4, err_msg=name)


def test_a_stop_between_the_stages(tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    config = tiny.copy(tmp_path / "run")
    folder = RunFolder(config.out)
    state = folder.read_state()
    del state["stages"]["fit"], state["stages"]["render"]
    folder.write_state(state)
    folder.track.unlink()
    said = call(capsys, "overlay", config.out)
    assert said.complaint.endswith(f"track.npz: missing or damaged; run: bodyhull fit {config.out}")
    shutil.copy(tiny.folder.track, folder.track)
    folder.update_stage("fit", key="")
    said = call(capsys, "overlay", config.out)
    assert said.complaint.endswith(f"its fit was stopped half-way; go on with: bodyhull fit {config.out}")
    state["stages"]["hull"]["frames"].pop("000001")
    folder.write_state(state)
    assert (
        "only 3 of 4 frames are carved; finish them first: bodyhull carve"
        in call(capsys, "fit", config.out).complaint
    )
    del state["stages"]["hull"]
    folder.write_state(state)
    assert (
        "there are no hulls to fit; run: bodyhull carve RECORDING"
        in call(capsys, "fit", config.out).complaint
    )


def test_another_input_is_refused_with_both_fingerprints(
    tiny: TinyRun, tmp_path: Path, capsys: Capture
) -> None:
    config = tiny.copy(tmp_path / "run")
    recording = tmp_path / "recording"
    shutil.copytree(tiny.recording, recording)
    other = np.zeros((256, 256), np.uint8)
    other[100:200, 100:150] = 255
    cv2.imwrite(str(silhouette(recording, 0, 0)), other)
    before = times(config.out)
    said = call(capsys, "run", recording, "--out", config.out, "--voxel-mm", VOXEL_MM)
    known = RunFolder(config.out).read_state()["inputs"]["fingerprint"]
    now = fingerprint_of(recording)
    assert known != now
    assert (
        f"made from another input (fingerprint {known[:12]}, the recording now has {now[:12]})"
        in said.complaint
    )
    assert "run with --overwrite to redo it, or choose another --out" in said.complaint
    assert remade(config.out, before) == set()
    # The films would be drawn over other silhouettes than the body was fitted to.
    state = RunFolder(config.out).read_state()
    state["configuration"]["recording"] = str(recording)
    RunFolder(config.out).write_state(state)
    assert now[:12] in call(capsys, "overlay", config.out).complaint


def fingerprint_of(recording: Path) -> str:
    from capture.recording import open_recording

    return open_recording(recording).fingerprint()


def test_other_settings_are_refused(tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    config = tiny.copy(tmp_path / "run")
    before = times(config.out)
    said = call(capsys, "carve", tiny.recording, "--out", config.out, "--voxel-mm", 9)
    assert "made with other settings (voxel_mm was 12.0, now 9.0); run with --overwrite" in said.complaint
    said = call(capsys, "run", tiny.recording, "--out", config.out, "--voxel-mm", VOXEL_MM, "--up", "-y")
    assert "up was 'auto', now '-y'" in said.complaint
    assert remade(config.out, before) == set()
    # The shared run was fitted with coarser settings than the command's own.
    said = call(capsys, "fit", config.out)
    assert "holds a fit of body 'free:neutral' made with other settings" in said.complaint
    assert f"to replace it: bodyhull fit {config.out} --body free:neutral --overwrite" in said.complaint
    assert remade(config.out, before) == set()


def test_another_pose_prior_is_refused_and_a_wrong_one_named(
    tiny: TinyRun, tmp_path: Path, capsys: Capture
) -> None:
    config = tiny.copy(tmp_path / "run")
    standard = PosePrior.standard()
    file = tmp_path / "prior.npz"
    standard.save(file)
    before = times(config.out)
    fit_stage(replace(config, pose_prior=file), SETTINGS)  # the same numbers: nothing to do
    assert remade(config.out, before) == set()
    replace(standard, covariance=1.5 * standard.covariance).save(file)
    with pytest.raises(UserError, match="holds a fit of body 'free:neutral' made with other settings"):
        fit_stage(replace(config, pose_prior=file), SETTINGS)
    file.write_text("no")
    said = call(capsys, "fit", config.out, "--pose-prior", file)
    assert "not a readable pose prior" in said.complaint
    assert remade(config.out, before) == set()


def test_a_refused_body_leaves_the_configuration_alone(tiny: TinyRun, tmp_path: Path) -> None:
    config = tiny.copy(tmp_path / "run")
    body = tmp_path / "other.npz"
    from fit.body.model import load_body

    model = load_body("free:neutral", show_progress=False)
    replace(model, name="other", template=1.01 * model.template).save(body)
    with pytest.raises(UserError, match="holds a fit of body 'free:neutral' made with other settings"):
        cli.run(replace(config, body=str(body)), SETTINGS)
    assert RunFolder(config.out).read_state()["configuration"]["body"] == "free:neutral"


def test_overwrite_redoes_and_clears(tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    config = tiny.copy(tmp_path / "run")
    notes = config.out / "notes.txt"
    notes.write_text("mine")
    said = call(
        capsys,
        "carve",
        tiny.recording,
        "--out",
        config.out,
        "--voxel-mm",
        25,
        "--frames",
        "0:2",
        "--overwrite",
    )
    assert said.code == 0, said.err
    assert set(times(config.out)) == {
        "run.json", "capture/rig.json", *HULL_FILES, "notes.txt",
    }  # fmt: skip
    state = RunFolder(config.out).read_state()
    assert set(state["stages"]) == {"hull"} and state["configuration"]["voxel_mm"] == 25.0
    assert set(state["stages"]["hull"]["frames"]) == {"000000", "000001"}


def test_overwriting_a_fit_leaves_the_hulls(tiny: TinyRun, tmp_path: Path) -> None:
    config = replace(tiny.copy(tmp_path / "run"), overwrite=True)
    before = times(config.out)
    fit_stage(config, replace(SETTINGS, n_points=1500, max_iterations=2))
    new = remade(config.out, before)
    assert {"fit/track.npz", "fit/fusion.ply", "fit/alignments/000000.npz", "fit/meshes/000001.ply"} <= new
    assert not any(name.startswith(("hull/", "capture/", "render/")) for name in new)


def test_a_damaged_run_json(tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    config = tiny.copy(tmp_path / "run")
    state_file = config.out / "run.json"
    for content in (state_file.read_text()[:200], "[]", ""):
        state_file.write_text(content)
        for words in (("run", tiny.recording, "--out", config.out), ("fit", config.out)):
            said = call(capsys, *words)
            assert "run.json: cannot be read (" in said.complaint and "--overwrite" in said.complaint
    said = call(
        capsys, "carve", tiny.recording, "--out", config.out, "--voxel-mm", 25, "--frames", "0", "--overwrite"
    )
    assert said.code == 0 and set(times(config.out)) == {"run.json", "capture/rig.json", *HULL_FILES[:2]}


def test_run_json_of_another_version(tiny: TinyRun, tmp_path: Path, capsys: Capture) -> None:
    config = tiny.copy(tmp_path / "run")
    state = json.loads((config.out / "run.json").read_text())
    state["configuration"]["colour"] = "blue"
    (config.out / "run.json").write_text(json.dumps(state))
    assert (
        "written by another version of bodyhull (it differs in colour)"
        in call(capsys, "fit", config.out).complaint
    )


def test_stopping_with_the_keyboard(monkeypatch: pytest.MonkeyPatch, capsys: Capture, tmp_path: Path) -> None:
    def stopped(command: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "perform", stopped)
    said = call(capsys, "fit", tmp_path)
    assert said.code == 130 and "run the same command to go on" in said.err


def test_new_keypoints_are_noticed(tmp_path: Path) -> None:
    assert keypoints_print(None) is None
    (tmp_path / "cam-000").mkdir()
    file = tmp_path / "cam-000" / "000000.json"
    file.write_text("{}")
    first = keypoints_print(tmp_path)
    assert keypoints_print(tmp_path) == first
    os.utime(file, ns=(1, 1))
    assert keypoints_print(tmp_path) not in (first, None)


def test_the_configuration_survives_its_file(tmp_path: Path) -> None:
    plain = RunConfig(tmp_path / "a", tmp_path / "b")
    full = RunConfig(
        tmp_path / "a", tmp_path / "b", "walk", "free:male", tmp_path / "c.json", "0:9:3", 5.0, "mm", "-y",
        tmp_path / "plates", tmp_path / "keypoints", True, tmp_path / "prior.npz", False, 2, False, False,
    )  # fmt: skip
    for config in (plain, full):
        assert RunConfig.from_dict(json.loads(json.dumps(config.as_dict()))) == config
