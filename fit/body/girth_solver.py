"""What to model so that a tape reads what was asked: a fixed point per person.

Smooth unions and muscles add to every section by an amount that depends on the whole person. So the body is
modelled, measured with rays (`implicit_tape`) and modelled again with every girth, every depth and squareness
of the trunk and the fullness between the girths moved by what was missed. Two rounds after a start from the
average of the sex leave a few tenths of a per cent, as long as no knob comes to the end of its range; where
one does, girths and volume are kept and the trunk's breadths and depths give way.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float

from .anthropometry import GIRTHS, SQUARED_SECTIONS, TRUNK_SECTIONS, Measurements, survey_mean
from .density import volume_litres
from .implicit import ImplicitBody
from .implicit_tape import RayTape

N_ROUNDS = 2
N_ROUNDS_OF_THE_AVERAGE = 2
PROBE = 0.02  # of the finite differences
RIDGE = {"girth": 0.001, "depth": 0.004, "squareness": 0.001, "fullness": 0.002}
"""How much less a knob is turned that the tape hardly feels, against its squared response (about 1)."""
WEIGHT = {"girth": 1.0, "depth": 0.1, "squareness": 0.1, "fullness": 1.0}
"""Of what the tape misses, squared: breadths and depths give way where not all can be had."""
N_KNOBS_HELD = 6  # times that knobs at their ends are set aside
KNOBS_LIMIT = {"girth": 0.20, "depth": 0.16, "squareness": 0.35, "fullness": 0.17}
"""Either way: beyond it a body fits the tape and no longer looks like one."""

Model = Callable[[Measurements], tuple[ImplicitBody, Float[np.ndarray, "24 3"]]]
KNOBS = (
    *GIRTHS,
    *(f"{name} depth" for name in TRUNK_SECTIONS),
    *(f"{name} squareness" for name in SQUARED_SECTIONS),
    "fullness",
)


@dataclass(frozen=True)
class Knobs:
    """Logs of what is modelled over what is asked, in the order of KNOBS."""

    values: Float[np.ndarray, "k"]

    def applied(self, m: Measurements) -> Measurements:
        value = dict(zip(KNOBS, self.values.tolist(), strict=True))
        asked = asdict(m)
        changed = {name: asked[name] * np.exp(value[name]) for name in GIRTHS}
        for name in TRUNK_SECTIONS:
            changed[f"{name}_depth"] = asked[f"{name}_depth"] * np.exp(value[f"{name} depth"])
        for name in SQUARED_SECTIONS:
            changed[f"{name}_squareness"] = value[f"{name} squareness"]
        return replace(m, **{k: float(v) for k, v in changed.items()}, fullness=value["fullness"])


def missed(m: Measurements, tape: RayTape, body: ImplicitBody) -> Float[np.ndarray, "k"]:
    """Logs of asked over read, in the order of KNOBS."""
    reading, asked = tape.read(body), asdict(m)
    girths = [np.log(asked[name] / reading.girth[name]) for name in GIRTHS]
    depths = [
        np.log(asked[f"{name}_depth"] / asked[f"{name}_breadth"]) - reading.depth[name]
        for name in TRUNK_SECTIONS
    ]
    squareness = [
        np.log(asked[name] / (asked[f"{name}_breadth"] + asked[f"{name}_depth"])) - reading.squareness[name]
        for name in SQUARED_SECTIONS
    ]
    litres = volume_litres(m.weight, m.stature, m.sex)
    return np.array([*girths, *depths, *squareness, np.log(litres / reading.litres)])


def _by_knob(value: dict[str, float]) -> Float[np.ndarray, "k"]:
    return np.array([value["girth" if knob in GIRTHS else knob.split()[-1]] for knob in KNOBS])


def _turned(
    knobs: Float[np.ndarray, "k"], response: Float[np.ndarray, "k k"], wanted: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """The knobs, within their limits, whose change comes nearest to what is wanted.

    Weighted and damped least squares. A knob that would leave its range stays at its end, and the others are
    solved again without it: so they make up for it as far as they can.
    """
    most, pull, damping = _by_knob(KNOBS_LIMIT), _by_knob(WEIGHT), _by_knob(RIDGE)
    turned, free = knobs.copy(), np.ones(len(KNOBS), dtype=bool)
    for _ in range(N_KNOBS_HELD):
        rest = wanted - response[:, ~free] @ (turned - knobs)[~free]
        left = response[:, free].T * pull
        normal = left @ response[:, free] + np.diag(damping[free])
        turned[free] = knobs[free] + np.linalg.solve(normal, left @ rest)
        outside = free & (np.abs(turned) > most)
        turned = np.clip(turned, -most, most)
        if not outside.any():
            break
        free &= ~outside
    return turned


@dataclass(frozen=True)
class Start:
    """Where the rounds begin, from people who were solved before."""

    knobs: Float[np.ndarray, "k"]
    response: Float[np.ndarray, "k k"]
    """Of the tape (rows) to the knobs (columns), logs."""
    rays_m: Float[np.ndarray, "r"] | None


def solve(m: Measurements, model: Model, start: Start, n_rounds: int) -> Start:
    """The knobs that make the tape read `m` and the rays then, after so many rounds from `start`."""
    knobs, tape = start.knobs, None
    for _ in range(n_rounds):
        body, joints = model(Knobs(knobs).applied(m))
        tape = RayTape(m, joints, start.rays_m) if tape is None else tape
        knobs = _turned(knobs, start.response, missed(m, tape, body))
    assert tape is not None
    return Start(knobs, start.response, tape.length)


def response_of(m: Measurements, model: Model, knobs: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k k"]:
    """The tape's response (rows) to the knobs (columns) at this person, by finite differences."""
    body, joints = model(Knobs(knobs).applied(m))
    tape = RayTape(m, joints)
    for _ in range(2):  # rays settle
        here = missed(m, tape, body)
    response = np.empty((len(KNOBS), len(KNOBS)))
    for k in range(len(KNOBS)):
        there, _ = model(Knobs(knobs + PROBE * (np.arange(len(KNOBS)) == k)).applied(m))
        response[:, k] = (here - missed(m, tape, there)) / PROBE
    return response


def modelled_for(m: Measurements, model: Model) -> Measurements:
    """What `model` must be given so that a tape around the body reads `m`."""
    female, male = (average_start(sex, model) for sex in (0.0, 1.0))
    assert female.rays_m is not None
    assert male.rays_m is not None
    start = Start(
        mix_arrays(female.knobs, male.knobs, m.sex),
        mix_arrays(female.response, male.response, m.sex),
        mix_arrays(female.rays_m, male.rays_m, m.sex),
    )
    return Knobs(solve(m, model, start, N_ROUNDS).knobs).applied(m)


def mix_arrays(female: np.ndarray, male: np.ndarray, sex: float) -> np.ndarray:
    """Between the sexes."""
    return female + (male - female) * sex


@cache
def average_start(sex: float, model: Model) -> Start:
    """The survey's average person of this sex, solved from nothing."""
    average, start = survey_mean(sex), Start(np.zeros(len(KNOBS)), np.eye(len(KNOBS)), None)
    for _ in range(N_ROUNDS_OF_THE_AVERAGE):
        response = response_of(average, model, start.knobs)
        start = solve(average, model, replace(start, response=response), 2)
    return start
