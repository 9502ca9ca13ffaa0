"""What the accuracy tables are made of, on cases whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.accuracy import chosen, plan
from benchmarks.accuracy_baseline import in_zero_pose
from benchmarks.accuracy_cells import DETAILED, FUSION, Cell
from benchmarks.accuracy_protocol import (
    Posed,
    error_by_frame,
    low_quantile_shape,
    marker_errors_mm,
    mean_shape,
    rms_by_confidence,
    score,
    share_within,
    tied_frames,
    vertex_towards,
)
from benchmarks.accuracy_subjects import SEEDS, scanned
from benchmarks.accuracy_tables import laws, markdown, summary, table_one
from fit.body.model import load_body
from fit.evaluate import Surface
from fit.solver import Fitter, ScanPoints
from fit.state import BodyState
from fit.surface import vertex_normals
from render.scene import Surface as Drawn


def sphere(radius: float, n: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A closed ball of triangles with its normals outwards, m."""
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh.create_sphere(radius, n)
    return np.asarray(mesh.vertices).copy(), np.asarray(mesh.triangles).astype(np.int64)


def test_ties_come_from_ten_frames_of_the_first_fifty() -> None:
    assert tied_frames(200).tolist() == tied_frames(50).tolist()
    assert len(tied_frames(200)) == 10
    assert (tied_frames(200)[0], tied_frames(200)[-1]) == (0, 49)
    assert tied_frames(3).tolist() == [0, 1, 2], "no frame twice where there are few"


def test_markers_that_ride_on_the_result_have_the_error_of_their_tie() -> None:
    rng = np.random.default_rng(0)
    body = rng.uniform(-1, 1, (50, 3))
    moving = body + np.linspace(0, 1, 12)[:, None, None] * [0.3, 0.0, 0.1]
    markers = moving[:, [3, 17]] + [0.0, 0.004, 0.0]
    errors = marker_errors_mm(markers, moving)
    assert errors.shape == (10, 12, 2)
    np.testing.assert_allclose(errors, 4.0, atol=1e-9)
    np.testing.assert_allclose(error_by_frame(errors), 4.0, atol=1e-9)
    np.testing.assert_array_equal(share_within(errors, np.array([3, 5])), [0.0, 1.0])


def test_a_result_that_slips_away_shows_in_the_frames_where_it_does() -> None:
    body = np.eye(3)[None].repeat(10, axis=0)
    result = body.copy()
    result[5:] += [0.0, 0.0, 0.01]
    errors = marker_errors_mm(body, result)
    # Half of the ties were taken before it slipped and half after: the nearest vertex is the same.
    np.testing.assert_allclose(error_by_frame(errors), [0.0] * 5 + [10.0] * 5, atol=1e-9)
    np.testing.assert_allclose(share_within(errors, np.array([0, 9, 11])), [0.5, 0.5, 1.0])


def test_the_naive_quantile_is_the_sphere_that_a_tenth_of_the_frames_go_below() -> None:
    vertices, faces = sphere(1.0)
    radii = np.linspace(1.0, 1.2, 21)
    templates = radii[:, None, None] * vertices
    low = low_quantile_shape(templates, faces)
    # The mean is a sphere of 1.1; a tenth of the way from 1.0 to 1.2 lies at 1.02.
    outwards = np.einsum("va,va->v", vertices, vertex_normals(vertices, faces))
    expected = 1.1 + (1.02 - 1.1) * outwards**2
    np.testing.assert_allclose(np.einsum("va,va->v", low, vertices), expected, atol=1e-9)
    np.testing.assert_allclose(mean_shape(templates), 1.1 * vertices, atol=1e-12)
    np.testing.assert_allclose(low_quantile_shape(templates, faces, 0.5), 1.1 * vertices, atol=1e-9)


def test_fifths_of_confidence_are_equal_in_area_and_in_order() -> None:
    confidence = np.linspace(0, 1, 1001)
    error = 10.0 * (1.0 - np.floor(confidence * 4.999) / 4.0)
    fifths = rms_by_confidence(confidence, error, np.ones(1001))
    means, sizes = np.array(fifths).T
    np.testing.assert_allclose(means, [0.1, 0.3, 0.5, 0.7, 0.9], atol=2e-3)
    np.testing.assert_allclose(sizes, [10.0, 7.5, 5.0, 2.5, 0.0], atol=0.3)
    assert (np.diff(sizes) < 0).all()


def test_the_same_confidence_everywhere_is_one_group() -> None:
    found = rms_by_confidence(np.full(9, 0.5), np.full(9, 3.0), np.ones(9))
    assert found == [(pytest.approx(0.5), pytest.approx(3.0))]


def test_a_ball_two_millimetres_too_big_scores_two_millimetres_too_fat() -> None:
    truth, faces = sphere(0.3, 80)  # so fine that turning it brings no vertex over a facet's middle
    result = Surface(truth * (0.302 / 0.3), faces)
    everywhere = np.ones(len(truth), dtype=bool)
    posed = Posed(result, np.ones((len(truth), 1)), np.zeros((1, 3)), np.array([-1]))
    found = score(posed, truth, faces, everywhere, truth[:, 2] > 0, truth[:, 2] < 0)
    for summary_of in (found.paper, found.direct):
        assert summary_of.rms == pytest.approx(2.0, abs=0.1)
        assert summary_of.bias == pytest.approx(2.0, abs=0.1)
    moved = replace(posed, surface=Surface(result.vertices + np.array([0.01, 0.0, 0.0]), faces))
    again = score(moved, truth, faces, everywhere, truth[:, 2] > 0, truth[:, 2] < 0)
    assert again.paper.rms == pytest.approx(2.0, abs=0.1), "the paper's measure scores shape, not place"
    assert again.direct.rms > 5.0


