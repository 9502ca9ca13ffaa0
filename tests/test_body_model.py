"""The free body keeps its promises, and body files round-trip or say what is wrong with them."""

import ast
import hashlib
from pathlib import Path

import numpy as np
import pytest

from fit.body import BodyModel, BodyModelError, load_body
from fit.body.parts import BODY_25, REGIONS, region_mask, region_of_vertices
from fit.body.skeleton import JOINT, MIRROR, PARENTS
from fit.body.tape import volume_m3


def signature(body: BodyModel) -> tuple[float, ...]:
    """One number an array: its product with a fixed wave, which any change of an entry changes."""
    arrays = (body.template, body.shape_directions, body.pose_directions, body.weights, body.joint_regressor)
    return tuple(float(a.ravel() @ np.sin(0.7 * np.arange(a.size) + 0.3)) for a in arrays)


SIGNATURES: dict[str, tuple[float, ...]] = {
    "neutral": (-0.70204, -0.75186, 0.03373, 46.79093, 0.49551),
    "female": (-0.84839, -0.64285, -0.15557, 48.20472, 0.40824),
    "male": (-0.56128, -0.34026, -0.35731, 45.56139, -0.2112),
}


@pytest.fixture(scope="module", params=["neutral", "female", "male"])
def body(request: pytest.FixtureRequest) -> BodyModel:
    return load_body(f"free:{request.param}", show_progress=False)


def small_body(**changes: np.ndarray) -> dict[str, np.ndarray]:
    """Arrays of the neutral body under SMPL's keys, as somebody else's file might hold them."""
    body = load_body("free:neutral", show_progress=False)
    arrays = {
        "v_template": body.template.astype(np.float32),
        "f": body.faces.astype(np.uint32),
        "shapedirs": body.shape_directions[:, :, :10].astype(np.float32),
        "posedirs": body.pose_directions.astype(np.float32),
        "weights": body.weights.astype(np.float32),
        "J_regressor": body.joint_regressor.astype(np.float32),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)], dtype=np.uint32),
    }
    return {**arrays, **changes}


def test_it_has_smpl_s_structure(body: BodyModel) -> None:
    assert body.template.shape == (6890, 3)
    assert body.faces.shape == (13776, 3)
    assert tuple(body.parents) == PARENTS
    assert body.pose_directions.shape == (6890, 3, 207)
    assert body.n_betas > body.n_anthropometric >= 16
    assert body.licence == "CC0-1.0"
    assert body.template.dtype == np.float64


def test_its_mesh_is_closed_manifold_and_oriented_outwards(body: BodyModel) -> None:
    directed = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    edges, count = np.unique(np.sort(directed, 1), axis=0, return_counts=True)
    assert (count == 2).all()
    assert 6890 - len(edges) + len(body.faces) == 2
    assert 0.05 < volume_m3(body.template, body.faces) < 0.10


def test_left_and_right_are_mirror_images(body: BodyModel) -> None:
    from scipy.spatial import cKDTree

    flip = np.array([-1.0, 1.0, 1.0])
    distance, partner = cKDTree(body.template).query(body.template * flip)
    assert distance.max() < 1e-8
    np.testing.assert_allclose(body.weights[partner][:, MIRROR], body.weights, atol=1e-9)
    anthropometric = body.shape_directions[:, :, : body.n_anthropometric]
    np.testing.assert_allclose(anthropometric[partner] * flip[:, None], anthropometric, atol=1e-8)
    bumps = body.shape_directions[:, :, body.n_anthropometric :]
    seen = bumps[partner] * flip[:, None]
    even, odd = np.abs(seen - bumps).max((0, 1)), np.abs(seen + bumps).max((0, 1))
    assert np.minimum(even, odd).max() < 1e-6
    joints = body.joint_regressor @ body.template
    np.testing.assert_allclose(joints[MIRROR] * flip, joints, atol=1e-8)


def test_weights_and_regressor_are_convex_and_sparse(body: BodyModel) -> None:
    for rows in (body.weights, body.joint_regressor, body.landmarks):
        np.testing.assert_allclose(rows.sum(1), 1, atol=1e-9)
        assert rows.min() >= 0
    assert (body.weights > 0).sum(1).max() <= 4
    assert (body.joint_regressor > 0).sum(1).max() < 400


