"""Every format of body file that people have gives the body that was written into it."""

import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csc_matrix, csr_array, csr_matrix

from fit.body import BodyModel, BodyModelError, load_body
from fit.body.body_file import SPELLINGS, BodyFile, gender_of_path, read_body_file
from fit.body.joint_trees import TREES, driven_ancestors
from fit.body.parts import BODY_25, region_of_vertices
from fit.body.skeleton import JOINT, PARENTS
from tests.body_formats import (
    N_BETAS,
    Arrays,
    fingered_arrays,
    posed,
    posed_model,
    python2_pickle,
    smpl_arrays,
    write_chumpy_pickle,
)


@pytest.fixture(scope="module")
def arrays() -> Arrays:
    return smpl_arrays()


@pytest.fixture(scope="module", params=["SMPL-H", "SMPL-X"])
def fingered(request: pytest.FixtureRequest) -> tuple[str, Arrays]:
    return request.param, fingered_arrays(request.param)


def same(file: BodyFile, arrays: Arrays) -> None:
    np.testing.assert_array_equal(file.template, arrays["v_template"])
    np.testing.assert_array_equal(file.faces, arrays["f"])
    np.testing.assert_array_equal(file.shape_directions, arrays["shapedirs"])
    np.testing.assert_array_equal(file.pose_directions, arrays["posedirs"])
    np.testing.assert_array_equal(file.weights, arrays["weights"])
    np.testing.assert_array_equal(file.joint_regressor, arrays["J_regressor"])


def some_pose(n_joints: int, n_driven: int) -> np.ndarray:
    pose = np.zeros((n_joints, 3))
    pose[:n_driven] = 0.4 * np.random.default_rng(3).standard_normal((n_driven, 3))
    return pose


@pytest.mark.parametrize("protocol", [0, 2])
def test_smpl_s_own_pickle_with_chumpy_objects(tmp_path: Path, arrays: Arrays, protocol: int) -> None:
    path = tmp_path / "basicmodel_f_lbs_10_207_0_v1.1.0.pkl"
    write_chumpy_pickle(path, arrays, protocol)
    assert b"chumpy.ch" in path.read_bytes() and b"scipy.sparse.csc\n" in path.read_bytes()
    file = read_body_file(path)
    same(file, arrays)
    assert (file.kind, file.gender, file.name) == ("SMPL", "female", path.stem)
    model, betas, pose = load_body(path), np.random.default_rng(1).standard_normal(10), some_pose(24, 24)
    np.testing.assert_allclose(posed_model(model, betas, pose), posed(arrays, betas, pose), atol=1e-9)


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_plain_pickles_of_any_protocol(tmp_path: Path, arrays: Arrays, protocol: int) -> None:
    small = {key: arrays[key] for key in SPELLINGS} | {"J_regressor": csc_matrix(arrays["J_regressor"])}
    (tmp_path / "SMPL_MALE.pkl").write_bytes(pickle.dumps(small, protocol))
    file = read_body_file(tmp_path / "SMPL_MALE.pkl")
    same(file, arrays)
    assert file.gender == "male"


@pytest.mark.parametrize("form", [csc_matrix, csr_matrix, coo_matrix, csr_array])
def test_sparse_regressors_of_every_form(tmp_path: Path, arrays: Arrays, form: type) -> None:
    content = {**arrays, "J_regressor": form(arrays["J_regressor"])}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    same(read_body_file(tmp_path / "a.pkl"), arrays)
    (tmp_path / "old.pkl").write_bytes(python2_pickle(content))
    same(read_body_file(tmp_path / "old.pkl"), arrays)
    held = np.empty((), dtype=object)
    held[()] = content["J_regressor"]
    np.savez(tmp_path / "a.npz", **{**arrays, "J_regressor": held})
    same(read_body_file(tmp_path / "a.npz"), arrays)


def test_dictionaries_and_lists_in_other_dress(tmp_path: Path, arrays: Arrays) -> None:
    lists = {
        "f": arrays["f"].tolist(),
        "kintree_table": arrays["kintree_table"].tolist(),
        "v_template": arrays["v_template"].astype(">f8"),
        "weights": np.asfortranarray(arrays["weights"]),
        "gender": np.array(b"female"),
    }
    (tmp_path / "a.pickle").write_bytes(pickle.dumps(OrderedDict({**arrays, **lists})))
    file = read_body_file(tmp_path / "a.pickle")
    same(file, arrays)
    assert file.gender == "female" and file.template.dtype.isnative


def test_an_npz_may_hold_things_of_no_use(tmp_path: Path, arrays: Arrays) -> None:
    named = np.empty((), dtype=object)
    named[()] = {"Pelvis": 0}
    np.savez_compressed(tmp_path / "body.npz", **arrays, joint2num=named, allow=np.array(["x"]))
    same(read_body_file(tmp_path / "body.npz"), arrays)


