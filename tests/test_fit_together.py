"""One shape and all poses at once: clothes that move give away their thickness, skin is kept."""

from dataclasses import replace
from functools import cache

import numpy as np

from fit.align import Alignment
from fit.evaluate import Surface, signed_error_mm
from fit.fuse import FusionShape, fused, usable
from fit.settings import FitSettings
from fit.state import BodyState
from fit.surface import vertex_normals
from fit.thickness import bending_noise, expected_thickness, thickness_per_movement
from fit.together import Together, _by_betas, _by_pose, can_be_together, fit_together
from tests.test_fit_pose_finding import finder, fitter

SETTINGS = FitSettings(n_points=6000)
N_FRAMES = 6


@cache
def true_states() -> tuple[BodyState, ...]:
    """A person within the shape space who steps and lifts his arms."""
    betas = np.zeros(fitter().model.n_betas)
    betas[:4] = [0.8, 0.7, -0.5, 0.6]
    states = []
    for k in range(N_FRAMES):
        pose = finder().mean_pose()
        pose[0] = [0.0, 0.2 * k, 0.0]
        pose[1] += [-0.1 * k, 0.0, 0.0]
        pose[17] += [0.0, 0.1 * k, -0.1 * k]
        states.append(BodyState(fitter().shaped(betas), pose, np.array([0.04 * k, 0.9, 0.0]), betas))
    return tuple(states)


def covered() -> np.ndarray:
    """Vertices under a shirt and trousers."""
    zero = true_states()[0].template
    return (np.abs(zero[:, 0]) < 0.35) & (zero[:, 1] < 0.4) & (zero[:, 1] > -0.7)


@cache
def clothed(mean_m: float) -> tuple[Alignment, ...]:
    """Alignments of the person in clothes that stand off by mean_m on average and swing in proportion, from
    poses that are somewhat wrong."""
    model, rng = fitter().model, np.random.default_rng(3)
    ratio = thickness_per_movement(model)
    swing = np.sin(np.arange(N_FRAMES) / N_FRAMES * 2 * np.pi) * np.sqrt(2)
    out = []
    for k, state in enumerate(true_states()):
        normals = vertex_normals(state.template, model.faces)
        off = covered() * mean_m * (1.0 + swing[k] / ratio)
        worn = state.moved(template=state.template + off[:, None] * normals)
        posed = fitter().posed(worn, fitter().joints(state.betas))
        # The pose an alignment has is off; its template takes that up, so that the posed surface is right.
        pose = state.pose + 0.02 * rng.normal(size=state.pose.shape)
        joints = fitter().joints(state.betas)
        start = BodyState(state.template, pose, state.translation, state.betas)
        vertices, rotations, _ = fitter().linearised(start, joints)
        template = state.template + np.linalg.solve(rotations, (posed - vertices)[:, :, None])[:, :, 0]
        out.append(Alignment(k, start.moved(template=template), 0.03, 0.002))
    return tuple(out)


@cache
def found(mean_m: float) -> tuple[Together, FusionShape, tuple[Alignment, ...]]:
    together = fit_together(fitter(), finder(), clothed(mean_m), SETTINGS)
    fusion, again = fused(fitter(), finder(), clothed(mean_m), SETTINGS)
    return together, fusion, tuple(again)


def error_mm(fusion: FusionShape, alignments: tuple[Alignment, ...]) -> np.ndarray:
    """Signed errors of all frames' covered vertices, posed."""
    rows = []
    for alignment, true in zip(alignments, true_states(), strict=True):
        state = alignment.state.moved(template=fusion.template)
        surface = Surface(fitter().posed(state, fusion.joints), fitter().model.faces)
        rows.append(signed_error_mm(fitter().posed(true), surface)[covered()])
    return np.concatenate(rows)


def test_the_thickness_of_swinging_clothes_is_found_and_bare_parts_have_none():
    together = found(0.02)[0]
    expected = together.thickness.expected
    assert 0.012 < np.median(expected[covered()]) < 0.028
    zero = true_states()[0].template
    head = zero[:, 1] > 0.55
    assert np.median(expected[head]) < 0.004
    assert np.median(together.thickness.tolerance[head]) < np.median(together.thickness.tolerance[covered()])


