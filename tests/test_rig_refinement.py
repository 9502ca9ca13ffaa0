"""Outlines, the planes that touch them, and rigs refined from nothing else."""

import numpy as np
import pytest

from capture.layouts import dome_layout
from capture.rig import Rig
from capture.rig_adjustment import RigPose
from hull.errors import HullError
from hull.outlines import outline_of
from hull.rig_consistency import agreement_with_others
from hull.rig_refinement import Evidence, refine_pose, score_pose
from hull.tangency import InnerTangency, OuterTangency
from hull.touching_planes import OutlineFrame, Possible
from render.spoil import displaced_rig
from tests.hull_subjects import ball
from tests.moving_figure import filmed, pixels_apart

N_CAMERAS, N_FRAMES, SIDE_PX = 9, 6, 320


def disc(centre: tuple[float, float], radius: float, side: int = 120) -> np.ndarray:
    v, u = np.mgrid[:side, :side]
    return np.where(np.hypot(u - centre[0], v - centre[1]) <= radius, 255, 0).astype(np.uint8)


def evidence_of(frames: list) -> Evidence:
    return Evidence(tuple(OutlineFrame.of(images) for images in frames), ())


def test_an_outline_is_true_to_a_fraction_of_a_pixel():
    outline = outline_of(disc((60.3, 55.7), 30.4))
    assert outline is not None
    (loop,) = outline.loops
    radius = np.hypot(*(loop - [60.3, 55.7]).T)
    assert abs(radius.mean() - 30.4) < 0.05 and np.abs(radius - 30.4).max() < 0.5
    assert np.linalg.norm(np.diff(loop, axis=0), axis=1).max() < 1.1
    assert outline.sure[0].all()


def test_holes_are_loops_and_specks_are_not():
    mask = disc((60, 60), 40) - disc((60, 60), 15)
    mask[5:8, 5:8] = 255
    outline = outline_of(mask)
    assert outline is not None and len(outline.loops) == 2
    assert all(len(loop) > 80 for loop in outline.loops)


def test_an_outline_at_the_border_or_beside_the_unknown_is_not_sure():
    mask = disc((0, 60), 30)
    mask[88:, :] = np.where(mask[88:, :] == 255, 255, 128)
    outline = outline_of(mask)
    assert outline is not None
    pixels, sure = np.concatenate(outline.loops), np.concatenate(outline.sure)
    assert not sure[pixels[:, 0] < 3].any()
    assert not sure[pixels[:, 1] > 86].any()
    assert sure[(pixels[:, 0] > 6) & (pixels[:, 1] < 80)].all()


@pytest.mark.parametrize("mask", [np.zeros((40, 40), np.uint8), np.full((40, 40), 128, np.uint8)])
def test_nobody_has_no_outline(mask):
    assert outline_of(mask) is None


def test_where_a_person_may_be():
    mask = disc((60, 60), 10)
    mask[:, 100:] = 128
    asked = np.array([[60.0, 60], [72.6, 60], [74.0, 60], [20, 20], [110, 5], [-9, 60], [60, 1e12]])
    assert Possible.of(mask).at(asked).tolist() == [True, True, False, False, True, True, True]


def test_planes_touch_a_ball_on_both_sides_in_all_pairs():
    rig = dome_layout(6, (320, 320))
    term = OuterTangency([OutlineFrame.of(ball().silhouettes(rig))], np.ones(6, bool))
    residuals, cameras = term.residuals(RigPose.of(rig))
    assert len(np.unique(cameras, axis=0)) == len(residuals) / 2
    assert 10 <= len(residuals) / 2 <= 15
    assert np.abs(residuals).max() < 0.4, residuals


def test_inner_planes_are_more_and_as_true():
    rig, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    pose, use = RigPose.of(rig), np.ones(N_CAMERAS, bool)
    outlines = [OutlineFrame.of(images) for images in frames]
    outer, _ = OuterTangency(outlines, use).residuals(pose)
    inner, _ = InnerTangency(outlines, use, pose, 2.0).residuals(pose)
    assert len(inner) > 1.2 * len(outer)
    assert np.median(np.abs(inner)) < 0.15 and np.percentile(np.abs(inner), 90) < 0.8


