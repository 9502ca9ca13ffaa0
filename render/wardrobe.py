"""What a synthetic person can wear, by name: each garment's edges, room and colours in terms of the body's
joints.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from .garments import Cut, Landmarks

Points = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, " n"]
Field = Callable[[Points, Landmarks], Values]

Tones = tuple[tuple[int, int, int], tuple[int, int, int]]
CLOTH_TONES: tuple[Tones, ...] = (
    ((58, 84, 140), (74, 104, 164)),
    ((146, 44, 48), (170, 62, 60)),
    ((220, 214, 200), (238, 234, 224)),
    ((54, 110, 84), (72, 132, 100)),
    ((206, 152, 58), (222, 174, 86)),
    ((92, 80, 110), (112, 98, 132)),
)
DARK_TONES: tuple[Tones, ...] = (
    ((38, 44, 62), (52, 58, 80)),
    ((62, 56, 50), (80, 72, 62)),
    ((34, 34, 38), (48, 48, 54)),
    ((84, 88, 72), (102, 106, 88)),
)
HAIR_TONES: tuple[Tones, ...] = (
    ((44, 30, 22), (66, 46, 34)),
    ((120, 84, 48), (150, 110, 66)),
    ((24, 20, 20), (40, 34, 32)),
    ((96, 44, 26), (120, 62, 40)),
)
SHOE_TONES: tuple[Tones, ...] = (((32, 32, 34), (46, 46, 50)), ((214, 212, 206), (196, 194, 190)))


NECK_HALF_WIDTH_M = 0.085
"""Beyond this from the midline a collar's plane would cut into the shoulders."""


def _smallest(*fields: Values) -> Values:
    return np.minimum.reduce(fields)


def _step(values: Values, low: float, high: float) -> Values:
    x = np.clip((values - low) / (high - low), 0.0, 1.0)
    return x * x * (3 - 2 * x)


def shirt(sleeve: float, hem: float, collar_m: float = 0.02) -> Field:
    """Torso and arms. sleeve: where it ends along the arm (1: the wrist); hem: along the leg (0: hip joints,
    negative above); collar_m: metres above the neck joint.
    """

    def inside(points: Points, body: Landmarks) -> Values:
        leg_m = body["left_hip"][1] - body["left_knee"][1]
        return _smallest(
            (sleeve - body.along_arm(points)) * body.arm_m,
            (hem - body.along_leg(points)) * leg_m,
            np.maximum(
                collar_m - (points - body["neck"]) @ np.array([0.0, 0.85, 0.53]),
                np.abs(points[:, 0]) - NECK_HALF_WIDTH_M,
            ),
        )

    return inside


def sports_top() -> Field:
    """A sleeveless top from the lower ribs up, with straps over the shoulders."""

    def inside(points: Points, body: Landmarks) -> Values:
        return _smallest(
            (0.02 - body.along_arm(points)) * body.arm_m,
            points[:, 1] - (0.6 * body["spine1"][1] + 0.4 * body["spine2"][1]),
            np.maximum(
                -0.055 - (points - body["neck"]) @ np.array([0.0, 0.75, 0.66]),
                np.abs(points[:, 0]) - NECK_HALF_WIDTH_M - 0.02,
            ),
        )

    return inside


def trousers(leg: float, waist: float = 0.35) -> Field:
    """Legs and seat. leg: where they end (1: the knee, 2: the ankle); waist: 0 at the pelvis joint, 1 at
    spine1.
    """

    def inside(points: Points, body: Landmarks) -> Values:
        top = (1 - waist) * body["pelvis"][1] + waist * body["spine1"][1]
        leg_m = 0.5 * (body["left_hip"][1] - body["left_ankle"][1])
        return _smallest((leg - body.along_leg(points)) * leg_m, top - points[:, 1])

    return inside


def shoe() -> Field:
    """Foot and ankle up to a little above the ankle joint."""

    def inside(points: Points, body: Landmarks) -> Values:
        return 0.5 * (body["left_ankle"][1] + body["right_ankle"][1]) + 0.025 - points[:, 1]

    return inside


def hair_line(crown_from: float = 0.55) -> Field:
    """The top and back of the head: above the forehead, behind the ears, down to the nape."""

    def inside(points: Points, body: Landmarks) -> Values:
        head = body["head"]
        top = points[:, 1].max()
        height = (points[:, 1] - head[1]) / (top - head[1])
        size = top - head[1]
        behind = head[2] + 0.015 - points[:, 2]
        above = (height - crown_from) * size
        # the hair line: over the forehead at crown_from, falling to the nape behind the ears
        return _smallest(
            np.maximum(above, np.minimum(behind, (height - 0.02) * size)),
            size * 0.9 - np.abs(points[:, 0]) * 0.5,
            (height + 0.1) * size,
        )

    return inside


def evenly(points: Points, body: Landmarks) -> Values:
    """The same room everywhere."""
    return np.ones(len(points))


