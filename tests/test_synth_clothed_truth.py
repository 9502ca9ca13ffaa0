"""Distances to a dressed person: exact on made shapes, and open garments still hold their inside."""

import numpy as np
import pytest

from fit.body import load_body
from render.clothed import DressedTruth
from render.scene import Surface
from render.subject import make_subject
from render.synthetic import perform


def tube(radius: float, low: float, high: float, n: int = 96, foot_radius: float | None = None) -> Surface:
    """An open cylinder about z, faces outwards; with rims down to `foot_radius` if given."""
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    rows = [(radius, low), (radius, high)]
    if foot_radius is not None:
        rows = [(foot_radius, low), *rows, (foot_radius, high)]
    vertices = np.concatenate([r * ring + [0, 0, z] for r, z in rows])
    faces = []
    for k in range(len(rows) - 1):
        a, b = k * n + np.arange(n), k * n + (np.arange(n) + 1) % n
        faces += [np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n])]
    return Surface(vertices, np.concatenate(faces))


def capped(radius: float, low: float, high: float, n: int = 96) -> Surface:
    sides = tube(radius, low, high, n)
    middle = np.array([[0, 0, low], [0, 0, high]])
    a, b = np.arange(n), (np.arange(n) + 1) % n
    caps = [
        np.column_stack([b, a, np.full(n, 2 * n)]),
        np.column_stack([a + n, b + n, np.full(n, 2 * n + 1)]),
    ]
    return Surface(np.concatenate([sides.vertices, middle]), np.concatenate([sides.faces, *caps]))


def test_a_cylinder_in_a_sleeve() -> None:
    truth = DressedTruth([capped(0.10, -1.0, 1.0), tube(0.15, -0.5, 0.5, foot_radius=0.095)])
    points = np.array(
        [[0.25, 0, 0], [0.13, 0, 0], [0.05, 0, 0], [0.13, 0, 0.6], [0.0, 0.12, -0.55], [0, 0.14, 0.45]]
    )
    expected = np.array([0.10, -0.02, -0.05, 0.03, 0.02, -0.01])
    assert np.abs(truth.signed_distance(points) - expected).max() < 1e-3


def test_places_under_cloth_are_inside_and_places_off_it_outside() -> None:
    person = make_subject(load_body("free:neutral", show_progress=False), 4, "tshirt-trousers")
    dressed = perform(person, "a-t-u", 2, 0).surfaces(0)
    truth = DressedTruth(dressed)
    body = dressed[0]
    for sheet, garment in zip(dressed[1:], person.garments, strict=True):
        n_outer = len(sheet.vertices) - len(garment.rim)
        chosen = np.linspace(0, n_outer - 1, 300).astype(int)
        away = sheet.vertices[chosen] - body.vertices[_nearest(body.vertices, sheet.vertices[chosen])]
        gap = np.linalg.norm(away, axis=1)
        wide = gap > 0.012
        way = away[wide] / gap[wide, None]
        within = truth.signed_distance(sheet.vertices[chosen][wide] - 0.004 * way)
        # Near a hem the way to the body leads past its edge.
        assert (within < 0.001).mean() > 0.9
    far = body.vertices[:200] - np.array([0, 1.5, 0])
    assert (truth.signed_distance(far) > 0.3).all()
    with pytest.raises(IndexError):
        DressedTruth([])


def _nearest(cloud: np.ndarray, points: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(cloud).query(points)[1]
