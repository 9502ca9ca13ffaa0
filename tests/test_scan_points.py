"""A scan drawn from a hull: all cloth, even in area, the same for the same seed, on the surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hull.scan import Scan, even_samples, trust
from hull.visual_hull import Hull


def _sphere(n: int = 48) -> Hull:
    """A ball of radius 0.3 with very uneven faces: long slivers at the poles, wide ones at the equator."""
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, n)[1:-1], np.linspace(0, 2 * np.pi, 2 * n, endpoint=False)
    )
    ring = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    rows, columns = ring.shape[:2]
    vertices = 0.3 * np.concatenate([ring.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    faces = []
    for i in range(rows):
        j = (i + 1) % rows
        faces.append([i * columns, j * columns, rows * columns])
        faces.append([i * columns + columns - 1, rows * columns + 1, j * columns + columns - 1])
        for k in range(columns - 1):
            a, b = i * columns + k, j * columns + k
            faces += [[a, a + 1, b], [b, a + 1, b + 1]]
    table = np.array(faces)
    return Hull.of_mesh(vertices, table)


def test_all_cloth_with_unit_weights_and_normals() -> None:
    scan = Scan.from_hull(_sphere(), 5000, seed=3)
    assert scan.points.shape == scan.normals.shape == (5000, 3)
    assert scan.faces is None
    assert not scan.is_skin.any()
    assert (scan.weight == 1).all()
    assert np.abs(np.linalg.norm(scan.normals, axis=1) - 1).max() < 1e-12
    radial = scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True)
    assert np.einsum("ni,ni->n", radial, scan.normals).min() > 0.99


def test_the_same_seed_gives_the_same_points() -> None:
    hull = _sphere()
    one, two, other = (Scan.from_hull(hull, 1000, seed=s) for s in (7, 7, 8))
    assert np.array_equal(one.points, two.points)
    assert np.array_equal(one.normals, two.normals)
    assert not np.array_equal(one.points, other.points)


def test_even_in_area() -> None:
    """On a ball the area is uniform in height (Archimedes): compare with slices of equal height."""
    points = Scan.from_hull(_sphere(), 40000, seed=0).points
    count, _ = np.histogram(points[:, 2], bins=20, range=(-0.3, 0.3))
    assert count == pytest.approx(np.full(20, 2000), rel=0.06)
    assert points.mean(axis=0) == pytest.approx(np.zeros(3), abs=0.003)


def test_each_face_gets_its_share() -> None:
    """Stratified: the number of points on a face differs from its share of the area by less than two."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0], [0, 3, 0], [1, 3, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [2, 4, 5]])
    area = np.array([0.5, 0.5, 1.0])
    face_idx, barycentric = even_samples(vertices, faces, 999, seed=1)
    assert np.abs(np.bincount(face_idx) - 999 * area / area.sum()).max() < 2
    assert barycentric.min() >= 0
    assert barycentric.sum(axis=1) == pytest.approx(1)
    # 250 and 500 points: the mean's own spread is 0.015.
    middle = [barycentric[face_idx == f].mean(axis=0) for f in range(3)]
    assert np.array(middle) == pytest.approx(1 / 3, abs=0.06)


def test_without_a_number_the_scan_is_the_mesh_itself() -> None:
    hull = _sphere(12)
    scan = Scan.from_hull(hull, None)
    assert scan.points is hull.vertices
    assert scan.faces is hull.faces
    assert len(scan.is_skin) == len(scan.weight) == len(hull.vertices)


def test_a_hull_from_many_cameras_counts_evenly() -> None:
    slack = np.random.default_rng(0).uniform(0.002, 0.05, 500)
    assert (trust(slack) == 1.0).all()
    assert (trust(np.zeros(10)) == 1.0).all()


def test_in_a_loose_hull_tight_places_count_more() -> None:
    hull = _sphere()
    height = hull.vertices[:, 2]
    hull = replace(hull, slack_m=np.select([height > 0.15, height > -0.05], [0.3, 0.1], 0.05))
    weights = trust(hull.slack_m)
    assert weights[hull.vertices[:, 2] > 0.16].max() < weights[hull.vertices[:, 2] < -0.1].min()
    assert 0.2 <= weights.min() < weights.max() <= 1.5
    scan = Scan.from_hull(hull, 4000, seed=1)
    assert scan.weight.mean() == pytest.approx(1.0)
    assert scan.weight[scan.points[:, 2] > 0.17].mean() < 0.5 * scan.weight[scan.points[:, 2] < -0.05].mean()
