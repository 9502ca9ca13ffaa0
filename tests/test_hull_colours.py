"""Colours of a hull: what the cameras that see a place agree on, and nothing from those that do not."""

from __future__ import annotations

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout
from hull.colours import vertex_colours
from hull.visual_hull import Hull, build_hull
from tests.hull_subjects import Balls

RIG = dome_layout(14, (256, 256))
SUBJECT = Balls(np.array([[0, 0, 1.2], [0.42, 0, 1.0]]), np.array([0.3, 0.1]))


def _paint(points: np.ndarray) -> np.ndarray:
    """(N 3) RGB: the large ball red in front (y < 0), green behind; the small one blue."""
    small = np.linalg.norm(points - SUBJECT.centres[1], axis=1) < 0.12
    large = np.where(points[:, [1]] < 0, [220, 40, 30], [30, 190, 60])
    return np.where(small[:, None], [20, 30, 230], large).astype(np.uint8)


def _picture(camera: Camera) -> np.ndarray:
    """(h w 3) what the camera sees: the nearest ball's paint before white."""
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    eye, rays = camera.rays(pixels)
    nearest = np.full(len(rays), np.inf)
    for centre, radius in zip(SUBJECT.centres, SUBJECT.radii, strict=True):
        along = rays @ (centre - eye)
        room = radius**2 - ((centre - eye) @ (centre - eye) - along**2)
        hit = room > 0
        nearest[hit] = np.minimum(nearest[hit], along[hit] - np.sqrt(room[hit]))
    picture = np.full((len(rays), 3), 255, dtype=np.uint8)
    seen = np.isfinite(nearest)
    picture[seen] = _paint(eye + nearest[seen, None] * rays[seen])
    return picture.reshape(height, width, 3)


@pytest.fixture(scope="module")
def hull() -> Hull:
    return build_hull(RIG, SUBJECT.silhouettes(RIG), 0.016)


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return [_picture(camera) for camera in RIG]


def _close(found: np.ndarray | None, hull: Hull) -> np.ndarray:
    assert found is not None
    return np.abs(found.astype(int) - _paint(hull.vertices)).max(axis=1) < 40


def _away_from_seams(hull: Hull) -> np.ndarray:
    """Vertices farther than 3 cm from where the paint changes."""
    small = np.linalg.norm(hull.vertices - SUBJECT.centres[1], axis=1)
    return (np.abs(hull.vertices[:, 1]) > 0.03) & (np.abs(small - 0.12) > 0.03) | (small < 0.09)


def test_the_paint_of_a_subject_comes_back(hull: Hull, pictures: list[np.ndarray]) -> None:
    found = vertex_colours(hull.vertices, hull.faces, hull.normals, RIG.cameras, pictures.__getitem__)
    clear = _away_from_seams(hull)
    assert clear.sum() > 500
    assert _close(found, hull)[clear].mean() > 0.98


def test_a_camera_that_lies_is_outvoted(hull: Hull, pictures: list[np.ndarray]) -> None:
    wrong = list(pictures)
    wrong[3] = np.zeros_like(wrong[3])
    wrong[3][..., 0] = 255
    found = vertex_colours(hull.vertices, hull.faces, hull.normals, RIG.cameras, wrong.__getitem__)
    assert _close(found, hull)[_away_from_seams(hull)].mean() > 0.95


def test_what_no_camera_sees_takes_its_neighbours_colour(hull: Hull, pictures: list[np.ndarray]) -> None:
    front = {k: p for k, p in enumerate(pictures) if RIG[k].centre[1] < 0}
    found = vertex_colours(hull.vertices, hull.faces, hull.normals, RIG.cameras, front.get)
    assert found is not None
    before = hull.vertices[:, 1] < -0.05
    assert _close(found, hull)[before & _away_from_seams(hull)].mean() > 0.98
    assert (np.abs(found.astype(int) - 128).max(axis=1) > 30).mean() > 0.95, "the back must not stay grey"


def test_without_pictures_there_are_no_colours(hull: Hull) -> None:
    assert vertex_colours(hull.vertices, hull.faces, hull.normals, RIG.cameras, lambda k: None) is None
