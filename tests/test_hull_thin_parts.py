"""Parts thinner than the grid: cells are halved there, and the surface stays closed and manifold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from capture.layouts import dome_layout
from hull.bounds import bounds_from_tables
from hull.carve import Blocks, Grid, carve
from hull.cleaning import is_closed
from hull.culling import Culling
from hull.diagnosis import inside_by_definition
from hull.finer_cells import interior, placed, with_finer_cells
from hull.marching import GridSurface, binary_surface
from hull.quality import silhouette_agreement
from hull.tables import prepare_tables
from hull.thin_parts import halved, with_thin_parts
from hull.visual_hull import build_hull, grid_over
from hull.witnesses import witness_rule
from tests.hull_subjects import Balls, ball, is_vertex_manifold

N = 9


def _volume(smooth: float, seed: int) -> np.ndarray:
    """Random bools on a lattice four times as fine as a grid of N voxels, none at its end."""
    random = np.random.default_rng(seed)
    values = random.random((4 * N,) * 3)
    values = gaussian_filter(values, smooth) if smooth else values
    volume = values > np.median(values)
    volume[:4] = volume[-4:] = False
    volume[:, :4] = volume[:, -4:] = False
    volume[:, :, :4] = volume[:, :, -4:] = False
    return volume


def _coarse(volume: np.ndarray) -> GridSurface:
    voxels = np.stack(np.nonzero(volume[::4, ::4, ::4]))
    return binary_surface(Blocks(Grid(np.zeros(3), 1.0, (N, N, N)), (voxels,)))


@pytest.mark.parametrize("smooth", [0.0, 0.8, 2.0])
@pytest.mark.parametrize("share", [0.03, 0.4, 0.8])
def test_closed_and_manifold_whatever_cells_are_halved_and_halved_again(smooth: float, share: float) -> None:
    for seed in range(3):
        random, volume = np.random.default_rng(seed), _volume(smooth, seed)
        surface = _coarse(volume)
        cells = np.argwhere(random.random((N - 2,) * 3) < share) + 1
        halves = with_finer_cells(surface, cells, lambda at, v=volume: v[tuple(2 * at.T)])
        assert halves is not None
        once, cells = halves
        inner = placed(interior(cells))
        chosen = inner[random.random(len(inner)) < 0.5]
        surfaces = [once]
        if len(chosen):
            asked = lambda at, v=volume: v[tuple(at.T)]  # noqa: E731
            again = with_finer_cells(once, chosen, asked, interior(cells))
            assert again is not None
            surfaces.append(again[0])
        for found in surfaces:
            assert is_closed(found.faces, len(found.inner))
            assert is_vertex_manifold(found.faces, len(found.inner))
            assert len(np.unique(found.faces)) == len(found.inner), "a vertex that no face uses"
            length = np.abs(found.outer - found.inner).sum(axis=1)
            assert set(length) <= {1, 2, 4}


def test_all_cells_halved_are_marching_cubes_at_half_the_pitch() -> None:
    volume = _volume(1.5, 3)
    cells = np.argwhere(np.ones((N - 1,) * 3, dtype=bool))
    halves = with_finer_cells(_coarse(volume), cells, lambda at: volume[tuple(2 * at.T)])
    assert halves is not None
    found, _ = halves
    fine = np.stack(np.nonzero(volume[::2, ::2, ::2]))
    expected = binary_surface(Blocks(Grid(np.zeros(3), 1.0, (2 * N,) * 3), (fine,)))
    assert {tuple(row) for row in (found.inner + found.outer).tolist()} == {
        tuple(row) for row in (expected.inner + expected.outer).tolist()
    }
    assert len(found.faces) == len(expected.faces)


def test_vertices_of_halved_cells_part_inside_from_outside_by_definition() -> None:
    """What the halved cells take for inside is what every camera says of those places."""
    rig, subject = dome_layout(12, (300, 300)), _fork()
    tables = prepare_tables(rig, subject.silhouettes(rig))
    box = bounds_from_tables(tables)
    grid, rule = grid_over(box, 0.024), witness_rule(tables, box.centre)
    coarse = binary_surface(carve(tables, rule, grid))
    surface, fine = with_thin_parts(coarse, grid, Culling(tables, grid), rule)
    assert fine.voxel_m < grid.voxel_m
    assert len(surface.faces) > len(coarse.faces)
    # Borders are calmed: a few of their points are not what the cameras say.
    for ends, expected in ((surface.inner, True), (surface.outer, False)):
        said = inside_by_definition(tables, rule, fine.centres(ends.T))
        assert (said == expected).mean() > 0.995


def _fork() -> Balls:
    """A trunk with three prongs 14 mm thick."""
    centres, radii = [(0.0, 0.0, 1.0 + 0.04 * k) for k in range(6)], [0.12] * 6
    for side in (-0.06, 0.0, 0.06):
        centres += [(0.1 + 0.005 * k, side, 1.1 + 0.001 * k) for k in range(50)]
        radii += [0.007] * 50
    return Balls(np.array(centres), np.array(radii))


def test_prongs_thinner_than_a_voxel_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, subject = dome_layout(16, (512, 512)), _fork()
    images = subject.silhouettes(rig)
    hull = build_hull(rig, images, 0.02)
    with monkeypatch.context() as patch:
        patch.setattr("hull.thin_parts._N_HALVINGS", 0)
        without = build_hull(rig, images, 0.02)
    agreement, before = (silhouette_agreement(h.vertices, h.faces, rig, images) for h in (hull, without))
    tips = hull.vertices[hull.vertices[:, 0] > 0.32]
    for side in (-0.06, 0.0, 0.06):
        assert (np.abs(tips[:, 1] - side) < 0.02).any(), f"the prong at {side} m is missing"
    assert hull.vertices[:, 0].max() == pytest.approx(0.352, abs=0.012)
    # A prong is three pixels thick.
    assert agreement.min() > 0.97
    assert before.min() < 0.95, "the grid alone finds the prongs"


def test_a_fork_is_watertight_and_manifold_too() -> None:
    rig = dome_layout(12, (320, 320))
    for voxel_m in (0.024, 0.013):
        hull = build_hull(rig, _fork().silhouettes(rig), voxel_m)
        assert is_closed(hull.faces, len(hull.vertices))
        assert is_vertex_manifold(hull.faces, len(hull.vertices))
        assert np.isfinite(hull.vertices).all()


@pytest.mark.parametrize("votes", [1, 2])
def test_compiled_or_plain_the_same_cells_are_halved(votes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = dome_layout(12, (300, 300))
    images = _fork().silhouettes(rig)
    for image in images[::3]:
        image[:, 170:] = 128
    tables = prepare_tables(rig, images)
    box = bounds_from_tables(tables)
    grid, rule = grid_over(box, 0.024), witness_rule(tables, box.centre)
    coarse = binary_surface(carve(tables, rule, grid, votes))
    compiled, _ = with_thin_parts(coarse, grid, Culling(tables, grid), rule, votes)
    monkeypatch.setattr("hull.culling.stacked", lambda tables: None)
    plain, _ = with_thin_parts(coarse, grid, Culling(tables, grid), rule, votes)
    assert len(plain.faces) != len(coarse.faces)
    for name in ("inner", "outer", "faces"):
        assert np.array_equal(getattr(compiled, name), getattr(plain, name)), name


@pytest.mark.parametrize("voxel_m", [0.005, 0.006])
def test_grids_finer_than_a_fingers_third_are_left_alone(
    voxel_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def noted(surface: GridSurface, grid: Grid, *others: object) -> tuple[GridSurface, Grid]:
        asked.append(grid.voxel_m)
        return surface, grid

    monkeypatch.setattr("hull.visual_hull.with_thin_parts", noted)
    rig = dome_layout(8, (160, 160))
    build_hull(rig, ball(0.12).silhouettes(rig), voxel_m)
    assert asked == ([] if voxel_m < 0.0055 else [voxel_m])


def test_halved_voxels_lie_where_they_were_and_between() -> None:
    grid = Grid(np.array([0.1, -0.2, 0.3]), 0.02, (5, 6, 7))
    fine = halved(grid)
    place = np.array([[1], [2], [3]])
    assert fine.centres(2 * place) == pytest.approx(grid.centres(place), abs=1e-12)
    last = np.array([[4], [5], [6]])
    assert np.array(fine.shape) - 1 == pytest.approx(2 * last.ravel())
