"""Sparing questions that a camera could not answer otherwise changes nothing of the surface."""

from __future__ import annotations

import numpy as np
import pytest

from capture.layouts import cage_layout, dome_layout
from capture.rig import Rig
from hull.bounds import bounds_from_tables
from hull.carve import carve
from hull.cleaning import is_closed, vertex_normals
from hull.culling import Culling
from hull.marching import binary_surface
from hull.ridges import raise_ridges
from hull.surface import cross_exactly, way_out
from hull.tables import NO_EVIDENCE, OUTSIDE, UNKNOWN, SilhouetteTable, prepare_tables
from hull.visual_hull import grid_over
from hull.witnesses import witness_rule
from tests.hull_subjects import figure


def _noisy(image: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Specks and holes, and a part that is unknown: outlines everywhere."""
    flips = np.kron(random.random((image.shape[0] // 4, image.shape[1] // 4)) < 0.004, np.ones((4, 4)))
    image = np.where(flips > 0, 255 - image, image).astype(np.uint8)
    image[200:230, 40:150] = UNKNOWN
    return image


def _scenes() -> dict[str, tuple[Rig, list[np.ndarray]]]:
    random = np.random.default_rng(2)
    dome, cage = dome_layout(20, (320, 320)), cage_layout(8, (320, 320))
    return {
        "clean": (dome, figure().silhouettes(dome)),
        "noisy": (cage, [_noisy(image, random) for image in figure().silhouettes(cage)]),
    }


@pytest.mark.parametrize("scene", ["clean", "noisy"])
def test_the_surface_is_the_same_with_and_without_culling(scene: str) -> None:
    rig, images = _scenes()[scene]
    tables = prepare_tables(rig, images)
    box = bounds_from_tables(tables)
    grid = grid_over(box, 0.016)
    surface = binary_surface(carve(tables, witness_rule(tables, box.centre), grid))
    culling = Culling(tables, grid)
    culled, plain = cross_exactly(surface, grid, tables, culling), cross_exactly(surface, grid, tables)
    assert np.abs(culled.vertices - plain.vertices).max() < 1e-9
    assert (culled.cut_by == plain.cut_by).all()
    normals = vertex_normals(plain.vertices, surface.faces)
    cell_m = np.full(len(normals), 0.016)
    raised, faces = raise_ridges(culled, surface.faces, normals, tables, cell_m, culling)
    plainly, plain_faces = raise_ridges(plain, surface.faces, normals, tables, cell_m)
    assert len(raised.vertices) > 1.05 * len(plain.vertices), "no ridge was raised"
    assert (faces == plain_faces).all()
    assert np.abs(raised.vertices - plainly.vertices).max() < 1e-9
    assert (raised.cut_by == plainly.cut_by).all()
    assert is_closed(faces, len(raised.vertices))
    asked = _n_asked(culling, raised.vertices.T)
    assert asked < 0.9, f"{asked:.0%} of the questions were left"


def test_the_witnesses_are_counted_alike() -> None:
    rig, images = _scenes()["noisy"]
    tables = prepare_tables(rig, images)
    box = bounds_from_tables(tables)
    culling = Culling(tables, grid_over(box, 0.016))
    points = np.random.default_rng(0).uniform(box.low, box.high, size=(4000, 3)).T
    blocks = culling.blocks_of(points)
    n_unsure = 0
    for table_idx, table in enumerate(tables):
        seen, unsure = culling.evidence(table_idx, blocks)
        answers = table.ask_points(points)
        seen[unsure] = answers[unsure] != NO_EVIDENCE
        assert (seen == (answers != NO_EVIDENCE)).all()
        n_unsure += len(unsure)
        spared = np.setdiff1d(np.arange(points.shape[1]), culling.may_refuse(table_idx, blocks))
        assert (answers[spared] != OUTSIDE).all()
    assert 0 < n_unsure < 0.5 * len(tables) * points.shape[1]


def test_a_crossing_lies_where_the_silhouette_is_one_half() -> None:
    """A vertex that a camera cuts projects onto that camera's bilinear outline, to a hundredth of a pixel."""
    rig, images = _scenes()["clean"]
    tables = prepare_tables(rig, images)
    box = bounds_from_tables(tables)
    for voxel_m in (0.012, 0.032):
        grid = grid_over(box, voxel_m)
        surface = binary_surface(carve(tables, witness_rule(tables, box.centre), grid))
        crossings = cross_exactly(surface, grid, tables)
        ends = grid.centres(surface.outer.T) - grid.centres(surface.inner.T)
        share = np.linalg.norm(crossings.vertices - grid.centres(surface.inner.T).T, axis=1) / voxel_m
        off = []
        for table_idx, table in enumerate(tables):
            mine = (crossings.cut_by == table_idx) & (share > 0.03) & (share < 0.97)
            off.append(_pixels_to_the_outline(table, crossings.vertices[mine].T, ends[:, mine]))
        errors = np.concatenate(off)
        assert len(errors) > 1000
        assert np.median(errors) < 0.01, f"median {np.median(errors):.3f} px at {voxel_m} m"
        # Edges that graze an outline see its value rise and fall slowly.
        assert np.percentile(errors, 95) < 0.1, (
            f"95 % below {np.percentile(errors, 95):.3f} px at {voxel_m} m"
        )


def test_a_way_that_begins_behind_the_camera_ends_half_way() -> None:
    rig, images = _scenes()["clean"]
    table = prepare_tables(rig, images)[0]
    forward = table.projection[2, :3] / np.linalg.norm(table.projection[2, :3])
    starts = table.centre[:, None] + forward[:, None] * np.array([-0.2, -0.1, 0.3])
    ways = np.repeat(forward[:, None], 3, axis=1)
    base, way = table.projected(starts), table.projected_way(ways)
    some, all_ = (
        way_out(table, base, way, np.full(3, 0.8)),
        way_out(table, base[:, :2], way[:, :2], np.ones(2)),
    )
    assert some[:2].tolist() == [0.4, 0.4]
    assert 0 <= some[2] <= 0.8
    assert all_.tolist() == [0.5, 0.5]


def _pixels_to_the_outline(table: SilhouetteTable, points: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """How far along its edge, in pixels, each point lies from where the value is exactly one half."""
    base, way = table.projected(points), table.projected_way(ends)
    px = np.linalg.norm((base + 1e-6 * way)[:2] / (base + 1e-6 * way)[2] - base[:2] / base[2], axis=0) / 1e-6
    reach = 0.5 / np.maximum(px, 1e-9)
    low, high = -reach, reach
    for _ in range(16):
        middle = 0.5 * (low + high)
        u, v, depth = base + way * middle
        outside = table.ask_pixels(u / depth, v / depth) < 0.5
        low, high = np.where(outside, low, middle), np.where(outside, middle, high)
    return np.abs(0.5 * (low + high)) * px


def _n_asked(culling: Culling, places: np.ndarray) -> float:
    blocks = culling.blocks_of(places)
    asked = sum(len(culling.may_refuse(k, blocks)) for k in range(len(culling.tables)))
    return asked / (len(culling.tables) * places.shape[1])
