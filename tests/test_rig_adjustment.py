"""Moving a rig's cameras: steps and back, derivatives, the gauge, keypoints through lenses and outliers."""

import numpy as np

from capture.keypoint_adjustment import Detections, KeypointTerm
from capture.keypoints import chosen_detections
from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from capture.rig_adjustment import AdjustmentSettings, RigPose, adjusted
from hull.tangency import linearised
from hull.touching_planes import Touches
from tests.moving_figure import displaced, pixels_apart
from tests.test_capture_keypoints import BODY, detected, lensed_rig


def some_step(n_cameras: int, size: float, n_unknowns: int = 7) -> np.ndarray:
    return size * np.random.default_rng(3).standard_normal((n_cameras, n_unknowns))


def test_a_step_is_found_again():
    pose = RigPose.of(dome_layout(5))
    step = some_step(5, 0.05)
    moved = pose.moved(step)
    assert np.allclose(moved.step_from(pose, 7), step, atol=1e-12)
    assert np.allclose(moved.centres - pose.centres, step[:, 3:6])
    assert np.allclose(moved.intrinsics[:, 1, 1], pose.intrinsics[:, 1, 1] * np.exp(step[:, 6]))


def test_the_rig_keeps_lenses_names_and_cameras_that_stay():
    rig = lensed_rig(4)
    moved = RigPose.of(rig).moved(some_step(4, 0.01)).in_rig(rig, np.array([True, False, True, True]))
    assert moved[1] == rig[1] and moved[0] != rig[0]
    assert moved.names == rig.names
    assert all(np.array_equal(m.distortion, c.distortion) for m, c in zip(moved, rig, strict=True))


def true_touches(rig: Rig, n: int) -> Touches:
    """Pixels of random points in two cameras each."""
    rng = np.random.default_rng(4)
    cameras, pixels = [], []
    for _ in range(n):
        pair = np.sort(rng.choice(len(rig), 2, replace=False))
        point = rng.uniform([-0.5, -0.5, 0], [0.5, 0.5, 2], 3)
        cameras.append(pair)
        pixels.append([rig[k].project(point[None])[0][0] for k in pair.tolist()])
    return Touches(np.array(cameras), np.array(pixels))


def test_a_touching_plane_s_derivatives_are_those_of_finite_differences():
    rig = dome_layout(6)
    pose, touches = RigPose.of(rig), true_touches(rig, 40)
    residuals, rows = linearised(pose, touches, 7)
    assert np.abs(residuals).max() < 1e-9
    for unknown in range(7):
        for side in (0, 1):
            for k in range(len(rig)):
                step = np.zeros((len(rig), 7))
                step[k, unknown] = 1e-6
                forth, _ = linearised(pose.moved(step), touches, 0)
                back, _ = linearised(pose.moved(-step), touches, 0)
                own = touches.cameras[:, side] == k
                expected = ((forth - back) / 2e-6)[own]
                assert np.allclose(rows[own, side, unknown], expected, rtol=1e-4, atol=1e-3)


def test_residuals_are_pixels():
    """A camera turned by one pixel about its x axis sees rays of cameras beside it one pixel off."""
    rig = ring_layout(12)
    touches = true_touches(rig, 400)
    beside = (np.diff(touches.cameras, axis=1)[:, 0] == 1) & (touches.cameras == 5).any(axis=1)
    touches = Touches(touches.cameras[beside], touches.pixels[beside])
    assert len(touches.cameras) > 2
    one_pixel = np.degrees(1 / rig[5].intrinsics[1, 1])
    turned = displaced(rig[5], np.array([one_pixel, 0, 0]), np.zeros(3))
    pose = RigPose.of(Rig((*rig.cameras[:5], turned, *rig.cameras[6:])))
    # Sampson's distance shares the pixel between the two cameras.
    residuals = np.abs(linearised(pose, touches, 0)[0])
    assert np.all((residuals > 0.6) & (residuals < 0.8)), residuals


