"""Who bounds a hull, and how much room it has: against closed forms on balls seen by rings of cameras."""

from __future__ import annotations

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import look_at, ring_layout
from capture.rig import Rig
from hull.bounds import Bounds
from hull.carve import Grid
from hull.culling import Culling
from hull.slack import outlines_at, spread_to_neighbours
from hull.tables import INSIDE, NO_EVIDENCE, prepare_tables
from hull.visual_hull import Hull, build_hull
from tests.hull_subjects import ball, figure

RADIUS_M, FAR_M = 0.4, 200.0
CENTRE = np.array([0.05, -0.03, 1.1])


def _far_ring(n_cameras: int, side_px: int = 512) -> Rig:
    """Cameras so far away, at the ball's height, that their rays are parallel: 2 mm to a pixel."""
    focal = side_px / 1.0 * FAR_M
    middle = (side_px - 1) / 2
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    cameras = []
    for k in range(n_cameras):
        angle = 2 * np.pi * k / n_cameras + 0.1
        eye = CENTRE + FAR_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        pose = look_at(eye, CENTRE, np.array([0, 0, 1.0]))
        cameras.append(Camera(f"cam{k}", (side_px, side_px), intrinsics, pose, np.zeros(0)))
    return Rig(tuple(cameras))


def _ring_hull(n_cameras: int) -> tuple[Rig, Hull]:
    rig = _far_ring(n_cameras)
    # Beyond the pictures, a metre wide, too few cameras would vouch for what they see.
    box = Bounds(CENTRE - 0.48, CENTRE + 0.48)
    return rig, build_hull(rig, ball(RADIUS_M).silhouettes(rig), 0.01, box)


@pytest.mark.parametrize("n_cameras", [5, 7])
def test_the_equator_of_a_ball_in_a_ring_has_the_room_of_a_polygons_side(n_cameras: int) -> None:
    """Seen by n cameras (n odd) the equator is a regular polygon of 2 n sides around the circle: half a side
    is R tan(pi / 2n); a vertex at share t of a side has max(t, 1 - t) of it."""
    _, hull = _ring_hull(n_cameras)
    place = hull.vertices - CENTRE
    # Phantoms in the corners of the box are farther out than the polygon's corners.
    at = (np.abs(place[:, 2]) < 0.015) & (np.hypot(place[:, 0], place[:, 1]) < 0.43)
    half_side = RADIUS_M * np.tan(np.pi / (2 * n_cameras))
    # Sides touch the circle where the cameras look past it, a right angle from their own directions.
    angle = np.arctan2(place[at, 1], place[at, 0]) - 0.1 - np.pi / 2
    step = np.pi / n_cameras
    off_middle = np.abs((angle + step / 2) % step - step / 2)
    middle = off_middle < 0.1 * step
    expected = half_side + RADIUS_M * np.tan(off_middle[middle])
    # Measured half a pixel (1 mm) inside, where a side is longer by what its neighbours lean outwards.
    longer = 0.001 / np.tan(2 * np.pi / (2 * n_cameras))
    error = hull.slack_m[at][middle] - expected
    assert middle.sum() > 20
    assert np.median(np.abs(error - longer)) < 0.004, f"median {np.median(error)} m, expected {longer}"
    least, most = np.percentile(hull.slack_m[at], [2, 98])
    assert 0.93 * half_side < least
    assert 1.8 * half_side < most < 2.15 * half_side


def test_more_cameras_leave_less_room() -> None:
    medians = [float(np.median(_ring_hull(n)[1].slack_m)) for n in (5, 9, 17)]
    assert medians == sorted(medians, reverse=True), medians
    assert medians[-1] < 0.6 * medians[0], medians


