"""Soft silhouettes: what one camera merely doubts stays, what several doubt or one is sure of goes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout
from capture.rig import Rig
from capture.silhouette_files import read_silhouette, undistort_probabilities
from hull.bounds import Bounds
from hull.carve import Grid
from hull.cleaning import is_closed
from hull.errors import HullError
from hull.soft import carve_soft, inside_softly
from hull.soft_tables import LIMIT, doubt, prepare_soft_tables, sure_mask
from hull.visual_hull import HullOptions, build_hull
from hull.witnesses import witness_rule
from tests.hull_subjects import Balls, ball, figure

SOFT = HullOptions(soft=True)
BOX = Bounds(np.array([-0.6, -0.6, 0.5]), np.array([0.7, 0.6, 1.7]))


def matte(subject: Balls, camera: Camera, fine: int = 4) -> np.ndarray:
    """(h w) uint8: the share of each pixel that the subject covers."""
    width, height = camera.size
    zoom = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1.0]])
    finer = Camera(
        camera.name,
        (width * fine, height * fine),
        zoom @ camera.intrinsics,
        camera.camera_from_world,
        camera.distortion,
    )
    covered = subject.silhouette(finer).reshape(height, fine, width, fine)
    return np.round(covered.mean(axis=(1, 3))).astype(np.uint8)


def spoilt(image: np.ndarray, level: int, random: np.random.Generator, n: int = 3) -> np.ndarray:
    """With patches inside the person whose value is no more than `level`."""
    rows, columns = np.nonzero(image > 128)
    patches = np.zeros_like(image)
    for k in random.integers(len(rows), size=n):
        cv2.circle(patches, (int(columns[k]), int(rows[k])), 4, 255, -1)
    return np.where(patches > 0, np.minimum(image, level), image).astype(np.uint8)


def test_the_rates_of_the_sensor_in_closed_form() -> None:
    """Twenty to one against an occupied place, half of all empty places covered by the person anyway."""
    assert doubt(np.array([0.0]))[0] == pytest.approx(np.log(0.5 / 0.05))
    assert doubt(np.array([0.5, 0.7, 1.0])).tolist() == [0.0, 0.0, 0.0]
    assert pytest.approx(np.log(0.95 / 0.5)) == LIMIT
    half = np.array([0.35])
    assert doubt(half)[0] < LIMIT < 3 * doubt(half)[0]


def test_equal_to_the_definition() -> None:
    random = np.random.default_rng(2)
    rig = dome_layout(9, (240, 240))
    images = [cv2.GaussianBlur(spoilt(matte(figure(), camera, 2), 60, random), (0, 0), 2.0) for camera in rig]
    images[4][:, :100] = random.integers(0, 255, size=(240, 100))
    tables = prepare_soft_tables(rig, images)
    grid = Grid(np.array([-0.83, -0.41, -0.17]), 0.027, (61, 31, 75))
    rule = witness_rule(tables, grid.low + 0.5 * grid.voxel_m * np.array(grid.shape))
    found = carve_soft(tables, rule, grid).dense(np.zeros(3, dtype=int), np.array(grid.shape))
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")).reshape(3, -1)
    expected = inside_softly(tables, rule, grid.centres(cells))
    assert expected.sum() > 2000
    assert int((found.ravel() != expected).sum()) == 0


def test_mattes_give_outlines_finer_than_pixels() -> None:
    """A ball: the soft hull's surface is three times nearer to it than the hull of masks."""
    rig, subject = dome_layout(24, (200, 200)), ball()
    mattes = [matte(subject, camera) for camera in rig]
    masks = [np.where(image > 127, 255, 0).astype(np.uint8) for image in mattes]
    soft = build_hull(rig, mattes, 0.016, BOX, SOFT)
    hard = build_hull(rig, masks, 0.016, BOX)
    pixel = float(np.mean([np.linalg.norm(c.centre - subject.centres[0]) / c.intrinsics[0, 0] for c in rig]))
    errors = [np.median(np.abs(subject.distance(hull.vertices))) for hull in (soft, hard)]
    assert errors[0] < 0.12 * pixel, f"{errors[0] / pixel:.3f} px soft, {errors[1] / pixel:.3f} px cut"
    assert errors[0] < 0.5 * errors[1]
    assert is_closed(soft.faces, len(soft.vertices))
    assert soft.faults == ()


def test_blur_does_not_move_the_surface() -> None:
    rig, subject = dome_layout(24, (200, 200)), ball()
    mattes = [matte(subject, camera) for camera in rig]
    blurred = [cv2.GaussianBlur(image, (0, 0), 2.0) for image in mattes]
    volumes = [build_hull(rig, images, 0.016, BOX, SOFT).volume_m3 for images in (mattes, blurred)]
    assert volumes[1] == pytest.approx(volumes[0], rel=0.01)