def test_the_body_lies_under_loose_clothes_and_on_bare_skin():
    for mean_m, most_mm in ((0.0, 2.0), (0.02, 5.0)):
        _, fusion, again = found(mean_m)
        error = error_mm(fusion, again)
        assert abs(error.mean()) < most_mm, f"{1e3 * mean_m:.0f} mm of cloth: bias {error.mean():+.1f} mm"


def test_poses_get_nearer_to_the_truth_than_the_alignments_were():
    again = found(0.0)[2]
    for alignment, first, true in zip(again, clothed(0.0), true_states(), strict=True):
        joints = [
            fitter().posed_joints(state, fitter().joints(state.betas))
            for state in (alignment.state, first.state, true)
        ]
        now, before = (np.linalg.norm(j[:22] - joints[2][:22], axis=1).mean() for j in joints[:2])
        assert now < 0.6 * before, f"{1e3 * now:.1f} mm, {1e3 * before:.1f} mm before"


def test_realigning_keeps_the_posed_surfaces():
    together, fusion, again = found(0.02)
    for alignment, first in zip(again, clothed(0.02), strict=True):
        posed = fitter().posed(alignment.state)
        np.testing.assert_allclose(posed, fitter().posed(first.state), atol=1e-9)
        np.testing.assert_allclose(alignment.state.betas, together.betas)
    assert fusion.confidence is not None
    assert 0.0 < fusion.confidence.min() <= fusion.confidence.max() <= 1.0


def test_confidence_falls_where_clothes_are():
    fusion = found(0.02)[1]
    assert fusion.confidence is not None
    assert np.median(fusion.confidence[covered()]) < 0.6 * np.median(fusion.confidence[~covered()])


def test_energy_falls():
    energies = found(0.0)[0].energies
    assert len(energies) > 2
    assert energies[-1] < 0.5 * energies[0]


def test_few_frames_or_hulls_without_trust_keep_their_alignments():
    few = list(clothed(0.0)[:3])
    assert not can_be_together(few, 1.0)
    assert not can_be_together(clothed(0.0), 0.2)
    assert can_be_together(clothed(0.0), 1.0)
    fusion, again = fused(fitter(), finder(), few, SETTINGS)
    assert again == few
    assert fusion.confidence is None
    far = [replace(a, distance_m=0.012) for a in clothed(0.0)]
    assert fused(fitter(), finder(), far, SETTINGS)[1] == far


def test_suspect_frames_do_not_speak_for_the_shape():
    alignments = [*clothed(0.0)[:5], replace(clothed(0.0)[5], status="suspect")]
    assert [a.frame_id for a in usable(alignments)] == [0, 1, 2, 3, 4]
    again = fused(fitter(), finder(), alignments, SETTINGS)[1]
    assert again[5] is alignments[5]
    assert again[0] is not alignments[0]


def test_many_frames_share_the_shape_that_some_of_them_find():
    settings = replace(SETTINGS, together=replace(SETTINGS.together, shape_frames=4))
    together = fit_together(fitter(), finder(), clothed(0.0), settings)
    assert together.poses.shape == (N_FRAMES, fitter().model.n_joints, 3)
    for pose, state in zip(together.poses, true_states(), strict=True):
        assert np.abs(pose - state.pose)[[0, 1, 2, 4, 5, 16, 17]].max() < 0.12


def test_what_bending_does_is_not_cloth():
    model = fitter().model
    normals = vertex_normals(model.template, model.faces)
    still = np.stack([finder().mean_pose()] * 4)
    assert bending_noise(model, still, normals).max() < 1e-9
    moving = still.copy()
    moving[:, 4, 0] = [0.0, 0.6, 1.2, 1.8]
    noise = bending_noise(model, moving, normals)
    knee = model.weights[:, 4] > 0.3
    assert noise[knee].max() > 0.002
    assert noise[model.weights[:, 18] > 0.5].max() < 1e-6
    offsets = noise * np.array([-1.0, -0.5, 0.5, 1.0])[:, None]
    ratio = thickness_per_movement(model)
    thickness = expected_thickness(offsets, noise, ratio, model.faces, SETTINGS.thickness)
    np.testing.assert_allclose(thickness.expected, 0.0, atol=1e-4)
    more = expected_thickness(offsets, 0.0 * noise, ratio, model.faces, SETTINGS.thickness)
    assert more.expected[knee].max() > 0.003