def test_the_camera_that_cut_a_vertex_is_the_one_whose_cone_it_lies_on() -> None:
    """On parallel rays the cone is a cylinder: the vertex is R off the axis through the ball's centre."""
    rig, hull = _ring_hull(7)
    assert hull.cut_by.min() >= 0
    ways = np.array([CENTRE - c.centre for c in rig]) / FAR_M
    from_centre = hull.vertices - CENTRE
    across = from_centre[:, None] - np.einsum("vi,ci->vc", from_centre, ways)[:, :, None] * ways
    off = np.abs(np.linalg.norm(across, axis=2) - RADIUS_M)
    assert np.median(off[np.arange(len(off)), hull.cut_by]) < 0.0012
    # The nearest cone to within a pixel (2 mm), and never one that is far off.
    assert (off[np.arange(len(off)), hull.cut_by] - off.min(axis=1)).max() < 0.004
    near = (off < 0.001).sum(axis=1)
    assert (hull.n_bounding >= np.minimum(near, 1)).all()
    assert np.corrcoef(hull.n_bounding, (off < 0.002).sum(axis=1))[0, 1] > 0.7


def test_asking_in_blocks_changes_no_answer() -> None:
    rig = ring_layout(6, (200, 150))
    images = figure().silhouettes(rig)
    images[2][40:60] = 128
    tables = prepare_tables(rig, images)
    points = np.random.default_rng(1).uniform([-0.8, -0.5, 0], [0.8, 0.5, 1.8], (4000, 3))
    witnesses = sum((t.ask_points(points.T) != NO_EVIDENCE).astype(int) for t in tables)
    answers = []
    for voxel_m in (0.01, 0.07):
        shape = tuple(int(np.ceil(s / voxel_m)) for s in (1.6, 1.0, 1.8))
        grid = Grid(np.array([-0.8, -0.5, 0]), voxel_m, shape)
        answers.append(outlines_at(points, Culling(tables, grid)))
    some, other = answers
    assert np.array_equal(some.n_bounding, other.n_bounding)
    assert np.array_equal(some.n_witnesses, witnesses)
    assert np.array_equal(other.n_witnesses, witnesses)
    assert len(some.point_idx) == some.n_bounding.sum() > 300
    # A small step across an outline changes that camera's answer, so it must be counted as bounding.
    for k, table in enumerate(tables):
        here, there = (table.ask_points((points + np.array([0, 0, s])).T) for s in (-0.0005, 0.0005))
        crossed = np.flatnonzero((here == INSIDE) != (there == INSIDE))
        crossed = crossed[(here[crossed] != NO_EVIDENCE) & (there[crossed] != NO_EVIDENCE)]
        assert np.isin(crossed, some.point_idx[some.table_idx == k]).mean() > 0.9


def test_a_vertex_that_was_given_up_for_want_of_witnesses_is_cut_by_none() -> None:
    rig = ring_layout(8, (320, 320), camera_height_m=1.4)
    cut = np.array([[1.0, 0, 0], [0, 1, -130], [0, 0, 1]])
    part = Rig(
        tuple(Camera(c.name, (320, 190), cut @ c.intrinsics, c.camera_from_world, c.distortion) for c in rig)
    )
    box = Bounds(np.array([-0.9, -0.9, -0.1]), np.array([0.9, 0.9, 1.9]))
    hull = build_hull(part, figure().silhouettes(part), 0.016, box)
    top = hull.vertices[:, 2] > hull.vertices[:, 2].max() - 0.01
    assert (hull.cut_by[top] == -1).mean() > 0.5
    assert (hull.n_bounding[hull.cut_by == -1] == 0).mean() > 0.9
    below = hull.vertices[:, 2] < hull.vertices[:, 2].max() - 0.2
    assert (hull.cut_by[below] >= 0).mean() > 0.99


def test_what_was_not_measured_is_taken_from_the_neighbours() -> None:
    faces = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [5, 6, 7]])
    values = np.array([1.0, np.nan, 3.0, np.nan, np.nan, np.nan, np.nan, np.nan])
    filled = spread_to_neighbours(values, faces)
    assert filled[[0, 2]].tolist() == [1.0, 3.0]
    assert filled[1] == pytest.approx((1 + 3 + 3) / 3)  # once beside 0 and 2, once beside 2
    assert filled[3] == pytest.approx(3.0)
    assert (filled[5:] == 0).all()
