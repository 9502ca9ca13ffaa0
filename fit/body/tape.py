"""A tape around a finished body: girths, breadths, depths, heights and lengths as an anthropometrist
reads them.

Standing T-pose, y up, +z front, +x the body's left, metres. Levels are those of the survey's landmarks
(Gordon et al. 2014, NATICK/TR-15/007), found on the skin and the skeleton, so that any body of SMPL's
structure can be measured: a level that the survey defines by a landmark without a shape of its own
(navel, nipple) is the survey's average share of the way from the crotch to the shoulder joint.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from .anthropometry import Measurements, mix
from .density import weight_kg
from .plan import height_map
from .sections import Cutter, GirthLine, unique_edges, volume_m3
from .skeleton import JOINT

UP = np.array([0.0, 1.0, 0.0])
NECK_NORMAL = np.array([0.0, 0.88, 0.47])  # the neck leans forward, and the tape with it
SHOULDER_TO_ACROMION_M = 0.030  # joint centre to the bone's edge, outwards, at a stature of STATURE_M
STATURE_M = 1.69
TRUNK_SHARES = {"chest": (0.723, 0.770), "under_chest": (0.59, 0.62), "waist": (0.367, 0.367)}
"""Levels between the crotch (0) and the shoulder joint (1), of women and of men."""
CHEST_FRACTIONS = {"chest": (0.7195, 0.7352), "under_chest": (0.675, 0.686)}
"""The same as fractions of the average stature, for `plan.height_map`."""
HIP_SHARES = np.linspace(0.03, 0.20, 8)  # the fullest of these is the hip
CALF_SHARES = np.linspace(0.20, 0.50, 7)  # from the knee to the ankle; the fullest
ANKLE_SHARES = np.linspace(0.78, 1.0, 6)  # the slimmest
FOREARM_SHARES = (0.15, 0.2, 0.25, 0.3, 0.35)  # from the elbow to the wrist; the fullest
WRIST_SHARES = (0.90, 0.95, 1.0)  # the slimmest
NECK_SHARES = (0.40, 0.60, 0.80, 1.00)  # from the neck joint to the head joint; the slimmest
THIGH_BELOW_CROTCH = 0.030  # of stature: the gluteal furrow

Choice = Callable[[list[float]], int]


@dataclass(frozen=True)
class Levels:
    """Where the tape is laid on one body (metres above the frame's origin)."""

    crotch: float
    chest: float
    under_chest: float
    waist: float
    thigh: float

    @staticmethod
    def of_person(m: Measurements) -> "Levels":
        """Where the survey's landmarks lie on this person, above the floor."""
        y = height_map(m)
        chest, under_chest = (y(mix(fractions, m.sex)) for fractions in CHEST_FRACTIONS.values())
        return Levels(m.crotch_height, chest, under_chest, m.navel_height, y(0.450))


class Subject:
    """One body in the T-pose, ready to be measured."""

    def __init__(
        self,
        template: Float[np.ndarray, "v 3"],
        faces: Int[np.ndarray, "f 3"],
        joints: Float[np.ndarray, "24 3"],
        parts: Int[np.ndarray, "v"],
        levels: Levels | None = None,
        sex: float = 0.5,
    ) -> None:
        self.vertices, self.faces, self.joints = template, faces, joints
        self.cutter = Cutter(template, unique_edges(faces))
        self.middle = float(joints[JOINT["pelvis"], 0])
        self.floor, self.crown = float(template[:, 1].min()), float(template[:, 1].max())
        self.on_arm = np.isin(parts, _joints_named("shoulder", "elbow", "wrist", "hand"))
        self.on_head = parts == JOINT["head"]
        self.on_hand = np.isin(parts, _joints_named("wrist", "hand"))
        self.on_foot = np.isin(parts, _joints_named("ankle", "foot"))
        self.levels = self._find_levels(sex) if levels is None else levels

    @property
    def stature(self) -> float:
        return self.crown - self.floor

    def joint(self, name: str) -> Float[np.ndarray, "3"]:
        return self.joints[JOINT[name]]

    def _find_levels(self, sex: float) -> Levels:
        across = np.array([1.0, 0.0, 0.0])
        origin = np.array([self.middle, 0.0, 0.0])
        _, _, midline = self.cutter.points(origin, across, lambda e, p: np.ones(len(p), dtype=bool))
        if len(midline) < 3:
            raise ValueError(
                "the body has no midline section, so its crotch cannot be found: is it in the T-pose?"
            )
        crotch = float(midline[:, 1].min())
        top = float(self.joint("left_shoulder")[1])
        at = {name: crotch + mix(shares, sex) * (top - crotch) for name, shares in TRUNK_SHARES.items()}
        return Levels(crotch=crotch, thigh=crotch - THIGH_BELOW_CROTCH * self.stature, **at)

    # What counts as a part. Labels alone will not do: the side of the chest may follow the arm's bone.

    def _trunk(self, edges: Int[np.ndarray, "n 2"], p: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        beyond = np.abs(p[:, 0] - self.middle) > abs(self.joint("left_shoulder")[0] - self.middle)
        return ~(self.on_arm[edges].any(1) & beyond)

    def _leg(self, edges: Int[np.ndarray, "n 2"], p: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        return (p[:, 0] > self.middle + 0.002) & ~self.on_arm[edges].any(1)

    def _arm(self, edges: Int[np.ndarray, "n 2"], p: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        return p[:, 0] > self.joint("left_shoulder")[0]

    def _between(self, first: str, second: str, share: float) -> Float[np.ndarray, "3"]:
        return self.joint(first) + share * (self.joint(second) - self.joint(first))

    def _level(self, y: float) -> Float[np.ndarray, "3"]:
        return np.array([self.middle, y, 0.0])

    def _chosen(self, lines: list[GirthLine], choose: Choice) -> GirthLine:
        return lines[choose([line.length_m(self.vertices) for line in lines])]

    def _neck(self) -> GirthLine:
        reach = 0.065 * self.stature
        lines = []
        for share in NECK_SHARES:
            point = self._between("neck", "head", share)

            def near(edges: np.ndarray, p: np.ndarray, point: np.ndarray = point) -> np.ndarray:
                return np.linalg.norm(p - point, axis=1) < reach

            lines.append(self.cutter.girth_line(point, NECK_NORMAL, near))
        return self._chosen(lines, _slimmest)

    def _limb(
        self, first: str, second: str, shares: "np.ndarray | tuple[float, ...]", choose: Choice
    ) -> GirthLine:
        """Across an arm's bone, or level around a leg."""
        is_arm = first != "left_knee"
        normal = self.joint(second) - self.joint(first) if is_arm else UP
        keep = self._arm if is_arm else self._leg
        lines = [self.cutter.girth_line(self._between(first, second, float(s)), normal, keep) for s in shares]
        return self._chosen(lines, choose)

    def girth_lines(self) -> dict[str, GirthLine]:
        """The eleven girths of `anthropometry.GIRTHS`, then the one under the chest (underbust).

        Raises ValueError, naming the girth, where the body has no section at its level.
        """
        levels = self.levels
        top = float(self.joint("left_shoulder")[1])

        def trunk(y: float) -> GirthLine:
            return self.cutter.girth_line(self._level(y), UP, self._trunk)

        def leg(y: float) -> GirthLine:
            return self.cutter.girth_line(self._level(y), UP, self._leg)

        hips = [levels.crotch + float(s) * (top - levels.crotch) for s in HIP_SHARES]
        upper_arm = self.joint("left_elbow") - self.joint("left_shoulder")
        mid_arm = self._between("left_shoulder", "left_elbow", 0.5)
        found: dict[str, Callable[[], GirthLine]] = {
            "neck": self._neck,
            "chest": lambda: trunk(levels.chest),
            "waist": lambda: trunk(levels.waist),
            "hip": lambda: self._chosen([trunk(y) for y in hips], _fullest),
            "thigh": lambda: leg(levels.thigh),
            "knee": lambda: leg(float(self.joint("left_knee")[1])),
            "calf": lambda: self._limb("left_knee", "left_ankle", CALF_SHARES, _fullest),
            "ankle": lambda: self._limb("left_knee", "left_ankle", ANKLE_SHARES, _slimmest),
            "biceps": lambda: self.cutter.girth_line(mid_arm, upper_arm, self._arm),
            "forearm": lambda: self._limb("left_elbow", "left_wrist", FOREARM_SHARES, _fullest),
            "wrist": lambda: self._limb("left_elbow", "left_wrist", WRIST_SHARES, _slimmest),
            "under_chest": lambda: trunk(levels.under_chest),
        }
        lines = {}
        for name, find in found.items():
            try:
                lines[name] = find()
            except ValueError as error:
                raise ValueError(f"{name} {error}") from None
        return lines

    def extents(self, lines: dict[str, GirthLine]) -> dict[str, float]:
        """Breadths and depths of the trunk where its girths are, then heights and lengths (metres)."""
        v, joint = self.vertices, self.joint
        out = {}
        for name in ("chest", "waist", "hip"):
            size = np.ptp(lines[name].points(v), axis=0)
            out[f"{name}_breadth"], out[f"{name}_depth"] = float(size[0]), float(size[2])
        inset = SHOULDER_TO_ACROMION_M * self.stature / STATURE_M
        hand = v[self.on_hand & (v[:, 0] > self.middle)]
        foot = v[self.on_foot & (v[:, 0] > self.middle)]
        foot_length, foot_breadth = _foot_size(foot)
        above_ears = self.crown - 0.048 * self.stature
        skull = v[self.on_head & (v[:, 1] > above_ears)]
        return {
            **out,
            "biacromial": float(joint("left_shoulder")[0] - joint("right_shoulder")[0]) + 2 * inset,
            "upper_arm": float(np.linalg.norm(joint("left_elbow") - joint("left_shoulder"))),
            "lower_arm": float(np.linalg.norm(joint("left_wrist") - joint("left_elbow"))),
            "hand_length": float(hand[:, 0].max() - joint("left_wrist")[0]),
            "span": float(np.ptp(v[:, 0])),
            "crotch_height": self.levels.crotch - self.floor,
            "knee_height": float(joint("left_knee")[1]) - self.floor,
            "foot_length": foot_length,
            "foot_breadth": foot_breadth,
            "head_breadth": float(np.ptp(skull[:, 0])),
            "head_length": float(np.ptp(skull[:, 2])),
        }


def _joints_named(*names: str) -> list[int]:
    return [JOINT[f"{side}_{name}"] for side in ("left", "right") for name in names]


def _fullest(lengths: list[float]) -> int:
    return int(np.argmax(lengths))


def _slimmest(lengths: list[float]) -> int:
    return int(np.argmin(lengths))


def _foot_size(foot: Float[np.ndarray, "n 3"]) -> tuple[float, float]:
    """Length and breadth of a foot along and across its own long axis, seen from above."""
    plan = foot[:, [0, 2]]
    axis = np.linalg.svd(plan - plan.mean(0), full_matrices=False)[2][0]
    along, across = plan @ axis, plan @ np.array([-axis[1], axis[0]])
    return float(np.ptp(along)), float(np.ptp(across))


def measures_of(
    template: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    joints: Float[np.ndarray, "24 3"],
    parts: Int[np.ndarray, "v"],
    sex: float = 0.5,
) -> dict[str, float]:
    """All that a tape reads on a body in the T-pose: metres, but for `litres`, `kilograms` and `bmi`.

    `parts` is the bone (0 to 23) that moves each vertex most. `sex` (0 female to 1 male) enters the
    density that turns litres into kilograms, and the level of the chest. Girths come first, in the order
    of `anthropometry.GIRTHS`. Raises ValueError where the body has no section at a level: it is not in
    the T-pose, or not a body.
    """
    subject = Subject(template, faces, joints, parts, sex=sex)
    lines = subject.girth_lines()
    litres = 1000 * volume_m3(template, faces)
    kilograms = weight_kg(litres, subject.stature, sex)
    return {
        **{name: line.length_m(template) for name, line in lines.items()},
        "stature": subject.stature,
        **subject.extents(lines),
        "litres": litres,
        "kilograms": kilograms,
        "bmi": kilograms / subject.stature**2,
    }
