"""The three stages on scans whose truth is known: each recovers what it should, failures are kept."""

from functools import cache

import numpy as np
import pytest

from fit.align import Alignment, align_sequence, mean_distance
from fit.closest import Container
from fit.evaluate import Surface, pose_truth_to, signed_error_mm, summarise, transfer_rig
from fit.frames import apply, recording_from_body, scan_in_body_frame
from fit.fuse import fit_scale_from_spread, fuse, trust_in_spread
from fit.outliers import lost_points, robust_variance
from fit.settings import FitSettings
from fit.state import BodyState
from fit.surface import vertex_normals
from fit.track import held_inside, track_frame
from hull.scan import Scan
from tests.test_fit_pose_finding import finder, fitter

SETTINGS = FitSettings(n_points=6000)


def person() -> np.ndarray:
    """A template that the model does not know: drawn betas, plus a bump on the belly."""
    betas = np.zeros(fitter().model.shape_directions.shape[2])
    betas[:4] = [0.8, 0.7, -0.5, 0.6]
    template = fitter().shaped(betas)
    normals = vertex_normals(template, fitter().model.faces)
    belly = np.array([0.0, 0.08, 0.13])
    bump = 0.008 * np.exp(-(((template - belly) / 0.09) ** 2).sum(1))
    return template + bump[:, None] * normals


@cache
def moves() -> tuple[BodyState, ...]:
    """Four frames of that person."""
    betas = np.zeros(fitter().model.shape_directions.shape[2])
    betas[:4] = [0.8, 0.7, -0.5, 0.6]
    states = []
    for k in range(4):
        pose = finder().mean_pose()
        pose[0] = [0.0, 0.3 * k, 0.0]
        pose[16] += [0.0, -0.2 * k, 0.2 * k]
        pose[4] += [0.15 * k, 0.0, 0.0]
        states.append(BodyState(person(), pose, np.array([0.05 * k, 0.9, 0.0]), betas))
    return tuple(states)


def clothed_scan(state: BodyState, thickness_m: float) -> Scan:
    """The posed person inflated along the normals where clothes would be, as a scan of its own vertices."""
    vertices = fitter().posed(state)
    normals = vertex_normals(vertices, fitter().model.faces)
    zero = state.template
    covered = (np.abs(zero[:, 0]) < 0.35) & (zero[:, 1] < 0.45) & (zero[:, 1] > -0.7)
    points = vertices + (thickness_m * covered)[:, None] * normals
    n = len(points)
    return Scan(points, normals, fitter().model.faces, np.zeros(n, dtype=bool), np.ones(n))


@cache
def bare_alignments() -> tuple[Alignment, ...]:
    scans = [(k, clothed_scan(state, 0.0), None) for k, state in enumerate(moves()[:2])]
    return tuple(align_sequence(fitter(), finder(), scans, SETTINGS))


def test_alignment_lies_on_the_scan_and_finds_the_shape():
    for alignment, state in zip(bare_alignments(), moves(), strict=False):
        assert alignment.status == "ok"
        assert alignment.distance_m < 0.002, f"{1e3 * alignment.distance_m:.2f} mm from the scan"
        posed = fitter().posed(alignment.state)
        error = np.linalg.norm(posed - fitter().posed(state), axis=1)
        assert np.median(error) < 0.012, f"vertices slid by {1e3 * np.median(error):.1f} mm"


def test_a_frame_with_nan_is_marked_and_does_not_stop_the_others():
    good = clothed_scan(moves()[0], 0.0)
    points = good.points.copy()
    points[:, 1] = np.nan
    broken = Scan(points, good.normals, None, good.is_skin, good.weight)
    done = align_sequence(fitter(), finder(), [(7, broken, None), (8, good, None), (9, None, None)], SETTINGS)
    assert [a.status for a in done] == ["failed", "ok"]
    assert "frame 000007" in done[0].message


def test_finished_frames_are_taken_as_they_are():
    before = {0: bare_alignments()[0]}
    scans = [(0, clothed_scan(moves()[0], 0.0), None)]
    assert align_sequence(fitter(), finder(), scans, SETTINGS, done_before=before)[0] is before[0]


def as_alignments(thickness: list[float]) -> list[Alignment]:
    """Perfect alignments of a person whose cloth stands off by this much in each frame."""
    base = moves()[0]
    normals = vertex_normals(base.template, fitter().model.faces)
    return [
        Alignment(k, base.moved(template=base.template + t * normals), 0.03, 0.002)
        for k, t in enumerate(thickness)
    ]


def test_fusion_shape_lies_inside_the_cloth_and_nearer_to_the_truth():
    fusion = fuse(fitter(), as_alignments([0.004, 0.012, 0.02, 0.008, 0.016]), SETTINGS)
    normals = vertex_normals(person(), fitter().model.faces)
    offset = ((fusion.template - person()) * normals).sum(1)
    assert np.median(offset) < 0.008, "nearer than the mean of the alignments, 12 mm"
    assert (offset < 0.012).mean() > 0.95


def test_fusion_of_bare_alignments_keeps_the_volume():
    fusion = fuse(fitter(), as_alignments([0.0, 0.001, -0.001, 0.0, 0.0005]), SETTINGS)
    surface = Surface(fusion.template, fitter().model.faces)
    error = summarise(signed_error_mm(person(), surface), np.ones(len(person())))
    assert error.rms < 2.5, f"{error}"
    assert abs(error.bias) < 1.5, f"{error}"