def test_planes_do_not_depend_on_cameras_that_are_not_used():
    rig, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    use = np.arange(N_CAMERAS) != 2
    outlines = [OutlineFrame.of(images) for images in frames]
    for term in (OuterTangency(outlines, use), InnerTangency(outlines, use, RigPose.of(rig), 2.0)):
        assert 2 not in term.residuals(RigPose.of(rig))[1]


@pytest.mark.parametrize("seed", [21, 22])
def test_outlines_alone_bring_a_rig_back(seed):
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    given = displaced_rig(truth, (0.5, 1.0), (0.01, 0.02), seed)
    refinement = refine_pose(given, evidence_of(frames))
    assert refinement.moved.all() and not refinement.left
    before, after = (pixels_apart(rig, truth) for rig in (given, refinement.pose.in_rig(given)))
    assert before.mean() > 2.5 and after.max() < 0.3, f"{before} px before, {after} px after"


def test_swapped_cameras_and_one_that_shows_nobody_are_named_and_stay():
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    given = displaced_rig(truth, (0.5, 1.0), (0.01, 0.02), 23)
    spoiled = []
    for images in frames:
        wrong = list(images)
        wrong[2], wrong[6] = images[6], images[2]
        wrong[4] = np.zeros_like(images[4])
        spoiled.append(wrong)
    refinement = refine_pose(given, evidence_of(spoiled))
    assert sorted(refinement.left) == [2, 4, 6]
    assert "shows nobody in the frames chosen; left as it was" in refinement.left[4]
    assert "contradicts the others by" in refinement.left[2]
    assert "Does it show the same moment" in refinement.left[6]
    refined = refinement.pose.in_rig(given, refinement.moved)
    assert all(refined[k] == given[k] for k in (2, 4, 6))
    good = np.flatnonzero(refinement.moved).tolist()
    apart = pixels_apart(*(Rig(tuple(rig[k] for k in good)) for rig in (refined, truth)))
    assert apart.max() < 0.5, apart


def test_a_camera_that_shows_another_moment_is_named():
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    late = [[(frames[(k + 1) % N_FRAMES][5] if c == 5 else image) for c, image in enumerate(images)]
            for k, images in enumerate(frames)]  # fmt: skip
    refinement = refine_pose(displaced_rig(truth, (0.3, 0.5), (0.005, 0.01), 24), evidence_of(late))
    assert list(refinement.left) == [5]


def test_frames_without_evidence_do_no_harm():
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    holes = [[None] * N_CAMERAS, *frames[:3], [*frames[3][:1], *[None] * (N_CAMERAS - 1)], *frames[4:]]
    given = displaced_rig(truth, (0.5, 1.0), (0.01, 0.02), 25)
    refinement = refine_pose(given, evidence_of(holes))
    assert pixels_apart(refinement.pose.in_rig(given), truth).max() < 0.4


def test_too_few_cameras_are_an_error():
    rig = dome_layout(4, (160, 160))
    images = [*ball().silhouettes(rig)[:2], None, None]
    with pytest.raises(HullError, match=r"2 of 4 cameras show anybody .*needs 3: choose other frames"):
        refine_pose(rig, evidence_of([images, images]))


def test_the_hull_of_the_others_agrees_better_with_the_true_rig():
    truth, frames = filmed(N_CAMERAS, N_FRAMES, SIDE_PX)
    use = np.arange(N_CAMERAS) < 5
    images = [image if known else None for image, known in zip(frames[0], use, strict=True)]
    given = displaced_rig(truth, (0.5, 1.0), (0.01, 0.02), 26)
    scores = []
    for rig in (truth, given):
        iou = agreement_with_others(rig, images, use, 0.03)
        scores.append(score_pose(truth, RigPose.of(rig), evidence_of([images]), use, iou))
    assert scores[0].better_than(scores[1]) and not scores[1].better_than(scores[0])
    assert scores[0].mean_iou > 0.6 and np.isnan(scores[0].keypoints_px)
    assert np.isnan(scores[0].iou[5:]).all()


def test_agreement_is_not_told_where_there_is_nothing_to_compare():
    rig = dome_layout(4, (160, 160))
    images = [*ball().silhouettes(rig)[:3], None]
    scores = agreement_with_others(rig, images, np.array([True, True, False, True]), 0.03)
    assert np.isnan(scores[[0, 1, 3]]).all() and scores[2] > 0.3
