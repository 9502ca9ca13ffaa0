"""Drawings agree with `Camera.project` to a small fraction of a pixel, whatever the camera."""

import dataclasses

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout
from fit.surface import vertex_normals
from render.scene import Light, Renderer, Stage, Surface, clip_from_world

SIZE = (192, 128)


def skewed_camera(offset: np.ndarray | None = None) -> Camera:
    """Skew, unequal focal lengths, an off-centre principal point; given as an exact 3x4 matrix."""
    base = dome_layout(5, SIZE)[2]
    intrinsics = base.intrinsics.copy()
    intrinsics[0, 1], intrinsics[1, 1] = 21.0, 1.15 * intrinsics[0, 0]
    intrinsics[:2, 2] += [13.3, -4.7]
    pose = base.camera_from_world.copy()
    if offset is not None:
        pose[:3, 3] -= pose[:3, :3] @ offset
    return Camera("skewed", SIZE, intrinsics, pose, np.zeros(0), intrinsics @ pose[:3])


def triangle_soup(n: int, seed: int, offset: np.ndarray) -> Surface:
    """Separate triangles of about a metre around the middle of the rig's volume."""
    rng = np.random.default_rng(seed)
    middles = rng.uniform([-0.8, -0.8, 0.2], [0.8, 0.8, 2.0], (n, 3))
    corners = middles[:, None] + rng.normal(0, 0.4, (n, 3, 3))
    return Surface(corners.reshape(-1, 3) + offset, np.arange(3 * n).reshape(n, 3))


