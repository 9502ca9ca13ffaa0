"""The compiled loops give what the plain definitions give, to the last bit."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import cage_layout, dome_layout, look_at
from capture.rig import Rig
from hull import cleaning, marching, ridges, slack, tables
from hull.bounds import bounds_from_tables
from hull.carve import Blocks, carve
from hull.culling import Culling
from hull.loops import mesh_loops, table_loops
from hull.stack import stacked
from hull.surface import cross_exactly
from hull.tables import NO_EVIDENCE, OUTSIDE, UNKNOWN, SilhouetteTable, prepare_tables
from hull.visual_hull import grid_over
from hull.witnesses import witness_rule
from tests.hull_subjects import figure

VOXEL_M = 0.02
ROOT = Path(__file__).parent.parent


class PlainTable(SilhouetteTable):
    """A table that the compiled loops leave alone."""


def _plain(some: tuple[SilhouetteTable, ...]) -> tuple[SilhouetteTable, ...]:
    return tuple(PlainTable(**{f.name: getattr(table, f.name) for f in fields(table)}) for table in some)


def _spoilt(rig: Rig, images: list[np.ndarray]) -> list[np.ndarray]:
    """Specks, holes, and a part that is unknown."""
    random = np.random.default_rng(2)
    spoilt = []
    for image in images:
        flips = np.kron(random.random((image.shape[0] // 4, image.shape[1] // 4)) < 0.003, np.ones((4, 4)))
        image = np.where(flips > 0, 255 - image, image).astype(np.uint8)
        image[200:230, 40:150] = UNKNOWN
        spoilt.append(image)
    return spoilt


def _scene(name: str) -> tuple[SilhouetteTable, ...]:
    if name == "clean":
        rig = dome_layout(66, (160, 160))  # more than one word of cameras
        return prepare_tables(rig, figure().silhouettes(rig))
    rig = cage_layout(9, (320, 320))
    # One camera stands within the space that is carved, so that some of it lies behind.
    inner = Camera(
        "inner",
        (320, 320),
        np.array([[300.0, 0, 160], [0, 300, 160], [0, 0, 1]]),
        look_at(np.array([0.0, -0.9, 1.0]), np.array([0.0, 0.0, 1.0]), np.array([0, 0, 1.0])),
        np.zeros(0),
    )
    rig = Rig((*rig.cameras, inner))
    return prepare_tables(rig, _spoilt(rig, figure().silhouettes(rig)))


@pytest.fixture(scope="module", params=["clean", "spoilt"])
def scene(request: pytest.FixtureRequest) -> tuple[SilhouetteTable, ...]:
    return _scene(request.param)


def _same_blocks(some: Blocks, other: Blocks) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(some.cells, other.cells, strict=True))


def test_the_numbers_that_stand_in_two_places_agree() -> None:
    loops = table_loops()
    assert loops is not None
    for name in ("INSIDE", "OUTSIDE", "NO_EVIDENCE", "UNDECIDED", "FIRST_OUTLINE_BLOCK"):
        assert getattr(loops, name) == getattr(tables, name), name
    assert (loops.DEEP, loops.HIGH) == (ridges.DEEP, ridges.HIGH)
    assert tables.BLOCK_PX == 4, "hull.compiled counts on blocks of four pixels"
    table = _scene("clean")[0]
    assert len(table.numbers) == loops.N_NUMBERS
    assert table.numbers[loops.LOWEST_X : loops.LOWEST_Y + 1] == table.lowest
    assert table.numbers[loops.ORIGIN_X :] == table.origin


def test_importing_the_hull_starts_no_compiler() -> None:
    code = "import sys, hull.visual_hull; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_plain_tables_are_left_alone(scene: tuple[SilhouetteTable, ...]) -> None:
    assert stacked(scene) is not None
    assert stacked(_plain(scene)) is None
    assert stacked((*scene[:-1], *_plain(scene[-1:]))) is None


def test_cells_are_answered_alike(scene: tuple[SilhouetteTable, ...]) -> None:
    stack = stacked(scene)
    assert stack is not None
    centres = np.random.default_rng(0).uniform([-2, -2, -1], [2, 2, 3], (3000, 3)).T.copy()
    kinds = set()
    for half_m in (0.005, 0.04, 0.3):
        found = np.empty((len(scene), centres.shape[1]), dtype=np.uint8)
        stack.loops.ask_cells(stack.numbers, stack.projections, centres, half_m, found)
        for answers, table in zip(found, scene, strict=True):
            assert np.array_equal(answers, table.ask_cells(centres, half_m)), table.name
        kinds |= set(np.unique(found).tolist())
    assert {1, 2, 3, 4, 7} <= kinds, f"only {kinds} occurred"


@pytest.mark.parametrize("votes", [1, 2])
def test_the_same_voxels_are_carved(scene: tuple[SilhouetteTable, ...], votes: int) -> None:
    plain = _plain(scene)
    box, plain_box = bounds_from_tables(scene), bounds_from_tables(plain)
    assert np.array_equal(box.low, plain_box.low)
    assert np.array_equal(box.high, plain_box.high)
    rule, grid = witness_rule(scene, box.centre), grid_over(box, VOXEL_M)
    blocks = carve(scene, rule, grid, votes)
    assert blocks.n_voxels > 1000
    assert _same_blocks(blocks, carve(plain, rule, grid, votes))


@pytest.mark.parametrize("votes", [1, 2])
def test_the_same_surface_with_the_same_facts(scene: tuple[SilhouetteTable, ...], votes: int) -> None:
    box = bounds_from_tables(scene)
    grid = grid_over(box, VOXEL_M)
    surface = marching.binary_surface(carve(scene, witness_rule(scene, box.centre), grid, votes))
    results = []
    for some in (scene, _plain(scene)):
        culling = Culling(some, grid)
        crossings = cross_exactly(surface, grid, some, culling, votes)
        normals = cleaning.vertex_normals(crossings.vertices, surface.faces, n_rings=1)
        cell_m = np.full(len(normals), VOXEL_M)
        raised, faces = ridges.raise_ridges(crossings, surface.faces, normals, some, cell_m, culling, votes)
        results.append((raised, faces, slack.outlines_at(raised.vertices, culling)))
    (raised, faces, outlines), (plainly, plain_faces, plain_outlines) = results
    assert np.array_equal(faces, plain_faces)
    assert np.array_equal(raised.vertices, plainly.vertices)
    assert np.array_equal(raised.cut_by, plainly.cut_by)
    assert len(raised.vertices) > len(surface.inner), "no ridge was raised"
    assert np.array_equal(outlines.n_witnesses, plain_outlines.n_witnesses)
    assert np.array_equal(outlines.n_bounding, plain_outlines.n_bounding)
    pairs = (np.lexsort((o.table_idx, o.point_idx)) for o in (outlines, plain_outlines))
    some_pairs, other_pairs = pairs
    assert np.array_equal(outlines.point_idx[some_pairs], plain_outlines.point_idx[other_pairs])
    assert np.array_equal(outlines.table_idx[some_pairs], plain_outlines.table_idx[other_pairs])


def test_the_loops_over_the_mesh_agree_with_numpy(
    scene: tuple[SilhouetteTable, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert mesh_loops() is not None
    box = bounds_from_tables(scene)
    grid = grid_over(box, VOXEL_M)
    blocks = carve(scene, witness_rule(scene, box.centre), grid)

    def described() -> tuple[np.ndarray, ...]:
        surface = marching.binary_surface(blocks)
        vertices, faces = surface.inner + 0.3 * (surface.outer - surface.inner), surface.faces
        label = cleaning.face_pieces(faces, len(vertices) + 3)
        values = np.where(np.arange(len(vertices)) % 7 == 0, vertices[:, 0], np.nan)
        return (
            surface.inner,
            surface.outer,
            faces,
            cleaning.vertex_normals(vertices, faces, 1),
            cleaning.vertex_normals(vertices, faces, 3),
            label,
            slack.spread_to_neighbours(values, faces, 2),
            slack.spread_to_neighbours(values, faces),
            cleaning.piece_volumes(vertices, faces, label),
        )

    compiled = described()
    for module in (marching, cleaning, slack):
        monkeypatch.setattr(module, "mesh_loops", lambda: None)
    *plain, volumes = described()
    for k, (some, other) in enumerate(zip(compiled, plain, strict=False)):
        assert np.array_equal(some, other), f"result {k}"
    np.testing.assert_allclose(compiled[-1], volumes, rtol=1e-9, atol=1e-9)
    assert (compiled[6] == 0).any(), "nothing was out of reach after two rounds"


def test_a_pictures_box_is_the_one_that_opencv_finds() -> None:
    loops, random = mesh_loops(), np.random.default_rng(3)
    assert loops is not None
    for size in ((40, 60), (33, 7), (1, 1), (5, 200)):
        assert loops.picture_box(np.zeros(size, dtype=np.uint8)) == (0, 0, 0, 0)
        for share in (0.001, 0.02, 0.5, 1.0):
            image = np.where(random.random(size) < share, 255, 0).astype(np.uint8)
            assert loops.picture_box(image) == tuple(cv2.boundingRect(image))


def test_a_place_behind_a_camera_is_no_evidence_compiled_either() -> None:
    table = _scene("spoilt")[-1]
    stack = stacked((table,))
    assert stack is not None
    forward = table.projection[2, :3] / np.linalg.norm(table.projection[2, :3])
    places = np.ascontiguousarray((table.centre + np.outer([-0.5, 0.9], forward)).T)
    answers = np.empty((1, 2), dtype=np.uint8)
    stack.loops.ask_cells(stack.numbers, stack.projections, places, 0.001, answers)
    assert answers[0, 0] == NO_EVIDENCE
    assert answers[0].tolist() == table.ask_cells(places, 0.001).tolist()
    refused = [
        stack.loops.refuser(stack.numbers, stack.projections, *place, -1, -1, 0, 1, np.array([0]), 1)
        for place in places.T
    ]
    assert refused[0] == -1
    assert [by == 0 for by in refused] == (table.ask_points(places) == OUTSIDE).tolist()
