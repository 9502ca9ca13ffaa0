"""The compiled loops of the fit give what the plain definitions give: skinning, closest points, equations."""

import numpy as np
import pytest

from fit.articulation import Articulation, PosedBody
from fit.body.model import BodyModel, load_body
from fit.closest import Container, Depths, closest_points
from fit.mesh_blocks import MeshEdges, sum_over_points
from fit.moving_mesh import MovingMesh
from fit.normal_equations import MeshPattern, accumulate, edge_laplacian
from fit.solver import ScanPoints


@pytest.fixture(scope="module")
def model() -> BodyModel:
    return load_body("free:neutral", show_progress=False)


@pytest.fixture(scope="module")
def random() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def state(model: BodyModel, random: np.random.Generator) -> tuple[np.ndarray, ...]:
    betas = random.normal(size=model.n_betas) * (np.arange(model.n_betas) < 10)
    template = model.template + model.shape_directions @ betas + 1e-3 * random.normal(size=(6890, 3))
    pose = 0.4 * random.normal(size=(24, 3))
    pose[3] = 0.0  # where quotients by the angle would fail
    return template, model.joint_regressor @ template, pose, random.normal(size=3)


@pytest.fixture(scope="module")
def posed(model: BodyModel, state: tuple[np.ndarray, ...]) -> PosedBody:
    return Articulation.of(model).posed(*state)


def test_skinning_and_its_derivatives_are_those_of_the_jax_definition(
    model: BodyModel, state: tuple[np.ndarray, ...], posed: PosedBody
) -> None:
    from fit.body.skinning import SkinningArrays, posed_joints, skin_with_jacobian

    arrays = SkinningArrays.of(model.with_betas(0))
    vertices, rotations, jacobian = map(np.asarray, skin_with_jacobian(arrays, *state))
    np.testing.assert_allclose(posed.vertices, vertices, atol=1e-12)
    np.testing.assert_allclose(posed.rotations, rotations, atol=1e-12)
    np.testing.assert_allclose(posed.jacobian(), jacobian.reshape(3 * 6890, -1), atol=1e-11)
    _, joints, pose, shift = state
    found = posed.articulation.chain(joints, pose).posed_joints + shift
    np.testing.assert_allclose(found, np.asarray(posed_joints(arrays, joints, pose, shift)), atol=1e-12)


def test_moves_and_forces_are_transposes_and_moves_are_the_dense_product(
    posed: PosedBody, random: np.random.Generator
) -> None:
    template, pose, shift, bones = (random.normal(size=s) for s in ((6890, 3), (24, 3), (3,), (24, 3)))
    moves = posed.moved_by(template, pose, shift, bones)
    limbs, weights = posed.articulation, np.zeros((6890, 24))
    np.put_along_axis(weights, limbs.bone_idx, limbs.bone_weight, 1)
    expected = np.einsum("vab,vb->va", posed.rotations, template) + weights @ bones
    expected += (posed.jacobian() @ np.concatenate([pose.ravel(), shift])).reshape(-1, 3)
    np.testing.assert_allclose(moves, expected, atol=1e-11)
    force = random.normal(size=(6890, 3))
    parts = zip(posed.gathered(force), (template, pose, shift, bones), strict=True)
    np.testing.assert_allclose(sum((a * b).sum() for a, b in parts), (force * moves).sum(), rtol=1e-9)


def test_closest_points_are_the_plain_ones_with_any_guess(
    model: BodyModel, posed: PosedBody, random: np.random.Generator
) -> None:
    surface = MovingMesh.of(model.template, model.faces)
    points = posed.vertices[model.faces].mean(1)[::3]
    points = points + 0.02 * random.normal(size=points.shape)
    plain = closest_points(posed.vertices, model.faces, points)
    cold = surface.closest(posed.vertices, points)
    wrong = surface.closest(posed.vertices, points, random.integers(len(model.faces), size=len(points)))
    for found in (cold, wrong):
        # Beside the same place two sheets may be equally near; the distance is the same then.
        np.testing.assert_allclose(np.abs(found.distance), np.abs(plain.distance), atol=1e-6)
        same = np.linalg.norm(found.points - plain.points, axis=1) < 1e-6
        assert same.mean() > 0.995, f"{1 - same.mean():.2%} of the points meet another place"
        np.testing.assert_allclose(found.distance[same], plain.distance[same], atol=1e-6)
        np.testing.assert_allclose(found.normals[same], plain.normals[same], atol=1e-4)
        far = same & (np.abs(plain.distance) > 1e-3)
        np.testing.assert_allclose(found.direction[far], plain.direction[far], atol=2e-3)
    np.testing.assert_allclose(wrong.distance, cold.distance, rtol=1e-9)


def test_small_meshes_and_lone_triangles_have_trees() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    for n in (1, 2, 4):
        points = np.array([[0.2, 0.2, -0.3], [-1.0, -1.0, -1.0]])
        found = MovingMesh.of(vertices, faces[:n]).closest(vertices, points)
        np.testing.assert_allclose(np.abs(found.distance), [0.3, np.sqrt(3.0)], atol=1e-12)


