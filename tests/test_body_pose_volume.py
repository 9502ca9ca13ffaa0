"""Bends keep the volume of the body and of the limb; creases keep their two sides apart."""

import numpy as np
import pytest

from benchmarks.body_pose import (
    BENDS,
    kept_volume,
    pose_of,
    posed,
    segment_of,
    union_volume_m3,
    weight_component,
)
from fit.body import BodyModel, load_body
from fit.body.bends import flesh_bends
from fit.body.flesh import Bone, Flesh, area_vectors
from fit.body.sections import volume_m3
from fit.body.segments import Segment
from fit.body.skeleton import JOINT, axis_angle_to_matrix, blend_linearly, world_from_rest
from fit.surface import vertex_normals


@pytest.fixture(scope="module", params=["neutral", "female", "male"])
def model(request: pytest.FixtureRequest) -> BodyModel:
    return load_body(f"free:{request.param}", show_progress=False)


@pytest.fixture(scope="module")
def rod() -> tuple[np.ndarray, np.ndarray]:
    """A closed round rod along x, 0.6 m long and 0.1 m thick."""
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rings = [
        np.stack([np.full(24, x), 0.05 * np.cos(around), 0.05 * np.sin(around)], 1)
        for x in np.linspace(-0.3, 0.3, 41)
    ]
    vertices = np.concatenate([*rings, [[-0.3, 0, 0], [0.3, 0, 0]]])
    faces = []
    for ring in range(40):
        for k in range(24):
            a, b = 24 * ring + k, 24 * ring + (k + 1) % 24
            faces += [[a, b, b + 24], [a, b + 24, a + 24]]
    for k in range(24):
        faces += [[984, (k + 1) % 24, k], [985, 960 + k, 960 + (k + 1) % 24]]
    return vertices, np.array(faces)


def test_the_mean_body_keeps_its_volume(model: BodyModel) -> None:
    for name, whole, segment in kept_volume(model, np.zeros(model.n_betas)):
        assert abs(whole) < 1, f"{model.name}, {name}: the body's volume changes by {whole:.2f} %"
        assert abs(segment) < 2, f"{model.name}, {name}: the segment's volume changes by {segment:.2f} %"


def test_heavy_and_thin_bodies_keep_it_in_single_bends(model: BodyModel) -> None:
    for step in (-2, 2):
        betas = np.zeros(model.n_betas)
        betas[weight_component(model)] = step
        for (name, whole, _), (*_, parts) in zip(kept_volume(model, betas), BENDS, strict=True):
            if parts:
                assert abs(whole) < 2, f"{model.name} {step:+d} SD, {name}: {whole:.2f} %"


def test_a_straight_pose_changes_no_part(model: BodyModel) -> None:
    for name, _, parts in BENDS:
        segment = segment_of(model, parts)
        rest = segment.volume_m3(model.template)
        assert rest > 0, name
        still = posed(model, model.template, pose_of({}))
        assert segment.volume_m3(still) == pytest.approx(rest, rel=1e-9)


def test_a_side_of_the_trunk_stays_when_an_arm_goes_up(model: BodyModel) -> None:
    """Skin of the side chest a hand's breadth below the armpit moves by less than three centimetres."""
    up = posed(model, model.template, pose_of({"left_collar": (0, 0, 26), "left_shoulder": (0, 0, 62)}))
    joints = model.joint_regressor @ model.template
    shoulder = joints[JOINT["left_shoulder"]]
    below = model.template[:, 1] - shoulder[1]
    side = (below < -0.20) & (below > -0.30) & (model.template[:, 0] > 0)
    side &= model.template[:, 0] < shoulder[0] + 0.05
    assert side.sum() > 20
    moved = np.linalg.norm(up - model.template, axis=1)[side]
    assert moved.max() < 0.03, f"the side chest moves by {1e3 * moved.max():.0f} mm"


def test_an_arm_goes_with_its_own_bones_alone(model: BodyModel) -> None:
    arm = [JOINT[f"left_{name}"] for name in ("shoulder", "elbow", "wrist", "hand")]
    joints = model.joint_regressor @ model.template
    beyond = model.template[:, 0] > joints[JOINT["left_shoulder"], 0] + 0.12
    np.testing.assert_allclose(model.weights[beyond][:, arm].sum(1), 1, atol=1e-6)