def shirt_room(points: Points, body: Landmarks) -> Values:
    """Close at the shoulders and the collar, roomy at the belly and the sleeves' ends."""
    along = body.along_arm(points)
    height = (points[:, 1] - body["pelvis"][1]) / (body["neck"][1] - body["pelvis"][1])
    return np.clip(0.12 + 0.88 * np.maximum(_step(0.95 - height, 0.0, 0.6), _step(along, 0.0, 0.3)), 0.0, 1.0)


def trouser_room(flare: float) -> Field:
    """Held at the waist, close over the seat, looser down the leg; flare: room at the ankle as a share."""

    def room(points: Points, body: Landmarks) -> Values:
        along = body.along_leg(points)
        return np.interp(
            along, [-0.45, -0.2, 0.1, 0.6, 1.0, 1.5, 2.0], [0.03, 0.22, 0.5, 0.65, 0.7, 0.95, flare]
        )

    return room


def shoe_room(points: Points, body: Landmarks) -> Values:
    """A sole: thicker where the foot is low."""
    low = points[:, 1].min()
    return 0.25 + 0.75 * _step(low + 0.035 - points[:, 1], 0.0, 0.03)


def hair_room(points: Points, body: Landmarks) -> Values:
    """Full on top and behind, thin at the hair line in front."""
    return np.clip(0.35 + 8.0 * (body["head"][2] + 0.06 - points[:, 2]), 0.15, 1.0)


def _tones(rng: np.random.Generator, among: tuple[Tones, ...]) -> Tones:
    return among[int(rng.integers(len(among)))]


def _no_garment(rng: np.random.Generator) -> tuple[Cut, ...]:
    return ()


def _tight(rng: np.random.Generator) -> tuple[Cut, ...]:
    return (
        Cut("leggings", trousers(1.9), 0.0015, 0.0025, evenly, 2, 0.0005, _tones(rng, DARK_TONES)),
        Cut("sports top", sports_top(), 0.0015, 0.003, evenly, 4, 0.0005, _tones(rng, CLOTH_TONES)),
    )


def _tshirt(rng: np.random.Generator) -> Cut:
    stripes = 0.07 if rng.uniform() < 0.3 else 0.0
    return Cut(
        "t-shirt", shirt(0.42, 0.1), 0.004, 0.022, shirt_room, 24, 0.006, _tones(rng, CLOTH_TONES), stripes
    )


def _tshirt_shorts(rng: np.random.Generator) -> tuple[Cut, ...]:
    legs = Cut("shorts", trousers(0.72), 0.002, 0.022, trouser_room(1.0), 16, 0.005, _tones(rng, DARK_TONES))
    return (legs, _tshirt(rng))


def _tshirt_trousers(rng: np.random.Generator) -> tuple[Cut, ...]:
    legs = Cut(
        "trousers", trousers(1.93), 0.002, 0.022, trouser_room(1.2), 16, 0.005, _tones(rng, DARK_TONES)
    )
    return (legs, _tshirt(rng))


def _loose(rng: np.random.Generator) -> tuple[Cut, ...]:
    return (
        Cut(
            "baggy trousers",
            trousers(1.96),
            0.002,
            0.038,
            trouser_room(1.3),
            40,
            0.009,
            _tones(rng, DARK_TONES),
        ),
        Cut("baggy shirt", shirt(0.9, 0.3), 0.004, 0.034, shirt_room, 45, 0.009, _tones(rng, CLOTH_TONES)),
    )


def _jacket(rng: np.random.Generator) -> tuple[Cut, ...]:
    legs = Cut(
        "trousers", trousers(1.93), 0.002, 0.018, trouser_room(1.1), 16, 0.005, _tones(rng, DARK_TONES)
    )
    coat = Cut(
        "jacket", shirt(0.95, 0.15, 0.035), 0.009, 0.028, shirt_room, 60, 0.005, _tones(rng, CLOTH_TONES)
    )
    return (legs, coat)


OUTFITS: dict[str, Callable[[np.random.Generator], tuple[Cut, ...]]] = {
    "none": _no_garment,
    "tight": _tight,
    "tshirt-shorts": _tshirt_shorts,
    "tshirt-trousers": _tshirt_trousers,
    "loose": _loose,
    "jacket": _jacket,
}
"""Every outfit by its name on the command line; what is worn over something else comes later."""


def shoes(rng: np.random.Generator) -> Cut:
    """Low shoes with a sole."""
    return Cut("shoes", shoe(), 0.003, 0.013, shoe_room, 6, 0.0, _tones(rng, SHOE_TONES), lively=0.0)


def hair(rng: np.random.Generator) -> Cut:
    """Short to medium hair."""
    room = float(rng.uniform(0.006, 0.02))
    return Cut("hair", hair_line(), 0.003, room, hair_room, 4, 0.003, _tones(rng, HAIR_TONES), lively=0.15)
