"""Legs stand where they are told; arms turn about their own length and bend about the elbow's axis."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fit.body import load_body
from fit.body.skeleton import JOINT, PARENTS, axis_angle_to_matrix, world_from_rest
from render.limb_angles import STANDING, Turn, ankle_lift, standing_leg, turned_arm
from render.motions import make_motion
from render.subject import make_subject
from render.synthetic import perform


@pytest.fixture(scope="module")
def body():
    return load_body("free:neutral", show_progress=False)


@pytest.fixture(scope="module")
def rest(body) -> np.ndarray:
    return body.joint_regressor @ body.template


def posed(rest: np.ndarray, joints: dict[str, Turn]) -> tuple[np.ndarray, np.ndarray]:
    """Joints (J 3) and the bones' rotations (J 3 3) with the pelvis where it rests."""
    pose = np.zeros((len(PARENTS), 3))
    for name, turn in joints.items():
        pose[JOINT[name]] = turn
    bones = world_from_rest(axis_angle_to_matrix(pose), rest)
    return np.einsum("jab,jb->ja", bones[:, :3, :3], rest) + bones[:, :3, 3], bones[:, :3, :3]


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_ankle_is_where_it_was_put_and_the_sole_is_level(rest: np.ndarray, side: str) -> None:
    sign = 1.0 if side == "left" else -1.0
    thigh_m = np.linalg.norm(rest[JOINT["left_knee"]] - rest[JOINT["left_hip"]])
    rng = np.random.default_rng(2)
    for _ in range(50):
        pelvis = tuple(rng.uniform(-0.3, 0.3, 3).tolist())
        move = rng.uniform((-0.1, 0.15, -0.6), (0.4, 0.5, 0.6)) * (sign, 1.0, 1.0)
        target = STANDING * (sign, 1.0, 1.0) + move
        out = float(rng.uniform(0.0, 0.3))
        leg = standing_leg(side, pelvis, target, knee_out=out)
        places, turns = posed(rest, {"pelvis": pelvis, **leg})
        found = (places[JOINT[f"{side}_ankle"]] - rest[JOINT["pelvis"]]) / thigh_m
        assert np.abs(found - target).max() < 0.02, "more than 8 mm from where it was put"
        up = turns[JOINT[f"{side}_ankle"]] @ np.array([0.0, 1.0, 0.0])
        assert np.degrees(np.arccos(min(up[1], 1.0))) < 0.1
        assert leg[f"{side}_knee"][0] >= 0 and leg[f"{side}_knee"][1:] == (0.0, 0.0)


def test_standing_straight_is_the_rest_pose() -> None:
    for side, sign in (("left", 1.0), ("right", -1.0)):
        leg = standing_leg(side, (0.0, 0.0, 0.0), STANDING * (sign, 1.0, 1.0))
        assert max(np.abs(turn).max() for turn in leg.values()) < 1e-6


def test_out_of_reach_the_knee_is_straight() -> None:
    leg = standing_leg("left", (0.0, 0.0, 0.0), STANDING * 1.3)
    near = standing_leg("left", (0.0, 0.0, 0.0), STANDING * 2.0)
    assert leg["left_knee"] == near["left_knee"] and leg["left_knee"][0] < 0.1


def test_a_foot_rolls_over_ball_and_heel() -> None:
    assert ankle_lift(0.0) == 0.0
    tilts = np.linspace(-0.5, 0.7, 25)
    assert min(ankle_lift(float(t)) for t in tilts) > -0.002, (
        "the price of smoothness: less than a millimetre"
    )
    assert ankle_lift(0.4) > 2 * ankle_lift(-0.4) > 0, "the ball is farther from the ankle than the heel is"


