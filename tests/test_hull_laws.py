"""Laws of visual hulls on subjects whose silhouettes are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from hull.bounds import Bounds, find_bounds
from hull.cleaning import is_closed
from hull.quality import share_outside, silhouette_agreement
from hull.visual_hull import Hull, build_hull
from tests.hull_subjects import Balls, ball, figure

BOX = Bounds(np.array([-0.9, -0.9, -0.1]), np.array([0.9, 0.9, 1.9]))


@pytest.fixture(scope="module")
def dome() -> Rig:
    return dome_layout(24, (512, 512))


@pytest.fixture(scope="module")
def figure_hull(dome: Rig) -> Hull:
    return build_hull(dome, figure().silhouettes(dome), 0.012)


def _cropped(camera: Camera, first_row: int) -> Camera:
    """The same camera without the rows of its picture above `first_row`."""
    shift = np.array([[1.0, 0, 0], [0, 1, -first_row], [0, 0, 1]])
    return Camera(
        camera.name,
        (camera.size[0], camera.size[1] - first_row),
        shift @ camera.intrinsics,
        camera.camera_from_world,
        camera.distortion,
    )


def _pixel_m(rig: Rig, place: np.ndarray) -> float:
    """The side of a pixel at a place, metres, in the rig's average camera."""
    return float(np.mean([np.linalg.norm(c.centre - place) / c.intrinsics[0, 0] for c in rig]))


def test_a_ball_from_all_around_comes_back_to_a_third_of_a_pixel(dome: Rig) -> None:
    subject = ball()
    hull = build_hull(dome, subject.silhouettes(dome), 0.016)
    distance = subject.distance(hull.vertices)
    pixel = _pixel_m(dome, subject.centres[0])
    assert np.median(np.abs(distance)) < 0.35 * pixel
    assert distance.min() > -1.5 * pixel
    exact = 4 / 3 * np.pi * 0.4**3
    assert exact * 0.99 < hull.volume_m3 < exact * 1.04


def test_the_surface_is_closed_and_its_normals_look_outward(figure_hull: Hull) -> None:
    hull = figure_hull
    assert is_closed(hull.faces, len(hull.vertices))
    assert np.abs(np.linalg.norm(hull.normals, axis=1) - 1).max() < 1e-9
    assert hull.volume_m3 > 0
    # Two millimetres along its normal a vertex is outside, two against it inside, but for ridges and folds.
    assert share_outside(hull.vertices + 0.002 * hull.normals, hull) > 0.97
    assert share_outside(hull.vertices - 0.002 * hull.normals, hull) < 0.03
    assert hull.problems == ()


