"""The first part of the shape space: principal components of drawn people.

Area-weighted PCA (Loper et al., SMPL, section 3), scaled so that a coefficient of one is one standard
deviation; people's girths take part as further coordinates, since a wrist 6 % too thick is too small an error
in millimetres for components to be spent on it. `local_variation` and `smooth_variation` add what no tape has
measured.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from .anatomy import make_person
from .anthropometry import GIRTHS, draw_people, measure
from .correspondence import Carrier
from .sections import volume_m3
from .skeleton import JOINT

N_ANTHROPOMETRIC = 40
"""About as many as measures are drawn (37): fewer cannot tell a wrist from the rest of its arm."""
METRES_PER_LOG_GIRTH = 0.03
"""What a girth's error counts against the RMS error of the skin."""


@dataclass(frozen=True)
class People:
    """Drawn people on the half template, all shifted so that their surface centroids agree (metres)."""

    halves: Float[np.ndarray, "n h 3"]
    joints: Float[np.ndarray, "n 24 3"]
    stature: Float[np.ndarray, "n"]
    bmi: Float[np.ndarray, "n"]
    log_girths: Float[np.ndarray, "n g"]


def gather_people(
    carrier: Carrier,
    half_area: Float[np.ndarray, "h"],
    n: int,
    seed: int,
    sex: float | None,
    progress: Callable[[], object],
) -> People:
    """Build n drawn people. Aligned at the centroid of the skin: aligned at the pelvis, leg length would move
    every vertex and take a component for itself. The mean pelvis joint becomes the origin.
    """
    weight = half_area / half_area.sum()
    sexes, scores = draw_people(n, seed, sex)
    halves, joints = np.empty((n, carrier.n, 3)), np.empty((n, 24, 3))
    stature, bmi, log_girths = np.empty(n), np.empty(n), np.empty((n, len(GIRTHS)))
    for i in range(n):
        person = measure(float(sexes[i]), scores[i])
        body, joints[i] = make_person(person)
        halves[i] = carrier(body)
        centroid = np.array([0, weight @ halves[i, :, 1], weight @ halves[i, :, 2]])  # x = 0 after mirroring
        halves[i] -= centroid
        joints[i] -= centroid
        stature[i], bmi[i] = person.stature, person.bmi
        log_girths[i] = np.log([getattr(person, name) for name in GIRTHS])
        progress()
    origin = joints[:, JOINT["pelvis"]].mean(0)
    return People(halves - origin, joints - origin, stature, bmi, log_girths)


def principal_components(
    people: People, half_area: Float[np.ndarray, "h"], n_components: int
) -> tuple[Float[np.ndarray, "h 3"], Float[np.ndarray, "h 3 b"], Float[np.ndarray, "b"]]:
    """Mean, components at one standard deviation, and the share of variance of each.

    Area-weighted, or the fine hands would rule. Shares are of skin and girths together. The sign of a
    component is that of taller, else of heavier.
    """
    n = len(people.halves)
    mean = people.halves.mean(0)
    centred = people.halves - mean
    weighted = (centred * np.sqrt(half_area / half_area.sum())[None, :, None]).reshape(n, -1)
    girths = METRES_PER_LOG_GIRTH * (people.log_girths - people.log_girths.mean(0))
    variance, vectors = np.linalg.eigh(weighted @ weighted.T + girths @ girths.T)
    variance, vectors = variance[::-1], vectors[:, ::-1][:, :n_components]
    for b in range(n_components):
        by_stature = np.corrcoef(vectors[:, b], people.stature)[0, 1]
        by_bmi = np.corrcoef(vectors[:, b], people.bmi)[0, 1]
        if (by_stature if abs(by_stature) > 0.5 else by_bmi) < 0:
            vectors[:, b] *= -1
    components = np.einsum("nb,nvc->vcb", vectors, centred) / np.sqrt(n - 1)
    return mean, components, variance[:n_components] / variance.sum()


def weight_component(
    template: Float[np.ndarray, "v 3"],
    shape_directions: Float[np.ndarray, "v 3 b"],
    faces: Int[np.ndarray, "f 3"],
) -> int:
    """The component, among the first ten, that changes volume most at a given stature: what a person would
    call weight.
    """
    change = []
    for k in range(min(shape_directions.shape[2], 10)):
        ratio = []
        for step in (-2, 2):
            v = template + step * shape_directions[:, :, k]
            ratio.append(volume_m3(v, faces) / np.ptp(v[:, 1]) ** 3)
        change.append(abs(np.log(ratio[1] / ratio[0])))
    return int(np.argmax(change))