@pytest.mark.parametrize(("level", "n_doubting", "stays"), [(90, 1, True), (90, 4, False), (0, 1, False)])
def test_who_may_cut(level: int, n_doubting: int, stays: bool) -> None:
    """A patch on the ball's top in the pictures of the highest cameras, of little or of no probability."""
    rig, subject = dome_layout(16, (240, 240)), ball()
    images = [matte(subject, camera, 2) for camera in rig]
    whole = build_hull(rig, images, 0.016, BOX, SOFT)
    top = subject.centres[0] + np.array([0, 0, 0.4])
    for camera_idx in range(len(rig) - n_doubting, len(rig)):
        pixel, _ = rig[camera_idx].project(top[None])
        patch = np.zeros_like(images[camera_idx])
        cv2.circle(patch, tuple(int(v) for v in np.round(pixel[0])), 7, 255, -1)
        spoil = (patch > 0) & (images[camera_idx] > level)
        images[camera_idx] = np.where(spoil, np.uint8(level), images[camera_idx])
    hull = build_hull(rig, images, 0.016, BOX, replace(SOFT, find_faults=False))
    lost = 1 - hull.volume_m3 / whole.volume_m3
    assert (lost < 0.002) == stays, f"{lost:.2%} of the volume lost"


def test_doubtful_patches_cost_less_than_with_masks() -> None:
    random = np.random.default_rng(0)
    rig = dome_layout(16, (320, 320))
    clean = [matte(figure(), camera, 2) for camera in rig]
    whole = build_hull(rig, clean, 0.016, None, SOFT).volume_m3
    images = [spoilt(image, 90, random) for image in clean]
    masks = [np.where(image > 127, 255, 0).astype(np.uint8) for image in images]
    soft = 1 - build_hull(rig, images, 0.016, None, SOFT).volume_m3 / whole
    hard = 1 - build_hull(rig, masks, 0.016, None, HullOptions(find_faults=False)).volume_m3 / whole
    assert hard > 0.05
    assert soft < 0.5 * hard, f"{soft:.1%} of the volume lost soft, {hard:.1%} cut"


def test_a_wrong_camera_is_found_among_soft_ones() -> None:
    rig = dome_layout(16, (320, 320))
    images = [matte(figure(), camera, 2) for camera in rig]
    whole = build_hull(rig, images, 0.016, None, SOFT)
    assert whole.faults == ()
    images[6][200:] = 0
    hull = build_hull(rig, images, 0.016, None, SOFT)
    assert [fault.name for fault in hull.faults] == [rig[6].name]
    assert hull.volume_m3 == pytest.approx(whole.volume_m3, rel=0.02)


def test_votes_and_doubts_exclude_each_other() -> None:
    rig = dome_layout(6, (100, 100))
    with pytest.raises(HullError, match="votes and soft silhouettes exclude each other"):
        build_hull(rig, figure().silhouettes(rig), options=HullOptions(soft=True, votes=2))


def test_files_keep_their_grey_values(tmp_path: Path) -> None:
    path = tmp_path / "silh_000000.png"
    grey = np.tile(np.arange(0, 250, 5, dtype=np.uint8), (40, 1))
    cv2.imwrite(str(path), grey)
    found = read_silhouette(path, soft=True)
    assert found.problem is None
    assert np.array_equal(found.mask, grey)
    turned = read_silhouette(path, soft=True, inverted=True)
    assert np.array_equal(turned.mask, 255 - grey)
    assert read_silhouette(path).mask is None, "as a mask it is a photograph"
    cv2.imwrite(str(path), np.where(grey > 100, 1, 0).astype(np.uint8))
    assert set(np.unique(read_silhouette(path, soft=True).mask)) == {0, 255}
    cv2.imwrite(str(path), np.full((40, 50), 30, np.uint8))
    assert read_silhouette(path, soft=True).problem is not None


def test_what_a_lens_never_saw_is_one_half() -> None:
    camera = dome_layout(3, (120, 100))[0]
    bent = Camera(
        camera.name, camera.size, camera.intrinsics, camera.camera_from_world, np.array([0.3, 0, 0, 0])
    )
    seen = undistort_probabilities(bent, np.full((100, 120), 200, dtype=np.uint8))
    assert seen[50, 60] == 200
    assert seen[0, 0] == 128
    plain = np.arange(12000, dtype=np.uint8).reshape(100, 120)
    assert undistort_probabilities(camera, plain) is plain


def test_only_the_nearly_certain_is_asked_for_faults() -> None:
    assert sure_mask(np.array([[0, 50, 51, 128, 204, 205, 255]], dtype=np.uint8)).tolist() == [
        [0, 0, 128, 128, 128, 255, 255]
    ]


def test_cameras_without_evidence() -> None:
    rig = dome_layout(8, (200, 200))
    images: list = [matte(ball(), camera, 2) for camera in rig]
    images[2] = None
    hull = build_hull(rig, images, 0.02, BOX, SOFT)
    part = Rig(tuple(camera for k, camera in enumerate(rig) if k != 2))
    same = build_hull(part, [i for i in images if i is not None], 0.02, BOX, SOFT)
    assert np.array_equal(hull.vertices, same.vertices)
    assert set(hull.cut_by) - {-1} == set(range(8)) - {2}