def test_what_the_hull_stands_off_is_expected_on_top_of_the_cloth():
    model, settings = fitter().model, SETTINGS.thickness
    rng = np.random.default_rng(4)
    swing = rng.normal(size=(8, 1)) * np.ones((8, model.n_vertices))
    ratio, none = thickness_per_movement(model), np.zeros(model.n_vertices)
    stands_off = np.full(model.n_vertices, 0.004)
    for movement_m, share in ((0.0, settings.excess_shares[0]), (0.01, settings.excess_shares[1])):
        offsets = 0.02 + movement_m * swing
        cloth = expected_thickness(offsets, none, ratio, model.faces, settings)
        hull = expected_thickness(offsets, none, ratio, model.faces, settings, stands_off)
        np.testing.assert_allclose(hull.expected - cloth.expected, share * 0.004, atol=1e-12)
        np.testing.assert_array_equal(hull.movement, cloth.movement)


def test_known_skin_has_no_cloth_over_it():
    bare = covered().astype(float)
    together = fit_together(fitter(), finder(), clothed(0.02), SETTINGS, bare)
    assert together.thickness.expected[covered()].max() < 1e-9
    assert np.allclose(together.thickness.tolerance[covered()], SETTINGS.thickness.tolerance_m)
    assert np.median(found(0.02)[0].thickness.expected[covered()]) > 0.01


def test_one_percent_of_points_lost_inside_costs_less_than_half_a_millimetre():
    rng, model = np.random.default_rng(6), fitter().model
    for mean_m in (0.0, 0.02):
        spoilt = []
        for alignment in clothed(mean_m):
            template = alignment.state.template.copy()
            lost = rng.random(len(template)) < 0.01
            depth = rng.uniform(0.02, 0.06, (int(lost.sum()), 1))
            template[lost] -= depth * vertex_normals(template, model.faces)[lost]
            spoilt.append(replace(alignment, state=alignment.state.moved(template=template)))
        fusion, again = fused(fitter(), finder(), spoilt, SETTINGS)
        shapes = (found(mean_m)[1:], (fusion, tuple(again)))
        clean, now = (float(np.sqrt((error_mm(*shape) ** 2).mean())) for shape in shapes)
        assert now - clean < 0.5, f"{1e3 * mean_m:.0f} mm of cloth: {clean:.2f} mm clean, {now:.2f} mm spoilt"


def test_a_frames_equations_are_those_of_dense_derivatives():
    random, fitted = np.random.default_rng(2), fitter()
    model, n = fitted.model, fitted.model.n_vertices
    betas, pose = 0.5 * random.normal(size=model.n_betas), 0.3 * random.normal(size=(24, 3))
    state = BodyState(fitted.shaped(betas), pose, random.normal(size=3), betas)
    body = fitted.body(state)
    normals, used = vertex_normals(body.vertices, model.faces), np.arange(1, n, 3)
    weight, residual = random.random(len(used)), random.normal(size=len(used))
    moves = np.einsum("va,vap->vp", normals, body.jacobian().reshape(n, 3, -1))
    step = 1e-5
    by_betas = np.empty((n, 3))
    for k in range(3):
        ends = []
        for sign in (-1.0, 1.0):
            other = betas + sign * step * (np.arange(model.n_betas) == 60 * k)
            ends.append(fitted.posed(state.moved(template=fitted.shaped(other), betas=other)))
        by_betas[:, k] = np.einsum("va,va->v", normals, (ends[1] - ends[0]) / (2 * step))
    pose_matrix, pose_rhs = _by_pose(body, normals, used, weight, residual)
    cross, corner, rhs = _by_betas(fitted, pose, body, normals, used, weight, residual, model.n_betas)
    weighted = weight[:, None] * moves[used]
    np.testing.assert_allclose(pose_matrix, weighted.T @ moves[used], atol=1e-9)
    np.testing.assert_allclose(pose_rhs, weighted.T @ residual, atol=1e-9)
    three = 60 * np.arange(3)
    np.testing.assert_allclose(cross[:, three], weighted.T @ by_betas[used], atol=1e-5)
    np.testing.assert_allclose(
        corner[np.ix_(three, three)], (weight * by_betas[used].T) @ by_betas[used], atol=1e-6
    )
    np.testing.assert_allclose(rhs[three], by_betas[used].T @ (weight * residual), atol=1e-6)
