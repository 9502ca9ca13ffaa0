"""Closest points: exact on triangles, edges and vertices; the sign tells inside from outside."""

import numpy as np
import pytest

from fit.closest import barycentric_of_closest, closest_points
from tests.test_fit_energy import octahedron


def test_barycentric_of_closest_against_brute_force():
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(200, 3, 3))
    points = 2 * rng.normal(size=(200, 3))
    bary = barycentric_of_closest(corners, points)
    assert (bary >= -1e-12).all()
    np.testing.assert_allclose(bary.sum(1), 1.0, atol=1e-12)
    found = np.linalg.norm(np.einsum("nc,nca->na", bary, corners) - points, axis=1)
    steps = np.linspace(0, 1, 61)
    u, v = (g.ravel() for g in np.meshgrid(steps, steps))
    inside = u + v <= 1 + 1e-12
    samples = np.stack([1 - u - v, u, v], 1)[inside]
    grid = np.einsum("sc,nca->nsa", samples, corners)
    brute = np.linalg.norm(grid - points[:, None], axis=2).min(1)
    assert (found <= brute + 1e-9).all()
    assert (brute - found).max() < 0.1


@pytest.mark.parametrize("radius, sign", [(0.6, -1.0), (1.5, 1.0)])
def test_sign_and_distance_on_a_sphere(radius, sign):
    vertices, faces = octahedron(4)
    rng = np.random.default_rng(2)
    points = rng.normal(size=(300, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    closest = closest_points(vertices, faces, points)
    np.testing.assert_allclose(closest.distance, sign * abs(radius - 1), atol=4e-3)
    # the direction always points out of the body
    assert ((closest.direction * points).sum(1) > 0).all()


def test_points_on_the_surface_use_the_normal():
    vertices, faces = octahedron(3)
    closest = closest_points(vertices, faces, vertices)
    assert np.abs(closest.distance).max() < 1e-6
    np.testing.assert_allclose((closest.direction * vertices).sum(1), 1.0, atol=5e-3)