def test_blocks_on_the_mesh_are_the_sparse_matrix(
    model: BodyModel, posed: PosedBody, random: np.random.Generator
) -> None:
    faces = model.faces
    points = posed.vertices[faces].mean(1) + 0.01 * random.normal(size=(len(faces), 3))
    closest = closest_points(posed.vertices, faces, points)
    weight = random.random(len(points)) - 0.2  # some are out of play
    plain, plain_rhs = accumulate(MeshPattern.of(faces, 6890), faces, closest, weight)
    edges = MeshEdges.of(faces, 6890, np.ones(6890))
    matrix, rhs = sum_over_points(edges, closest, weight)
    np.testing.assert_allclose((matrix.sparse - plain).data, 0.0, atol=1e-12)
    np.testing.assert_allclose(rhs, plain_rhs, atol=1e-14)
    moves = random.normal(size=(6890, 3))
    np.testing.assert_allclose((matrix @ moves).ravel(), plain @ moves.ravel(), atol=1e-11)
    np.testing.assert_allclose(matrix.mean_diagonal, plain.diagonal().reshape(-1, 3).mean(1), atol=1e-12)
    depth, direction = random.random(6890), closest.direction[:6890]
    more = matrix.with_vertex_blocks(depth, direction) @ moves - matrix @ moves
    np.testing.assert_allclose(
        more, depth[:, None] * direction * (direction * moves).sum(1)[:, None], atol=1e-12
    )


def test_lumping_bounds_the_data_term_and_keeps_common_moves(
    model: BodyModel, posed: PosedBody, random: np.random.Generator
) -> None:
    points = posed.vertices[model.faces].mean(1)
    surface = MovingMesh.of(model.template, model.faces)
    closest = surface.closest(posed.vertices, points + 0.01 * random.normal(size=points.shape))
    edges = MeshEdges.of(model.faces, 6890, np.ones(6890))
    matrix, _ = sum_over_points(edges, closest, np.ones(len(points)))

    def lumped(moves: np.ndarray) -> float:
        block = matrix.lumped[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        return float(np.einsum("va,vab,vb->", moves, block, moves))

    for _ in range(5):
        moves = random.normal(size=(6890, 3))
        assert lumped(moves) >= (moves * (matrix @ moves)).sum()
    common = np.tile(random.normal(size=3), (6890, 1))
    np.testing.assert_allclose(lumped(common), (common * (matrix @ common)).sum(), rtol=1e-10)
    # And the dense block over pose and translation is J^T H J of the lumped matrix.
    step = np.concatenate([0.1 * random.normal(size=72), random.normal(size=3)])
    moves = (posed.jacobian() @ step).reshape(-1, 3)
    dense = posed.squared(matrix.lumped, with_bones=True)
    np.testing.assert_allclose(step @ dense[:75, :75] @ step, lumped(moves), rtol=1e-10)
    bones = random.normal(size=(24, 3))
    zero = np.zeros((24, 3))
    moves += posed.moved_by(np.zeros((6890, 3)), zero, np.zeros(3), bones)
    both = np.concatenate([step, bones.ravel()])
    np.testing.assert_allclose(both @ dense @ both, lumped(moves), rtol=1e-10)


def test_coupling_on_edges_is_the_laplacian(model: BodyModel, random: np.random.Generator) -> None:
    from fit.compiled_skin import add_coupling

    weight = random.random(6890) + 0.5
    edges = MeshEdges.of(model.faces, 6890, weight)
    laplacian = edge_laplacian(model.faces, 6890, weight)
    difference, out = random.normal(size=(6890, 3)), np.zeros((6890, 3))
    add_coupling(edges.edges, 2.0 * edges.strength, 0.3, difference, out)
    np.testing.assert_allclose(out, 2.0 * (laplacian @ difference) + 0.3 * difference, atol=1e-11)


def test_depths_after_a_move_are_those_of_a_full_search(
    model: BodyModel, random: np.random.Generator
) -> None:
    container = Container.of(1.02 * model.template, model.faces)
    vertices, margin = model.template, 0.0005
    depths = Depths.of(container, vertices)
    for _ in range(4):
        vertices = vertices + 0.004 * random.normal(size=vertices.shape)
        depths = depths.after(vertices, margin)
        full = container.closest(vertices)
        near = full.distance > -margin
        assert 50 < near.sum() < 5000
        np.testing.assert_array_equal(depths.distance[near], full.distance[near])
        np.testing.assert_array_equal(depths.closest.direction[near], full.direction[near])
        assert (depths.distance[~near] <= -margin).all()


def test_sorting_and_drawing_points_keep_what_belongs_together(random: np.random.Generator) -> None:
    points = random.normal(size=(5000, 3))
    scan = ScanPoints(points, -points, points[:, 0], points[:, 1] > 0)
    for found, n in ((scan.cell_by_cell(), 5000), (scan.drawn(500), None), (scan.thinned(500), 500)):
        np.testing.assert_array_equal(found.normals, -found.points)
        np.testing.assert_array_equal(found.weight, found.points[:, 0])
        np.testing.assert_array_equal(found.is_skin, found.points[:, 1] > 0)
        assert len(found.points) == n or 400 < len(found.points) < 600
    np.testing.assert_array_equal(np.sort(scan.cell_by_cell().weight), np.sort(scan.weight))