def test_a_marker_lies_where_its_way_leaves_the_body() -> None:
    vertices, _ = sphere(0.1)
    for way in np.concatenate([np.eye(3), -np.eye(3)]):
        found = vertices[vertex_towards(vertices, np.zeros(3), way)]
        assert found @ way > 0.099


def test_a_scan_shows_the_outside_and_labels_what_it_shows() -> None:
    inner, faces = sphere(0.2)
    outer = sphere(0.21)[0]
    upper = faces[(outer[faces][:, :, 2] > 0.0).all(1)]
    grey = np.full((len(inner), 3), 128, np.uint8)
    lift = np.array([0.0, 0.0, 1.0])
    scan = scanned([Drawn(inner + lift, faces, grey), Drawn(outer + lift, upper, grey)], 2000, [1])
    radius = np.linalg.norm(scan.points - lift, axis=1)
    above = scan.points[:, 2] > 1.05
    assert len(scan.points) == 2000
    assert not scan.is_skin[above].any(), "what lies under the cap is not seen"
    assert scan.is_skin[scan.points[:, 2] < 0.95].all()
    assert abs(radius[above].mean() - 0.21) < 0.001
    assert radius[above].min() > 0.206


def test_points_of_a_posed_body_go_back_to_the_zero_pose() -> None:
    model = load_body("free:neutral", show_progress=False)
    fitter, rng = Fitter.of(model), np.random.default_rng(2)
    betas = np.zeros(model.n_betas)
    betas[:4] = rng.standard_normal(4)
    pose = 0.2 * rng.standard_normal((model.n_joints, 3))
    state = BodyState(fitter.shaped(betas), pose, np.array([0.1, 1.0, -0.3]), betas)
    posed = fitter.posed(state)
    points = posed + 0.002 * vertex_normals(posed, model.faces)
    n = len(points)
    back = in_zero_pose(
        fitter, state, ScanPoints(points, vertex_normals(posed, model.faces), np.ones(n), np.zeros(n, bool))
    )
    away = np.linalg.norm(back.points - state.template, axis=1)
    assert np.median(away) == pytest.approx(0.002, rel=0.1)
    along = np.einsum("va,va->v", back.normals, vertex_normals(state.template, model.faces))
    assert np.median(along) > 0.99


def cell_of(seed: int, source: str, fusion: float, detailed: float) -> dict:
    """A finished cell, as far as the tables look at it."""

    def error(size: float) -> dict:
        one = {"rms": size, "mean": size, "bias": -size, "p90": size}
        return {"paper": one, "under_cloth": one, "bare": one, "direct": one}

    return {
        "cell": {"seed": seed, "outfit": "tshirt-shorts", "motion": "hips", "source": source,
                 "n_frames": 40, "used": 0},
        "errors": {FUSION: error(fusion), DETAILED: error(detailed)},
        "scan": {"mean_mm": 12.0},
    }  # fmt: skip


def test_tables_say_what_the_cells_say() -> None:
    cells = [cell_of(1, "scans", 3.0, 2.0), cell_of(2, "scans", 4.0, 5.0)]
    cells.append(cell_of(1, "scans-labelled", 3.0, 1.5))
    block = table_one(cells)
    assert "| scans, all cloth: fusion | 3.00 | 4.00 | **3.54 (-3.5)** |  |" in block
    assert "| scans, labelled: detailed | 1.50 | - | **1.50 (-1.5)** | 2.55 |" in block, "the paper's beside"
    assert "Yang" not in block, "no row for a result that nobody made"
    assert "| scans, all cloth (2) | - | - | - | 3.54 (-3.5) | 3.81 (-3.5) |" in summary(cells)
    told = laws(cells)
    assert "| detailed better than fusion, scans, all cloth | 1 of 2 | +0.00 | -1.00 | +1.00 |" in told
    assert "| labelled better than all cloth, detailed | 1 of 1 | +0.50 | +0.50 | +0.50 |" in told
    assert "| scans, all cloth within 2.5 mm, detailed | 1 of 2 | -1.00 | -2.50 | +0.50 |" in told
    assert "quantile" not in told


def test_markdown_has_a_line_a_row() -> None:
    assert markdown("T", ["a", "b"], [["1", "2"]]) == "\nT\n\n| a | b |\n| --- | --- |\n| 1 | 2 |"


def test_the_plan_holds_every_cell_of_the_papers_table() -> None:
    cells = plan(quick=False, full=True, n_frames=40)["table"]
    assert len(set(cells)) == len(cells) == 6 * 2 * 3 * 4
    assert {c.seed for c in cells} == set(SEEDS)
    assert not {c.seed for c in plan(True, False, 12)["table"]} & set(SEEDS), "quick runs leave them alone"
    some = chosen(cells, ["9001", "9002", "hips", "scans"])
    assert {(c.seed, c.motion, c.source) for c in some} == {(k, "hips", "scans") for k in (9001, 9002)}


def test_fewer_frames_are_spread_over_the_whole_sequence() -> None:
    cell = Cell(1, "none", "hips", "scans", 40)
    assert cell.frame_ids == tuple(range(40))
    assert replace(cell, used=4).frame_ids == (5, 15, 25, 35)
    assert cell.name != replace(cell, used=4).name