def test_a_rod_cut_in_two_gives_two_closed_halves(rod: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = rod
    left, right = (Segment.of(faces, side * vertices[:, 0] < 0.001) for side in (1, -1))
    assert len(left.rims) == len(right.rims) == 1
    whole = Segment.of(faces, np.ones(len(vertices), bool)).volume_m3(vertices)
    assert whole == pytest.approx(volume_m3(vertices, faces), rel=1e-12)
    assert left.volume_m3(vertices) == pytest.approx(whole / 2, rel=1e-9)
    assert right.volume_m3(vertices) == pytest.approx(whole / 2, rel=1e-9)


def test_space_filled_counts_an_overlap_once(rod: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = rod
    one = union_volume_m3(vertices, faces, 0.002)
    assert one == pytest.approx(volume_m3(vertices, faces), rel=0.01)
    both = np.concatenate([faces, faces + len(vertices)])
    moved = np.concatenate([vertices, vertices + np.array([0.3, 0.0, 0.0])])  # half of it inside the first
    assert union_volume_m3(moved, both, 0.002) == pytest.approx(1.5 * one, rel=0.01)


def test_area_vectors_are_the_derivative_of_the_volume(rod: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = rod
    move = np.random.default_rng(0).normal(0, 1e-6, vertices.shape)
    change = volume_m3(vertices + move, faces) - volume_m3(vertices - move, faces)
    assert change == pytest.approx(2 * (area_vectors(vertices, faces) * move).sum(), rel=1e-6)


def test_settled_flesh_rests_turns_rigidly_and_is_not_wrung(rod: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, faces = rod
    joint = np.zeros(3)
    weights = np.zeros((len(vertices), 24))
    share = np.clip(0.5 + vertices[:, 0] / 0.06, 0, 1)
    weights[:, 0], weights[:, 1] = 1 - share, share
    normals = vertex_normals(vertices, faces)
    bones = (
        Bone(np.array([-0.3, 0, 0]), joint, 0),
        Bone(joint, np.array([0.3, 0, 0]), 1),
    )
    flesh = Flesh(vertices, normals, weights, np.ones(len(vertices), bool), bones, 0.015, joint, 0.5)
    rest = np.tile(np.eye(4), (24, 1, 1))
    np.testing.assert_allclose(flesh.posed(rest, np.eye(4)), vertices, atol=1e-9)

    turned = rest.copy()
    turned[:, :3, :3] = axis_angle_to_matrix(np.array([0.3, -0.8, 0.5]))
    turned[:, :3, 3] = [0.1, 0.2, -0.3]
    np.testing.assert_allclose(
        flesh.posed(turned, np.eye(4)), vertices @ turned[0, :3, :3].T + turned[0, :3, 3], atol=1e-6
    )

    wrung = rest.copy()
    wrung[1, :3, :3] = axis_angle_to_matrix(np.array([2.4, 0.0, 0.0]))
    waist = np.abs(vertices[:, 0]) < 0.001
    thickness = np.linalg.norm(flesh.posed(wrung, np.eye(4))[waist, 1:], axis=1)
    linear = np.linalg.norm(blend_linearly(vertices, weights, wrung)[0][waist, 1:], axis=1)
    assert linear.max() < 0.4 * 0.05, "linear skinning wrings the waist"
    assert thickness.min() > 0.8 * 0.05, f"the waist is {1e3 * thickness.min():.0f} of 50 mm"


def test_the_two_sides_of_a_crease_stay_apart() -> None:
    """At 140 degrees no settled skin of the calf lies on the thigh's side of the plane between them."""
    model = load_body("free:neutral", show_progress=False)
    joints = model.joint_regressor @ model.template
    examples = flesh_bends(model.template, model.faces, model.weights, joints)
    bend = examples[JOINT["left_knee"],][-1]
    pose = np.zeros((24, 3))
    pose[JOINT["left_knee"]] = np.radians([70, 0, 0])
    half = world_from_rest(axis_angle_to_matrix(pose), joints)[JOINT["left_knee"]]
    along = joints[JOINT["left_ankle"]] - joints[JOINT["left_knee"]]
    along /= np.linalg.norm(along)
    rest = (model.template[bend.skin] - joints[JOINT["left_knee"]]) @ along
    place = (bend.wanted - joints[JOINT["left_knee"]]) @ (half[:3, :3] @ along)
    near = np.linalg.norm(model.template[bend.skin] - joints[JOINT["left_knee"]], axis=1) < 0.11
    crossing = (np.sign(rest) * place)[near & (np.abs(rest) > 0.03)].min()
    assert crossing > -0.012, f"{-1e3 * crossing:.1f} mm beyond the plane"
