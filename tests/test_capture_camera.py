"""Camera: projecting and unprojecting undo each other, the lens agrees with OpenCV, a matrix is kept
exactly."""

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import look_at
from capture.projection_split import camera_from_projection

LENSES = {
    "pinhole": [],
    "4": [-0.12, 0.05, 1e-3, -7e-4],
    "5": [-0.05, 0.14, 6e-4, 7e-4, 0.01],
    "8": [0.3, 0.1, 1e-3, -5e-4, 0.02, 0.4, 0.12, 0.03],
}


def make_camera(lens: str = "pinhole", skew: float = 0.0, size: tuple[int, int] = (640, 480)) -> Camera:
    pose = look_at(np.array([3.0, -2.0, 1.4]), np.array([0.1, 0.0, 1.0]), np.array([0.1, 0.0, 1.0]))
    intrinsics = np.array([[520.0, skew, 322.3], [0, 515.0, 236.8], [0, 0, 1]])
    return Camera("a", size, intrinsics, pose, np.array(LENSES[lens]))


def some_points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.8, 0.8, (n, 3)) + np.array([0, 0, 1])


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("skew", [0.0, 2.5])
def test_unproject_inverts_project(lens, skew):
    camera = make_camera(lens, skew)
    points = some_points()
    pixels, depth = camera.project(points)
    assert (depth > 0).all()
    assert np.abs(camera.unproject(pixels, depth) - points).max() < 1e-9
    origin, directions = camera.rays(pixels)
    distance = np.linalg.norm(points - origin, axis=1, keepdims=True)
    assert np.abs(origin + distance * directions - points).max() < 1e-9


@pytest.mark.parametrize("lens", LENSES)
def test_projection_agrees_with_opencv(lens):
    camera = make_camera(lens)
    points = some_points()
    pose = camera.camera_from_world
    expected, _ = cv2.projectPoints(
        points, pose[:3, :3].copy(), pose[:3, 3].copy(), camera.intrinsics.copy(), camera.distortion.copy()
    )
    assert np.abs(camera.project(points)[0] - expected.reshape(-1, 2)).max() < 1e-9


def test_depth_is_along_the_viewing_axis():
    camera = make_camera()
    points = camera.centre + np.outer([0.5, 2.0, -1.0], camera.forward)
    assert np.allclose(camera.project(points)[1], [0.5, 2.0, -1.0])


def test_first_pixel_centre_is_zero():
    """A camera whose picture is 3x3 and whose principal point is the middle pixel's centre: (1, 1)."""
    camera = Camera("a", (3, 3), np.array([[2.0, 0, 1], [0, 2, 1], [0, 0, 1]]), np.eye(4), np.zeros(0))
    pixels, _ = camera.project(np.array([[0.0, 0, 1], [0.5, 0.5, 1], [-0.5, -0.5, 1]]))
    assert np.allclose(pixels, [[1, 1], [2, 2], [0, 0]])


@pytest.mark.parametrize("lens", ["4", "5", "8"])
def test_undistorted_picture_shows_what_the_pinhole_sees(lens):
    """Blobs drawn where the lens puts them appear, after undistortion, where the pinhole projects them."""
    camera = make_camera(lens)
    pinhole = camera.pinhole()
    points = pinhole.unproject(np.array([[100.0, 90], [330, 240], [560, 400]]), np.full(3, 3.0))
    bent, straight = camera.project(points)[0], pinhole.project(points)[0]
    assert np.abs(bent - straight).max() > 1
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    picture = sum(np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 4.0**2)) for u, v in bent)
    seen = camera.undistort_image(np.repeat((255 * picture).astype(np.uint8)[..., None], 3, axis=2))
    assert seen.shape == (480, 640, 3)
    for u, v in straight:
        box = seen[round(v) - 12 : round(v) + 13, round(u) - 12 : round(u) + 13, 0].astype(float)
        offset = np.arange(-12, 13)
        found = [(box.sum(axis=axis) * offset).sum() / box.sum() for axis in (0, 1)]
        assert abs(round(u) + found[0] - u) < 0.2 and abs(round(v) + found[1] - v) < 0.2


def test_outside_of_the_filmed_picture_is_marked():
    camera = Camera(
        "a",
        (200, 200),
        np.array([[150.0, 0, 100], [0, 150, 100], [0, 0, 1]]),
        np.eye(4),
        np.array([0.3, 0, 0, 0]),
    )
    seen = camera.undistort_image(np.full((200, 200), 255, np.uint8), outside=128)
    assert seen[0, 0] == 128 and seen[100, 100] == 255


def test_a_point_that_the_lens_model_folds_back_has_no_pixel():
    camera = make_camera("4")
    strong = Camera("b", camera.size, camera.intrinsics, np.eye(4), np.array([-0.4, 0.0, 0, 0]))
    pixels, _ = strong.project(np.array([[0.2, 0.1, 1.0], [2.5, 0.0, 1.0]]))
    assert np.isfinite(pixels[0]).all() and np.isnan(pixels[1]).all()


def test_scaling_the_world_keeps_pixels_and_scales_depth():
    for camera in (
        make_camera("5"),
        camera_from_projection("a", (640, 480), -3 * make_camera().projection_matrix),
    ):
        points = some_points(20)
        pixels, depth = camera.project(points)
        scaled = camera.with_world_scaled(1000.0)
        again, deeper = scaled.project(1000 * points)
        assert np.allclose(again, pixels, atol=1e-9) and np.allclose(deeper, 1000 * depth)
        assert np.allclose(scaled.centre, 1000 * camera.centre)
        assert np.allclose(scaled.intrinsics, camera.intrinsics)


@pytest.mark.parametrize("factor", [1.0, -1.0, 2.7, -1e-3])
def test_a_projection_matrix_is_split_and_kept_exactly(factor):
    given = make_camera(skew=1.5)
    matrix = factor * given.projection_matrix
    camera = camera_from_projection("a", (640, 480), matrix)
    assert np.array_equal(camera.projection, matrix / (np.sign(factor) * np.linalg.norm(matrix[2, :3]))), (
        "only the scale may change"
    )
    assert np.allclose(camera.intrinsics @ camera.camera_from_world[:3], camera.projection, atol=1e-10)
    assert np.allclose(camera.intrinsics, given.intrinsics, atol=1e-9)
    assert np.allclose(camera.camera_from_world, given.camera_from_world, atol=1e-12)
    assert np.isclose(np.linalg.det(camera.camera_from_world), 1)


def test_equal_means_every_number_equal():
    assert make_camera("5") == make_camera("5") and hash(make_camera("5")) == hash(make_camera("5"))
    assert make_camera("5") != make_camera("4")
    assert make_camera().with_world_scaled(1 + 1e-15) != make_camera()


def test_impossible_cameras_are_refused():
    good = make_camera()
    with pytest.raises(ValueError, match="not a finite number"):
        Camera("a", good.size, good.intrinsics * np.nan, good.camera_from_world, np.zeros(0))
    with pytest.raises(ValueError, match="not a rotation"):
        Camera("a", good.size, good.intrinsics, np.diag([-1.0, 1, 1, 1]), np.zeros(0))
    with pytest.raises(ValueError, match="3 distortion values"):
        Camera("a", good.size, good.intrinsics, good.camera_from_world, np.zeros(3))
    with pytest.raises(ValueError, match="singular"):
        camera_from_projection("a", (4, 4), np.array([[1.0, 0, 0, 0], [1, 0, 0, 1], [0, 0, 1, 1]]))
