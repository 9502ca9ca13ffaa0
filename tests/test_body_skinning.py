"""Laws of skinning: rigid motions pass through, rest stays rest, the Jacobian is the derivative."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fit.body import BodyModel, load_body
from fit.body.skeleton import (
    JOINT,
    MIRROR,
    PARENTS,
    axis_angle_to_matrix,
    blend_linearly,
    world_from_rest,
)
from fit.body.skinning import (
    SkinningArrays,
    joints_from_betas,
    left_jacobians,
    posed_joints,
    rotation_matrices,
    shape_template,
    skin,
    skin_with_jacobian,
)
from fit.body.tape import volume_m3
from fit.jax_setup import setup_jax


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return load_body("free:neutral", show_progress=False)


@pytest.fixture(scope="module")
def arrays(model: BodyModel) -> SkinningArrays:
    return SkinningArrays.of(model)


@pytest.fixture(scope="module")
def state(model: BodyModel) -> dict[str, np.ndarray]:
    """A free-form template, joints of a shape, a pose and a translation."""
    rng = np.random.default_rng(3)
    betas = rng.normal(0, 0.7, model.n_betas)
    return {
        "template": model.shaped(betas) + rng.normal(0, 0.003, model.template.shape),
        "joints": model.joint_regressor @ model.shaped(betas),
        "pose": rng.normal(0, 0.5, (24, 3)),
        "translation": np.array([0.3, -0.2, 1.1]),
        "betas": betas,
    }


def posed(arrays: SkinningArrays, state: dict[str, np.ndarray], **changes: np.ndarray) -> np.ndarray:
    at = {**state, **changes}
    return np.asarray(skin(arrays, at["template"], at["joints"], at["pose"], at["translation"]))


def test_double_precision_throughout(arrays: SkinningArrays, state: dict[str, np.ndarray]) -> None:
    assert posed(arrays, state).dtype == np.float64


def test_zero_pose_returns_the_template(arrays: SkinningArrays, state: dict[str, np.ndarray]) -> None:
    rest = posed(arrays, state, pose=np.zeros((24, 3)), translation=np.zeros(3))
    np.testing.assert_allclose(rest, state["template"], atol=1e-12)


def test_shape_and_joints_follow_the_model(
    model: BodyModel, arrays: SkinningArrays, state: dict[str, np.ndarray]
) -> None:
    betas = state["betas"]
    np.testing.assert_allclose(shape_template(arrays, betas), model.shaped(betas), atol=1e-12)
    np.testing.assert_allclose(joints_from_betas(arrays, betas), state["joints"], atol=1e-12)


def test_skinning_commutes_with_rigid_motion(arrays: SkinningArrays, state: dict[str, np.ndarray]) -> None:
    """Turning the root by Q about its joint and shifting is the same as moving the posed body."""
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7])
    shift = np.array([0.5, 0.1, -0.3])
    turned = (turn * Rotation.from_rotvec(state["pose"][0])).as_rotvec()
    moved = posed(
        arrays,
        state,
        pose=np.concatenate([turned[None], state["pose"][1:]]),
        translation=state["translation"] + shift,
    )
    pivot = state["joints"][0] + state["translation"]
    wanted = turn.apply(posed(arrays, state) - pivot) + pivot + shift
    np.testing.assert_allclose(moved, wanted, atol=1e-12)


def test_it_agrees_with_the_plain_formula(
    model: BodyModel, arrays: SkinningArrays, state: dict[str, np.ndarray]
) -> None:
    """SMPL's equations in dense numpy, all weights and all correctives."""
    rotations = axis_angle_to_matrix(state["pose"])
    corrected = state["template"] + model.pose_directions @ (rotations[1:] - np.eye(3)).ravel()
    bones = world_from_rest(rotations, state["joints"])
    wanted, _ = blend_linearly(corrected, model.weights, bones)
    np.testing.assert_allclose(posed(arrays, state), wanted + state["translation"], atol=1e-6)
    joints = posed_joints(arrays, state["joints"], state["pose"], state["translation"])
    at_joints = np.einsum("jab,jb->ja", bones[:, :3, :3], state["joints"]) + bones[:, :3, 3]
    np.testing.assert_allclose(joints, at_joints + state["translation"], atol=1e-12)


