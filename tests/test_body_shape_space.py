"""The shape space beyond measured people: named places move where their names say, the rest is smooth."""

from pathlib import Path

import numpy as np
import pytest

from fit.body import BodyModel, load_body
from fit.body.local_variation import COMPONENTS
from fit.body.marks import COCO_17, bare_skin, coco_landmarks, marks_of, shape_names
from fit.body.parts import BODY_25, region_mask, region_of_vertices
from fit.body.skeleton import JOINT
from fit.body.smooth_variation import SPREAD_M
from fit.surface import vertex_areas, vertex_normals

N_LOCAL = len(COMPONENTS)


@pytest.fixture(scope="module", params=["neutral", "female", "male"])
def body(request: pytest.FixtureRequest) -> BodyModel:
    return load_body(f"free:{request.param}", show_progress=False)


def component(body: BodyModel, name: str) -> np.ndarray:
    return body.shape_directions[:, :, shape_names(body).index(name)]


def smooth(body: BodyModel) -> np.ndarray:
    return body.shape_directions[:, :, body.n_anthropometric + N_LOCAL :]


def partner_of(body: BodyModel) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(body.template).query(body.template * [-1.0, 1.0, 1.0])[1]


def test_smooth_components_leave_hands_feet_and_face_alone(body: BodyModel) -> None:
    still = region_mask(body.parts, "hand", "foot")
    face = (body.parts == JOINT["head"]) & (body.template[:, 2] > 0.06)
    size = np.linalg.norm(smooth(body), axis=1)
    assert (size[region_mask(body.parts, "torso", "arm", "leg")].max(0) > 5e-4).all()
    assert size[face].max() < 1e-3
    assert np.median(size[still]) < 1e-4


def test_smooth_components_move_along_the_normal_the_strongest_first(body: BodyModel) -> None:
    area, normals = vertex_areas(body.template, body.faces), vertex_normals(body.template, body.faces)
    bumps = smooth(body)
    along = np.einsum("va,vak->vk", normals, bumps)
    np.testing.assert_allclose(np.linalg.norm(bumps, axis=1), np.abs(along), atol=1e-8)
    variance = (area[:, None] * along**2).sum(0) / area.sum()
    assert (np.diff(variance) < 1e-3 * variance[0]).all()
    # Truncation and what the named components took leave less than the whole process, but most of it.
    assert 0.4 * SPREAD_M < np.sqrt(variance.sum()) < 1.1 * SPREAD_M


def test_smooth_components_say_nothing_that_the_others_say(body: BodyModel) -> None:
    area, normals = vertex_areas(body.template, body.faces), vertex_normals(body.template, body.faces)
    along = np.sqrt(area)[:, None] * np.einsum("va,vak->vk", normals, body.shape_directions)
    along /= np.linalg.norm(along, axis=0)
    known, new = np.split(along, [body.n_anthropometric + N_LOCAL], axis=1)
    assert np.abs(known.T @ new).max() < 1e-3
    assert np.abs(new.T @ new - np.eye(new.shape[1])).max() < 0.01


@pytest.mark.parametrize(
    ("name", "region", "ahead", "height"),
    [
        ("belly", "torso", 1, (0.55, 0.68)),
        ("chest", "torso", 1, (0.68, 0.80)),
        ("buttock", "torso leg", -1, (0.44, 0.58)),
        ("upper back", "torso", -1, (0.70, 0.85)),
        ("thigh front", "leg", 1, (0.32, 0.46)),
        ("calf", "leg", -1, (0.14, 0.26)),
    ],
)
def test_a_named_component_is_strongest_at_its_place(
    body: BodyModel, name: str, region: str, ahead: int, height: tuple[float, float]
) -> None:
    size = np.linalg.norm(component(body, name), axis=1)
    peak = int(size.argmax())
    floor, stature = body.template[:, 1].min(), np.ptp(body.template[:, 1])
    assert region_of_vertices(body)[peak] in region.split()
    assert np.sign(body.template[peak, 2]) == ahead
    assert height[0] < (body.template[peak, 1] - floor) / stature < height[1]
    # Half a metre away nothing moves.
    far = np.linalg.norm(body.template * [0, 1, 1] - body.template[peak] * [0, 1, 1], axis=1) > 0.5
    assert size[far].max() < 0.02 * size[peak]


