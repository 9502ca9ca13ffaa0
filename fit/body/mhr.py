"""The Momentum Human Rig (Ferguson et al. 2025; Apache-2.0) as a body of SMPL's structure, through the
optional `body-models`.

Its shape coefficients move the surface alone; the lengths of the bones are controls beside those of the pose.
So people are drawn in both: coefficients of unit variance, and bones as long as the statures of adults ask
for. Each stands in SMPL's T-pose by the rig's own controls, found by least squares, so that the rig's twists
and correctives shape the shoulders.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from tqdm import tqdm

from .body_archive import BodyModelError
from .body_file import BodyFile
from .foreign_shapes import DrawnPeople, body_of_people, fold_by_name, triangles
from .skeleton import JOINT, JOINT_NAMES

N_PEOPLE = 200
N_BETAS = 30  # its body has 20 components and some ten lengths
LICENCE = "Apache-2.0 (Momentum Human Rig by Meta; changed: made into SMPL's structure)"
STATURE = (
    1.693,
    0.092,
)  # mean, SD in m: as many women as men of ANSUR II (1.629 and 1.756 m, SD 0.064 and 0.069)
PROPORTION_SD = 0.025  # of one length, given the stature
PLAUSIBLE_HEIGHT_M = (1.0, 2.5)
MAX_ANGLE = np.radians(
    10.0
)  # of a bone off its T-pose: hinges leave elbows and knees a few degrees of their own
MAX_LENGTH_ERROR_M = 0.02

N_BODY_CONTROLS = 94
LIMBS = slice(27, 65)  # of them: angles of arms and legs (columns 30 to 67 of the rig's 204)
PROPORTIONS = slice(79, 94)  # lengths of the bones, some a decimetre a unit (columns 139 to 153)
_SIDED = {
    "upleg": "hip", "lowleg": "knee", "foot": "ankle", "ball": "foot", "clavicle": "collar",
    "uparm": "shoulder", "lowarm": "elbow", "wrist": "wrist",
    **{f"{finger}1": "hand" for finger in ("middle", "index", "ring", "pinky")},
}  # fmt: skip
JOINT_OF_BONE: dict[str, str] = {
    "root": "pelvis", "body_world": "pelvis", "c_spine1": "spine1", "c_spine2": "spine2",
    "c_spine3": "spine3", "c_neck": "neck", "c_head": "head",
    **{f"l_{bone}": f"left_{joint}" for bone, joint in _SIDED.items()},
    **{f"r_{bone}": f"right_{joint}" for bone, joint in _SIDED.items()},
}  # fmt: skip
"""MHR's bone -> SMPL's joint; the first bone of a joint says where the joint lies. Of its four spine
joints the lowest lies below the waist and goes with the pelvis."""
_MIDDLE = [
    ("pelvis", "neck"), ("neck", "head"), ("left_hip", "right_hip"), ("left_shoulder", "right_shoulder"),
]  # fmt: skip
_LIMB = [
    ("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"), ("shoulder", "elbow"), ("elbow", "wrist"),
    ("wrist", "hand"),
]  # fmt: skip
_LENGTHS = _MIDDLE + [(f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in _LIMB]
_FROM = np.array([JOINT[a] for a, _ in _LENGTHS])
_TO = np.array([JOINT[b] for _, b in _LENGTHS])
Pose = dict[str, Any]


@runtime_checkable
class Rig(Protocol):
    """What is asked of `body_models.mhr.numpy.MHR`: metres, y up, +z front; poses are keyword arguments."""

    @property
    def joint_names(self) -> Sequence[str]: ...
    @property
    def parents(self) -> Sequence[int]: ...
    @property
    def faces(self) -> Any: ...
    @property
    def skin_weights(self) -> Any: ...
    def get_rest_pose(self, *, hands: Any = "default") -> Pose: ...
    def forward_vertices(self, **pose: Any) -> Any: ...
    def forward_skeleton(self, **pose: Any) -> Any: ...


@dataclass(frozen=True)
class _Figure:
    """The rig, and where SMPL's joints are in its skeleton."""

    rig: Rig
    at: list[int]
    knuckles: list[int]
    """Little and index finger's first joints, left then right."""

    @classmethod
    def of(cls, rig: Rig) -> "_Figure":
        bones = list(rig.joint_names)
        missing = sorted(set(JOINT_OF_BONE) - set(bones))
        if missing:
            raise BodyModelError(
                f"mhr: its rig has no bones {', '.join(missing[:4])} (of {len(bones)}); "
                "this reads the rig of MHR's release 1.0."
            )
        first = [next(bone for bone, own in JOINT_OF_BONE.items() if own == name) for name in JOINT_NAMES]
        knuckles = ("l_pinky1", "l_index1", "r_pinky1", "r_index1")
        return cls(rig, [bones.index(bone) for bone in first], [bones.index(bone) for bone in knuckles])

    def bones(self, pose: Mapping[str, Any]) -> Float[np.ndarray, "b 3"]:
        return np.asarray(self.rig.forward_skeleton(**pose), dtype=np.float64)[:, :3, 3]

    def joints(self, pose: Mapping[str, Any]) -> Float[np.ndarray, "24 3"]:
        return self.bones(pose)[self.at]

    def vertices(self, pose: Mapping[str, Any]) -> Float[np.ndarray, "v 3"]:
        return np.asarray(self.rig.forward_vertices(**pose), dtype=np.float64)