def test_the_jacobian_is_the_derivative(
    model: BodyModel, arrays: SkinningArrays, state: dict[str, np.ndarray]
) -> None:
    vertices, rotations, jacobian = skin_with_jacobian(
        arrays, state["template"], state["joints"], state["pose"], state["translation"]
    )
    np.testing.assert_allclose(vertices, posed(arrays, state), atol=1e-12)
    assert jacobian.shape == (6890, 3, 72 + 3 + model.n_betas)
    x = np.concatenate([state["pose"].ravel(), state["translation"], state["betas"]])

    def at(x: np.ndarray) -> np.ndarray:
        return posed(
            arrays,
            state,
            pose=x[:72].reshape(24, 3),
            translation=x[72:75],
            joints=np.asarray(joints_from_betas(arrays, x[75:])),
        )

    step = 1e-5
    for column in [*range(75), 75, 77, 80, 90, 75 + model.n_anthropometric + 3]:
        e = np.zeros_like(x)
        e[column] = step
        numeric = (at(x + e) - at(x - e)) / (2 * step)
        error = np.abs(numeric - np.asarray(jacobian)[:, :, column]).max()
        assert error < 1e-8, f"column {column}: off by {error:.1e} m per unit"
    move = np.random.default_rng(1).normal(0, 1, state["template"].shape)
    wanted = posed(arrays, state, template=state["template"] + move) - posed(arrays, state)
    np.testing.assert_allclose(np.einsum("vab,vb->va", rotations, move), wanted, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0099, 0.0101, 1.0, 3.0])
def test_rotations_are_exact_and_smooth_through_zero(angle: float) -> None:
    setup_jax()
    vector = jax.numpy.asarray(angle * np.array([[0.48, -0.6, 0.64]]))
    np.testing.assert_allclose(
        rotation_matrices(vector)[0], Rotation.from_rotvec(np.array(vector[0])).as_matrix(), atol=1e-13
    )
    derivative = jax.jacfwd(lambda v: rotation_matrices(v)[0])(vector)[:, :, 0]
    assert np.isfinite(derivative).all()
    # dR R^T is the cross matrix of the left Jacobian's column.
    spin = np.einsum("abe,cb->ace", derivative, rotation_matrices(vector)[0])
    axes = np.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
    np.testing.assert_allclose(left_jacobians(vector)[0], axes, atol=1e-10)


def test_a_mirrored_pose_gives_the_mirrored_body(model: BodyModel, arrays: SkinningArrays) -> None:
    from scipy.spatial import cKDTree

    flip = np.array([-1.0, 1.0, 1.0])
    _, partner = cKDTree(model.template).query(model.template * flip)
    pose = np.random.default_rng(2).normal(0, 0.4, (24, 3))
    mirrored = pose[MIRROR] * [1, -1, -1]
    joints, zero = model.joint_regressor @ model.template, np.zeros(3)
    one = np.asarray(skin(arrays, model.template, joints, pose, zero))
    other = np.asarray(skin(arrays, model.template, joints, mirrored, zero))
    np.testing.assert_allclose(other[partner] * flip, one, atol=1e-6)


@pytest.mark.parametrize(
    ("joint", "turn"),
    [
        ("left_elbow", (0, -1.57, 0)),
        ("left_knee", (1.57, 0, 0)),
        ("left_hip", (-1.4, 0, 0)),
        ("left_shoulder", (0, 0, -1.2)),
    ],
)
def test_correctives_keep_volume(
    model: BodyModel, arrays: SkinningArrays, joint: str, turn: tuple[float, float, float]
) -> None:
    pose = np.zeros((24, 3))
    pose[JOINT[joint]] = turn
    joints = model.joint_regressor @ model.template
    rest = volume_m3(model.template, model.faces)
    bent = volume_m3(np.asarray(skin(arrays, model.template, joints, pose, np.zeros(3))), model.faces)
    plain, _ = blend_linearly(
        model.template, model.weights, world_from_rest(axis_angle_to_matrix(pose), joints)
    )
    lost, lost_plain = abs(bent - rest) / rest, abs(volume_m3(plain, model.faces) - rest) / rest
    assert lost < 0.01, f"{joint}: {100 * lost:.2f} % of the volume"
    # A hip with a narrow ramp loses next to nothing in the mean body; correctives serve thin and heavy too.
    assert lost < max(lost_plain, 0.002)


def test_parents_come_first() -> None:
    assert all(parent < j for j, parent in enumerate(PARENTS))
