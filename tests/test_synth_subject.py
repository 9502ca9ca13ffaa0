"""The synthetic person: a body that the model cannot say exactly, wholly inside its clothes."""

import numpy as np
import open3d as o3d
import pytest

from fit.body import BodyModel, load_body
from fit.body.parts import region_mask
from fit.body.skeleton import axis_angle_to_matrix
from fit.surface import vertex_normals
from render.garments import drape
from render.scene import Surface
from render.subject import BARE, CLOTH, HAIR, SHOE, SubjectError, make_subject
from render.synthetic import UP, perform
from render.wardrobe import OUTFITS

CLOTHED = [name for name in OUTFITS if name != "none"]


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body("free:neutral", show_progress=False)


def ray_scene(surfaces: list[Surface]) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    for surface in surfaces:
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(surface.vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(surface.faces.astype(np.uint32)),
        )
    return scene


def test_the_detail_is_outside_of_the_shape_space_and_as_large_as_asked(body: BodyModel) -> None:
    subject = make_subject(body, 3, "none", detail_m=0.003)
    detail = subject.template - body.shaped(subject.betas)
    space = body.shape_directions.reshape(-1, body.n_betas)
    said = space @ np.linalg.lstsq(space, detail.ravel(), rcond=None)[0]
    assert np.abs(said).max() < 1e-9
    trunk = region_mask(body.parts, "torso", "arm", "leg", "neck")
    size = np.linalg.norm(detail, axis=1)
    assert size[trunk].mean() == pytest.approx(0.003)
    assert size.max() < 0.02
    assert size[region_mask(body.parts, "hand", "foot", "head")].mean() < 0.002
    # smooth: along an edge (two centimetres) the height over the skin changes little; noise would give 1.4
    height = (detail * vertex_normals(body.shaped(subject.betas), body.faces)).sum(1)
    a, b = body.faces[:, 0], body.faces[:, 1]
    assert np.abs(height[a] - height[b]).mean() < 0.5 * np.abs(height).mean()


def test_no_detail_where_none_is_wanted(body: BodyModel) -> None:
    subject = make_subject(body, 3, "none", betas=np.array([1.0, -0.5]), detail_m=0.0)
    assert np.allclose(subject.template, body.shaped(np.array([1.0, -0.5])), atol=1e-12)


def test_people_differ_by_seed_and_only_by_seed(body: BodyModel) -> None:
    one, again, other = (make_subject(body, seed, "loose") for seed in (1, 1, 2))
    assert np.array_equal(one.template, again.template)
    assert np.abs(one.template - other.template).max() > 0.01
    up = np.array([0.0, 1.0, 0.0])
    still = np.zeros_like(one.template)
    for first, second in zip(
        one.dressed(one.template, still, up, 1.0), again.dressed(again.template, still, up, 1.0), strict=True
    ):
        assert np.array_equal(first.vertices, second.vertices)
    naked = make_subject(body, 1, "none")
    assert np.array_equal(naked.template, one.template), "the outfit changed the body"


def test_betas_have_the_model_s_spread(body: BodyModel) -> None:
    n = body.n_anthropometric
    drawn = np.array([make_subject(body, seed, "none").betas for seed in range(60)])
    assert np.abs(drawn).max() <= 2.0
    assert (drawn[:, n:] == 0).all(), "a person is made of measures, the bumps are the fit's own"
    assert 0.75 < drawn[:, :n].std() < 1.0 and abs(drawn[:, :n].mean()) < 0.1


def test_posing_commutes_with_a_turn_of_the_whole_body(body: BodyModel) -> None:
    subject = make_subject(body, 5, "none")
    rng = np.random.default_rng(0)
    pose = rng.normal(0, 0.3, (24, 3))
    pose[0] = 0
    turn, shift = np.array([0.3, -1.1, 0.4]), np.array([0.2, -0.4, 1.0])
    plain = subject.posed(pose, np.zeros(3))
    turned = subject.posed(np.concatenate([turn[None], pose[1:]]), shift)
    matrix = axis_angle_to_matrix(turn[None])[0]
    assert np.allclose(turned, (plain - subject.joints[0]) @ matrix.T + subject.joints[0] + shift, atol=1e-12)
    assert np.allclose(subject.posed(np.zeros((24, 3)), np.zeros(3)), subject.template, atol=1e-12)


@pytest.mark.parametrize("garment", CLOTHED)
def test_the_body_is_inside_its_clothes(garment: str, body: BodyModel) -> None:
    """From covered skin no ray along the normal escapes (a few vertices at hems aside)."""
    subject = make_subject(body, 8, garment)
    performance = perform(subject, "lunge", 3, 8)
    for frame_idx in range(3):
        surfaces = performance.surfaces(frame_idx)
        skin = surfaces[0]
        normals = vertex_normals(skin.vertices, skin.faces)
        for label in (CLOTH, SHOE, HAIR):
            here = subject.covered == label
            if not here.any():
                continue
            rays = np.concatenate([skin.vertices + 2e-4 * normals, normals], 1)[here].astype(np.float32)
            reach = ray_scene(surfaces).cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
            share = (reach > 0.15).mean()
            assert share < 0.01, f"{100 * share:.1f} % of the skin under label {label} lies open"


