"""How true the surface is: on the exact cones to a third of a pixel, and as large as closed forms say."""

from __future__ import annotations

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout, look_at
from capture.rig import Rig
from hull.bounds import Bounds
from hull.quality import contour_distance, mask_distance, silhouette_agreement
from hull.rays import RayScene
from hull.visual_hull import build_hull
from tests.hull_subjects import Balls, ball, figure

FAR_M = 200.0
CENTRE = np.array([0.02, -0.03, 1.0])


def _over_the_cones(subject: Balls, points: np.ndarray, rig: Rig) -> np.ndarray:
    """(N,) metres by which the worst camera's ray through each point passes the subject; negative: inside."""
    worst = np.full(len(points), -np.inf)
    for camera in rig:
        ray = points - camera.centre
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        passes = np.full(len(points), np.inf)
        for centre, radius in zip(subject.centres, subject.radii, strict=True):
            across = centre - camera.centre - (ray @ (centre - camera.centre))[:, None] * ray
            passes = np.minimum(passes, np.linalg.norm(across, axis=1) - radius)
        worst = np.maximum(worst, passes)
    return worst


def _far_ring(n_cameras: int, side_px: int = 400, first_angle: float = 0.1) -> Rig:
    """Cameras with parallel rays, level with CENTRE, whose pictures are a metre wide."""
    focal, middle = side_px * FAR_M, (side_px - 1) / 2
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    cameras = []
    for k in range(n_cameras):
        angle = 2 * np.pi * k / n_cameras + first_angle
        eye = CENTRE + FAR_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        pose = look_at(eye, CENTRE, np.array([0, 0, 1.0]))
        cameras.append(Camera(f"cam{k}", (side_px, side_px), intrinsics, pose, np.zeros(0)))
    return Rig(tuple(cameras))


def _seen(rig: Rig, vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    scene = RayScene(vertices, faces)
    return [np.where(scene.mask(camera), 255, 0).astype(np.uint8) for camera in rig]


AROUND = Bounds(CENTRE - 0.47, CENTRE + 0.47)


@pytest.mark.parametrize("voxel_m", [0.016, 0.008])
def test_vertices_lie_on_the_exact_cones_to_a_third_of_a_pixel(voxel_m: float) -> None:
    rig, subject = dome_layout(16, (640, 640)), figure()
    images = subject.silhouettes(rig)
    hull = build_hull(rig, images, voxel_m)
    off = np.abs(_over_the_cones(subject, hull.vertices, rig))
    pixel = np.min(
        [np.linalg.norm(hull.vertices - c.centre, axis=1) / c.intrinsics[0, 0] for c in rig], axis=0
    )
    assert np.median(off / pixel) < 0.35
    assert np.percentile(off / pixel, 95) < 0.8
    assert silhouette_agreement(hull.vertices, hull.faces, rig, images).min() > 0.985
    assert contour_distance(hull.vertices, hull.faces, rig, images).max() < 0.3


@pytest.mark.parametrize("n_cameras", [3, 5, 8])
def test_a_ball_in_a_ring_has_the_volume_of_its_cylinders(n_cameras: int) -> None:
    """Parallel rays at the ball's height: the hull is where the cylinders around all the lines of sight meet.

    At height z it is a regular polygon around a circle of radius r = sqrt(R^2 - z^2), with m sides (m the
    number of different lines of tangents: 2 n for odd n, n for even n), so its volume is
    m tan(pi / m) * integral of r^2 = m tan(pi / m) * 4/3 R^3, and the mean area surplus m tan(pi / m) / pi.
    """
    radius = 0.3
    rig = _far_ring(n_cameras)
    hull = build_hull(rig, ball(radius, tuple(CENTRE)).silhouettes(rig), 0.012, AROUND)
    m = n_cameras if n_cameras % 2 == 0 else 2 * n_cameras
    exact = m * np.tan(np.pi / m) * 4 / 3 * radius**3
    assert hull.volume_m3 == pytest.approx(exact, rel=0.004), f"{hull.volume_m3 / exact - 1:+.4f}"
    corner = np.hypot(*(hull.vertices - CENTRE)[:, :2].T).max()
    assert corner == pytest.approx(radius / np.cos(np.pi / m), abs=0.005)


def test_an_upright_cylinder_is_a_prism_of_the_right_volume() -> None:
    """Seen level, its top is seen edge on: the hull is the polygon around the circle times the height."""
    radius, height, n = 0.2, 0.6, 7
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(400)])
    half = np.array([0, 0, height / 2])
    low, high = CENTRE - half, CENTRE + half
    vertices = np.concatenate([ring + low, ring + high, [low, high]])
    i, j = np.arange(400), (np.arange(400) + 1) % 400
    faces = np.concatenate(
        [
            np.column_stack([i, j, i + 400]),
            np.column_stack([j, j + 400, i + 400]),
            np.column_stack([j, i, np.full(400, 800)]),
            np.column_stack([i + 400, j + 400, np.full(400, 801)]),
        ]
    )
    rig = _far_ring(n)
    hull = build_hull(rig, _seen(rig, vertices, faces), 0.012, AROUND)
    exact = 2 * n * np.tan(np.pi / (2 * n)) * radius**2 * height
    assert hull.volume_m3 == pytest.approx(exact, rel=0.01), f"{hull.volume_m3 / exact - 1:+.4f}"


def test_a_box_seen_along_its_sides_comes_back_as_it_is() -> None:
    """Two pairs of cameras that look straight at the sides of a box: their cones meet in the box itself."""
    size = np.array([0.3, 0.22, 0.5])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    vertices = corners * size / 2 + CENTRE
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])
    rig = _far_ring(4, first_angle=0.0)
    images = _seen(rig, vertices, faces)
    errors = []
    for voxel_m in (0.024, 0.012, 0.006):
        hull = build_hull(rig, images, voxel_m, AROUND)
        assert np.abs(np.abs(hull.vertices - CENTRE).max(axis=0) - size / 2).max() < 0.0025  # a pixel
        errors.append(abs(hull.volume_m3 / size.prod() - 1))
    assert errors[-1] < 0.01, errors
    assert errors[-1] < errors[0], "a finer grid must come nearer"


def test_normals_on_a_ball_are_true_and_no_sliver_upsets_them() -> None:
    rig, subject = dome_layout(40, (512, 512)), ball()
    hull = build_hull(rig, subject.silhouettes(rig), 0.016)
    true = hull.vertices - subject.centres[0]
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    error = np.rad2deg(np.arccos(np.clip((true * hull.normals).sum(axis=1), -1, 1)))
    assert np.median(error) < 4
    assert np.percentile(error, 99) < 12
    assert error.max() < 30


def test_the_distance_of_outlines() -> None:
    known = np.ones((60, 80), dtype=bool)
    one, other = np.zeros_like(known), np.zeros_like(known)
    one[20:40, 20:60] = True
    other[20:40, 23:63] = True  # three columns to the right: the short sides are 3 px off, the long ones 0
    assert mask_distance(one, one, known) == 0.0
    sides, ends = 40 * 2, 20 * 2
    # Of the long sides, the three pixels beyond the other's end are 1, 2, 3 px from it (less at its corner).
    assert mask_distance(one, other, known) == pytest.approx(3 * ends / (sides + ends), rel=0.12)
    half = known.copy()
    half[:, 30:] = False
    assert mask_distance(one, other, half) == mask_distance(other, one, half)
    assert mask_distance(one, other, half) < 3
    assert np.isnan(mask_distance(one, one, np.zeros_like(known)))
    assert mask_distance(one, np.zeros_like(one), known) == 100.0