def mhr_body_file(assets: Path | None = None, *, seed: int = 0, show_progress: bool = True) -> BodyFile:
    """MHR as a body file. `assets`: folder of its release (or a file in it); None: where body-models keeps
    (or fetches) them.

    Raises BodyModelError where body-models is not installed, the assets are not there or hold another rig.
    """
    try:
        from body_models.mhr.numpy import MHR
    except ImportError as error:
        raise BodyModelError(
            f"mhr: needs the package body-models ({error}). Install it: pip install 'bodyhull[bodies]'"
        ) from error
    try:
        model = MHR(model_path=assets.parent if assets is not None and assets.is_file() else assets)
    except Exception as error:  # a download that fails raises whatever it likes
        raise BodyModelError(
            f"mhr: its assets cannot be had ({type(error).__name__}: {str(error)[:200]}). "
            "Unpack assets.zip of MHR's release and give its folder: mhr:FOLDER, with mhr_model.pt in it."
        ) from error
    return body_of_people(people_of_rig(model, seed=seed, show_progress=show_progress), N_BETAS)


def people_of_rig(
    rig: Rig, *, n_people: int = N_PEOPLE, seed: int = 0, show_progress: bool = True
) -> DrawnPeople:
    """People drawn from the rig, in SMPL's T-pose. Raises BodyModelError where the rig is not MHR's."""
    figure, random = _Figure.of(rig), np.random.default_rng(seed)
    pose = t_pose(rig)
    faces = triangles(np.asarray(rig.faces, dtype=np.int64))
    used, index = np.unique(faces, return_inverse=True)
    height = float(np.ptp(figure.vertices(pose)[used, 1]))
    usual = figure.joints(pose)
    # What is above the head's joint and below the ankle's does not grow with the bones.
    grows = usual[JOINT["head"], 1] - usual[[JOINT["left_ankle"], JOINT["right_ankle"]], 1].mean()
    answer = _answer_of_lengths(figure, pose)
    vertices, joints = [], []
    for _ in tqdm(range(n_people), desc="drawing MHR's people", disable=not show_progress):
        size = 1 + (random.normal(*STATURE) - height) / grows
        middle, sided = np.split(random.normal(0, PROPORTION_SD, len(_MIDDLE) + len(_LIMB)), [len(_MIDDLE)])
        factors = size + np.concatenate([middle, sided, sided])  # both sides alike
        drawn = _with_lengths(figure, pose, answer, factors * _lengths(usual))
        drawn["shape"] = random.standard_normal(np.shape(pose["shape"])[-1])
        vertices.append(figure.vertices(drawn)[used])
        joints.append(figure.joints(drawn))
    weights = np.zeros((len(used), len(JOINT_NAMES)))
    folded = fold_by_name(list(rig.joint_names), list(rig.parents), JOINT_OF_BONE)
    np.add.at(weights.T, folded, np.asarray(rig.skin_weights, dtype=np.float64)[used].T)
    return DrawnPeople(
        name="mhr",
        licence=LICENCE,
        gender="neutral",
        vertices=np.stack(vertices),
        joints=np.stack(joints),
        faces=index.reshape(faces.shape),
        weights=weights / weights.sum(1, keepdims=True),
    )


