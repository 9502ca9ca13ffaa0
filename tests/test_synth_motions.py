"""Motions are smooth, natural, on the floor, and reproducible."""

import numpy as np
import pytest

from fit.body import load_body
from fit.body.skeleton import JOINT
from render.motions import MOTIONS, joint_positions, make_motion, stance_travel
from render.subject import make_subject
from render.synthetic import perform


@pytest.fixture(scope="module")
def naked():
    return make_subject(load_body("free:neutral", show_progress=False), 2, "none")


@pytest.mark.parametrize("name", list(MOTIONS))
def test_smooth_over_time(name: str) -> None:
    """Second differences of a smooth curve fall with the square of the step; a jump's do not."""
    for seed in (0, 1):
        coarse, fine = (make_motion(name, n, seed).pose for n in (60, 240))
        bend = [np.abs(np.diff(pose, 2, axis=0)).max() for pose in (coarse, fine)]
        assert bend[1] < bend[0] / 3, f"{name} jumps: {bend[1]:.3f} rad of second difference in 240 frames"
        assert np.abs(np.diff(fine, axis=0)).max() < 0.1


@pytest.mark.parametrize("name", list(MOTIONS))
def test_it_moves_and_stays_within_what_joints_can_do(name: str) -> None:
    pose = make_motion(name, 24, 3).pose
    assert np.ptp(pose, axis=0).max() > 0.35, "hardly anything moves"
    sway = 0.12
    for side in ("left", "right"):
        knee = pose[:, JOINT[f"{side}_knee"]]
        assert knee[:, 0].min() > -sway and knee[:, 0].max() < 2.3, "a knee bends the wrong way or too far"
        assert np.abs(knee[:, 1:]).max() < sway
    assert np.linalg.norm(pose, axis=2).max() < 2.4
    for joint in ("spine1", "spine2", "spine3", "neck", "head"):
        assert np.linalg.norm(pose[:, JOINT[joint]], axis=1).max() < 0.7


@pytest.mark.parametrize("name", list(MOTIONS))
def test_the_lowest_vertex_stands_on_the_floor(name: str, naked) -> None:
    performance = perform(naked, name, 5, 1)
    lowest = performance.vertices[:, :, 2].min(1)
    assert np.abs(lowest).max() < 1e-9
    on_feet = np.isin(naked.region[performance.vertices[:, :, 2].argmin(1)], ["foot"])
    assert on_feet.all(), "something else than a foot touches the floor"
    middle = performance.vertices[:, :, :2].mean(1)
    assert np.linalg.norm(middle, axis=1).max() < 0.6, "walks out of the cameras' view"


@pytest.mark.parametrize("name", list(MOTIONS))
def test_the_standing_foot_does_not_slide(name: str, naked) -> None:
    motion = make_motion(name, 48, 0)
    travel = stance_travel(motion, naked.joints)
    places = joint_positions(motion.pose, naked.joints) + travel[:, None]
    ankles = places[:, [JOINT["left_ankle"], JOINT["right_ankle"]]][:, :, [0, 2]]
    for foot in (0, 1):
        standing = motion.stance[:, foot] == 1.0
        both = standing[1:] & standing[:-1]
        steps = np.linalg.norm(np.diff(ankles[:, foot], axis=0), axis=1)
        assert both.sum() == 0 or steps[both].max() < 1e-9
    weighted = (0.5 * (motion.stance[1:] + motion.stance[:-1]))[:, :, None] * np.diff(ankles, axis=0)
    assert np.abs(weighted.sum(1)).max() < 1e-9


def test_a_walk_goes_forward(naked) -> None:
    """One double step of an adult: about a metre and a quarter, towards the front (-y of the world)."""
    motion = make_motion("walk", 60, 0)
    travel = stance_travel(motion, naked.joints)
    assert 0.7 < travel[-1, 2] - travel[0, 2] < 1.7
    assert abs(travel[-1, 0] - travel[0, 0]) < 0.1
    assert (np.diff(travel[:, 2]) > 0).mean() > 0.9


def test_a_squat_goes_down_and_a_t_u_raises_the_arms(naked) -> None:
    squat = perform(naked, "squat", 9, 0)
    pelvis = squat.translation[:, 1]
    assert pelvis[[0, -1]].min() - pelvis[4] > 0.25
    wrists = joint_positions(make_motion("a-t-u", 9, 0).pose, naked.joints)[:, JOINT["left_wrist"], 1]
    head = naked.joints[JOINT["head"], 1]
    assert (np.diff(wrists) > 0).all() and wrists[0] < head - 0.3 and wrists[-1] > head + 0.1


def test_seeds() -> None:
    same, again, other = (make_motion("hips", 6, seed).pose for seed in (4, 4, 5))
    assert np.array_equal(same, again)
    assert 0.01 < np.abs(same - other).max() < 0.6


def test_a_motion_of_one_frame() -> None:
    assert make_motion("walk", 1, 0).pose.shape == (1, 24, 3)


def test_unknown_names_and_no_frames() -> None:
    with pytest.raises(ValueError, match="no motion is called 'dance'; there are: tilt-twist, hips"):
        make_motion("dance", 12)
    with pytest.raises(ValueError, match="a motion of 0 frames: at least 1 is needed"):
        make_motion("walk", 0)
