"""Head, hands and feet: relief on the skin, the mesh's lines and sizes, proportions, people without folds."""

import itertools

import numpy as np
import pytest
from jaxtyping import Float, Int

from fit.body import half_mesh
from fit.body.anatomy import make_person
from fit.body.anthropometry import Measurements, measure, n_scores
from fit.body.build import load_or_build
from fit.body.correspondence import Carrier
from fit.body.foot import foot_of
from fit.body.hand import hand_of
from fit.body.head import feature_lines, head_of, mouth_line
from fit.body.implicit import Ellipsoid, ImplicitBody
from fit.body.implicit_relief import Bump, Opening, Relief, Ridge, arcs_of
from fit.body.parts import BODY_25
from fit.body.plan import plan
from fit.body.remesh import SEAM_TOLERANCE_M
from fit.body.skeleton import JOINT
from fit.surface import vertex_normals

Mesh = tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]
PEOPLE = [(0.0, 17.0), (0.0, 25.0), (0.0, 40.0), (1.0, 18.0), (1.0, 26.0), (1.0, 40.0), (0.5, 25.0)]


@pytest.fixture(scope="module")
def half() -> Mesh:
    load_or_build("neutral", show_progress=False)
    return half_mesh.load_half_mesh()


@pytest.fixture(scope="module")
def carrier(half: Mesh) -> Carrier:
    return Carrier(*half, make_person(measure(0.5))[0])


def foremost(v: Float[np.ndarray, "v 3"], near: np.ndarray) -> float:
    """Largest z of the vertices that are marked."""
    return float(v[near, 2].max())


# Relief


def test_a_bump_raises_the_skin_by_its_height() -> None:
    body = ImplicitBody()
    body.add(Ellipsoid((0.2, 0, 0), (0.1, 0.1, 0.1), 0.01))
    body.add(Relief([Bump((0.2, 0, 0.1), (0.02, 0.02, 0.05), 0.004)]))
    on_top, aside = body.project(np.array([[0.2, 0, 0.09], [0.2, 0.1, 0.01]]), np.zeros(2, bool), steps=12)
    # The hill falls off slowly along z, so its foot at 0.104 is a little lower than at 0.100.
    assert on_top[2] == pytest.approx(0.1 + 0.004 * np.exp(-0.5 * (0.004 / 0.05) ** 2), abs=2e-6)
    assert np.linalg.norm(aside - [0.2, 0, 0]) == pytest.approx(0.1, abs=1e-6)


def test_relief_sums_its_forms_as_written() -> None:
    rng = np.random.default_rng(0)
    p = rng.uniform(-0.1, 0.1, (200, 3))
    bump = Bump((0.01, 0.02, -0.03), (0.02, 0.03, 0.05), 0.002)
    line = np.array([[-0.05, 0, 0], [0.01, 0.02, 0.01], [0.06, -0.01, 0.03]])
    ridge = Ridge(line, 0.02, -0.003, depth=0.25)
    metric = np.array([1, 1, 0.25])
    dense = np.concatenate([np.linspace(a, b, 20001) for a, b in itertools.pairwise(line)]) * metric
    away = np.array([np.linalg.norm(dense - q, axis=1).min() for q in p * metric])
    wanted = 0.002 * np.exp(-0.5 * (((p - bump.centre) / bump.sigma_m) ** 2).sum(1))
    wanted += -0.003 * np.exp(-0.5 * (away / 0.02) ** 2)
    np.testing.assert_allclose(Relief([bump, ridge]).distance(p), -wanted, atol=1e-9)


def test_an_opening_sinks_the_inside_of_its_arcs_and_nothing_else() -> None:
    opening = Opening(np.array([[0.0, 0, 0], [0.03, 0.002, -0.004]]), 0.006, 0.004, 0.002, 0.002)
    relief = Relief([opening])
    upper, lower = arcs_of(opening, n=21)
    np.testing.assert_allclose(relief.distance(np.concatenate([upper, lower])), 0, atol=1e-9)
    np.testing.assert_allclose(upper[[0, -1]], opening.corners, atol=1e-12)
    assert relief.distance(0.5 * (upper[10:11] + lower[10:11]))[0] == pytest.approx(0.002)
    assert (relief.distance(upper[1:-1] + np.array([0, 0.001, 0])) == 0).all()


# The mesh


def test_the_half_mesh_closes_to_a_sphere_of_good_triangles(half: Mesh) -> None:
    v, f, _ = half_mesh.mirror(*half)
    assert (len(v), len(f)) == (6890, 13776)
    edges = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert len(v) - len(unique) + len(f) == 2  # no bridge between two fingers or toes
    side = v[np.roll(f, -1, axis=1)] - v[f]
    side /= np.linalg.norm(side, axis=2, keepdims=True)
    angle = np.degrees(np.arccos(-(side * np.roll(side, 1, axis=1)).sum(2)))
    assert angle.min() > 20
    valence = np.bincount(f.ravel())
    assert ((valence >= 5) & (valence <= 7)).mean() > 0.99