def test_joints_lie_inside_the_body_and_the_pelvis_at_the_origin(body: BodyModel) -> None:
    joints = body.joint_regressor @ body.template
    assert np.linalg.norm(joints[0]) < 0.01
    down, up = body.template[:, 1].min(), body.template[:, 1].max()
    share = (joints[:, 1] - down) / (up - down)
    for name, low, high in (
        ("left_ankle", 0.03, 0.07),
        ("left_knee", 0.25, 0.30),
        ("left_hip", 0.48, 0.54),
        ("head", 0.85, 0.90),
    ):
        assert low < share[JOINT[name]] < high, f"{name} at {share[JOINT[name]]:.3f} of stature"


def test_every_vertex_has_a_part_and_a_region(body: BodyModel) -> None:
    regions = region_of_vertices(body)
    assert set(regions) == set(REGIONS)
    assert set(body.parts) == set(range(24))
    assert (region_mask(body.parts, "arm") == (regions == "arm")).all()


def test_landmarks_are_where_their_names_say(body: BodyModel) -> None:
    points = dict(zip(BODY_25, body.landmarks @ body.template, strict=True))
    assert points["left_wrist"][0] > points["left_elbow"][0] > points["left_shoulder"][0] > 0.1
    assert points["nose"][2] > points["left_eye"][2] > points["left_ear"][2]
    assert points["left_ear"][0] > points["left_eye"][0] > 0.02
    assert points["left_eye"][1] > points["nose"][1]
    assert points["left_heel"][2] < points["left_ankle"][2] < points["left_small_toe"][2]
    assert points["left_big_toe"][2] > points["left_small_toe"][2]
    assert points["left_small_toe"][0] > points["left_big_toe"][0]
    for left in (name for name in BODY_25 if name.startswith("left_")):
        right = left.replace("left_", "right_")
        np.testing.assert_allclose(points[right] * [-1, 1, 1], points[left], atol=0.004)


def test_saving_and_loading_changes_nothing(body: BodyModel, tmp_path: Path) -> None:
    body.save(tmp_path / "body.npz")
    again = BodyModel.load(tmp_path / "body.npz")
    assert again.content_hash == body.content_hash
    assert (again.name, again.licence, again.n_anthropometric) == (
        body.name,
        body.licence,
        body.n_anthropometric,
    )
    np.testing.assert_array_equal(again.landmarks, body.landmarks)
    assert [p.name for p in tmp_path.iterdir()] == ["body.npz"]


def test_the_three_sexes_share_one_mesh_and_differ() -> None:
    bodies = [load_body(f"free:{sex}", show_progress=False) for sex in ("neutral", "female", "male")]
    assert all((b.faces == bodies[0].faces).all() for b in bodies)
    assert len({b.content_hash for b in bodies}) == 3
    assert len({b.name for b in bodies}) == 3


def test_the_shipped_mesh_is_the_one_that_is_known_and_lies_on_the_average_body() -> None:
    """A changed anatomy needs `python -m fit.body.half_mesh`; a changed numbering breaks saved fits."""
    from fit.body.anatomy import make_person
    from fit.body.anthropometry import measure
    from fit.body.half_mesh import load_half_mesh

    vertices, faces = load_half_mesh()
    digest = hashlib.sha256(vertices.tobytes() + faces.tobytes()).hexdigest()
    assert digest[:16] == "94b0c9329ace7191"
    assert np.abs(make_person(measure(0.5))[0](vertices)).max() < 1e-4


@pytest.mark.parametrize(("sex", "known"), SIGNATURES.items())
def test_the_built_bodies_are_the_ones_that_are_known(sex: str, known: tuple[float, ...]) -> None:
    """Every array against the one this version was released with, up to the last bits of a linear algebra
    library (a hash of all bits would tell processors apart)."""
    np.testing.assert_allclose(signature(load_body(f"free:{sex}", show_progress=False)), known, atol=2e-4)


