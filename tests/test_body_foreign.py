"""A body of another structure becomes one of SMPL's: on made people whose answer is known."""

from pathlib import Path

import numpy as np
import pytest

from fit.body import BodyModel, BodyModelError, load_body
from fit.body.anny import JOINT_OF_BONE, anny_body_file
from fit.body.body_file import read_body_file
from fit.body.foreign_shapes import DrawnPeople, body_of_people, fold_by_name, triangles
from fit.body.skeleton import JOINT, JOINT_NAMES

N_PEOPLE, N_MODES = 40, 4


@pytest.fixture(scope="module")
def people() -> DrawnPeople:
    """People of the free body, of its first components alone."""
    free = load_body("free:neutral", show_progress=False)
    betas = np.random.default_rng(0).standard_normal((N_PEOPLE, N_MODES))
    vertices = free.template + np.einsum("vak,nk->nva", free.shape_directions[:, :, :N_MODES], betas)
    joints = np.einsum("jv,nva->nja", free.joint_regressor, vertices)
    return DrawnPeople("made", "CC0-1.0", "neutral", vertices, joints, free.faces, free.weights)


def test_every_drawn_person_is_in_the_shape_space(people: DrawnPeople, tmp_path: Path) -> None:
    file = body_of_people(people, N_MODES)
    file.save(tmp_path / "made.npz")
    model = BodyModel.of_file(read_body_file(tmp_path / "made.npz"))
    directions = model.shape_directions.reshape(-1, N_MODES)
    betas = np.linalg.lstsq(
        directions, (people.vertices - model.template).reshape(N_PEOPLE, -1).T, rcond=None
    )[0]
    made = np.stack([model.shaped(b) for b in betas.T])
    np.testing.assert_allclose(made, people.vertices, atol=1e-8)
    np.testing.assert_allclose(betas.std(1, ddof=1), 1.0, atol=1e-9)
    assert "keep 100.0 % of their variance" in file.notes[0]


def test_joints_are_regressed_from_their_surroundings(people: DrawnPeople) -> None:
    file = body_of_people(people, N_MODES)
    found = np.einsum("jv,nva->nja", file.joint_regressor, people.vertices)
    error_mm = 1e3 * np.linalg.norm(found - people.joints, axis=2)
    assert error_mm.mean() < 1.0 and error_mm.max() < 8.0, (
        f"{error_mm.mean():.2f}, worst {error_mm.max():.2f} mm"
    )
    np.testing.assert_allclose(file.joint_regressor.sum(1), 1, atol=1e-9)
    assert (file.joint_regressor != 0).sum(1).max() <= 60


def test_fewer_components_keep_less(people: DrawnPeople) -> None:
    shares = [float(body_of_people(people, k).notes[0].split("keep ")[1].split(" %")[0]) for k in (1, 2, 3)]
    assert 0 < shares[0] < shares[1] < shares[2] < 100


def test_unnamed_bones_follow_their_ancestors() -> None:
    bones = [
        "root",
        "spine04",
        "breast.L",
        "lowerarm01.L",
        "lowerarm02.L",
        "wrist.L",
        "finger1-1.L",
        "head",
        "jaw",
    ]
    parents = [-1, 0, 1, 1, 3, 4, 5, 1, 7]
    joints = [JOINT_NAMES[k] for k in fold_by_name(bones, parents, JOINT_OF_BONE)]
    assert joints == [
        "pelvis", "spine1", "spine1", "left_elbow", "left_elbow", "left_wrist", "left_wrist", "head", "head",
    ]  # fmt: skip
    assert set(JOINT_OF_BONE.values()) == set(JOINT)
    with pytest.raises(KeyError):
        fold_by_name(["tail"], [-1], JOINT_OF_BONE)


def test_quads_become_triangles_of_the_same_area() -> None:
    np.testing.assert_array_equal(triangles(np.array([[0, 1, 2, 3]])), [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(triangles(np.array([[4, 5, 6, 6]])), [[4, 5, 6]])


def test_anny_without_its_package_or_assets_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(
        BodyModelError, match=r"anny: (needs the package body-models|its assets cannot be had)"
    ):
        anny_body_file(tmp_path, show_progress=False)
