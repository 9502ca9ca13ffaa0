"""A second subject, and one that leaves what the cameras see: said, with the cameras, and the rest kept."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from hull.bounds import Bounds
from hull.cleaning import is_closed
from hull.marks import size_mark
from hull.quality import share_outside
from hull.visual_hull import HullOptions, build_hull
from tests.hull_subjects import Balls, figure


def moved(subject: Balls, by: tuple[float, float, float], scale: float = 1.0) -> Balls:
    return Balls(subject.centres * scale + np.array(by), subject.radii * scale)


def both(one: Balls, other: Balls) -> Balls:
    return Balls(np.concatenate([one.centres, other.centres]), np.concatenate([one.radii, other.radii]))


def cropped(camera: Camera, first_row: int) -> Camera:
    shift = np.array([[1.0, 0, 0], [0, 1, -first_row], [0, 0, 1]])
    size = (camera.size[0], camera.size[1] - first_row)
    return Camera(camera.name, size, shift @ camera.intrinsics, camera.camera_from_world, camera.distortion)


def turned(subject: Balls) -> Balls:
    """With the arms along y, so that two fit side by side."""
    return Balls(subject.centres[:, [1, 0, 2]] * np.array([1, -1, 1]), subject.radii)


def test_one_subject_has_no_marks() -> None:
    rig = dome_layout(12, (256, 256))
    assert build_hull(rig, figure().silhouettes(rig), 0.016).marks == ()


@pytest.mark.parametrize("box", [None, Bounds(np.array([-1.0, -0.8, -0.1]), np.array([1.1, 0.8, 1.9]))])
def test_of_two_people_one_is_kept_and_it_is_said(box: Bounds | None) -> None:
    """The one that most cameras vouch for; with a box around both the larger."""
    rig = dome_layout(16, (384, 384), radius_m=1.6)
    large, small = moved(turned(figure()), (-0.6, 0, 0)), moved(turned(figure()), (0.7, 0, 0), 0.8)
    hull = build_hull(rig, both(large, small).silhouettes(rig), 0.016, box)
    assert is_closed(hull.faces, len(hull.vertices))
    assert share_outside(large.centres, hull) == 0.0
    assert share_outside(small.centres, hull) == 1.0
    assert len(hull.marks) == 1
    said = (
        "something else stands near (0.7, "
        if box is None
        else "there is more than one subject: the largest ("
    )
    assert said in hull.marks[0]
    assert box is None or "L near (0.7, " in hull.marks[0]
    assert hull.marks[0] in hull.problems
    assert hull.faults == (), "nobody is to blame for a second person"


def test_a_second_person_outside_the_box_is_said() -> None:
    rig = dome_layout(16, (384, 384), radius_m=1.6)
    one, other = moved(turned(figure()), (-0.6, 0, 0)), moved(turned(figure()), (0.7, 0, 0), 0.9)
    box = Bounds(np.array([-0.9, -0.8, -0.1]), np.array([-0.3, 0.8, 1.9]))
    hull = build_hull(rig, both(one, other).silhouettes(rig), 0.016, box)
    said = [mark for mark in hull.marks if "something else stands near (0.7, " in mark]
    assert len(said) == 1
    assert "(a second person?); cameras cam-000, cam-001, " in said[0]
    assert said[0].endswith("and 8 more show it")
    assert hull.faults == ()


def test_a_thrown_ball_is_no_second_person() -> None:
    rig = dome_layout(12, (320, 320))
    ball = Balls(np.array([[0.75, 0.2, 1.7]]), np.array([0.1]))
    hull = build_hull(rig, both(figure(), ball).silhouettes(rig), 0.016)
    assert hull.marks == ()
    assert share_outside(ball.centres, hull) == 0.0


def test_a_head_that_no_camera_sees_is_said() -> None:
    rig = ring_layout(8, (320, 320), camera_height_m=1.4)
    part = Rig(tuple(cropped(camera, 100) for camera in rig))
    hull = build_hull(part, figure().silhouettes(part), 0.016)
    assert len(hull.marks) == 1
    assert hull.marks[0].startswith("the subject leaves what enough cameras see, near (")
    assert "the hull ends there over about" in hull.marks[0]
    assert all(name in hull.marks[0] for name in part.names), hull.marks[0]
    assert hull.faults == ()


def test_a_subject_that_walks_out_of_the_volume_is_said() -> None:
    """One step aside enough cameras still have the whole of it; further out they lose an arm."""
    rig = dome_layout(12, (320, 320), radius_m=0.8)
    stays = build_hull(rig, figure().silhouettes(rig), 0.016)
    assert stays.marks == ()
    assert build_hull(rig, moved(figure(), (0.6, 0, 0)).silhouettes(rig), 0.016).marks == ()
    leaves = build_hull(rig, moved(figure(), (1.8, 0, 0)).silhouettes(rig), 0.016)
    assert len(leaves.marks) == 1
    assert leaves.marks[0].startswith("the subject leaves what enough cameras see, near (2.0, ")
    assert re.search("cameras cam-.* do not see that place$", leaves.marks[0])


def test_cameras_that_see_half_leave_no_mark_where_others_see_the_rest() -> None:
    rig = ring_layout(16, (320, 320), camera_height_m=1.4)
    part = Rig(tuple(cropped(c, 130) if i % 2 else c for i, c in enumerate(rig)))
    assert build_hull(part, figure().silhouettes(part), 0.016).marks == ()


@pytest.mark.parametrize("n_cameras", [16, 68])
@pytest.mark.parametrize("lower", [True, False])
def test_half_the_cameras_cropped_at_sixty_per_cent(n_cameras: int, lower: bool) -> None:
    """Every other camera keeps 60 % of its picture's height; the hull stays within 3 %."""
    rig = dome_layout(n_cameras, (320, 320))
    subject = figure()
    whole = build_hull(rig, subject.silhouettes(rig), 0.016)
    cameras, images = [], []
    for k, (camera, image) in enumerate(zip(rig, subject.silhouettes(rig), strict=True)):
        if k % 2 and lower:
            camera, image = cropped(camera, 128), image[128:].copy()
        elif k % 2:
            camera, image = replace(camera, size=(320, 192), projection=None), image[:192].copy()
        cameras.append(camera)
        images.append(image)
    hull = build_hull(Rig(tuple(cameras)), images, 0.016)
    assert hull.volume_m3 == pytest.approx(whole.volume_m3, rel=0.03)
    assert hull.faults == ()
    plain = build_hull(Rig(tuple(cameras)), images, 0.016, options=HullOptions(find_faults=False))
    assert np.array_equal(plain.vertices, hull.vertices)


def test_a_hull_as_large_as_two_people_or_smaller_than_one() -> None:
    """People of 110 kg in loose clothes stay below, with few cameras too."""
    for n_cameras, litres in ((3, 195), (4, 190), (8, 150), (16, 150), (68, 150)):
        assert size_mark(litres / 1000, n_cameras) == ()
    assert size_mark(0.015, 16) == (), "a small child"
    (mark,) = size_mark(0.240, 16)
    assert mark.startswith(
        "the hull holds 240 L, more than one person does (up to 198 L with 16 cameras): two"
    )
    (mark,) = size_mark(0.0014, 16)
    assert mark.startswith("the hull holds 1.4 L, less than a person does")
