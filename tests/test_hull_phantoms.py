"""Parts of a hull that no silhouette needs: found, also where they hang on what is needed."""

from __future__ import annotations

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout, look_at
from capture.rig import Rig
from hull.visual_hull import Hull, build_hull
from tests.hull_subjects import Balls, figure

LEG_AT = 0.26


def _table() -> Balls:
    """A round top on two legs, along x."""
    rows = [(x, y, 1.4, 0.09) for x in np.arange(-0.4, 0.41, 0.04) for y in np.arange(-0.4, 0.41, 0.04)]
    rows = [row for row in rows if np.hypot(row[0], row[1]) < 0.42]
    rows += [(side * LEG_AT, 0.0, z, 0.07) for side in (-1, 1) for z in np.arange(0.6, 1.4, 0.03)]
    table = np.array(rows)
    return Balls(table[:, :3], table[:, 3])


def _cameras(*azimuths_deg: float) -> Rig:
    intrinsics = np.array([[900.0, 0, 199.5], [0, 900.0, 199.5], [0, 0, 1]])
    middle, cameras = np.array([0, 0, 1.05]), []
    for k, azimuth in enumerate(np.deg2rad(azimuths_deg)):
        eye = middle + 5.0 * np.array([np.cos(azimuth), np.sin(azimuth), 0.1])
        pose = look_at(eye, middle, np.array([0, 0, 1.0]))
        cameras.append(Camera(f"cam{k}", (400, 400), intrinsics, pose, np.zeros(0)))
    return Rig(tuple(cameras))


def _near_leg(hull: Hull, x: float, y: float) -> np.ndarray:
    """Vertices of the column around (x, y), clear of the top."""
    place = hull.vertices
    return (np.hypot(place[:, 0] - x, place[:, 1] - y) < 0.2) & (place[:, 2] > 0.7) & (place[:, 2] < 1.15)


def test_two_diagonal_views_of_two_legs_need_none_of_the_four_that_they_allow() -> None:
    """Each leg, true or not, stands behind another one in either picture; the top is needed."""
    rig, subject = _cameras(45, 135), _table()
    hull = build_hull(rig, subject.silhouettes(rig), 0.012)
    for x, y in ((LEG_AT, 0), (-LEG_AT, 0), (0, LEG_AT), (0, -LEG_AT)):
        leg = _near_leg(hull, x, y)
        assert leg.sum() > 100, f"the hull has no leg at {x}, {y}"
        assert hull.is_phantom[leg].mean() > 0.8
    top = hull.vertices[:, 2] > 1.35
    assert hull.is_phantom[top].mean() < 0.05
    assert np.median(hull.slack_m[_near_leg(hull, 0, LEG_AT)]) > 0.05


def test_a_third_view_from_the_front_settles_it() -> None:
    rig, subject = _cameras(45, 135, 90), _table()
    hull = build_hull(rig, subject.silhouettes(rig), 0.012)
    assert _near_leg(hull, 0, LEG_AT).sum() == _near_leg(hull, 0, -LEG_AT).sum() == 0
    assert _near_leg(hull, LEG_AT, 0).sum() > 100
    assert hull.is_phantom.mean() < 0.02


@pytest.mark.parametrize("n_cameras", [12, 24])
def test_a_figure_seen_from_all_around_has_no_phantoms(n_cameras: int) -> None:
    rig = dome_layout(n_cameras, (320, 320))
    hull = build_hull(rig, figure().silhouettes(rig), 0.014)
    assert hull.is_phantom.mean() < 0.01