def test_every_spelling_of_every_key(tmp_path: Path, arrays: Arrays) -> None:
    n_spellings = max(len(names) for names in SPELLINGS.values())
    for k in range(n_spellings):
        renamed = {names[min(k, len(names) - 1)]: arrays[key] for key, names in SPELLINGS.items()}
        np.savez(tmp_path / "body.npz", **renamed)
        file = read_body_file(tmp_path / "body.npz")
        same(file, arrays)
        for key, name in zip(SPELLINGS, renamed, strict=True):
            assert (f"{name} is read as {key}" in file.notes) == (name != key)


def test_flat_and_transposed_layouts(tmp_path: Path, arrays: Arrays) -> None:
    n = len(arrays["v_template"])
    laid = {
        "shapedirs": arrays["shapedirs"].reshape(3 * n, -1),
        "posedirs": arrays["posedirs"].reshape(3 * n, -1).T,
        "weights": arrays["weights"].T,
        "J_regressor": arrays["J_regressor"].T,
        "kintree_table": np.array([0, *PARENTS[1:]]),
    }
    np.savez(tmp_path / "body.npz", **{**arrays, **laid})
    same(read_body_file(tmp_path / "body.npz"), arrays)
    np.savez(tmp_path / "body.npz", **{**arrays, "kintree_table": arrays["kintree_table"].T.astype(np.int64)})
    same(read_body_file(tmp_path / "body.npz"), arrays)


def test_fingers_and_faces_at_rest_fold_exactly(tmp_path: Path, fingered: tuple[str, Arrays]) -> None:
    kind, arrays = fingered
    np.savez(tmp_path / "model_male.npz", **arrays)
    (tmp_path / "model_male.pkl").write_bytes(
        python2_pickle({**arrays, "J_regressor": csc_matrix(arrays["J_regressor"])})
    )
    betas = np.random.default_rng(1).standard_normal(N_BETAS)
    for path in (tmp_path / "model_male.npz", tmp_path / "model_male.pkl"):
        same(read_body_file(path), arrays)
        model = load_body(path)
        assert (model.kind, model.gender, model.n_joints) == (kind, "male", 24)
        pose = some_pose(len(TREES[kind]), 22)
        found = posed_model(model, betas, pose[:24] * (np.arange(24) < 22)[:, None])
        np.testing.assert_allclose(found, posed(arrays, betas, pose), atol=1e-9)
        turned = some_pose(24, 24)
        np.testing.assert_array_equal(
            posed_model(model, betas, turned),
            posed_model(model, betas, turned * (np.arange(24) < 22)[:, None]),
        )


def test_a_folded_body_has_parts_and_landmarks(tmp_path: Path, fingered: tuple[str, Arrays]) -> None:
    _, arrays = fingered
    np.savez(tmp_path / "body.npz", **arrays)
    model, free = load_body(tmp_path / "body.npz"), load_body("free:neutral", show_progress=False)
    assert (region_of_vertices(model) == region_of_vertices(free)).mean() > 0.99
    points, wanted = model.landmarks @ model.template, free.landmarks @ free.template
    for name, point, true in zip(BODY_25, points, wanted, strict=True):
        assert np.linalg.norm(point - true) < 0.004, name
    hands = (model.joint_regressor @ model.template)[[JOINT["left_hand"], JOINT["right_hand"]]]
    truth = (free.joint_regressor @ free.template)[[JOINT["left_hand"], JOINT["right_hand"]]]
    assert np.abs(hands - truth).max() < 0.02


def test_folding_sends_every_joint_to_the_body_joint_above_it() -> None:
    assert (driven_ancestors("SMPL-X")[:22] == np.arange(22)).all()
    assert set(driven_ancestors("SMPL-X")[22:25]) == {15}
    for kind, first in (("SMPL-H", 22), ("SMPL-X", 25)):
        assert set(driven_ancestors(kind)[first : first + 15]) == {20}
        assert set(driven_ancestors(kind)[first + 15 :]) == {21}
        assert all(parent < joint for joint, parent in enumerate(TREES[kind]))


@pytest.mark.parametrize(
    ("width", "n_shape", "note"),
    [
        (20, 10, "of 20 shape and expression components the first 10 are shape"),
        (400, 300, "of 400 shape and expression components the first 300 are shape"),
        (16, 16, "all 16 components are taken for shape"),
    ],
)
def test_smpl_x_s_expressions_are_told_apart(tmp_path: Path, width: int, n_shape: int, note: str) -> None:
    arrays = fingered_arrays("SMPL-X", width)
    np.savez(tmp_path / "SMPLX_NEUTRAL.npz", **arrays)
    file = read_body_file(tmp_path / "SMPLX_NEUTRAL.npz")
    assert file.shape_directions.shape[2] == n_shape
    assert file.expression_directions.shape[2] == width - n_shape
    assert any(text.startswith(note) for text in file.notes), file.notes
    file.save(tmp_path / "again.npz")
    again = read_body_file(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.expression_directions, file.expression_directions)
    np.testing.assert_array_equal(again.shape_directions, file.shape_directions)


