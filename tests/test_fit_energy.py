"""Every residual's weight and gradient against finite differences; the point terms' shapes."""

import numpy as np
import pytest

from fit import energy as terms
from fit.closest import closest_points
from fit.normal_equations import MeshPattern, accumulate, edge_laplacian


def octahedron(subdivisions: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere from a subdivided octahedron, outward oriented."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(subdivisions):
        corners = vertices[faces]
        middle = 0.5 * (corners + np.roll(corners, -1, axis=1))
        quads = np.concatenate(
            [
                np.stack([corners[:, 0], middle[:, 0], middle[:, 2]], 1),
                np.stack([corners[:, 1], middle[:, 1], middle[:, 0]], 1),
                np.stack([corners[:, 2], middle[:, 2], middle[:, 1]], 1),
                middle,
            ]
        ).reshape(-1, 3)
        vertices, inverse = np.unique(np.round(quads, 12), axis=0, return_inverse=True)
        faces = inverse.reshape(-1, 3)
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, faces


@pytest.mark.parametrize(
    "term",
    [
        lambda d: terms.geman_mcclure(d, 0.05),
        lambda d: terms.huber(d, 0.006),
        lambda d: terms.outside(d, 0.006),
        lambda d: terms.fit(d, 0.02),
        lambda d: terms.skin(d, 0.05),
    ],
)
def test_weight_is_half_the_slope_over_the_distance(term):
    d = np.array([-0.08, -0.02, -0.004, -0.001, 0.0015, 0.004, 0.03, 0.2])
    h = 1e-7
    slope = (term(d + h)[0] - term(d - h)[0]) / (2 * h)
    np.testing.assert_allclose(term(d)[1] * 2 * d, slope, rtol=1e-5, atol=1e-8)


def test_robust_terms_are_bounded_and_quadratic_near_zero():
    sigma = 0.02
    energy, _ = terms.geman_mcclure(np.array([1e-5, 10.0]), sigma)
    assert energy[0] == pytest.approx(1e-10, rel=1e-5)
    assert energy[1] == pytest.approx(sigma**2, rel=1e-4)


def test_outside_only_penalises_points_inside_the_body():
    energy, weight = terms.outside(np.array([-0.01, 0.01]), 0.006)
    assert energy[0] > 0 and weight[0] > 0
    assert energy[1] == 0 and weight[1] == 0


def test_coupling_ignores_translation_and_matches_the_edge_sum():
    vertices, faces = octahedron()
    laplacian = edge_laplacian(faces, len(vertices), np.ones(len(vertices)))
    rng = np.random.default_rng(0)
    difference = rng.normal(size=vertices.shape)
    shifted, _ = terms.coupling(difference + np.array([3.0, -2.0, 1.0]), laplacian)
    energy, half_gradient = terms.coupling(difference, laplacian)
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0
    )
    assert energy == pytest.approx(((difference[edges[:, 0]] - difference[edges[:, 1]]) ** 2).sum())
    assert shifted == pytest.approx(energy)
    h = 1e-6
    bumped = difference.copy()
    bumped[7, 1] += h
    slope = (terms.coupling(bumped, laplacian)[0] - energy) / h
    assert 2 * half_gradient[7, 1] == pytest.approx(slope, rel=1e-4)


def test_normal_equations_predict_the_gradient_of_the_data_term():
    vertices, faces = octahedron()
    rng = np.random.default_rng(1)
    points = rng.normal(size=(400, 3))
    points *= (1 + 0.1 * rng.normal(size=(400, 1))) / np.linalg.norm(points, axis=1, keepdims=True)

    def energy(v: np.ndarray) -> float:
        return float((closest_points(v, faces, points).distance ** 2).sum())

    closest = closest_points(vertices, faces, points)
    hessian, rhs = accumulate(MeshPattern.of(faces, len(vertices)), faces, closest, np.ones(len(points)))
    assert abs(hessian - hessian.T).max() < 1e-12
    for vertex, axis in ((0, 0), (11, 1), (30, 2)):
        h = 1e-5
        up, down = vertices.copy(), vertices.copy()
        up[vertex, axis] += h
        down[vertex, axis] -= h
        slope = (energy(up) - energy(down)) / (2 * h)
        # rhs is minus half the gradient
        assert -2 * rhs[vertex, axis] == pytest.approx(slope, rel=2e-3, abs=2e-4)


def test_one_gauss_newton_step_brings_the_surface_to_the_points():
    vertices, faces = octahedron(3)
    points = 1.05 * vertices
    closest = closest_points(vertices, faces, points)
    pattern = MeshPattern.of(faces, len(vertices))
    hessian, rhs = accumulate(pattern, faces, closest, np.ones(len(points)))
    from scipy.sparse import identity
    from scipy.sparse.linalg import spsolve

    step = spsolve((hessian + 1e-9 * identity(hessian.shape[0])).tocsc(), rhs.ravel()).reshape(-1, 3)
    after = closest_points(vertices + step, faces, points).distance
    assert np.abs(after).max() < 0.1 * np.abs(closest.distance).max()
