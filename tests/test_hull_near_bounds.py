"""The last frame's box makes the search quicker and changes nothing of what is found."""

from __future__ import annotations

import numpy as np
import pytest

from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from hull.bounds import Bounds, bounds_from_tables
from hull.carve import Grid, possible_witnesses
from hull.errors import HullError
from hull.tables import prepare_tables
from hull.visual_hull import build_hull
from hull.witnesses import witness_rule
from tests.hull_subjects import Balls, ball, figure


def _same(a: Bounds, b: Bounds) -> bool:
    return np.array_equal(a.low, b.low) and np.array_equal(a.high, b.high)


def _around(subject: Balls, shift: tuple[float, float, float] = (0, 0, 0)) -> Bounds:
    low = (subject.centres - subject.radii[:, None]).min(axis=0)
    high = (subject.centres + subject.radii[:, None]).max(axis=0)
    return Bounds(low + shift, high + shift)


@pytest.mark.parametrize("n_cameras", [2, 8, 20])
def test_the_box_is_the_same_whatever_the_last_one_was(n_cameras: int) -> None:
    subject, rig = figure(), ring_layout(max(n_cameras, 3), (256, 256))
    rig = Rig(rig.cameras[:n_cameras])
    tables = prepare_tables(rig, subject.silhouettes(rig))
    whole = bounds_from_tables(tables)
    # Right, a step off, half missed, elsewhere, far out of all pictures, everything.
    for shift in ((0, 0, 0), (0.2, -0.1, 0.1), (0.9, 0, 0), (2, 0, 0), (0, 0, 80)):
        assert _same(bounds_from_tables(tables, _around(subject, shift)), whole), shift
    assert _same(bounds_from_tables(tables, Bounds(np.full(3, -50.0), np.full(3, 50.0))), whole)


def test_fewer_cells_are_asked_near_the_last_box(monkeypatch: pytest.MonkeyPatch) -> None:
    subject, rig = figure(), dome_layout(12, (256, 256))
    tables = prepare_tables(rig, subject.silhouettes(rig))
    searched = []

    def counted(*arguments):  # type: ignore[no-untyped-def]
        searched.append(len(arguments))
        return possible_witnesses(*arguments)

    monkeypatch.setattr("hull.bounds.possible_witnesses", counted)
    bounds_from_tables(tables, _around(subject))
    assert searched == [5], "all of space was searched besides"
    bounds_from_tables(tables, _around(subject, (2, 0, 0)))
    assert searched == [5, 5, 4], "the search near a wrong box must be followed by one of all space"


def test_a_part_of_the_search_finds_what_the_whole_search_finds_there() -> None:
    subject, rig = figure(), dome_layout(12, (256, 256))
    tables = prepare_tables(rig, subject.silhouettes(rig))
    rule = witness_rule(tables, np.array([0, 0, 1.0]))
    grid = Grid(np.array([-2.0, -2, -1]), 0.0625, (64, 64, 64))
    whole = possible_witnesses(tables, rule, grid, 2)
    low, high = np.array([20, 25, 10]), np.array([43, 40, 47])
    part = possible_witnesses(tables, rule, grid, 2, (low, high))
    inside = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    assert (whole[inside] > 0).sum() > 200
    assert np.array_equal(part[inside], whole[inside])


def test_a_sequence_of_hulls_is_the_same_with_and_without_help() -> None:
    rig = dome_layout(12, (200, 200))
    near = None
    # The last step is a leap that no search near the last box can follow.
    for x in (0.0, 0.1, 0.25, 0.4, -0.9):
        images = ball(0.3, (x, 0.1, 1.0)).silhouettes(rig)
        helped, plain = build_hull(rig, images, 0.025, near=near), build_hull(rig, images, 0.025)
        assert np.array_equal(helped.vertices, plain.vertices)
        assert np.array_equal(helped.faces, plain.faces)
        near = Bounds(helped.vertices.min(axis=0), helped.vertices.max(axis=0))


def test_an_empty_hull_is_told_alike() -> None:
    rig = ring_layout(6, (128, 128))
    images = [np.zeros((128, 128), dtype=np.uint8) for _ in rig]
    for k, image in enumerate(images):
        image[10 + 18 * k : 20 + 18 * k, 40:90] = 255  # each sees somebody at another height
    tables = prepare_tables(rig, images)
    texts = []
    for near in (None, _around(ball(0.3))):
        with pytest.raises(HullError) as error:
            bounds_from_tables(tables, near)
        texts.append(str(error.value))
    assert texts[0] == texts[1]