def test_the_hull_contains_the_subject(dome: Rig, figure_hull: Hull) -> None:
    random = np.random.default_rng(0)
    direction = random.normal(size=(20000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    subject = figure()
    which = random.integers(len(subject.radii), size=len(direction))
    points = subject.centres[which] + subject.radii[which, None] * direction
    pixel = _pixel_m(dome, np.array([0, 0, 1.0]))
    # A pixel's centre decides for the whole pixel, so up to a pixel may be lost; beyond that next to nothing.
    assert share_outside(points, figure_hull, tolerance_m=pixel) < 0.002


def test_the_hull_shrinks_as_views_are_added() -> None:
    subject, rig = figure(), ring_layout(12, (256, 256), camera_height_m=1.6)
    images = subject.silhouettes(rig)
    order = [0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11]
    volumes = []
    previous = None
    for n in (4, 6, 9, 12):
        chosen = order[:n]
        hull = build_hull(Rig(tuple(rig[i] for i in chosen)), [images[i] for i in chosen], 0.02, BOX)
        volumes.append(hull.volume_m3)
        if previous is not None:
            assert share_outside(hull.vertices, previous, tolerance_m=0.004) < 0.005
        previous = hull
    assert volumes == sorted(volumes, reverse=True), f"volumes {volumes} m^3 for 4, 6, 9, 12 cameras"
    assert volumes[-1] < 0.9 * volumes[0]


def test_the_projection_agrees_with_every_silhouette(dome: Rig) -> None:
    images = figure().silhouettes(dome)
    hull = build_hull(dome, images, 0.008)
    scores = silhouette_agreement(hull.vertices, hull.faces, dome, images)
    # The perimeter is long at half a megapixel: a quarter of a pixel all around is already one in a hundred.
    assert scores.min() > 0.985, f"worst agreement {scores.min():.4f}"


def test_cropped_cameras_give_no_evidence_beyond_their_pictures() -> None:
    """Half the cameras see only what is below the shoulders; the head neither vanishes nor grows."""
    subject, rig = figure(), ring_layout(16, (320, 320), camera_height_m=1.4)
    whole = build_hull(rig, subject.silhouettes(rig), 0.016)
    part = Rig(tuple(_cropped(c, 130) if i % 2 else c for i, c in enumerate(rig)))
    hull = build_hull(part, subject.silhouettes(part), 0.016)
    assert hull.vertices[:, 2].max() == pytest.approx(whole.vertices[:, 2].max(), abs=0.02)
    assert hull.volume_m3 == pytest.approx(whole.volume_m3, rel=0.03)
    assert hull.n_witnesses.min() >= 8
    assert hull.n_witnesses.max() == 16


def test_space_that_no_picture_shows_does_not_fill_up() -> None:
    """All cameras crop the head: the hull ends where the pictures do; nothing refutes what is above."""
    subject, rig = figure(), ring_layout(8, (320, 320), camera_height_m=1.4)
    part = Rig(tuple(_cropped(c, 130) for c in rig))
    hull = build_hull(part, subject.silhouettes(part), 0.016, BOX)
    top = max(c.unproject(np.array([[160.0, 0.0]]), np.array([4.0]))[0, 2] for c in part)
    assert 1.0 < hull.vertices[:, 2].max() < top + 0.05
    assert hull.n_witnesses.min() < 3, "the cut must be recognisable by its want of witnesses"
    assert (hull.n_witnesses[hull.vertices[:, 2] < hull.vertices[:, 2].max() - 0.15] == 8).all()


def test_four_cameras_suffice_and_two_are_allowed() -> None:
    subject = figure()
    for n in (4, 2):
        rig = ring_layout(5 if n == 2 else n, (256, 256))
        rig = Rig(rig.cameras[:n])
        hull = build_hull(rig, subject.silhouettes(rig), 0.016)
        assert is_closed(hull.faces, len(hull.vertices))
        assert share_outside(subject.centres, hull) == 0.0
        assert 1.6 < np.ptp(hull.vertices[:, 2]) < 2.1


def test_moving_the_world_moves_the_hull() -> None:
    """Bounds and grid follow the recording wherever its origin is; the shape stays."""
    subject, rig = figure(), dome_layout(10, (256, 256))
    images = subject.silhouettes(rig)
    here = build_hull(rig, images, 0.016)
    shift = np.array([16.0, -8.0, 4.0]) * 20 * 0.016
    pose = np.eye(4)
    pose[:3, 3] = -shift
    moved = Rig(
        tuple(Camera(c.name, c.size, c.intrinsics, c.camera_from_world @ pose, c.distortion) for c in rig)
    )
    there = build_hull(moved, images, 0.016)
    assert there.volume_m3 == pytest.approx(here.volume_m3, rel=1e-3)
    assert np.abs((there.vertices.mean(axis=0) - shift) - here.vertices.mean(axis=0)).max() < 1e-3


def test_bounds_hold_the_hull_tightly_and_one_bad_silhouette_does_not_cut_them() -> None:
    subject, rig = figure(), dome_layout(16, (256, 256))
    images = subject.silhouettes(rig)
    true_low, true_high = np.array([-0.64, -0.15, 0.03]), np.array([0.64, 0.15, 1.75])
    clean = find_bounds(rig, images)
    assert (clean.low < true_low).all()
    assert (clean.high > true_high).all()
    assert (clean.size_m < (true_high - true_low) + 0.4).all()
    images[3][120:] = 0  # the lower half is lost ...
    half = find_bounds(rig, images)
    images[3][:] = 0  # ... or all of it
    none = find_bounds(rig, images)
    for bounds in (half, none):
        assert (bounds.low < true_low).all()
        assert (bounds.high > true_high).all()
        assert (bounds.size_m < (true_high - true_low) + 0.8).all()


def test_a_piece_apart_is_kept_if_a_silhouette_needs_it() -> None:
    subject = Balls(np.array([[0, 0, 1.0], [0.55, 0, 1.5]]), np.array([0.3, 0.08]))
    rig = dome_layout(12, (320, 320))
    hull = build_hull(rig, subject.silhouettes(rig), 0.016, BOX)
    assert share_outside(subject.centres, hull) == 0.0
    assert len(hull.problems) == 1
    assert hull.problems[0].startswith("the hull is in 2 separate pieces (")


def test_phantoms_that_no_silhouette_needs_are_left_out() -> None:
    """Two balls seen by two cameras cross into two more places, hidden by the true ones in both pictures."""
    subject = Balls(np.array([[0.45, 0, 1.1], [-0.45, 0, 1.1]]), np.array([0.2, 0.18]))
    rig = ring_layout(8, (256, 256))
    rig = Rig((rig[1], rig[3]))
    hull = build_hull(rig, subject.silhouettes(rig), 0.02, Bounds(BOX.low, np.array([0.9, 0.9, 2.2])))
    covered = silhouette_agreement(hull.vertices, hull.faces, rig, subject.silhouettes(rig))
    assert covered.min() > 0.95
    assert any("separate piece" in problem for problem in hull.problems)
