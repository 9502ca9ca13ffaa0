"""The bends that flesh is settled in: hips, knees, elbows and shoulders over their natural range.

Left side only (the mirror makes the right). Angles in degrees, as in `pose_prior`: what clinical tables call
flexion, abduction and so on is noted there.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fit.surface import vertex_normals

from .dual_quaternions import blend_dual_quaternions
from .flesh import Bone, Core, Crease, Flesh
from .pose_prior import PosePrior
from .ramp import smooth_step
from .skeleton import JOINT, N_JOINTS, PARENTS, axis_angle_to_matrix, blend_linearly, world_from_rest

GROIN = np.array([0.42, -0.907, 0.0])  # from the trunk to the thigh
LEFT = np.array([1.0, 0.0, 0.0])
Turn = tuple[int, int, int]
_ELBOW: tuple[dict[str, Turn], ...] = tuple(
    {"left_elbow": turn}
    for turn in ((0, -40, 0), (0, -75, 0), (0, -110, 0), (0, -140, 0), (28, 0, 0), (-28, 0, 0))
)
_KNEE: tuple[dict[str, Turn], ...] = tuple({"left_knee": (a, 0, 0)} for a in (40, 75, 110, 140))
_HIP: tuple[dict[str, Turn], ...] = tuple(
    {"left_hip": turn}
    for turn in (
        (-35, 0, 0), (-70, 0, 0), (-110, 0, 0), (20, 0, 0), (0, 0, 35), (0, 0, -15), (0, 40, 0),
        (0, -35, 0), (-90, 10, 25), (-105, 12, 16), (-60, -10, -10),
    )
)  # fmt: skip
_SHOULDER: tuple[dict[str, Turn], ...] = tuple(
    {"left_collar": collar, "left_shoulder": shoulder}
    for collar, shoulder in (
        ((0, 0, 0), (0, 0, -40)), ((0, 0, -5), (0, 0, -78)), ((0, 0, -4), (0, -35, -60)),
        ((0, 0, -4), (0, 25, -65)), ((0, 0, -4), (40, 0, -65)), ((0, 0, -4), (-40, 0, -65)),
        ((0, 0, 12), (0, 0, 30)), ((0, 0, 26), (0, 0, 62)), ((0, -10, 12), (0, -50, 45)),
        ((0, -6, 0), (0, -45, 0)), ((0, -13, 0), (0, -90, 0)), ((0, -13, 0), (0, -105, -25)),
        ((0, 10, 0), (0, 30, 0)), ((0, 0, 22), (0, 0, 0)), ((0, -14, 0), (0, 0, 0)), ((0, 0, 0), (45, 0, 0)),
    )
)  # fmt: skip


@dataclass(frozen=True)
class Bend:
    """One settled example. rotations: every joint's own. skin: vertices; wanted: where they go, m; swell: the
    way they would give (unit normals of the posed skin, fading out away from the joint and in creases).
    combined: a hip that turns about several axes, as in squats, where the volume of the whole matters most.
    """

    rotations: Float[np.ndarray, "24 3 3"]
    skin: Int[np.ndarray, "r"]
    wanted: Float[np.ndarray, "r 3"]
    swell: Float[np.ndarray, "r 3"]
    combined: bool = False


def flesh_bends(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    weights: Float[np.ndarray, "v 24"],
    joints: Float[np.ndarray, "24 3"],
) -> dict[tuple[int, ...], list[Bend]]:
    """Settled examples by the joints that turn in them."""
    normals = vertex_normals(vertices, faces)

    def at(name: str) -> Float[np.ndarray, "3"]:
        return joints[JOINT[name]]

    def near(name: str, radius_m: float, *owners: str) -> Bool[np.ndarray, "v"]:
        owned = weights[:, [JOINT[o] for o in owners]].sum(1) > 0.5
        return owned & (np.linalg.norm(vertices - at(name), axis=1) < radius_m) & (vertices[:, 0] >= 0)

    def bone(start: str, end: str, reach_m: float = 0.03, share: float = 0.45) -> Bone:
        return Bone(at(start), at(end), JOINT[start], reach_m, share)

    def across(name: str, to: str, reach_m: float) -> Crease:
        along = at(to) - at(name)
        return Crease(at(name), along / np.linalg.norm(along), reach_m)

    def settle(
        flesh: Flesh, examples: tuple[dict[str, Turn], ...], crease: str, reach_m: float
    ) -> list[Bend]:
        bends = []
        for turns in examples:
            pose = np.zeros((N_JOINTS, 3))
            for name, turn in turns.items():
                pose[JOINT[name]] = np.radians(turn)
            rotations = axis_angle_to_matrix(pose)
            half = pose.copy()
            half[JOINT[crease]] *= 0.5
            half_turn = world_from_rest(axis_angle_to_matrix(half), joints)[JOINT[crease]]
            bones = world_from_rest(rotations, joints)
            wanted = flesh.posed(bones, half_turn)
            whole, _ = blend_linearly(vertices, weights, bones)
            whole[flesh.region] = wanted
            fade = smooth_step(-reach_m, -0.4 * reach_m, -np.linalg.norm(whole - at(crease), axis=1))
            fade = fade[flesh.region] * flesh.free_of_crease(wanted, half_turn) * flesh.softness
            swell = fade[:, None] * vertex_normals(whole, faces)[flesh.region]
            combined = crease == "left_hip" and int(np.count_nonzero(pose[JOINT[crease]])) > 1
            bends.append(Bend(rotations, flesh.region, wanted, swell, combined))
        return bends

    elbow = Flesh(
        vertices, normals, weights, near("left_elbow", 0.17, "left_shoulder", "left_elbow", "left_wrist"),
        (bone("left_shoulder", "left_elbow"), bone("left_elbow", "left_wrist")),
        0.012, at("left_elbow"), 0.17, crease=across("left_elbow", "left_wrist", 0.15),
    )  # fmt: skip
    knee = Flesh(
        vertices, normals, weights, near("left_knee", 0.26, "left_hip", "left_knee", "left_ankle"),
        (bone("left_hip", "left_knee", 0.04), bone("left_knee", "left_ankle", 0.04)),
        0.018, at("left_knee"), 0.26, crease=across("left_knee", "left_ankle", 0.22),
    )  # fmt: skip
    groin = Crease(at("left_hip"), GROIN, 0.25)
    trunk = tuple(JOINT[name] for name in ("pelvis", "spine1", "spine2", "spine3", "neck"))
    hip = Flesh(
        vertices, normals, weights, near("left_hip", 0.34, "pelvis", "spine1", "left_hip", "left_knee"),
        (bone("left_hip", "left_knee", 0.045), bone("left_knee", "left_ankle", 0.045)), 0.022,
        at("left_hip"), 0.34, core=Core(0.04, trunk, at("left_hip") - 0.02 * GROIN, GROIN),
        crease=groin, left_half=True,
    )  # fmt: skip
    shoulder = Flesh(
        vertices, normals, weights,
        near("left_shoulder", 0.34, "spine1", "spine2", "spine3", "neck", "left_collar", "left_shoulder",
             "left_elbow"),
        (bone("left_collar", "left_shoulder", 0.025), bone("left_shoulder", "left_elbow", 0.035),
         bone("left_elbow", "left_wrist", 0.035)),
        0.022, at("left_shoulder"), 0.34,
        core=Core(0.03, trunk, at("left_shoulder") - 0.025 * LEFT, LEFT), left_half=True,
    )  # fmt: skip
    return {
        (JOINT["left_elbow"],): settle(elbow, _ELBOW, "left_elbow", 0.15),
        (JOINT["left_knee"],): settle(knee, _KNEE, "left_knee", 0.24),
        (JOINT["left_hip"],): settle(hip, _HIP, "left_hip", 0.26),
        (JOINT["left_collar"], JOINT["left_shoulder"]): settle(shoulder, _SHOULDER, "left_shoulder", 0.22),
    }


def plain_bends(
    joint: int,
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    weights: Float[np.ndarray, "v 24"],
    joints: Float[np.ndarray, "24 3"],
) -> list[Bend]:
    """Dual-quaternion examples of the other joints: one axis at a time, most of the way to the end of its
    range.
    """
    prior = PosePrior.standard()
    behind = [joint]
    for j in range(joint + 1, N_JOINTS):
        if PARENTS[j] in behind:
            behind.append(j)
    share = weights[:, behind].sum(1)
    skin = np.flatnonzero((share > 0.002) & (share < 0.998))
    bends = []
    for axis in range(3):
        for limit in (prior.low, prior.high):
            pose = np.zeros((N_JOINTS, 3))
            pose[joint, axis] = 0.75 * limit[3 * (joint - 1) + axis]
            rotations = axis_angle_to_matrix(pose)
            bones = world_from_rest(rotations, joints)
            whole = blend_dual_quaternions(vertices, weights, bones)
            fade = 4 * share[skin] * (1 - share[skin])
            swell = fade[:, None] * vertex_normals(whole, faces)[skin]
            bends.append(Bend(rotations, skin, whole[skin], swell))
    return bends
