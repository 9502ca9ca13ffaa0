"""What to model so that a tape reads what was asked: a fixed point per person.

Smooth unions and muscles add to every section by an amount that depends on the whole person. So the body is
modelled, measured with rays (`implicit_tape`) and modelled again with every girth, every depth of the trunk
and the fullness between the girths moved by what was missed. Two rounds after a start from the average of the
sex leave a few tenths of a per cent.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float

from .anthropometry import GIRTHS, TRUNK_SECTIONS, Measurements, survey_mean
from .density import volume_litres
from .implicit import ImplicitBody
from .implicit_tape import RayTape

N_ROUNDS = 2
N_ROUNDS_OF_THE_AVERAGE = 2
PROBE = 0.02  # of the finite differences
RIDGE = {"girth": 0.002, "depth": 0.04, "fullness": 0.01}
"""How much less a knob is turned that the tape hardly feels, against its squared response (about 1)."""
KNOBS_LIMIT = {"girth": 0.20, "depth": 0.12, "fullness": 0.14}
"""Either way: beyond it a body fits the tape and no longer looks like one."""

Model = Callable[[Measurements], tuple[ImplicitBody, Float[np.ndarray, "24 3"]]]
KNOBS = (*GIRTHS, *(f"{name} depth" for name in TRUNK_SECTIONS), "fullness")


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
        return replace(m, **{k: float(v) for k, v in changed.items()}, fullness=value["fullness"])


def missed(m: Measurements, tape: RayTape, body: ImplicitBody) -> Float[np.ndarray, "k"]:
    """Logs of asked over read, in the order of KNOBS."""
    reading, asked = tape.read(body), asdict(m)
    girths = [np.log(asked[name] / reading.girth[name]) for name in GIRTHS]
    depths = [
        np.log(asked[f"{name}_depth"] / asked[f"{name}_breadth"]) - reading.depth[name]
        for name in TRUNK_SECTIONS
    ]
    litres = volume_litres(m.weight, m.stature, m.sex)
    return np.array([*girths, *depths, np.log(litres / reading.litres)])


def _by_knob(value: dict[str, float]) -> Float[np.ndarray, "k"]:
    kinds = ["girth"] * len(GIRTHS) + ["depth"] * len(TRUNK_SECTIONS) + ["fullness"]
    return np.array([value[kind] for kind in kinds])


def _turned(knobs: Float[np.ndarray, "k"], change: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    most = _by_knob(KNOBS_LIMIT)
    return np.clip(knobs + change, -most, most)


@dataclass(frozen=True)
class Start:
    """Where the rounds begin, from people who were solved before."""

    knobs: Float[np.ndarray, "k"]
    gain: Float[np.ndarray, "k k"]
    """Inverse of the tape's response: times what was missed, the change of the knobs."""
    rays_m: Float[np.ndarray, "r"] | None


def solve(m: Measurements, model: Model, start: Start, n_rounds: int) -> Start:
    """The knobs that make the tape read `m` and the rays then, after so many rounds from `start`."""
    knobs, tape = start.knobs, None
    for _ in range(n_rounds):
        body, joints = model(Knobs(knobs).applied(m))
        tape = RayTape(m, joints, start.rays_m) if tape is None else tape
        knobs = _turned(knobs, start.gain @ missed(m, tape, body))
    assert tape is not None
    return Start(knobs, start.gain, tape.length)


def response_gain(m: Measurements, model: Model, knobs: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k k"]:
    """Inverse of the tape's response to the knobs at this person, by finite differences.

    Damped (ridge), so that a knob that the tape hardly feels is not thrown about.
    """
    body, joints = model(Knobs(knobs).applied(m))
    tape = RayTape(m, joints)
    for _ in range(2):  # rays settle
        here = missed(m, tape, body)
    response = np.empty((len(KNOBS), len(KNOBS)))
    for k in range(len(KNOBS)):
        there, _ = model(Knobs(knobs + PROBE * (np.arange(len(KNOBS)) == k)).applied(m))
        response[:, k] = (here - missed(m, tape, there)) / PROBE
    normal = response.T @ response + np.diag(_by_knob(RIDGE))
    return np.linalg.solve(normal, response.T)


def modelled_for(m: Measurements, model: Model) -> Measurements:
    """What `model` must be given so that a tape around the body reads `m`."""
    female, male = (average_start(sex, model) for sex in (0.0, 1.0))
    assert female.rays_m is not None
    assert male.rays_m is not None
    start = Start(
        mix_arrays(female.knobs, male.knobs, m.sex),
        mix_arrays(female.gain, male.gain, m.sex),
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
        gain = response_gain(average, model, start.knobs)
        start = solve(average, model, replace(start, gain=gain), 2)
    return start