@pytest.mark.parametrize("garment", CLOTHED)
def test_clothes_are_nowhere_thinner_than_they_say(garment: str, body: BodyModel) -> None:
    subject = make_subject(body, 8, garment)
    performance = perform(subject, "shoulders-mill", 4, 8)
    thinnest = []
    for frame_idx, posed in enumerate(performance.vertices):
        covered = np.zeros(len(posed))
        velocity = np.gradient(performance.vertices, axis=0)[frame_idx]
        for item in subject.garments:
            vertices, covered = drape(item, posed, body.faces, velocity, UP, 0.5 * frame_idx, covered)
            outer = vertices[: len(vertices) - len(item.rim)]
            skin = item.from_body @ posed
            normals = item.from_body @ vertex_normals(posed, body.faces)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            thinnest.append((((outer - skin) * normals).sum(1)).min() - item.cut.least_m)
            assert item.cut.least_m >= 0.0015
    assert min(thinnest) > -1e-9


@pytest.mark.parametrize("garment", ["tshirt-shorts", "loose"])
def test_cloth_touches_and_leaves_the_skin_as_time_goes_on(garment: str, body: BodyModel) -> None:
    subject = make_subject(body, 4, garment)
    performance = perform(subject, "tilt-twist", 8, 4)
    index = len(subject.garments) - 1
    n_outer = subject.garments[index].from_body.shape[0]
    heights = []
    for frame_idx in range(8):
        surfaces = performance.surfaces(frame_idx)
        points = surfaces[1 + index].vertices[:n_outer].astype(np.float32)
        heights.append(ray_scene(surfaces[:1]).compute_distance(o3d.core.Tensor.from_numpy(points)).numpy())
    height = np.array(heights)
    assert 0.008 < height.mean() < 0.035, f"mean {1e3 * height.mean():.1f} mm"
    assert height.max() < 0.12
    assert height.min(0).mean() < 0.75 * height.mean(), "the same places stay far from the skin"
    assert height.std(0).mean() > 0.002


@pytest.mark.parametrize("garment", CLOTHED)
def test_garments_are_closed_down_to_the_skin(garment: str, body: BodyModel) -> None:
    """Every edge has two faces, wound the same way, but for the rim's foot under the skin."""
    for item in make_subject(body, 1, garment).garments:
        n_outer = item.from_body.shape[0]
        edges = np.concatenate([item.faces[:, [0, 1]], item.faces[:, [1, 2]], item.faces[:, [2, 0]]])
        unique, count = np.unique(edges, axis=0, return_counts=True)
        assert (count == 1).all(), f"{item.cut.name}: two faces run along an edge in the same direction"
        there = {tuple(edge) for edge in unique.tolist()}
        open_edges = [e for e in there if (e[1], e[0]) not in there]
        assert all(min(e) >= n_outer for e in open_edges), f"{item.cut.name}: open above the skin"
        assert len(open_edges) == len(item.rim)
        assert np.allclose(item.from_body.sum(1), 1.0)
        assert item.faces.max() == n_outer + len(item.rim) - 1


def test_worn_over_each_other(body: BodyModel) -> None:
    """Where trousers lie under a shirt, the shirt is outside (seen along the body's normals)."""
    subject = make_subject(body, 4, "tshirt-trousers")
    surfaces = perform(subject, "a-t-u", 2, 4).surfaces(1)
    names = [item.cut.name for item in subject.garments]
    shirt, trousers = surfaces[1 + names.index("t-shirt")], surfaces[1 + names.index("trousers")]
    skin = surfaces[0]
    normals = vertex_normals(skin.vertices, skin.faces)
    rays = o3d.core.Tensor.from_numpy(np.concatenate([skin.vertices, normals], 1).astype(np.float32))
    over, under = (ray_scene([s]).cast_rays(rays)["t_hit"].numpy() for s in (shirt, trousers))
    both = (over < 0.1) & (under < 0.1) & (subject.region == "torso")
    assert both.sum() > 100
    assert (over < under)[both].mean() < 0.05


def test_what_covers_what(body: BodyModel) -> None:
    naked, dressed = make_subject(body, 1, "none"), make_subject(body, 1, "tshirt-trousers")
    assert (naked.covered == BARE).all() and naked.garments == ()
    region, covered = dressed.region, dressed.covered
    assert (covered[region == "foot"] == SHOE).mean() > 0.9
    assert (covered[region == "hand"] == BARE).all()
    assert (covered[region == "torso"] == CLOTH).mean() > 0.85
    assert (covered[region == "leg"] == CLOTH).mean() > 0.9
    assert 0.2 < (covered[region == "head"] == HAIR).mean() < 0.8
    bald = make_subject(body, 1, "tshirt-trousers", with_hair=False)
    assert not (bald.covered == HAIR).any() and len(bald.garments) == len(dressed.garments) - 1


def test_an_outfit_that_is_not_there(body: BodyModel) -> None:
    with pytest.raises(
        SubjectError, match="no outfit is called 'toga'; there are: none, tight, tshirt-shorts"
    ):
        make_subject(body, 1, "toga")