def test_a_file_written_again_is_the_same_and_holds_no_pickle(
    tmp_path: Path, fingered: tuple[str, Arrays]
) -> None:
    kind, arrays = fingered
    extra = {"hands_meanl": np.arange(45.0), "lmk_faces_idx": np.arange(51)}
    np.savez(tmp_path / "SMPLX_FEMALE.npz", **arrays, **extra)
    file = read_body_file(tmp_path / "SMPLX_FEMALE.npz")
    file.save(tmp_path / "plain.npz")
    with np.load(tmp_path / "plain.npz", allow_pickle=False) as stored:
        names = set(stored.files)
        for name in names:
            assert stored[name].dtype.kind in "fiuU", name
    assert {*SPELLINGS, "hands_meanl", "lmk_faces_idx", "gender", "licence", "name"} <= names
    again = read_body_file(tmp_path / "plain.npz")
    same(again, arrays)
    assert (again.kind, again.gender, again.name) == (kind, "female", "SMPLX_FEMALE")
    model = BodyModel.of_file(file)
    assert BodyModel.of_file(again).content_hash == model.content_hash
    model.save(tmp_path / "folded.npz")
    assert BodyModel.load(tmp_path / "folded.npz").content_hash == model.content_hash


@pytest.mark.parametrize(
    ("name", "gender"),
    [
        ("basicmodel_f_lbs_10_207_0_v1.1.0.pkl", "female"), ("basicModel_m_lbs_10_207_0_v1.0.0.pkl", "male"),
        ("basicModel_neutral_lbs_10_207_0_v1.0.0.pkl", "neutral"), ("SMPL_FEMALE.npz", "female"),
        ("SMPLX_NEUTRAL_2020.npz", "neutral"), ("SMPLH_MALE.pkl", "male"),
        ("smplh/female/model.npz", "female"),
        ("male/model.npz", "male"), ("smpl_m.pkl", "male"), ("model.npz", "unknown"), ("body.npz", "unknown"),
    ],
)  # fmt: skip
def test_gender_is_read_from_the_usual_names(name: str, gender: str) -> None:
    assert gender_of_path(Path("/somewhere/models") / name) == gender


def test_a_key_says_more_than_a_name(tmp_path: Path, arrays: Arrays) -> None:
    np.savez(tmp_path / "male.npz", **arrays, gender=np.array("female"))
    assert load_body(tmp_path / "male.npz").gender == "female"


def test_names_are_kept_to_one_printable_line(tmp_path: Path, arrays: Arrays) -> None:
    np.savez(
        tmp_path / "body.npz", **arrays, name=np.array("a\nb\x1b[2Jc" + 500 * "d"), licence=np.array("mine\t")
    )
    file = read_body_file(tmp_path / "body.npz")
    assert file.name.startswith("a b [2Jc") and len(file.name) == 200 and file.licence == "mine"


def test_the_free_bodies_know_their_gender(tmp_path: Path) -> None:
    for sex in ("neutral", "female", "male"):
        assert load_body(f"free:{sex}", show_progress=False).gender == sex


@pytest.mark.parametrize("n_betas", [10, 16, 300])
def test_ten_to_three_hundred_components(tmp_path: Path, arrays: Arrays, n_betas: int) -> None:
    many = 1e-3 * np.random.default_rng(0).standard_normal((len(arrays["v_template"]), 3, n_betas))
    np.savez(tmp_path / "body.npz", **{**arrays, "shapedirs": many.astype(np.float32)})
    assert read_body_file(tmp_path / "body.npz").shape_directions.shape[2] == n_betas


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"v_template": 100.0}, r"the template is 1\d\d high \(y\), expected 0.3 to 3.0 metres"),
        ({"kintree_table": np.zeros((2, 30))}, r"kintree_table has 30 joints; bodies of SMPL \(24\), SMPL-H"),
        ({"kintree_table": np.full((2, 24), np.nan)}, "kintree_table is an array of shape"),
        ({"weights": np.array(["a"])}, r"weights is an array of shape \(1,\) and type <U1, expected numbers"),
        ({"f": np.zeros((5, 3)) + 0.5}, r"f is an array of shape \(5, 3\).*expected whole numbers"),
        ({"parts": np.zeros(7)}, r"parts has shape \(7,\), expected \(6890,\)"),
        ({"n_anthropometric": np.zeros(7)}, "n_anthropometric is no whole number"),
    ],
)
def test_what_is_no_body_is_named(
    tmp_path: Path, arrays: Arrays, changes: dict[str, object], message: str
) -> None:
    made = {k: arrays[k] * v if isinstance(v, float) else v for k, v in changes.items()}
    np.savez(tmp_path / "wrong.npz", **{**arrays, **made})
    with pytest.raises(BodyModelError, match=r"wrong\.npz.*" + message):
        load_body(tmp_path / "wrong.npz")


def test_a_body_that_lies_down_is_refused(tmp_path: Path, arrays: Arrays) -> None:
    np.savez(tmp_path / "lying.npz", **{**arrays, "v_template": arrays["v_template"][:, [0, 2, 1]]})
    with pytest.raises(BodyModelError, match=r"lying\.npz: the template .*y up"):
        load_body(tmp_path / "lying.npz")
