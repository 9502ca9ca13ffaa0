"""What a user reads when no hull can be made: which camera, what was found, what to do."""

from __future__ import annotations

import re

import numpy as np
import pytest

from capture.layouts import dome_layout
from hull.bounds import Bounds
from hull.errors import HullError
from hull.visual_hull import HullOptions, build_hull
from tests.hull_subjects import ball, figure

RIG = dome_layout(8, (200, 200))
PLAIN = HullOptions(find_faults=False)
BOX = Bounds(np.array([-1.0, -1, 0]), np.array([1.0, 1, 2]))


def _error(*arguments: object, **named: object) -> str:
    with pytest.raises(HullError) as caught:
        build_hull(*arguments, **named)  # type: ignore[arg-type]
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 300
    return text


def test_the_camera_that_leaves_nothing_is_named() -> None:
    images = ball().silhouettes(RIG)
    images[5] = ball(0.2, (0.7, 0.6, 0.4)).silhouette(RIG[5])
    text = _error(RIG, images, 0.02, BOX, PLAIN)
    assert re.fullmatch(
        rf"camera {RIG[5].name} leaves nothing of what the other 7 cameras agree on \(2\d\d L\); "
        "look at its silhouette and its calibration, or leave it out",
        text,
    )


def test_an_empty_silhouette_is_named() -> None:
    images = ball().silhouettes(RIG)
    images[2][:] = 0
    text = _error(RIG, images, 0.02, options=PLAIN)
    assert text == (
        f"the silhouettes of camera {RIG[2].name} show nobody, so nothing is left; "
        "leave them out (None) or redo them"
    )


@pytest.mark.parametrize("box", [BOX, None])
def test_silhouettes_that_fit_no_calibration(box: Bounds | None) -> None:
    random = np.random.default_rng(0)
    places = random.uniform([-0.8, -0.8, 0.2], [0.8, 0.8, 1.9], size=(8, 3))
    images = [ball(0.1, tuple(place)).silhouette(camera) for place, camera in zip(places, RIG, strict=True)]
    text = _error(RIG, images, 0.02, box)
    assert text.startswith(
        "the silhouettes of the 8 cameras have no space in common, even without any single one"
    )
    assert "do the calibration and the pictures belong together" in text


def test_a_silhouette_of_another_size() -> None:
    images: list = ball().silhouettes(RIG)
    images[4] = images[4][::2, ::2].copy()
    text = _error(RIG, images)
    found = "its silhouette is uint8 of shape (100, 100), expected uint8 of shape (200, 200)"
    assert f"camera {RIG[4].name}: {found}" in text
    assert "were the pictures scaled, or the cameras mixed up?" in text


def test_too_few_silhouettes() -> None:
    images: list = ball().silhouettes(RIG)
    assert "8 cameras but 7 silhouettes" in _error(RIG, images[:7])
    alone = [images[0]] + [None] * 7
    assert f"only camera {RIG[0].name} gave a silhouette that could be read; a hull needs" in _error(
        RIG, alone
    )
    nothing = [None] * 8
    assert "no camera gave a silhouette that could be read; a hull needs at least 2" in _error(RIG, nothing)
    blank = [np.zeros_like(image) for image in images]
    assert f"0 of 8 silhouettes show anything (empty: {RIG[0].name}, " in _error(RIG, blank)
    assert "a hull needs at least 2, and 3 or more to be of use" in _error(RIG, alone, 0.02, BOX)


def test_impossible_voxels_and_boxes() -> None:
    images = figure().silhouettes(RIG)
    assert _error(RIG, images, 0.0) == "voxel_m is 0.0; it must be a positive length in metres, such as 0.008"
    huge = Bounds(BOX.low * 1000, BOX.high * 1000)
    assert "are the cameras in metres? Give a larger voxel or smaller bounds" in _error(
        RIG, images, 0.01, huge
    )
    with pytest.raises(HullError, match="enclose no space"):
        Bounds(BOX.high, BOX.low)


def test_a_hull_cut_by_its_box_says_so() -> None:
    box = Bounds(BOX.low, np.array([1.0, 1.0, 1.3]))
    hull = build_hull(RIG, figure().silhouettes(RIG), 0.02, box)
    assert hull.problems[-1] == "the hull reaches the end of the box it was carved in and is cut off there"
