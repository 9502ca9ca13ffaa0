"""A closed surface covers the same pixels by its contour as by a ray through every pixel."""

from __future__ import annotations

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout
from capture.rig import Rig
from hull.coverage import Coverage, NotClosedError
from hull.quality import projected_mask, silhouette_agreement
from hull.rays import RayScene
from hull.visual_hull import Hull, build_hull
from tests.hull_subjects import Balls, figure


@pytest.fixture(scope="module")
def scene() -> tuple[Rig, Hull]:
    rig = dome_layout(10, (400, 300))
    return rig, build_hull(rig, figure().silhouettes(rig), 0.016)


def _scaled(camera: Camera, factor: float) -> Camera:
    scale = np.diag([factor, factor, 1.0])
    return Camera(
        camera.name, camera.size, scale @ camera.intrinsics, camera.camera_from_world, camera.distortion
    )


@pytest.mark.parametrize("factor", [1.0, 4.0, 0.02])
def test_the_contour_covers_what_the_rays_cover(scene: tuple[Rig, Hull], factor: float) -> None:
    """Also where the picture cuts the surface, and where it is a dozen pixels large."""
    rig, hull = scene
    coverage, rays = Coverage(hull.vertices, hull.faces), RayScene(hull.vertices, hull.faces)
    for camera in rig:
        near = _scaled(camera, factor)
        by_contour, by_rays = coverage.mask(near), rays.mask(near)
        assert by_contour is not None
        assert by_contour.any() or factor > 1
        assert (by_contour != by_rays).sum() <= 1, "rays are single precision: one pixel may differ"


def test_layers_pieces_and_hollows_are_covered_once(scene: tuple[Rig, Hull]) -> None:
    """Two balls behind each other, far from the origin; a body in front of itself."""
    rig, hull = scene
    shift = np.array([300.0, -200.0, 40.0])
    vertices = np.concatenate([hull.vertices, 0.5 * hull.vertices + [0.3, 0.2, 0.4]]) + shift
    faces = np.concatenate([hull.faces, hull.faces + len(hull.vertices)])
    pose = np.eye(4)
    pose[:3, 3] = -shift
    for camera in rig.cameras[:4]:
        there = Camera(
            camera.name, camera.size, camera.intrinsics, camera.camera_from_world @ pose, np.zeros(0)
        )
        by_contour = Coverage(vertices, faces).mask(there)
        assert (by_contour != RayScene(vertices, faces).mask(there)).sum() <= 2


def test_an_open_surface_is_refused_and_seen_by_rays(scene: tuple[Rig, Hull]) -> None:
    rig, hull = scene
    with pytest.raises(NotClosedError, match="the surface is not closed"):
        Coverage(hull.vertices, hull.faces[1:])
    with pytest.raises(NotClosedError):
        Coverage(hull.vertices, np.concatenate([hull.faces, hull.faces]))
    open_one = projected_mask(hull.vertices, hull.faces[:-1], rig[0])
    assert (open_one != projected_mask(hull.vertices, hull.faces, rig[0])).sum() < 5


def test_a_surface_around_the_camera_has_no_contour_but_a_picture(scene: tuple[Rig, Hull]) -> None:
    rig, hull = scene
    camera = rig[0]
    vertices = hull.vertices - hull.vertices.mean(axis=0) + camera.centre
    assert Coverage(vertices, hull.faces).mask(camera) is None
    assert projected_mask(vertices, hull.faces, camera).shape == (300, 400)


def test_the_agreement_counts_unknown_pixels_nowhere() -> None:
    rig = dome_layout(6, (200, 200))
    subject = Balls(np.array([[0, 0, 1.0]]), np.array([0.4]))
    images = subject.silhouettes(rig)
    hull = build_hull(rig, images, 0.02)
    full = silhouette_agreement(hull.vertices, hull.faces, rig, images)
    images[2][:100] = 128
    part = silhouette_agreement(hull.vertices, hull.faces, rig, images)
    covered = projected_mask(hull.vertices, hull.faces, rig[2])[100:]
    person = images[2][100:] > 128
    assert part[2] == pytest.approx((covered & person).sum() / (covered | person).sum(), abs=1e-12)
    assert (np.delete(part, 2) == np.delete(full, 2)).all()