def test_the_cache_key_covers_every_source_that_the_build_imports() -> None:
    """A source left out would leave an old body in the cache after it has changed."""
    from fit.body import build as build_module

    reading = {"model.py"}  # a body's file is read and written by these, not shaped
    folder = Path(build_module.__file__).parent
    seen, waiting = set(), {"build.py"}
    while waiting:
        name = waiting.pop()
        seen.add(name)
        for node in ast.walk(ast.parse((folder / name).read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom):
                continue
            if node.level == 1:
                modules = [node.module] if node.module else [alias.name for alias in node.names]
            elif node.module and node.module.startswith("fit.") and not node.module.startswith("fit.body"):
                modules = [f"../{node.module.removeprefix('fit.')}"]
            else:
                continue
            waiting |= {f"{module}.py" for module in modules} - seen - reading
    assert seen <= set(build_module.GENERATOR), f"not in the key: {seen - set(build_module.GENERATOR)}"


def test_building_is_deterministic() -> None:
    from fit.body.build import build
    from fit.body.half_mesh import load_half_mesh

    first, second = (build(*load_half_mesh(), "female", n_people=130) for _ in range(2))
    assert first.content_hash == second.content_hash


def test_a_damaged_cache_is_built_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fit.body import build as build_module

    wanted = load_body("free:neutral", show_progress=False)
    calls = []

    def quick(*arguments: object, **_: object) -> BodyModel:
        calls.append(arguments)
        return wanted

    monkeypatch.setattr(build_module, "build", quick)
    (tmp_path / "neutral.npz").write_bytes(b"half a file")
    build_module.load_or_build("neutral", show_progress=False, folder=tmp_path)
    assert len(calls) == 1
    again = build_module.load_or_build("neutral", show_progress=False, folder=tmp_path)
    assert len(calls) == 1
    assert again.content_hash == wanted.content_hash


def test_a_file_with_smpl_s_keys_alone_gets_parts_and_landmarks(tmp_path: Path) -> None:
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **small_body())
    body = load_body(tmp_path / "SMPL_NEUTRAL.npz")
    free = load_body("free:neutral", show_progress=False)
    assert body.name == "SMPL_NEUTRAL"
    assert body.parents[0] == -1
    assert body.template.dtype == np.float64
    assert (body.n_betas, body.n_anthropometric) == (10, 10)
    assert (body.parts == free.parts).mean() > 0.999
    np.testing.assert_allclose(body.landmarks @ body.template, free.landmarks @ free.template, atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"posedirs": np.zeros((6890, 3, 100))}, r"posedirs has shape \(6890, 3, 100\), expected"),
        ({"weights": np.zeros((6890, 20))}, r"weights has shape \(6890, 20\), expected \(6890, 24\)"),
        ({"J_regressor": np.zeros((24, 10))}, r"J_regressor has shape \(24, 10\), expected \(24, 6890\)"),
        ({"weights": np.zeros((6890, 24))}, r"skinning weights of vertex 0 sum to 0.0000, not 1"),
        ({"f": np.full((4, 3), 7000)}, r"faces name vertices from 7000 to 7000, but there are 6890"),
        ({"f": np.zeros((0, 3))}, r"there are 6890 vertices and 0 faces"),
        (
            {"v_template": np.full((6890, 3), np.nan)},
            r"v_template holds values that are not finite",
        ),
        (
            {"v_template": np.zeros(6890)},
            r"v_template is an array of shape \(6890,\).*expected numbers with 2",
        ),
        ({"kintree_table": np.zeros((2, 52))}, r"kintree_table has 52 joints in another order than SMPL-H's"),
        ({"kintree_table": np.zeros((2, 24))}, r"kintree_table has 24 joints in another order than SMPL's"),
    ],
)
def test_a_wrong_array_is_named(tmp_path: Path, changes: dict[str, np.ndarray], message: str) -> None:
    np.savez(tmp_path / "wrong.npz", **small_body(**changes))
    with pytest.raises(BodyModelError, match=message):
        BodyModel.load(tmp_path / "wrong.npz")


def test_a_missing_key_is_named_with_what_was_found(tmp_path: Path) -> None:
    arrays = small_body()
    del arrays["posedirs"]
    np.savez(tmp_path / "partial.npz", **arrays)
    with pytest.raises(
        BodyModelError, match=r"partial\.npz: no posedirs in this body file \(found: J_regressor"
    ):
        BodyModel.load(tmp_path / "partial.npz")


def test_unreadable_and_absent_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 not the rest")
    with pytest.raises(BodyModelError, match=r"cut\.npz: not a readable \.npz .*Copy or download"):
        BodyModel.load(tmp_path / "cut.npz")
    with pytest.raises(BodyModelError, match=r"nowhere\.npz: no such body file\. Use free:neutral"):
        load_body(tmp_path / "nowhere.npz")
    (tmp_path / "basic.obj").write_bytes(b"")
    with pytest.raises(
        BodyModelError, match=r"basic\.obj: body files are read as \.npz or \.pkl, this is \.obj"
    ):
        load_body(tmp_path / "basic.obj")
    with pytest.raises(BodyModelError, match="there is no such free body"):
        load_body("free:child")


def test_fewer_betas_can_be_kept() -> None:
    body = load_body("free:neutral", show_progress=False)
    plain = body.with_betas(body.n_anthropometric)
    assert plain.n_betas == plain.n_anthropometric == body.n_anthropometric
    betas = np.random.default_rng(0).standard_normal(plain.n_betas)
    np.testing.assert_allclose(plain.shaped(betas), body.shaped(betas), atol=1e-12)