def test_arms_mirror_each_other_and_elbows_are_hinges() -> None:
    mirror = (1.0, -1.0, -1.0)
    for axial in (-0.8, 0.0, 1.3):
        left = turned_arm("left", (0.1, 0.2, -0.5), axial, 1.2)
        right = turned_arm("right", (0.1, 0.2, -0.5), axial, 1.2)
        for joint in ("shoulder", "elbow"):
            assert np.allclose(right[f"right_{joint}"], np.array(left[f"left_{joint}"]) * mirror)
        assert np.allclose(left["left_elbow"], (0.0, -1.2, 0.0))
    hanging = (0.0, 0.0, -np.pi / 2)
    forearm = Rotation.from_rotvec(turned_arm("left", hanging, 0.0, np.pi / 2)["left_shoulder"])
    bent = Rotation.from_rotvec((0.0, -np.pi / 2, 0.0))
    assert np.allclose((forearm * bent).apply([1.0, 0, 0]), [0, 0, 1.0]), "forwards"
    inwards = Rotation.from_rotvec(turned_arm("left", hanging, np.pi / 2, np.pi / 2)["left_shoulder"])
    assert np.allclose((inwards * bent).apply([1.0, 0, 0]), [-1.0, 0, 0]), "across the body"


@pytest.mark.parametrize("name", ["a-t-u", "hips", "walk", "squat", "tilt-twist"])
def test_elbows_bend_forwards_and_do_not_lean_sideways(name: str) -> None:
    """In the upper arm's own axes the forearm moves in the plane that the elbow's hinge allows."""
    pose = make_motion(name, 16, 1).pose
    for side, sign in (("left", 1.0), ("right", -1.0)):
        turns = Rotation.from_rotvec(pose[:, JOINT[f"{side}_elbow"]])
        forearm = turns.apply([sign, 0.0, 0.0])
        assert np.abs(forearm[:, 1]).max() < 0.2, "only the sway may take it out of the hinge's plane"
        assert forearm[:, 2].min() > 0.05, "an elbow is bent backwards"


def test_a_raised_hand_shows_its_palm_and_stays_beside_the_head(body) -> None:
    motion = make_motion("a-t-u", 9, 0)
    rest = body.joint_regressor @ body.template
    places, turns = posed(
        rest, {n: tuple(motion.pose[-1, j].tolist()) for n, j in JOINT.items() if n != "pelvis"}
    )
    for side, sign in (("left", 1.0), ("right", -1.0)):
        palm = turns[JOINT[f"{side}_wrist"]] @ np.array([0.0, -1.0, 0.0])
        assert palm[2] > 0.6, "palms face the front"
        assert places[JOINT[f"{side}_wrist"], 1] > places[JOINT["head"], 1]
        assert sign * places[JOINT[f"{side}_wrist"], 0] > 0.2


def test_hands_stay_near_the_hips_that_circle(body) -> None:
    motion = make_motion("hips", 12, 0)
    rest = body.joint_regressor @ body.template
    pelvis = []
    for pose in motion.pose:
        places, turns = posed(rest, {name: tuple(pose[j].tolist()) for name, j in JOINT.items()})
        for side, sign in (("left", 1.0), ("right", -1.0)):
            hand = turns[0].T @ (places[JOINT[f"{side}_hand"]] - places[0])
            assert np.abs(hand - (0.24 * sign, 0.05, 0.06)).max() < 0.09, "a hand is not on its hip"
        pelvis.append(places[0] - places[[JOINT["left_ankle"], JOINT["right_ankle"]]].mean(0))
    circle = np.ptp(np.array(pelvis), axis=0)
    assert circle[0] > 0.08 and circle[2] > 0.08 and circle[1] < 0.05


@pytest.mark.parametrize("name", ["tilt-twist", "hips", "squat", "a-t-u"])
def test_both_feet_that_carry_are_on_the_floor(name: str, body) -> None:
    """The sway, whose hips know nothing of the floor, may lift one by a centimetre and a half."""
    subject = make_subject(body, 2, "none")
    performance = perform(subject, name, 6, 2)
    for side in ("left", "right"):
        foot = np.isin(subject.body.parts, [JOINT[f"{side}_ankle"], JOINT[f"{side}_foot"]])
        assert performance.vertices[:, foot, 2].min(1).max() < 0.015, f"the {side} foot floats"
