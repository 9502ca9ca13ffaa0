"""A tape around an implicit body: girths, depths and volume from rays, before there is any mesh.

From a point inside a section, rays in the section's plane walk inwards to the skin (the pseudo-distance is
close to the distance along a ray, so three or four steps do). The convex perimeter is the integral of the
support function over all directions (Cauchy); areas of a stack of sections give the volume. Levels are those
of `tape.Subject`. Frame: floor y = 0, +z front, +x the body's left, metres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .anthropometry import GIRTHS, TRUNK_SECTIONS, Measurements
from .implicit import ImplicitBody, cross, unit
from .skeleton import JOINT
from .tape import (
    ANKLE_SHARES,
    CALF_SHARES,
    FOREARM_SHARES,
    HIP_SHARES,
    NECK_NORMAL,
    NECK_SHARES,
    WRIST_SHARES,
    Levels,
)

N_RAYS = 17
N_DIRECTIONS = 48
LONGEST_STEP_M = 0.06
FAR_M = 0.26  # outside of every section
OUTSIDE = 1.12
SLIMMEST = ("neck", "ankle", "wrist")  # of several sections; of the other girths the fullest counts

HEAD_LITRES = 0.60  # of height x length x breadth, above the chin's level
HAND_LITRES = 0.0215  # of length x breadth, times a metre
FOOT_LITRES = 0.37  # of length x breadth x height of the ankle joint
PARTS_OF_VOLUME = (HEAD_LITRES, HAND_LITRES, FOOT_LITRES)


@dataclass(frozen=True)
class Reading:
    """What the tape read (metres; litres)."""

    girth: dict[str, float]
    depth: dict[str, float]  # log of depth over breadth, by trunk section
    squareness: dict[str, float]  # log of girth over breadth and depth together, by trunk section
    litres: float


class RayTape:
    """Rays laid out around one person; `read` may be asked again after the body was modelled anew."""

    def __init__(
        self,
        m: Measurements,
        joints: Float[np.ndarray, "24 3"],
        start: Float[np.ndarray, "r"] | None = None,
    ) -> None:
        """`start`: another person's `length`, near which the rays begin; without it they come from afar."""
        self.m = m
        self.sections: list[tuple[str, np.ndarray, np.ndarray, np.ndarray, bool, float]] = []
        self.heights: list[float] = []
        self._lay(joints)
        self._stack(joints)
        origins, rays = [], []
        for _, centre, first, second, is_half, _ in self.sections:
            angle = (
                np.linspace(-np.pi / 2, np.pi / 2, N_RAYS)
                if is_half
                else np.arange(N_RAYS) * 2 * np.pi / N_RAYS
            )
            origins.append(np.repeat(centre[None], N_RAYS, 0))
            rays.append(np.outer(np.cos(angle), first) + np.outer(np.sin(angle), second))
        self.origins, self.rays = np.concatenate(origins), np.concatenate(rays)
        self.farthest = np.repeat([s[5] for s in self.sections], N_RAYS)
        self.start = start
        self.length: np.ndarray | None = None

    def _add(
        self,
        name: str,
        centre: Float[np.ndarray, "3"],
        normal: Float[np.ndarray, "3"],
        *,
        is_half: bool,
        farthest: float,
    ) -> None:
        """Rays across `normal`; half a turn on the left where the section is its own mirror image."""
        first = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.9 else np.array([0, 1.0, 0])
        second = unit(cross(unit(normal), first))
        first = cross(second, unit(normal))
        self.sections.append((name, centre, first, second, is_half, farthest))

    def _lay(self, joints: Float[np.ndarray, "24 3"]) -> None:
        m, levels, up = self.m, Levels.of_person(self.m), np.array([0.0, 1.0, 0.0])
        joint = {
            name: joints[JOINT[f"left_{name}"]]
            for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        }
        neck, head = joints[JOINT["neck"]], joints[JOINT["head"]]
        for share in NECK_SHARES:
            self._add("neck", neck + share * (head - neck), NECK_NORMAL, is_half=True, farthest=0.11)
        top = joint["shoulder"][1]
        hips = [levels.crotch + float(s) * (top - levels.crotch) for s in HIP_SHARES]
        for name, y in (("chest", levels.chest), ("waist", levels.waist), *(("hip", y) for y in hips[1::2])):
            self._add(name, np.array([0, y, 0.01]), up, is_half=True, farthest=0.45)

        def leg(name: str, y: float) -> None:
            share = np.interp(y, [joint["ankle"][1], joint["knee"][1], joint["hip"][1]], [2.0, 1.0, 0.0])
            a, b = ("hip", "knee") if share < 1 else ("knee", "ankle")
            centre = joint[a] + (share % 1 if share < 2 else 1.0) * (joint[b] - joint[a])
            self._add(name, np.array([centre[0], y, centre[2]]), up, is_half=False, farthest=0.25)

        leg("thigh", levels.thigh)
        leg("knee", joint["knee"][1])
        for name, shares in (("calf", CALF_SHARES[::2]), ("ankle", ANKLE_SHARES[::2])):
            for s in shares:
                leg(name, float(joint["knee"][1] + s * (joint["ankle"][1] - joint["knee"][1])))

        upper, lower = joint["elbow"] - joint["shoulder"], joint["wrist"] - joint["elbow"]
        self._add("biceps", joint["shoulder"] + 0.5 * upper, upper, is_half=False, farthest=0.15)
        for name, fractions in (("forearm", FOREARM_SHARES[::2]), ("wrist", WRIST_SHARES)):
            for s in fractions:
                self._add(name, joint["elbow"] + s * lower, lower, is_half=False, farthest=0.12)

        # Stacks for the volume: trunk above the crotch, leg below it, arm outside the shoulder joint.
        chin = m.stature - m.head_height
        crotch = m.crotch_height
        self.trunk_y = np.concatenate(
            [np.linspace(crotch + 0.012, top - 0.075, 11), np.linspace(top - 0.05, chin, 6)]
        )
        for y in self.trunk_y:
            z = float(np.interp(y, [top, chin], [0.0, -0.01]))
            reach = 0.45 if y < top - 0.06 else joint["shoulder"][0]
            self._add("trunk", np.array([0, y, z]), up, is_half=True, farthest=reach)
        self.leg_y = np.linspace(joint["ankle"][1], crotch, 11)
        for y in self.leg_y:
            leg("leg", float(y))
        self.arm_x = np.linspace(joint["shoulder"][0], joint["wrist"][0], 8)
        for x in self.arm_x:
            share = (x - joint["shoulder"][0]) / (joint["wrist"][0] - joint["shoulder"][0])
            centre = joint["shoulder"] + share * (joint["wrist"] - joint["shoulder"])
            self._add("arm", centre, np.array([1.0, 0, 0]), is_half=False, farthest=0.15)

    def _stack(self, joints: Float[np.ndarray, "24 3"]) -> None:
        names = [s[0] for s in self.sections]
        self.which = {name: np.flatnonzero([n == name for n in names]) for name in dict.fromkeys(names)}

    def _march(self, body: ImplicitBody) -> Float[np.ndarray, "s r"]:
        """Lengths of all rays, from outside inwards to the skin; the last ones are the next start."""
        if self.length is not None:
            t, n_steps = self.length, 3
        elif self.start is not None:  # a little outside, since the outermost skin is sought
            t, n_steps = np.minimum(self.farthest, OUTSIDE * self.start), 4
        else:
            t, n_steps = np.minimum(self.farthest, FAR_M), 7
        for step_idx in range(n_steps):
            p = self.origins + t[:, None] * self.rays
            if step_idx in (0, 3):
                reached = body.reached(p)
            move = np.clip(body(p, reached), -LONGEST_STEP_M, 0.10)
            t = np.clip(t - move, 0.004, self.farthest)
        self.length = t
        return t.reshape(-1, N_RAYS)

    def read(self, body: ImplicitBody) -> Reading:
        """Girths, depths and litres of this body."""
        length = self._march(body)
        flat = np.zeros((len(self.sections), N_RAYS, 2))
        is_half = np.array([s[4] for s in self.sections])
        half_turn = np.linspace(-np.pi / 2, np.pi / 2, N_RAYS)
        turn = np.arange(N_RAYS) * 2 * np.pi / N_RAYS
        angle = np.where(is_half[:, None], half_turn, turn)
        flat[..., 0], flat[..., 1] = length * np.cos(angle), length * np.sin(angle)
        direction = np.arange(N_DIRECTIONS) * 2 * np.pi / N_DIRECTIONS
        support = np.stack([np.cos(direction), np.sin(direction)])
        reach = (flat @ support).max(1)
        mirrored = (flat @ (support * [[-1.0], [1.0]])).max(1)
        reach = np.where(is_half[:, None], np.maximum(reach, mirrored), reach)
        perimeter = reach.mean(1) * 2 * np.pi
        girth, depth, squareness = {}, {}, {}
        for name in GIRTHS:
            values = perimeter[self.which[name]]
            best = values.argmin() if name in SLIMMEST else values.argmax()
            girth[name] = float(values[best])
            if name in TRUNK_SECTIONS:
                section = self.which[name][best]
                quarter = N_DIRECTIONS // 4
                breadth = 2 * reach[section, 0]
                through = reach[section, quarter] + reach[section, 3 * quarter]
                depth[name] = float(np.log(through / breadth))
                squareness[name] = float(np.log(girth[name] / (breadth + through)))
        return Reading(girth, depth, squareness, self._litres(flat, is_half))

    def _litres(self, flat: Float[np.ndarray, "s r 2"], is_half: np.ndarray) -> float:
        after = np.roll(flat, -1, 1)
        wedge = 0.5 * (flat[..., 0] * after[..., 1] - flat[..., 1] * after[..., 0])
        area = np.where(is_half, 2 * wedge[:, :-1].sum(1), wedge.sum(1))
        m = self.m
        trunk = np.trapezoid(area[self.which["trunk"]], self.trunk_y)
        leg = np.trapezoid(area[self.which["leg"]], self.leg_y)
        arm = np.trapezoid(area[self.which["arm"]], self.arm_x)
        head, hand, foot = PARTS_OF_VOLUME
        ends = head * m.head_height * m.head_length * m.head_breadth
        ends += 2 * hand * m.hand_length * m.hand_breadth
        ends += 2 * foot * m.foot_length * m.foot_breadth * float(self.leg_y[0])
        return float(1000 * (trunk + 2 * leg + 2 * arm + ends))
