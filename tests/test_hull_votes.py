"""Hulls in which several cameras must see background before a place is given up."""

from __future__ import annotations

import numpy as np
import pytest

from capture.layouts import dome_layout
from capture.rig import Rig
from hull.cleaning import is_closed
from hull.culling import Culling
from hull.errors import HullError
from hull.surface import exits
from hull.tables import OUTSIDE, prepare_tables
from hull.visual_hull import Hull, HullOptions, build_hull, grid_over
from tests.hull_subjects import figure
from tests.test_hull_laws import BOX

RIG = dome_layout(12, (320, 320))
VOTES = (1, 2, 3)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return figure().silhouettes(RIG)


@pytest.fixture(scope="module")
def hulls(images: list[np.ndarray]) -> dict[int, Hull]:
    return {k: build_hull(RIG, images, 0.016, BOX, HullOptions(votes=k)) for k in VOTES}


@pytest.mark.parametrize("votes", VOTES)
def test_the_surface_lies_where_the_last_vote_is_cast(
    votes: int, hulls: dict[int, Hull], images: list[np.ndarray]
) -> None:
    """Half a millimetre inside it too few cameras refuse, half a millimetre outside enough of them do."""
    hull, tables = hulls[votes], prepare_tables(RIG, images)
    assert is_closed(hull.faces, len(hull.vertices))
    for way, expected in ((-0.0005, False), (0.0005, True)):
        points = (hull.vertices + way * hull.normals).T
        n_refused = sum((table.ask_points(points) == OUTSIDE).astype(int) for table in tables)
        assert ((n_refused >= votes) == expected).mean() > 0.98


def test_more_votes_more_volume(hulls: dict[int, Hull]) -> None:
    volumes = [hulls[k].volume_m3 for k in VOTES]
    assert volumes == sorted(volumes)
    assert volumes[1] > 1.02 * volumes[0]


def test_one_camera_cannot_cut_against_two_votes(images: list[np.ndarray], hulls: dict[int, Hull]) -> None:
    """The hull with a wrong silhouette lies between two votes of all and two votes of the others."""
    wrong = [image.copy() for image in images]
    wrong[3][:] = 0
    options = HullOptions(votes=2, find_faults=False)
    hull = build_hull(RIG, wrong, 0.016, BOX, options)
    others = Rig(tuple(camera for k, camera in enumerate(RIG) if k != 3))
    once = build_hull(others, [i for k, i in enumerate(images) if k != 3], 0.016, BOX)
    assert hull.volume_m3 == pytest.approx(once.volume_m3, rel=2e-3)
    assert hull.volume_m3 > 0.97 * hulls[1].volume_m3


def test_clean_silhouettes_have_no_faults_with_votes(hulls: dict[int, Hull]) -> None:
    assert all(hull.faults == () for hull in hulls.values())


@pytest.mark.parametrize("votes", VOTES)
def test_ways_out_against_the_plain_definition(votes: int, images: list[np.ndarray]) -> None:
    """The place on each way where the last vote is cast, found by sampling the way densely."""
    random = np.random.default_rng(votes)
    tables = prepare_tables(RIG, images)
    origin = np.array(figure().centres)[random.integers(30, size=200)].T
    along = random.normal(size=(3, 200))
    along *= 0.3 / np.linalg.norm(along, axis=0)
    exit_at, cut_by = exits(tables, origin, along, votes=votes)
    share = (np.arange(3000) + 0.5) / 3000
    refused = np.zeros((3000, 200), dtype=int)
    for table in tables:
        places = origin[:, None, :] + along[:, None, :] * share[None, :, None]
        refused += (table.ask_points(places.reshape(3, -1)) == OUTSIDE).reshape(3000, 200)
    # Where refusals come and go along the way there is no single exit to compare with.
    once = (np.diff((refused >= votes).astype(int), axis=0) != 0).sum(axis=0) == 1
    steady = once & (np.diff(refused, axis=0) >= 0).all(axis=0)
    expected = np.argmax(refused >= votes, axis=0) / 3000
    assert steady.sum() > 60
    assert np.abs(exit_at - expected)[steady].max() < 2 / 3000
    assert (cut_by[steady] >= 0).all()
    grid = grid_over(BOX, 0.016)
    short = 0.016 * along / 0.3
    plain = exits(tables, origin, short, votes=votes)
    culled = exits(tables, origin, short, Culling(tables, grid), votes)
    assert np.array_equal(plain[0], culled[0])
    assert np.array_equal(plain[1], culled[1])


@pytest.mark.parametrize("votes", [0, 11])
def test_impossible_votes(votes: int, images: list[np.ndarray]) -> None:
    with pytest.raises(HullError, match=f"votes is {votes}; choose 1 or a few more, 2 fewer than there are"):
        build_hull(RIG, images, 0.016, options=HullOptions(votes=votes))