def test_edges_are_short_where_detail_is(half: Mesh) -> None:
    b = plan(measure(0.5))
    head, hand = head_of(b), hand_of(b)
    v, f = half
    edges = np.unique(np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1), axis=0)
    length = np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1)
    middle = 0.5 * (v[edges[:, 0]] + v[edges[:, 1]])

    def mean_near(place: np.ndarray, radius_m: float) -> float:
        return float(length[np.linalg.norm(middle - place, axis=1) < radius_m].mean())

    assert mean_near(head.at(0.0315, 0.494, 0.08), 0.015) < 0.0055
    assert mean_near(head.at(0.0, 0.2, 0.1), 0.015) < 0.0055
    assert mean_near(hand.tips()[1], 0.012) < 0.0075
    trunk = (middle[:, 0] < 0.12) & (middle[:, 1] > 0.9) & (middle[:, 1] < 1.3)
    assert 0.020 < length[trunk].mean() < 0.026


def test_vertices_lie_along_lids_and_lips(half: Mesh) -> None:
    head = head_of(plan(measure(0.5)))
    v = half[0][half[0][:, 2] > 0.05]
    for line in feature_lines(head):
        fine = np.concatenate([np.linspace(a, b, 60) for a, b in itertools.pairwise(line)])
        away = np.linalg.norm(v[:, None, :2] - fine[None, :, :2], axis=2)
        on_line = away.min(1) < 4e-4
        reached = away[on_line].min(0)  # how far each point of the line is from a vertex on it
        assert on_line.sum() >= 5
        assert reached.max() < 0.006


# Proportions


@pytest.mark.parametrize(("sex", "bmi"), PEOPLE)
def test_the_face_follows_the_canon(carrier: Carrier, sex: float, bmi: float) -> None:
    person = measure(sex, bmi=bmi)
    v = carrier(make_person(person)[0])
    head = head_of(plan(person))
    fraction = (v[:, 1] - head.chin) / head.height
    on_head = (v[:, 0] < 0.15) & (fraction > 0)
    assert fraction[on_head].max() == pytest.approx(1.0, abs=0.012)
    nose = np.flatnonzero(on_head)[v[on_head, 2].argmax()]
    assert v[nose, 0] == 0
    assert 0.31 < fraction[nose] < 0.38
    above_neck = on_head & (fraction > 0.25)
    ear = np.flatnonzero(above_neck)[v[above_neck, 0].argmax()]
    assert 0.40 < fraction[ear] < 0.60
    middle = on_head & (v[:, 0] == 0)
    # Down the midline: forehead, a hollow at the nose's root, the nose, its base, lips with a line, chin.
    brow, tip = foremost(v, middle & (abs(fraction - 0.60) < 0.03)), float(v[nose, 2])
    root = v[middle & (abs(fraction - 0.53) < 0.03) & (v[:, 2] > 0), 2].min()
    base = v[middle & (abs(fraction - 0.265) < 0.02) & (v[:, 2] > 0), 2].min()
    line_fraction = (mouth_line(head)[0, 1] - head.chin) / head.height
    line = v[middle & (abs(fraction - line_fraction) < 0.009) & (v[:, 2] > 0), 2].min()
    upper = foremost(v, middle & (fraction > line_fraction + 0.01) & (fraction < 0.245))
    lower = foremost(v, middle & (fraction < line_fraction - 0.01) & (fraction > 0.15))
    assert tip > brow + 0.012
    assert tip > root + 0.020
    assert tip > base + 0.008
    assert min(upper, lower) > line + 0.0008


@pytest.mark.parametrize(("sex", "bmi"), PEOPLE)
def test_the_sole_is_flat_and_its_arch_hollow(half: Mesh, carrier: Carrier, sex: float, bmi: float) -> None:
    person = measure(sex, bmi=bmi)
    v = carrier(make_person(person)[0])
    foot = foot_of(plan(person))
    sideways = foot.at(0.0, 1.0, 0.0) - foot.heel
    along = (v - foot.heel) @ foot.forward / foot.length
    side = (v - foot.heel) @ sideways / (sideways @ sideways)
    facing_down = (v[:, 1] < 0.03) & (vertex_normals(v, half[1])[:, 1] < -0.95)
    heel = facing_down & (along > 0.06) & (along < 0.20)
    ball = facing_down & (along > 0.62) & (along < 0.74) & (abs(side) < 0.030)  # its rim is round
    arch = (v[:, 1] < 0.03) & (along > 0.36) & (along < 0.5) & (side < -0.012) & (side > -0.026)
    assert heel.sum() >= 3
    assert ball.sum() > 5
    assert np.abs(v[heel | ball, 1]).max() < 0.0025
    assert v[arch, 1].max() > 0.008
    assert v[:, 1].min() > -0.002
    assert along[v[:, 1] < 0.10].max() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("sex", "bmi"), PEOPLE)