def test_one_step_takes_nearly_all_of_a_small_error_out_of_keypoints():
    """So it does only where all derivatives are right, the focal length's too."""
    rig = dome_layout(5)
    term = KeypointTerm(Detections.of_frames([np.array([detected(c, BODY) for c in rig])]))
    wrong = RigPose.of(rig).moved(some_step(5, 2e-3))
    equations = term.equations(wrong, 1e6, 7)
    # Nothing tells the world's place, turn and size: seven directions are left out.
    step = np.linalg.lstsq(equations.matrix, equations.right, rcond=1e-9)[0].reshape(5, 7)
    before, after = (float(np.median(term.residuals(p)[0])) for p in (wrong, wrong.moved(step)))
    assert before > 0.5 and after < 0.02 * before, (before, after)


def walking(rig: Rig, n_frames: int, noise_px: float) -> list[list[np.ndarray]]:
    rng = np.random.default_rng(2)
    frames = []
    for k in range(n_frames):
        joints = BODY * [1, np.cos(k), 1] + [0.3 * np.sin(k), 0.2 * np.cos(2 * k), 0]
        frame = [detected(camera, joints)[None] for camera in rig]
        for people in frame:
            people[..., :2] += rng.normal(0, noise_px, people[..., :2].shape)
        frames.append(frame)
    return frames


def test_keypoints_bring_a_rig_back_through_lenses_outliers_and_missing_points():
    truth = lensed_rig(4)
    rng = np.random.default_rng(5)
    frames = walking(truth, 20, 0.5)
    for frame in frames:
        for people in frame:
            people[0, rng.integers(25), :2] += 60.0
            people[0, rng.integers(25)] = 0.0
    errors = rng.standard_normal((2, 4, 3)) * np.array([0.5, 0.01])[:, None, None]
    given = Rig(tuple(displaced(c, *e) for c, e in zip(truth, errors.swapaxes(0, 1), strict=True)))
    people = [chosen_detections(given, frame, None) for frame in frames]
    term = KeypointTerm(Detections.of_frames(people))
    pose = adjusted(RigPose.of(given), [term], np.ones(4, bool))
    before, after = (np.median(term.residuals(p)[0]) for p in (RigPose.of(given), pose))
    assert before > 3 and after < 0.7, (before, after)
    apart = pixels_apart(pose.in_rig(given), truth)
    assert apart.max() < 0.5, f"cameras are {apart} px off"


def test_focal_lengths_come_back_with_the_rest():
    truth = dome_layout(6)
    wrong = np.array([1.02, 0.98, 1.01, 0.99, 1.02, 0.98])
    step = np.zeros((6, 7))
    step[:, 6] = np.log(wrong)
    given = RigPose.of(truth).moved(step)
    term = KeypointTerm(
        Detections.of_frames([np.array([people[0] for people in frame]) for frame in walking(truth, 12, 0.1)])
    )
    loose = AdjustmentSettings(prior_focal=0.03)
    found = adjusted(given, [term], np.ones(6, bool), loose, focal=True).intrinsics[:, 0, 0]
    ratio = found / RigPose.of(truth).intrinsics[:, 0, 0]
    # All lenses longer by the same is a camera farther away, which keypoints hardly tell.
    assert np.abs(ratio / ratio.mean() - 1).max() < 0.004, ratio
    fixed = adjusted(given, [term], np.ones(6, bool), loose)
    assert np.array_equal(fixed.intrinsics, given.intrinsics)


def test_what_nobody_sees_stays_as_it_was_given():
    """The world's place, turn and size: a rig without errors, seen in another world, stays in that world."""
    truth = ring_layout(5)
    given = RigPose.of(truth)
    detections = Detections.of_frames(
        [np.array([people[0] for people in frame]) for frame in walking(truth, 6, 0.0)]
    )
    pose = adjusted(given, [KeypointTerm(detections)], np.ones(5, bool))
    assert np.abs(pose.step_from(given, 6)).max() < 1e-5


def test_a_camera_that_is_not_free_stays():
    truth = ring_layout(5)
    given = Rig((displaced(truth[0], np.array([0, 1.0, 0]), np.zeros(3)), *truth.cameras[1:]))
    frames = [np.array([people[0] for people in frame]) for frame in walking(truth, 6, 0.0)]
    free = np.array([True, False, False, False, False])
    pose = adjusted(RigPose.of(given), [KeypointTerm(Detections.of_frames(frames))], free)
    assert np.abs(pose.step_from(RigPose.of(given), 6)[1:]).max() == 0
    assert pixels_apart(pose.in_rig(given), truth).max() < 0.2