def covered_and_doubtful(surface: Surface, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """By projection alone: pixels whose centre a triangle covers, and those within 0.002 px of an edge."""
    pixels, depth = camera.project(surface.vertices)
    assert (depth > 0).all()
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    covered = np.zeros((SIZE[1], SIZE[0]), bool)
    doubtful = covered.copy()
    for corners in pixels[surface.faces]:
        distances = []
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along = (b - a) / np.linalg.norm(b - a)
            distances.append(along[0] * (v - a[1]) - along[1] * (u - a[0]))
        sides = np.array(distances)
        covered |= (sides > 0).all(0) | (sides < 0).all(0)
        doubtful |= (np.abs(sides) < 0.002).any(0)
    return covered, doubtful


@pytest.mark.parametrize("offset", [[0.0, 0.0, 0.0], [350.0, -120.0, 40.0]], ids=["origin", "far away"])
def test_mask_is_what_projection_says_at_every_pixel_centre(offset: list[float]) -> None:
    offset_m = np.array(offset)
    camera = skewed_camera(offset_m)
    wrong = n_pixels = 0
    for seed in range(8):
        surface = triangle_soup(4, seed, offset_m)
        covered, doubtful = covered_and_doubtful(surface, camera)
        mask, _ = Renderer(*SIZE).silhouette([surface], camera)
        wrong += int(((mask != covered) & ~doubtful).sum())
        n_pixels += int(covered.sum())
    assert n_pixels > 5000
    assert wrong == 0, f"{wrong} of {n_pixels} pixels differ from the projection"


def test_half_a_pixel_would_be_noticed() -> None:
    camera = skewed_camera()
    surface = triangle_soup(4, 0, np.zeros(3))
    intrinsics = camera.intrinsics.copy()
    intrinsics[0, 2] += 0.5
    moved = dataclasses.replace(camera, intrinsics=intrinsics, projection=None)
    here, there = (Renderer(*SIZE).silhouette([surface], c)[0] for c in (camera, moved))
    assert (here != there).sum() > 50


def test_depth_is_that_of_the_plane() -> None:
    camera = skewed_camera()
    corners_px = np.array([[-40.0, -40.0], [400.0, -30.0], [60.0, 500.0]])
    depths = np.array([2.5, 4.0, 3.2])
    surface = Surface(camera.unproject(corners_px, depths), np.array([[0, 1, 2]]))
    mask, depth = Renderer(*SIZE).silhouette([surface], camera)
    rows, columns = np.nonzero(mask)
    assert len(rows) > 1000
    # over a plane, one over depth is linear in the picture
    plane = np.linalg.solve(np.column_stack([corners_px, np.ones(3)]), 1 / depths)
    wanted = 1 / (np.column_stack([columns, rows, np.ones(len(rows))]) @ plane)
    assert np.abs(depth[rows, columns] - wanted).max() < 1e-5
    assert (depth[~mask] == 0).all()


def test_nearer_surface_hides_the_farther() -> None:
    camera = dome_layout(1, SIZE)[0]
    square = np.array([[40.0, 30.0], [120.0, 30.0], [120.0, 90.0], [40.0, 90.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    near = Surface(camera.unproject(square, np.full(4, 3.0)), faces, colour=(255, 0, 0))
    far = Surface(camera.unproject(square, np.full(4, 4.0)), faces, colour=(0, 0, 255))
    for order in ([near, far], [far, near]):
        seen = Stage(order).colour(camera, ())
        assert seen.colour[60, 80].tolist() == [255, 0, 0]
        assert abs(float(seen.depth[60, 80]) - 3.0) < 1e-5


def test_part_outside_of_the_picture_and_part_behind_the_camera() -> None:
    camera = skewed_camera()
    inside = camera.unproject(np.array([[96.0, 64.0]]), np.array([3.0]))[0]
    behind = camera.centre - 1.0 * camera.camera_from_world[2, :3]
    surface = Surface(np.stack([inside, inside + np.array([0.3, 0, 0.3]), behind]), np.array([[0, 1, 2]]))
    mask, depth = Renderer(*SIZE).silhouette([surface], camera)
    # check against rays: a hit is where the ray meets the triangle in front of the camera
    rows, columns = np.nonzero(np.ones_like(mask))
    origin, directions = camera.rays(np.column_stack([columns, rows]).astype(float))
    a, b, c = surface.vertices
    weights = np.linalg.solve(
        np.broadcast_to(np.column_stack([b - a, c - a, np.zeros(3)]), (len(rows), 3, 3))
        - np.eye(3)[2] * directions[:, :, None],
        np.broadcast_to((origin - a)[:, None], (len(rows), 3, 1)),
    )[:, :, 0]
    s, t, reach = weights.T
    hit = (s >= 0) & (t >= 0) & (s + t <= 1) & (reach > 0.05)
    sure = (np.abs(np.stack([s, t, 1 - s - t])) > 1e-4).all(0)
    assert hit.sum() > 100
    assert (mask[rows, columns] != hit)[sure].sum() <= 2
    assert depth.max() > 0


def test_nothing_to_draw_is_an_empty_picture() -> None:
    camera = skewed_camera()
    for surfaces in ([], [Surface(np.zeros((0, 3)), np.zeros((0, 3), int))]):
        seen = Renderer(*SIZE).colour(surfaces, camera)
        assert not seen.mask.any() and not seen.coverage.any() and not seen.colour.any()


def test_smooth_edges_surround_the_mask() -> None:
    camera = skewed_camera()
    corners = np.array([[30.0, 20.0], [150.0, 35.0], [120.0, 110.0], [40.0, 90.0]])
    surface = Surface(camera.unproject(corners, np.full(4, 4.0)), np.array([[0, 1, 2], [0, 2, 3]]))
    seen = Renderer(*SIZE).colour([surface], camera)
    assert (seen.coverage[seen.mask] > 0).mean() > 0.999
    partly = (seen.coverage > 0) & (seen.coverage < 255)
    assert partly.any()
    grown = seen.mask.copy()
    for axis in (0, 1):
        grown = grown | np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
    assert not (seen.coverage[~grown] > 0).any()


def test_light_from_one_side() -> None:
    """Lambert: of two faces the one that looks at the light is brighter."""
    camera = dome_layout(1, SIZE, lowest_deg=0.0, highest_deg=1.0)[0]
    axes = camera.camera_from_world[:3, :3]
    middle = camera.unproject(np.array([[95.5, 63.5]]), np.array([4.0]))[0]
    ridge = np.array([[0, -0.5, 0], [0, 0.5, 0], [-0.5, 0, 0.5], [0.5, 0, 0.5]]) @ axes + middle
    surface = [
        Surface(ridge[[0, 1, 2]], np.array([[0, 2, 1]])),
        Surface(ridge[[0, 1, 3]], np.array([[0, 1, 2]])),
    ]
    seen = Stage(surface).colour(camera, [Light(axes.T @ np.array([1.0, 0.0, 0.4]), 3.0)])
    left, right = seen.colour[64, 80].mean(), seen.colour[64, 112].mean()
    assert left > 1.3 * right > 0


def test_two_renderers_live_side_by_side() -> None:
    camera = skewed_camera()
    surface = triangle_soup(3, 1, np.zeros(3))
    first, second = Renderer(*SIZE), Renderer(*SIZE)
    before, _ = first.silhouette([surface], camera)
    del second
    after, _ = first.silhouette([surface], camera)
    assert np.array_equal(before, after) and before.any()


def test_a_lens_cannot_be_drawn() -> None:
    camera = dataclasses.replace(dome_layout(1, SIZE)[0], distortion=np.array([-0.2, 0.05, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"cam-000 has lens distortion.*camera\.pinhole\(\) and undistort"):
        Renderer(*SIZE).silhouette([triangle_soup(1, 0, np.zeros(3))], camera)


def test_another_size_than_the_renderers() -> None:
    with pytest.raises(ValueError, match="cam-000 has pictures of 192 x 128, the renderer draws 64 x 64"):
        Renderer(64, 64).silhouette([], dome_layout(1, SIZE)[0])


def test_clip_corners_are_the_picture_s_corners() -> None:
    """The first pixel's outer corner is (-0.5, -0.5): OpenGL's (-1, 1)."""
    camera = skewed_camera()
    clip = clip_from_world(camera.projection_matrix, SIZE, 1.0, 9.0)
    for pixel, depth, wanted in (
        ([-0.5, -0.5], 1.0, [-1, 1, -1]),
        ([SIZE[0] - 0.5, SIZE[1] - 0.5], 9.0, [1, -1, 1]),
    ):
        point = camera.unproject(np.array([pixel]), np.array([depth]))[0]
        homogeneous = clip @ [*point, 1.0]
        assert np.abs(homogeneous[:3] / homogeneous[3] - wanted).max() < 1e-9
        assert abs(homogeneous[3] - depth) < 1e-9


def test_vertex_normals_of_a_box_corner_and_of_a_lone_vertex() -> None:
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]])
    normals = vertex_normals(corner, np.array([[0, 2, 1], [0, 3, 2], [0, 1, 3]]))
    assert np.allclose(normals[0], -np.ones(3) / np.sqrt(3))
    assert np.allclose(normals[4], [0, 0, 1])