def test_fingers_reach_as_far_as_the_hand_is_long(carrier: Carrier, sex: float, bmi: float) -> None:
    person = measure(sex, bmi=bmi)
    v = carrier(make_person(person)[0])
    hand = hand_of(plan(person))
    assert v[:, 0].max() - hand.wrist[0] == pytest.approx(hand.length, abs=0.006)
    for tip in hand.tips():
        assert 0.004 < np.linalg.norm(v - tip, axis=1).min() < 0.010  # skin around every fingertip's centre


def test_the_sexes_differ_in_the_face(carrier: Carrier) -> None:
    profile = {}
    for sex in (0.0, 1.0):
        person = measure(sex, bmi=24.0)
        v = carrier(make_person(person)[0])
        head = head_of(plan(person))
        fraction = (v[:, 1] - head.chin) / head.height
        middle = (v[:, 0] == 0) & (v[:, 2] > 0.05)
        order = np.flatnonzero(middle)[np.argsort(fraction[middle])]
        forehead, brow = np.interp([0.76, 0.60], fraction[order], v[order, 2])
        profile[sex] = (brow - forehead) / head.length
    assert profile[1.0] > profile[0.0] + 0.002  # men: a brow ridge and a forehead that falls back


def test_a_heavy_face_is_wider_at_the_cheeks() -> None:
    def half_width(bmi: float) -> float:
        person = measure(0.0, bmi=bmi)
        body, head = make_person(person)[0], head_of(plan(person))
        x = np.linspace(0.02, 0.12, 400)
        line = head.at(0.0, 0.24, 0.02) + x[:, None] * [1, 0, 0]
        return float(x[(body(line) < 0).nonzero()[0].max()])

    assert half_width(38.0) > 1.08 * half_width(20.0)


# People


def drawn(idx: int) -> Measurements:
    rng = np.random.default_rng(idx)
    return measure(float(idx % 2), np.clip(rng.normal(0, 1.3, n_scores()), -2.5, 2.5))


@pytest.mark.parametrize("idx", range(6))
def test_nobody_s_head_hands_or_feet_fold(half: Mesh, carrier: Carrier, idx: int) -> None:
    o3d = pytest.importorskip("open3d")
    person = drawn(idx)
    body, joints = make_person(person)
    carried = carrier(body)
    v, f, _ = half_mesh.mirror(carried, half[1])
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(v), o3d.utility.Vector3iVector(f))
    crossing = np.asarray(mesh.get_self_intersecting_triangles()).reshape(-1, 2)
    where = v[f[crossing].reshape(-1, 6)].mean(1)
    out = (
        (where[:, 1] > person.stature - person.head_height)
        | (np.abs(where[:, 0]) > joints[JOINT["left_wrist"], 0])
        | (where[:, 1] < 0.12)
    )
    assert not out.any(), f"crossing triangles at {where[out][:5].round(3).tolist()}"
    # No swimming: every place of the head keeps facing where it faced on the template.
    before, after = vertex_normals(*half), vertex_normals(carried, half[1])
    chin = head_of(plan(measure(0.5))).chin
    on_head = (half[0][:, 1] > chin + 0.01) & (half[0][:, 0] < 0.15) & (half[0][:, 0] > SEAM_TOLERANCE_M)
    agreement = (before * after).sum(1)[on_head]
    assert (agreement > 0.6).mean() > 0.99
    assert np.abs(body(carried[on_head])).max() < 0.006


@pytest.mark.parametrize("sex_name", ["neutral", "female", "male"])
def test_face_landmarks_sit_on_the_features(sex_name: str) -> None:
    body = load_or_build(sex_name, show_progress=False)
    sex = {"neutral": 0.5, "female": 0.0, "male": 1.0}[sex_name]
    b = plan(measure(sex))
    head = head_of(b)
    shift = (body.joint_regressor @ body.template)[JOINT["head"]] - b.joint("head")
    points = dict(zip(BODY_25, body.landmarks @ body.template - shift, strict=True))
    assert np.linalg.norm(points["nose"] - head.at(0.0, 0.345, 0.1165)) < 0.008
    assert np.linalg.norm(points["left_eye"] - head.at(0.0315, 0.494, 0.0820)) < 0.010
    assert np.linalg.norm((points["left_ear"] - head.at(0.078, 0.440, -0.006))[:2]) < 0.014
    toes, heel = points["left_big_toe"], points["left_heel"]
    assert np.linalg.norm((toes - heel)[[0, 2]]) > 0.85 * b.m.foot_length
