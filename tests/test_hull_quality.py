"""The measures of a hull's quality, against shapes whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from capture.layouts import dome_layout
from capture.rig import Rig
from hull.errors import HullError
from hull.quality import projected_mask, share_outside, signed_distance, silhouette_agreement
from hull.visual_hull import Hull, build_hull
from tests.hull_subjects import figure

RIG = dome_layout(12, (256, 256))


def _box() -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for x in (-0.2, 0.2) for y in (-0.3, 0.3) for z in (0.5, 1.5)], dtype=float)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners, np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])


def test_a_box_projects_to_the_hull_of_its_corners() -> None:
    """A pixel is covered exactly when its centre lies in the convex polygon of the projected corners."""
    from scipy.spatial import ConvexHull

    vertices, faces = _box()
    for camera in RIG:
        pixels, _ = camera.project(vertices)
        polygon = ConvexHull(pixels)
        grid = np.stack(np.meshgrid(np.arange(256.0), np.arange(256.0)), axis=-1)
        depth = (grid @ polygon.equations[:, :2].T + polygon.equations[:, 2]).max(axis=-1)
        mask = projected_mask(vertices, faces, camera)
        assert (mask == (depth < 0))[np.abs(depth) > 1e-3].all()
        assert mask.sum() > 500


def test_a_shape_agrees_with_its_own_projection_and_shifts_cost() -> None:
    vertices, faces = _box()
    images: list = [np.where(projected_mask(vertices, faces, c), 255, 0).astype(np.uint8) for c in RIG]
    assert (silhouette_agreement(vertices, faces, RIG, images) == 1.0).all()
    assert silhouette_agreement(vertices + np.array([0.05, 0, 0]), faces, RIG, images).max() < 0.99
    images[0] = np.roll(images[0], 10, axis=1)
    images[1] = None
    images[2][:, :] = 128
    images[3][:128] = 128  # unknown pixels count neither for nor against
    scores = silhouette_agreement(vertices, faces, RIG, images)
    assert scores[0] < 0.8
    assert np.isnan(scores[1:3]).all()
    assert (scores[3:] == 1.0).all()


def test_an_agreement_of_zero_is_not_an_absence_of_evidence() -> None:
    vertices, faces = _box()
    nobody = [np.zeros((256, 256), dtype=np.uint8)] * len(RIG)
    assert (silhouette_agreement(vertices, faces, RIG, nobody) == 0.0).all()
    away = silhouette_agreement(vertices + np.array([50.0, 0, 0]), faces, RIG, nobody)
    assert np.isnan(away).sum() > 6, "where neither shows in the picture there is nothing to agree on"


def test_sizes_are_checked() -> None:
    vertices, faces = _box()
    with pytest.raises(HullError, match="12 cameras but 1 silhouettes"):
        silhouette_agreement(vertices, faces, RIG, [None])
    wrong = [np.zeros((10, 10), dtype=np.uint8)] + [None] * 11
    with pytest.raises(
        HullError, match=rf"camera {RIG[0].name}: its silhouette is \(10, 10\), expected \(256, 256\)"
    ):
        silhouette_agreement(vertices, faces, RIG, wrong)


def test_signed_distance_and_share_outside_of_a_box() -> None:
    vertices, faces = _box()
    points = np.array([[0, 0, 1.0], [0.25, 0, 1], [0, 0.29, 1], [0, 0, 1.52], [3, 0, 1]])
    expected = [-0.2, 0.05, -0.01, 0.02, 2.8]
    assert signed_distance(points, vertices, faces) == pytest.approx(expected, abs=1e-5)
    far = np.array([1000.0, -500, 200])
    assert signed_distance(points + far, vertices + far, faces) == pytest.approx(expected, abs=1e-5)
    hull = Hull.of_mesh(vertices, faces)
    assert share_outside(points, hull) == 0.6
    assert share_outside(points, hull, tolerance_m=0.03) == 0.4


def test_the_rig_of_a_part_of_the_cameras() -> None:
    """Evidence is optional camera by camera, for bounds, hull and measures alike."""
    images: list = figure().silhouettes(RIG)
    some = [image if i % 3 else None for i, image in enumerate(images)]
    hull = build_hull(RIG, some, 0.02)
    same = build_hull(
        Rig(tuple(c for i, c in enumerate(RIG) if i % 3)), [i for i in some if i is not None], 0.02
    )
    assert np.array_equal(hull.vertices, same.vertices)
    assert np.array_equal(hull.faces, same.faces)
    assert np.isnan(silhouette_agreement(hull.vertices, hull.faces, RIG, some)).sum() == 4
