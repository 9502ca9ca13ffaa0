"""Random poses as people take them, for benchmarks: legs that stand, walk, sit, squat or lunge, under arms
that hang, reach, cross, rest on hips or thighs, or hold a telephone.

A third comes from the pose prior, a third is a frame of the synthetic motions, a third is put together here
from legs, trunk and arms. Hands are brought where they go by a small inverse kinematics. Poses in which limbs
pass through the body are drawn again. Frame: the body's (x its left, y up, z front); m and rad.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fit.body.pose_prior import PosePrior
from fit.body.skeleton import JOINT, N_JOINTS
from fit.surface import vertex_normals
from render.limb_angles import STANDING, standing_leg
from render.motions import MOTIONS, make_motion

#: A vertex this far out along its normal that is still inside the body is one limb within another.
PROBE_M = 0.006
#: Largest share of such vertices: creases of deep bends have some.
GROSS = 0.045

Angles = dict[str, tuple[float, ...]]
Random = np.random.Generator


def natural_pose(
    rng: Random,
    joints: Float[np.ndarray, "j 3"],
    skinned: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> tuple[str, Float[np.ndarray, "j 3"]]:
    """What is done, and the pose (J 3), facing anywhere.

    joints: of the rest pose (J 3); skinned: vertices and faces of the person in a pose, to see whether limbs
    go through the body.
    """
    while True:
        what, pose = (_of_prior, _of_motion, _put_together)[int(rng.integers(3))](rng, joints)
        if overlap(*skinned(pose)) < GROSS:
            break
    heading = Rotation.from_rotvec([0.0, rng.uniform(0.0, 2.0 * np.pi), 0.0])
    pose[0] = (heading * Rotation.from_rotvec(pose[0])).as_rotvec()
    return what, pose


def overlap(vertices: Float[np.ndarray, "v 3"], faces: np.ndarray) -> float:
    """Share of the skin that lies inside another part of the body."""
    import open3d as o3d

    scene: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(np.ascontiguousarray(faces, np.uint32))
    )
    outside = vertices + PROBE_M * vertex_normals(vertices, faces)
    inside = scene.compute_occupancy(o3d.core.Tensor(outside.astype(np.float32)), nthreads=1, nsamples=3)
    return float(inside.numpy().mean())


def _of_prior(rng: Random, joints: np.ndarray) -> tuple[str, np.ndarray]:
    pose = PosePrior.standard().sample_poses(1, int(rng.integers(2**31)))[0]
    pose[0] = [rng.normal(0.0, 0.05), 0.0, rng.normal(0.0, 0.05)]
    return "of the prior", pose


def _of_motion(rng: Random, joints: np.ndarray) -> tuple[str, np.ndarray]:
    name = list(MOTIONS)[int(rng.integers(len(MOTIONS)))]
    return name, make_motion(name, 40, int(rng.integers(2**31))).pose[int(rng.integers(40))]


def _put_together(rng: Random, joints: np.ndarray) -> tuple[str, np.ndarray]:
    legs = _LEGS[int(rng.integers(len(_LEGS)))]
    sits = legs is _sits
    arms = _ARMS[int(rng.integers(len(_ARMS)))]
    if sits and rng.uniform() < 0.5:
        arms = _on_thighs
    below, above = legs(rng), arms(rng, joints)
    pose = np.zeros((N_JOINTS, 3))
    for joint, turn in (below | above).items():
        pose[JOINT[joint]] = turn
    bend = np.array([rng.normal(0.05, 0.07), rng.normal(0.0, 0.08), rng.normal(0.0, 0.04)])
    for joint in ("spine1", "spine2", "spine3"):
        pose[JOINT[joint]] += bend
    pose[JOINT["head"]] += rng.normal(0.0, 0.2, 3)
    pose[1:] += rng.normal(0.0, 0.03, (N_JOINTS - 1, 3))
    return f"{legs.__name__[1:]}, arms {arms.__name__[1:]}".replace("_", " "), pose


# Legs: hips, knees, ankles and the pelvis.


def _both(name: str, x: float, y: float, z: float) -> Angles:
    return {f"left_{name}": (x, y, z), f"right_{name}": (x, -y, -z)}


def _stands(rng: Random) -> Angles:
    apart, bent = rng.uniform(0.0, 0.2), rng.uniform(0.0, 0.1)
    return {
        **_both("hip", -bent, 0.1, apart),
        **_both("knee", 2 * bent, 0, 0),
        **_both("ankle", -bent, 0, -apart),
    }


def _stands_on_one_leg(rng: Random) -> Angles:
    legs = _stands(rng)
    side, lift = str(rng.choice(["left", "right"])), rng.uniform(0.5, 1.5)
    return legs | {f"{side}_hip": (-lift, 0.0, 0.0), f"{side}_knee": (rng.uniform(0.6, 1.2) * lift, 0.0, 0.0)}


def _stands_legs_crossed(rng: Random) -> Angles:
    front, sign = (("left", 1.0), ("right", -1.0))[int(rng.integers(2))]
    back = "right" if front == "left" else "left"
    pelvis = (0.0, 0.0, 0.0)
    step = rng.uniform(0.28, 0.34)
    ahead = STANDING * (sign, 1.0, 1.0) + (-sign * step, 0.08, rng.uniform(0.3, 0.4))
    behind = STANDING * (-sign, 1.0, 1.0) + (sign * 0.02, 0.04, -0.05)
    return standing_leg(front, pelvis, ahead) | standing_leg(back, pelvis, behind)


def _sits(rng: Random) -> Angles:
    hip, lean = rng.uniform(1.25, 1.65), rng.uniform(-0.2, 0.3)
    return {
        "pelvis": (lean, 0.0, 0.0),
        **_both("hip", -hip - lean, 0.1, rng.uniform(0.05, 0.3)),
        **_both("knee", rng.uniform(1.2, 1.7), 0.0, 0.0),
    }


def _sits_one_leg_over(rng: Random) -> Angles:
    legs = _sits(rng)
    side, sign = (("left", 1.0), ("right", -1.0))[int(rng.integers(2))]
    return legs | {f"{side}_hip": (-1.75, 0.0, -0.28 * sign), f"{side}_knee": (1.3, 0.0, 0.0)}


def _squats(rng: Random) -> Angles:
    down = rng.uniform(0.7, 1.05)
    return {
        "pelvis": (0.35 * down, 0.0, 0.0),
        **_both("hip", -1.8 * down, 0.25, 0.3),
        **_both("knee", 2.0 * down, 0.0, 0.0),
        **_both("ankle", -0.55 * down, 0.0, -0.2),
    }


def _lunges(rng: Random) -> Angles:
    down = rng.uniform(0.6, 1.1)
    front, back = ("left", "right") if rng.uniform() < 0.5 else ("right", "left")
    return {
        f"{front}_hip": (-1.1 * down, 0.0, 0.0), f"{front}_knee": (1.2 * down, 0.0, 0.0),
        f"{back}_hip": (0.35 * down, 0.0, 0.0), f"{back}_knee": (0.7 * down, 0.0, 0.0),
        f"{back}_ankle": (-0.3 * down, 0.0, 0.0), f"{back}_foot": (-0.5 * down, 0.0, 0.0),
    }  # fmt: skip


def _kneels_on_one_knee(rng: Random) -> Angles:
    front, back = ("left", "right") if rng.uniform() < 0.5 else ("right", "left")
    return {
        f"{front}_hip": (rng.uniform(-1.6, -1.3), 0.0, 0.0), f"{front}_knee": (1.5, 0.0, 0.0),
        f"{back}_hip": (0.0, 0.0, 0.0), f"{back}_knee": (1.6, 0.0, 0.0), f"{back}_ankle": (0.4, 0.0, 0.0),
    }  # fmt: skip


def _steps_aside(rng: Random) -> Angles:
    side, sign = (("left", 1.0), ("right", -1.0))[int(rng.integers(2))]
    wide, down = rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.9)
    return _both("hip", 0.0, 0.1, wide) | {
        f"{side}_hip": (-down, 0.1 * sign, wide * sign), f"{side}_knee": (1.5 * down, 0.0, 0.0)
    }  # fmt: skip


def _bends_down(rng: Random) -> Angles:
    lean = rng.uniform(0.5, 1.1)
    return {
        "pelvis": (lean, 0.0, 0.0),
        **_both("hip", -lean - 0.1, 0.05, 0.1),
        **_both("knee", 0.2, 0.0, 0.0),
    }


def _walks(rng: Random) -> Angles:
    moment = MOTIONS["walk"](float(rng.uniform()), float(rng.uniform(0.8, 1.1)))
    return {k: v for k, v in moment.joints.items() if "shoulder" not in k and "elbow" not in k}


_LEGS: tuple[Callable[[Random], Angles], ...] = (
    _stands, _stands, _walks, _walks, _stands_on_one_leg, _stands_legs_crossed, _sits, _sits,
    _sits_one_leg_over, _squats, _lunges, _kneels_on_one_knee, _steps_aside, _bends_down,
)  # fmt: skip

# Arms: shoulders and elbows. Places are of the rest pose, before the trunk bends.


def arm_to(
    side: str, joints: Float[np.ndarray, "j 3"], wrist: Float[np.ndarray, "3"], elbow: Float[np.ndarray, "3"]
) -> Angles:
    """Shoulder and elbow that bring the wrist to a place, the elbow towards another."""
    at = {name: joints[JOINT[f"{side}_{name}"]] for name in ("shoulder", "elbow", "wrist")}
    upper, fore = at["elbow"] - at["shoulder"], at["wrist"] - at["elbow"]
    sign = 1.0 if side == "left" else -1.0

    def places(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turn = Rotation.from_rotvec(angles[:3])
        bend = Rotation.from_rotvec([0.0, -sign * angles[3], 0.0])
        middle = at["shoulder"] + turn.apply(upper)
        return middle, middle + turn.apply(bend.apply(fore))

    def misses(angles: np.ndarray) -> np.ndarray:
        middle, end = places(angles)
        return np.concatenate([10.0 * (end - wrist), 3.0 * (middle - elbow), 0.05 * angles])

    start = np.array([0.0, -0.3 * sign, -0.8 * sign, 1.0])
    bounds = ([-np.pi] * 3 + [0.0], [np.pi] * 3 + [2.5])
    found = least_squares(misses, start, bounds=bounds).x
    return {
        f"{side}_shoulder": tuple(found[:3].tolist()),
        f"{side}_elbow": (0.0, -sign * float(found[3]), 0.0),
    }


def _to_both(
    joints: np.ndarray, wrist: tuple[float, float, float], elbow: tuple[float, float, float], rng: Random
) -> Angles:
    """Wrists and elbows at mirrored places (for the left arm), a little apart from it."""
    arms: Angles = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        to = [np.array(place) * (sign, 1, 1) + rng.normal(0, 0.015, 3) for place in (wrist, elbow)]
        arms |= arm_to(side, joints, to[0], to[1])
    return arms


def _hang(rng: Random, joints: np.ndarray) -> Angles:
    down, bent = rng.uniform(1.0, 1.25), rng.uniform(0.1, 0.5)
    return {**_both("shoulder", 0.0, -0.1, -down), **_both("elbow", 0.0, -bent, 0.0)}


def _raised(rng: Random, joints: np.ndarray) -> Angles:
    up = rng.uniform(0.8, 1.3)
    return {
        **_both("collar", 0.0, 0.0, 0.3),
        **_both("shoulder", 0.0, rng.uniform(-0.5, 0.2), up - 0.3),
        **_both("elbow", 0.0, -rng.uniform(0.1, 0.9), 0.0),
    }


def _out(rng: Random, joints: np.ndarray) -> Angles:
    return {
        **_both("shoulder", 0.0, rng.uniform(-0.9, 0.1), rng.uniform(-0.7, 0.2)),
        **_both("elbow", 0.0, -rng.uniform(0.1, 1.3), 0.0),
    }


def _one_reaches(rng: Random, joints: np.ndarray) -> Angles:
    side, sign = (("left", 1.0), ("right", -1.0))[int(rng.integers(2))]
    way = np.array([sign * rng.uniform(-0.2, 0.9), rng.uniform(-0.4, 1.0), rng.uniform(0.2, 1.0)])
    way /= np.linalg.norm(way)
    start = joints[JOINT[f"{side}_shoulder"]]
    return _hang(rng, joints) | arm_to(side, joints, start + 0.5 * way, start + 0.26 * way + (0, -0.05, 0))


def _crossed(rng: Random, joints: np.ndarray) -> Angles:
    chest, shoulder = joints[JOINT["spine3"]], joints[JOINT["left_shoulder"]]
    above, sign = (("left", 1.0), ("right", -1.0))[int(rng.integers(2))]
    below = "right" if above == "left" else "left"
    y = shoulder[1] - 0.22
    return arm_to(above, joints, np.array([-0.1 * sign, y, chest[2] + 0.27]),
                  np.array([0.26 * sign, y - 0.06, chest[2] + 0.12])) | arm_to(
        below, joints, np.array([0.1 * sign, y - 0.07, chest[2] + 0.22]),
        np.array([-0.26 * sign, y - 0.08, chest[2] + 0.1]))  # fmt: skip


def _on_hips(rng: Random, joints: np.ndarray) -> Angles:
    pelvis = joints[JOINT["pelvis"]]
    return _to_both(joints, (0.25, pelvis[1] + 0.11, 0.0), (0.48, pelvis[1] + 0.25, -0.12), rng)


def _on_thighs(rng: Random, joints: np.ndarray) -> Angles:
    pelvis = joints[JOINT["pelvis"]]
    return _to_both(joints, (0.14, pelvis[1] + 0.12, 0.33), (0.28, pelvis[1] + 0.25, 0.05), rng)


def _behind_the_back(rng: Random, joints: np.ndarray) -> Angles:
    pelvis = joints[JOINT["pelvis"]]
    return _to_both(joints, (0.06, pelvis[1] + 0.06, -0.27), (0.32, pelvis[1] + 0.28, -0.18), rng)


def _on_the_head(rng: Random, joints: np.ndarray) -> Angles:
    head = joints[JOINT["head"]]
    return _to_both(joints, (0.2, head[1] + 0.14, -0.05), (0.45, head[1] + 0.05, 0.0), rng)


def _telephone(rng: Random, joints: np.ndarray) -> Angles:
    side, sign = (("left", 1.0), ("right", -1.0))[int(rng.integers(2))]
    head = joints[JOINT["head"]]
    ear = head + np.array([0.15 * sign, 0.0, 0.09])
    return _hang(rng, joints) | arm_to(side, joints, ear, head + np.array([0.3 * sign, -0.32, 0.12]))


def _hold_something(rng: Random, joints: np.ndarray) -> Angles:
    chest = joints[JOINT["spine3"]]
    ahead = rng.uniform(0.3, 0.4)
    return _to_both(joints, (0.1, chest[1] - rng.uniform(0.0, 0.2), chest[2] + ahead),
                    (0.26, chest[1] - 0.1, chest[2] + 0.1), rng)  # fmt: skip


_ARMS: tuple[Callable[[Random, np.ndarray], Angles], ...] = (
    _hang, _hang, _raised, _out, _one_reaches, _one_reaches, _crossed, _on_hips, _behind_the_back,
    _on_the_head, _telephone, _hold_something,
)  # fmt: skip