def test_lost_points_are_the_inward_outliers_only():
    rng = np.random.default_rng(0)
    offsets = 0.002 * rng.normal(size=(12, 500))
    offsets[3, :10] = -0.04
    offsets[5, 20:30] = +0.04
    lost = lost_points(offsets)
    assert lost[3, :10].all()
    assert not lost[5, 20:30].any()
    assert lost.mean() < 0.01
    assert robust_variance(offsets)[:10].mean() < 2.0 * robust_variance(offsets)[30:].mean()
    assert offsets[:, :10].var(axis=0).mean() > 20.0 * offsets[:, 30:].var(axis=0).mean()


def test_a_vertex_deep_inside_its_neighbours_is_lost_however_much_the_cloth_moves():
    swing = 0.02 * np.sin(2 * np.pi * np.arange(12) / 12)
    offsets = np.repeat(swing[:, None], fitter().model.n_vertices, axis=1)
    offsets[2, 100] -= 0.03
    assert not lost_points(offsets)[2, 100]
    lost = lost_points(offsets, fitter().laplacian)
    assert lost[2, 100]
    assert lost.sum() == 1


def test_spread_lowers_the_fit_weight_only_where_it_can_be_trusted():
    faces, n = fitter().model.faces, len(fitter().model.template)
    tight, loose = np.full(n, 0.0015), np.full(n, 0.008)
    trusted = [fit_scale_from_spread(s, faces, 1.0, SETTINGS).mean() for s in (tight, loose)]
    assert trusted[0] > 4.0 > 0.2 > trusted[1]
    assert fit_scale_from_spread(loose, faces, 0.0, SETTINGS).min() > 1.0
    near, far = (
        as_alignments([0.0] * 4),
        [a.__class__(0, a.state, 0.03, 0.012) for a in as_alignments([0.0] * 4)],
    )
    assert trust_in_spread(near, SETTINGS) == 1.0
    assert trust_in_spread(far, SETTINGS) < 0.1


def test_tracking_finds_the_pose_under_cloth_and_stays_inside_the_scan():
    fusion = fuse(fitter(), as_alignments([0.0, 0.001, -0.001, 0.0]), SETTINGS)
    state = moves()[1]
    scan = clothed_scan(state, 0.015)
    start = Alignment(
        1, state.moved(pose=state.pose + 0.05, translation=state.translation + 0.01), 0.03, 0.002
    )
    container = Container.of(scan.points, fitter().model.faces)
    found = track_frame(fitter(), finder(), fusion, start, scan, SETTINGS, container)
    vertices = fitter().posed(found, fusion.joints)
    beyond = container.closest(vertices).distance > 0.001
    assert beyond.mean() < 0.01, f"{100 * beyond.mean():.1f} % of the vertices stick out"
    error = np.linalg.norm(vertices - fitter().posed(state), axis=1)
    assert np.median(error) < 0.015, f"vertices are {1e3 * np.median(error):.1f} mm off"


def test_held_inside_leaves_a_body_that_is_inside_alone():
    fusion = fuse(fitter(), as_alignments([0.0, 0.001, -0.001, 0.0]), SETTINGS)
    state = moves()[0].moved(template=fusion.template, betas=fusion.betas)
    vertices = fitter().posed(state, fusion.joints)
    wide = vertices + 0.004 * vertex_normals(vertices, fitter().model.faces)
    container = Container.of(wide, fitter().model.faces)
    inside = container.closest(vertices).distance <= 0
    after = held_inside(fitter(), fusion, state, container)
    moved = np.linalg.norm(after.template - state.template, axis=1)
    assert inside.mean() > 0.9
    assert np.median(moved) < 1e-9


@pytest.mark.parametrize("up", [[0, 1, 0], [0, 0, 1], [0, -1, 0], [1, 0, 0], [-0.6, 0.0, 0.8]])
def test_recording_from_body_takes_up_to_up(up):
    transform = recording_from_body(np.array(up, float))
    np.testing.assert_allclose(transform[:3, :3] @ [0, 1, 0], np.array(up) / np.linalg.norm(up), atol=1e-12)
    np.testing.assert_allclose(transform[:3, :3] @ transform[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(transform[:3, :3]) == pytest.approx(1.0)
    scan = clothed_scan(moves()[0], 0.0)
    there = Scan(
        apply(transform, scan.points), scan.normals @ transform[:3, :3].T, None, scan.is_skin, scan.weight
    )
    back = scan_in_body_frame(there, transform)
    np.testing.assert_allclose(back.points, scan.points, atol=1e-12)


def test_the_papers_measure_takes_the_pose_out():
    state = moves()[0]
    faces = fitter().model.faces
    true = fitter().posed(state)
    turned = state.moved(pose=state.pose.copy())
    turned.pose[16] += [0.0, 0.0, 0.08]
    turned.pose[1] += [0.06, 0.0, 0.0]
    result = Surface(fitter().posed(turned), faces)
    scored = np.ones(len(true), dtype=bool)
    joints = fitter().posed_joints(turned, fitter().joints(state.betas))
    direct = np.abs(signed_error_mm(true, result)).mean()
    rig = transfer_rig(true, result, fitter().model.weights, joints, fitter().model.parents)
    reposed = pose_truth_to(true, faces, scored, rig, result)
    paper = np.abs(signed_error_mm(reposed, result)).mean()
    assert paper < 0.25 * direct, f"{paper:.2f} of {direct:.2f} mm are left"
    assert mean_distance(fitter(), true, true) < 1e-6
