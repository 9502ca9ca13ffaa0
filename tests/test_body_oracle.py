"""Files of ours through another program's reader and skinning (`body-models`), where it is installed."""

from pathlib import Path

import numpy as np
import pytest

from fit.body import load_body
from tests.body_formats import N_BETAS, fingered_arrays, posed_model, smpl_arrays, write_chumpy_pickle

pytest.importorskip("body_models", reason="body-models is not installed: pip install 'bodyhull[bodies]'")
AGREE_M = 1e-5


def pose_and_betas() -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(11)
    pose = 0.35 * random.standard_normal((24, 3))
    pose[22:] = 0
    return pose, random.standard_normal(N_BETAS)


@pytest.mark.parametrize("suffix", ["npz", "pkl"])
def test_smpl_agrees(tmp_path: Path, suffix: str) -> None:
    from body_models.smpl.numpy import SMPL

    path = tmp_path / f"SMPL_NEUTRAL.{suffix}"
    if suffix == "npz":
        np.savez(path, **smpl_arrays())
    else:
        write_chumpy_pickle(path, smpl_arrays())
    pose, betas = pose_and_betas()
    theirs = SMPL(model_path=path).forward_vertices(pose[1:], pelvis_rotation=pose[0], shape=betas)
    ours = posed_model(load_body(path), betas, pose)
    worst = float(np.abs(np.asarray(theirs) - ours).max())
    print(f"SMPL {suffix}: {worst:.2e} m apart")
    assert worst < AGREE_M


def test_smpl_x_agrees_with_hands_and_face_at_rest(tmp_path: Path) -> None:
    from body_models.smplx.numpy import SMPLX

    arrays = fingered_arrays("SMPL-X", 400)
    named = np.empty((), dtype=object)
    named[()] = {f"joint_{k}": k for k in range(55)}
    hands = {f"hands_mean{side}": np.zeros(45) for side in "lr"}
    np.savez(tmp_path / "SMPLX_NEUTRAL.npz", **arrays, **hands, joint2num=named)
    pose, betas = pose_and_betas()
    model = load_body(tmp_path / "SMPLX_NEUTRAL.npz")
    wide = np.zeros(model.n_betas)
    wide[:N_BETAS] = betas
    theirs = SMPLX(model_path=tmp_path / "SMPLX_NEUTRAL.npz").forward_vertices(
        pose[1:22],
        np.zeros((3, 3)),
        np.zeros((30, 3)),
        pelvis_rotation=pose[0],
        shape=wide,
        expression=np.zeros(100),
    )
    worst = float(np.abs(np.asarray(theirs) - posed_model(model, wide, pose)).max())
    print(f"SMPL-X: {worst:.2e} m apart")
    assert worst < AGREE_M
