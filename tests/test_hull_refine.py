"""Refinement: nearer to the subject, with the same silhouettes, still closed and inside the hull."""

from __future__ import annotations

import numpy as np
import pytest

from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from hull.cleaning import is_closed
from hull.quality import contour_distance, share_outside, silhouette_agreement
from hull.refine import inner_outline
from hull.tables import prepare_tables
from hull.visual_hull import Hull, HullOptions, build_hull
from tests.hull_subjects import figure


@pytest.fixture(scope="module", params=["ring of 4", "dome of 12"])
def case(request: pytest.FixtureRequest) -> tuple[Rig, list[np.ndarray], Hull, Hull]:
    rig = ring_layout(4, (400, 400)) if request.param == "ring of 4" else dome_layout(12, (400, 400))
    images = figure().silhouettes(rig)
    plain, finer = (
        build_hull(rig, images, 0.016, options=HullOptions(refine=refine)) for refine in (False, True)
    )
    return rig, images, plain, finer


def test_it_comes_nearer_to_the_subject(case: tuple[Rig, list[np.ndarray], Hull, Hull]) -> None:
    _, _, plain, finer = case
    before, after = (figure().distance(hull.vertices) for hull in (plain, finer))
    assert np.abs(after).mean() < 0.985 * np.abs(before).mean()
    assert np.sqrt((after**2).mean()) < np.sqrt((before**2).mean())


def test_the_silhouettes_stay(case: tuple[Rig, list[np.ndarray], Hull, Hull]) -> None:
    rig, images, plain, finer = case
    before, after = (silhouette_agreement(h.vertices, h.faces, rig, images) for h in (plain, finer))
    assert after.min() > before.min() - 0.002, f"{before.min():.4f} became {after.min():.4f}"
    assert contour_distance(finer.vertices, finer.faces, rig, images).max() < 0.5


def test_it_only_moves_inwards_and_stays_closed(case: tuple[Rig, list[np.ndarray], Hull, Hull]) -> None:
    _, _, plain, finer = case
    assert np.array_equal(plain.faces, finer.faces)
    assert is_closed(finer.faces, len(finer.vertices))
    step = ((finer.vertices - plain.vertices) * plain.normals).sum(axis=1)
    assert step.max() < 1e-9
    assert np.allclose(finer.vertices, plain.vertices + step[:, None] * plain.normals)
    assert (-step <= np.maximum(plain.slack_m, 0.002) + 1e-9).all()
    assert 0.8 * plain.volume_m3 < finer.volume_m3 < plain.volume_m3
    assert share_outside(finer.vertices, plain, tolerance_m=0.002) < 0.01
    assert np.abs(np.linalg.norm(finer.normals, axis=1) - 1).max() < 1e-9


def test_the_inner_outline_is_the_persons_pixels_with_background_beside_them() -> None:
    rig = ring_layout(3, (60, 60))
    image = np.zeros((60, 60), dtype=np.uint8)
    image[20:30, 15:40] = 255
    image[20:24, 36:40] = 128
    table = prepare_tables(Rig(rig.cameras[:1]), [image])[0]
    found = {(int(column), int(row)) for column, row in inner_outline(table)}
    person = {(c, r) for r in range(20, 30) for c in range(15, 40)}
    rim = {(c, r) for c, r in person if c in (15, 39) or r in (20, 29)}
    near_unknown = {(c, r) for c, r in rim if c >= 34 and r <= 25}
    assert rim - near_unknown <= found <= rim
