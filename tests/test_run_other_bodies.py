"""The fit and its evaluation with a body of SMPL-X's structure, read from a pickle."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bodyhull.evaluating import evaluate_stage
from bodyhull.fitting import fit_stage, load_track
from bodyhull.folder import RunFolder
from tests.body_formats import fingered_arrays, python2_pickle
from tests.tiny_run import FAILED, GOOD, SETTINGS, TinyRun


def test_the_pipeline_runs_with_fingers_and_a_face(
    tiny: TinyRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    body = tmp_path / "SMPLX_FEMALE.pkl"
    body.write_bytes(python2_pickle(fingered_arrays("SMPL-X", 20)))
    config = replace(tiny.copy(tmp_path / "run"), body=str(body), overwrite=True)
    fit_stage(config, SETTINGS)
    assert "the first 10 are shape; the face keeps its rest expression" in capsys.readouterr().err
    stage = json.loads((config.out / "run.json").read_text())["stages"]["fit"]
    assert (stage["kind"], stage["gender"], stage["body"]) == ("SMPL-X", "female", str(body))
    track = load_track(RunFolder(config.out))
    assert (str(track["kind"]), str(track["gender"])) == ("SMPL-X", "female")
    assert track["betas"].shape == (10,)
    for k, frame_id in enumerate(track["frame_ids"].tolist()):
        assert np.isfinite(track["pose"][k]).all() == (frame_id != FAILED)
    errors = evaluate_stage(config, tiny.truth)["summary"]
    usual = evaluate_stage(tiny.copy(tmp_path / "usual"), tiny.truth)["summary"]
    found, before = errors["detailed, direct"]["rms"], usual["detailed, direct"]["rms"]
    assert errors["hull, direct"]["rms"] == usual["hull, direct"]["rms"]
    assert len(GOOD) and found < 1.5 * before + 1.0, f"{found:.1f} mm, with the free body {before:.1f} mm"