def test_sloping_shoulders_carry_arms_and_joints_along(body: BodyModel) -> None:
    moved = component(body, "shoulder slope")
    hands = moved[region_mask(body.parts, "hand")]
    np.testing.assert_allclose(hands, np.broadcast_to(hands[0], hands.shape), atol=1e-5)
    joints = body.joint_regressor @ moved
    assert joints[JOINT["left_wrist"], 1] == pytest.approx(hands[0, 1], abs=1e-4)
    assert joints[JOINT["left_shoulder"], 1] == pytest.approx(hands[0, 1], rel=0.4)
    assert np.abs(joints[[JOINT[n] for n in ("pelvis", "left_knee", "spine1", "head")]]).max() < 1e-3


def test_asymmetry_is_odd_and_everything_else_that_has_a_name_is_even(body: BodyModel) -> None:
    partner, flip = partner_of(body), np.array([-1.0, 1.0, 1.0])
    for name in COMPONENTS:
        moved = component(body, name)
        seen = moved[partner] * flip
        sign = -1 if " left " in f"{name} " else 1
        assert np.abs(seen - sign * moved).max() < 1e-6, name


def test_random_people_stay_people(body: BodyModel) -> None:
    rng = np.random.default_rng(8)
    for _ in range(5):
        shaped = body.shaped(rng.standard_normal(body.n_betas))
        before, after = (vertex_normals(v, body.faces) for v in (body.template, shaped))
        assert ((before * after).sum(1) > 0).mean() > 0.998
        assert 1.3 < np.ptp(shaped[:, 1]) < 2.2


def test_coco_points_are_the_same_places_as_body_25_s(body: BodyModel) -> None:
    points = dict(zip(COCO_17, coco_landmarks(body) @ body.template, strict=True))
    for name, where in points.items():
        same = (body.landmarks @ body.template)[BODY_25.index(name)]
        np.testing.assert_allclose(where, same, atol=1e-12)  # the order of a BLAS's sums may differ
    assert points["left_ankle"][1] < points["left_knee"][1] < points["left_hip"][1] < points["nose"][1]


def test_bare_skin_is_hands_and_face(body: BodyModel) -> None:
    bare = bare_skin(body)
    regions = region_of_vertices(body)
    assert set(regions[bare]) == {"hand", "head"}
    assert bare[regions == "hand"].all()
    crown = body.template[:, 1].argmax()
    nape = np.flatnonzero(regions == "head")[body.template[regions == "head", 2].argmin()]
    assert not bare[crown] and not bare[nape]
    area = vertex_areas(body.template, body.faces)
    assert 0.04 < area[bare].sum() / area.sum() < 0.12
    np.testing.assert_array_equal(bare, bare[partner_of(body)])


def test_a_saved_body_carries_its_marks(body: BodyModel, tmp_path: Path) -> None:
    body.save(tmp_path / "body.npz")
    with np.load(tmp_path / "body.npz", allow_pickle=False) as stored:
        for key, array in marks_of(body).items():
            np.testing.assert_array_equal(stored[key], array, err_msg=key)
        assert len(stored["shape_names"]) == body.n_betas == len(set(stored["shape_names"].tolist()))
        starts, names = stored["girth_starts"], stored["girth_names"].tolist()
        first = slice(*starts[names.index("waist") : names.index("waist") + 2])
        edges, shares = stored["girth_edges"][first], stored["girth_shares"][first, None]
    corners = body.template[edges[:, 0]] * (1 - shares) + body.template[edges[:, 1]] * shares
    around = np.linalg.norm(np.roll(corners, -1, 0) - corners, axis=1).sum()
    assert 0.6 < around < 1.2
