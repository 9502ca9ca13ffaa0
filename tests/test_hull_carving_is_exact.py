"""Adaptive carving finds what asking every voxel's centre in every camera finds, voxel for voxel."""

from __future__ import annotations

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import cage_layout, dome_layout, ring_layout
from capture.rig import Rig
from hull.carve import Grid, carve
from hull.diagnosis import inside_by_definition
from hull.tables import INSIDE, NO_EVIDENCE, OUTSIDE, UNKNOWN, prepare_table, prepare_tables
from hull.witnesses import witness_rule
from tests.hull_subjects import figure


def _differences(rig: Rig, images: list, grid: Grid, votes: int = 1) -> tuple[int, int]:
    tables = prepare_tables(rig, images)
    rule = witness_rule(tables, grid.low + 0.5 * grid.voxel_m * np.array(grid.shape))
    blocks = carve(tables, rule, grid, votes)
    found = blocks.dense(np.zeros(3, dtype=int), np.array(grid.shape))
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij")).reshape(3, -1)
    expected = inside_by_definition(tables, rule, grid.centres(cells), votes)
    assert blocks.n_voxels == found.sum()
    return int((found.ravel() != expected).sum()), int(expected.sum())


GRID = Grid(np.array([-0.83, -0.41, -0.17]), 0.021, (79, 40, 97))


@pytest.mark.parametrize("votes", [1, 2, 3])
def test_equal_to_the_definition_for_a_figure(votes: int) -> None:
    rig = dome_layout(9, (320, 320))
    n_different, n_inside = _differences(rig, figure().silhouettes(rig), GRID, votes)
    assert n_inside > 5000
    assert n_different == 0


def test_equal_to_the_definition_when_pictures_are_cropped_unknown_and_missing() -> None:
    rig = ring_layout(8, (320, 320))
    images: list = figure().silhouettes(rig)
    images[0] = None
    images[1][100:180, :] = UNKNOWN
    images[2][:, :150] = UNKNOWN
    cropped = _cropped(rig[3], rows=200)
    rig = Rig((*rig.cameras[:3], cropped, *rig.cameras[4:]))
    images[3] = images[3][:200].copy()
    n_different, n_inside = _differences(rig, images, GRID)
    assert n_inside > 5000
    assert n_different == 0


def test_equal_to_the_definition_for_noise() -> None:
    """Silhouettes without any shape exercise every table and every bound, also with far too large cells."""
    random = np.random.default_rng(3)
    rig = cage_layout(4, (200, 160))
    images = []
    for _ in rig:
        coarse = random.choice([0, 255, 255, 255, UNKNOWN], size=(20, 25)).astype(np.uint8)
        images.append(np.ascontiguousarray(np.kron(coarse, np.ones((8, 8), dtype=np.uint8))))
    for grid in (GRID, Grid(np.array([-4.0, -4.0, -2.0]), 0.13, (61, 63, 47))):
        n_different, n_inside = _differences(rig, images, grid)
        assert n_inside > 100
        assert n_different == 0


def test_more_cameras_than_bits_in_a_word() -> None:
    rig = dome_layout(70, (160, 160))
    n_different, n_inside = _differences(rig, figure().silhouettes(rig), GRID)
    assert n_inside > 5000
    assert n_different == 0


def test_a_cell_never_contradicts_a_point_in_it() -> None:
    """Also beside, around and behind the camera, where the projection turns over."""
    random = np.random.default_rng(0)
    camera = dome_layout(3, (200, 150))[1]
    image = random.choice([0, 255, UNKNOWN], size=(15, 20), p=[0.5, 0.4, 0.1]).astype(np.uint8)
    table = prepare_table(camera, np.kron(image, np.ones((10, 10), dtype=np.uint8)), 0)
    decided = 0
    for half, spread in ((0.002, 0.3), (0.02, 0.3), (0.02, 5.0), (0.1, 2.0), (0.5, 2.0), (2.0, 5.0)):
        centres = np.array([[0.0], [0.0], [1.1]]) + spread * random.normal(size=(3, 4000))
        sets = table.ask_cells(centres, half)
        for _ in range(12):
            answers = table.ask_points(centres + random.uniform(-half, half, size=centres.shape))
            assert (answers & ~sets == 0).all()
        decided |= np.bitwise_or.reduce(sets[np.isin(sets, (INSIDE, OUTSIDE, NO_EVIDENCE))], initial=0)
    assert decided == INSIDE | OUTSIDE | NO_EVIDENCE, "the cells never came to one of the decisions"


def test_a_point_is_answered_by_the_interpolated_silhouette() -> None:
    random = np.random.default_rng(1)
    camera = dome_layout(3, (60, 50))[0]
    image = random.choice([0, 255], size=(50, 60)).astype(np.uint8)
    table = prepare_table(camera, image, 0)
    pixels = random.uniform([-3, -3], [63, 53], size=(20000, 2))
    answers = table.ask_points(camera.unproject(pixels, random.uniform(1, 6, size=len(pixels))).T)
    u, v = pixels.T
    seen = (u >= 2) & (u < 57) & (v >= 2) & (v < 47)  # two border pixels at each side say nothing
    assert (answers[~seen] == NO_EVIDENCE).all()
    x, y = np.floor(u[seen]).astype(int), np.floor(v[seen]).astype(int)
    fx, fy = u[seen] - x, v[seen] - y
    person = (image > 127).astype(float)
    value = (person[y, x] * (1 - fx) + person[y, x + 1] * fx) * (1 - fy)
    value += (person[y + 1, x] * (1 - fx) + person[y + 1, x + 1] * fx) * fy
    clear = np.abs(value - 0.5) > 1e-9
    assert ((answers[seen] == INSIDE) == (value >= 0.5))[clear].all()


def test_behind_the_camera_is_no_evidence() -> None:
    camera = ring_layout(3, (100, 100))[0]
    table = prepare_table(camera, np.full((100, 100), 255, dtype=np.uint8), 0)
    behind = camera.centre - camera.forward
    assert table.ask_points(behind[:, None]) == NO_EVIDENCE
    assert table.ask_cells(behind[:, None], 0.1) == NO_EVIDENCE


def _cropped(camera: Camera, rows: int) -> Camera:
    """The same camera, whose sensor ends after so many rows."""
    return Camera(
        camera.name,
        (camera.size[0], rows),
        camera.intrinsics,
        camera.camera_from_world,
        camera.distortion,
        camera.projection,
    )