def t_pose(rig: Rig) -> Pose:
    """SMPL's T-pose: arms level, palms down, legs a little apart; collar bones and feet as at rest.

    Raises BodyModelError where it stands in other axes or units, or a limb does not get there.
    """
    figure = _Figure.of(rig)
    pose = {
        name: np.asarray(value, dtype=np.float64) for name, value in rig.get_rest_pose(hands="flat").items()
    }
    _check_rest(figure, pose)
    rest = figure.joints(pose)
    limbs, directions = [], []
    for side, out in (("left", 1.0), ("right", -1.0)):
        for a, b, direction in (
            ("collar", "shoulder", None),
            ("shoulder", "elbow", (out, 0, 0)),
            ("elbow", "wrist", (out, 0, 0)),
            ("wrist", "hand", (out, 0, 0)),
            ("hip", "knee", (0.04 * out, -1, 0)),
            ("knee", "ankle", (0.04 * out, -1, 0)),
            ("ankle", "foot", None),
        ):
            start_idx, end_idx = JOINT[f"{side}_{a}"], JOINT[f"{side}_{b}"]
            limbs.append((start_idx, end_idx))
            directions.append(rest[end_idx] - rest[start_idx] if direction is None else np.array(direction))
    start, end = np.array(limbs).T
    wanted = _unit(np.stack(directions))

    def standing(controls: Float[np.ndarray, "c"]) -> Pose:
        body = pose["body_pose"].copy()
        body[LIMBS] = controls
        return {**pose, "body_pose": body}

    def off(controls: Float[np.ndarray, "c"]) -> Float[np.ndarray, "r"]:
        bones = figure.bones(standing(controls))
        along = _unit(bones[figure.at][end] - bones[figure.at][start]) - wanted
        little, index = bones[figure.knuckles].reshape(2, 2, 3).transpose(1, 0, 2)
        palms = _unit(index - little) - [0, 0, 1]  # thumbs to the front: palms down
        # Controls that nothing asks for stay at rest; the palms matter less than the bones.
        return np.concatenate([along.ravel(), 0.1 * palms.ravel(), 0.01 * controls])

    def slopes(controls: Float[np.ndarray, "c"]) -> Float[np.ndarray, "r c"]:
        step, now = 1e-3, off(controls)  # far above what single precision blurs
        return np.stack([(off(controls + step * e) - now) / step for e in np.eye(len(controls))], 1)

    found = least_squares(off, pose["body_pose"][LIMBS], jac=slopes).x
    joints = figure.joints(standing(found))
    angles = np.arccos(np.clip((_unit(joints[end] - joints[start]) * wanted).sum(1), -1, 1))
    if angles.max() > MAX_ANGLE:
        worst = JOINT_NAMES[start[angles.argmax()]]
        raise BodyModelError(
            f"mhr: its {worst.replace('_', ' ')} cannot be turned into the T-pose "
            f"({np.degrees(angles.max()):.0f} degrees off); this reads the rig of MHR's release 1.0."
        )
    return standing(found)


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _check_rest(figure: _Figure, pose: Pose) -> None:
    joints, n_controls = figure.joints(pose), np.shape(pose["body_pose"])[-1]
    feet = joints[[JOINT["left_foot"], JOINT["right_foot"]]].mean(0)
    ankles = joints[[JOINT["left_ankle"], JOINT["right_ankle"]]].mean(0)
    upright = joints[JOINT["head"], 1] - ankles[1] > 0.6 * np.ptp(joints, axis=0).max()
    height = float(np.ptp(figure.vertices(pose)[:, 1]))
    found = None
    if n_controls != N_BODY_CONTROLS:
        found = f"{n_controls} body controls instead of {N_BODY_CONTROLS}"
    elif not upright or feet[2] < ankles[2] or joints[JOINT["left_hip"], 0] < joints[JOINT["right_hip"], 0]:
        found = "other axes than y up and z to the front"
    elif not PLAUSIBLE_HEIGHT_M[0] < height < PLAUSIBLE_HEIGHT_M[1]:
        found = f"a height of {height:.2f} m"
    if found:
        raise BodyModelError(f"mhr: its rig has {found}; this reads MHR's release 1.0 with body-models 0.26.")


def _lengths(joints: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "l"]:
    return np.linalg.norm(joints[_TO] - joints[_FROM], axis=1)


def _lengthened(pose: Pose, controls: Float[np.ndarray, "c"]) -> Pose:
    body = pose["body_pose"].copy()
    body[PROPORTIONS] = controls
    return {**pose, "body_pose": body}


def _answer_of_lengths(figure: _Figure, pose: Pose) -> Float[np.ndarray, "c l"]:
    """Controls for a change of lengths in metres: least squares with a slight pull to none."""
    n, step = PROPORTIONS.stop - PROPORTIONS.start, 0.1
    usual = _lengths(figure.joints(pose))
    change = [_lengths(figure.joints(_lengthened(pose, step * e))) - usual for e in np.eye(n)]
    slopes = np.stack(change, 1) / step
    return np.linalg.solve(slopes.T @ slopes + 1e-5 * np.eye(n), slopes.T)


def _with_lengths(
    figure: _Figure, pose: Pose, answer: Float[np.ndarray, "c l"], wanted: Float[np.ndarray, "l"]
) -> Pose:
    """The pose with bones of these lengths. Raises BodyModelError where they cannot be had."""
    controls = np.zeros(len(answer))
    for _ in range(4):  # nearly linear: a hand's control is an exponent
        off = wanted - _lengths(figure.joints(_lengthened(pose, controls)))
        controls += answer @ off
    drawn = _lengthened(pose, controls)
    off = wanted - _lengths(figure.joints(drawn))
    worst = int(np.abs(off).argmax())
    if np.abs(off[worst]) > MAX_LENGTH_ERROR_M:
        a, b = _LENGTHS[worst]
        raise BodyModelError(
            f"mhr: {a} to {b} cannot be made {100 * wanted[worst]:.0f} cm long "
            f"({100 * off[worst]:+.1f} cm off); this reads the rig of MHR's release 1.0."
        )
    return drawn
