"""Local variation that anatomy allows, by name: shape components between the measured and the smooth ones.

Each component is one place of the body that differs from person to person at equal girths: a belly, the
height of the breasts, the slope of the shoulders, the bend of the spine, the two sides' difference.
Displacements are smooth fields on the mean body, laid out by its joints, at one standard deviation; those are
assumptions of a few millimetres, such that fitted coefficients of people of another model have about unit
size.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fit.surface import vertex_normals

from .parts import REGIONS
from .ramp import smooth_step
from .skeleton import JOINT

Field = Float[np.ndarray, "v 3"]


@dataclass(frozen=True)
class Lay:
    """The body on which the components are laid out: vertices, unit normals, joints, share of each region in
    each vertex (from the skin weights), all in metres in the rest pose."""

    v: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    joints: Float[np.ndarray, "24 3"]
    weights: Float[np.ndarray, "v 24"]

    def joint(self, name: str) -> Float[np.ndarray, "3"]:
        return self.joints[JOINT[name]]

    def share(self, *names: str) -> Float[np.ndarray, "v"]:
        """How far each vertex belongs to these regions or joints, 0 to 1."""
        joints = [JOINT[j] for name in names for j in REGIONS.get(name, (name,))]
        return self.weights[:, joints].sum(1)

    def spot(
        self, centre: tuple[float, float], radius: tuple[float, float], facing: tuple[float, float, float]
    ) -> Float[np.ndarray, "v"]:
        """A round spot on the trunk's skin: (x, y) of its centre and its radii in metres, both sides alike;
        `facing`: where the skin must look (it fades out to the sides)."""
        side = np.abs(self.v[:, 0])
        far = ((side - centre[0]) / radius[0]) ** 2 + ((self.v[:, 1] - centre[1]) / radius[1]) ** 2
        outwards = self.normals[:, 0] * np.sign(self.v[:, 0])  # away from the midline
        looks = facing[0] * outwards + self.normals[:, 1:] @ np.array(facing[1:])
        return np.exp(-far) * smooth_step(0.0, 0.7, looks)

    def limb(
        self, upper: str, lower: str, station: float, width: float, facing: tuple[float, float, float] | None
    ) -> Float[np.ndarray, "v"]:
        """A belt round both limbs at this share of the way from the left joint `upper` to `lower`, as wide
        (in the same share); with `facing` on that side of the limb only."""
        mirrored = self.v * np.where(self.v[:, :1] < 0, [-1.0, 1.0, 1.0], 1.0)
        normals = self.normals * np.where(self.v[:, :1] < 0, [-1.0, 1.0, 1.0], 1.0)
        start, end = self.joint(upper), self.joint(lower)
        axis = end - start
        t = (mirrored - start) @ axis / (axis @ axis)
        belt = np.exp(-(((t - station) / width) ** 2))
        if facing is not None:
            belt = belt * smooth_step(-0.2, 0.9, normals @ np.array(facing))
        return belt


def _along_normal(lay: Lay, bump: Float[np.ndarray, "v"]) -> Field:
    return lay.normals * bump[:, None]


Maker = Callable[[Lay], Field]


def _trunk(
    sd_mm: float, x: float, y: float, radius: tuple[float, float], facing: tuple[float, float, float]
) -> Maker:
    """A spot on the trunk; x in hip half-breadths of the joints, y from pelvis (0) to neck joint (1)."""

    def make(lay: Lay) -> Field:
        low, high = lay.joint("pelvis")[1], lay.joint("neck")[1]
        centre = (x * lay.joint("left_hip")[0], low + y * (high - low))
        bump = lay.spot(centre, radius, facing) * lay.share("torso", "left_hip", "right_hip")
        return _along_normal(lay, 1e-3 * sd_mm * bump)

    return make


def _shifted(
    sd_mm: float, x: float, y: float, radius: tuple[float, float], facing: tuple[float, float, float]
) -> Maker:
    """The same spot moved up: fuller above, flatter below."""
    step = 0.5 * radius[1] / 0.50  # in shares of the trunk's height of about half a metre

    def make(lay: Lay) -> Field:
        upper = _trunk(sd_mm, x, y + step, radius, facing)(lay)
        return upper - _trunk(sd_mm, x, y - step, radius, facing)(lay)

    return make


def _limb(
    sd_mm: float, upper: str, lower: str, station: float, width: float,
    facing: tuple[float, float, float] | None = None, region: str = "leg",
) -> Maker:  # fmt: skip
    def make(lay: Lay) -> Field:
        bump = lay.limb(upper, lower, station, width, facing) * lay.share(region)
        return _along_normal(lay, 1e-3 * sd_mm * bump)

    return make


def _limb_shifted(
    sd_mm: float, upper: str, lower: str, station: float, width: float, facing: tuple[float, float, float]
) -> Maker:
    def make(lay: Lay) -> Field:
        up = _limb(sd_mm, upper, lower, station - 0.5 * width, width, facing)(lay)
        return up - _limb(sd_mm, upper, lower, station + 0.5 * width, width, facing)(lay)

    return make


def _spine(sd_mm: float, y: float, width: float) -> Maker:
    """The trunk pushed forward around one height (share of pelvis to neck), limbs and head carried along."""

    def make(lay: Lay) -> Field:
        low, high = lay.joint("pelvis")[1], lay.joint("neck")[1]
        t = (lay.v[:, 1] - low) / (high - low)
        out = np.zeros_like(lay.v)
        out[:, 2] = 1e-3 * sd_mm * np.exp(-(((t - y) / width) ** 2))
        arms = lay.share("arm", "hand")
        at_shoulder = (lay.joint("left_shoulder")[1] - low) / (high - low)
        carried = 1e-3 * sd_mm * np.exp(-(((at_shoulder - y) / width) ** 2))
        out[:, 2] += arms * (carried - out[:, 2])
        return out

    return make


def _shoulders(lay: Lay, up_m: float, sides: tuple[float, float]) -> Field:
    """Shoulders lifted by `up_m` with the arms, rising from the neck outwards; `sides`: factors left and
    right."""
    inner, outer = 0.35 * lay.joint("left_shoulder")[0], lay.joint("left_shoulder")[0]
    rise = smooth_step(inner, outer, np.abs(lay.v[:, 0]))
    low, high = lay.joint("spine3")[1], lay.joint("left_shoulder")[1] - 0.03
    upper = np.maximum(smooth_step(low, high, lay.v[:, 1]), lay.share("arm", "hand"))
    out = np.zeros_like(lay.v)
    out[:, 1] = up_m * rise * upper * np.where(lay.v[:, 0] > 0, *sides)
    return out


def _one_side(make: Maker, factor: float = 0.4) -> Maker:
    """More on the left, less on the right."""

    def made(lay: Lay) -> Field:
        return factor * make(lay) * np.clip(lay.v[:, :1] / 0.04, -1, 1)

    return made


FRONT, BACK, OUT = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)
COMPONENTS: dict[str, Maker] = {
    "belly": _trunk(10.0, 0.0, 0.28, (0.11, 0.10), FRONT),
    "belly height": _shifted(5.0, 0.0, 0.30, (0.11, 0.10), FRONT),
    "chest": _trunk(7.0, 1.0, 0.66, (0.085, 0.075), FRONT),
    "chest height": _shifted(5.0, 1.0, 0.66, (0.085, 0.07), FRONT),
    "ribs": _trunk(5.0, 1.1, 0.45, (0.10, 0.08), FRONT),
    "buttock": _trunk(7.0, 0.9, -0.10, (0.09, 0.09), BACK),
    "buttock height": _shifted(5.0, 0.9, -0.10, (0.09, 0.08), BACK),
    "hip side": _trunk(5.0, 1.8, -0.08, (0.08, 0.09), OUT),
    "flank": _trunk(6.0, 1.5, 0.22, (0.08, 0.08), OUT),
    "chest side": _trunk(5.0, 1.7, 0.62, (0.08, 0.09), OUT),
    "upper back": _trunk(6.0, 0.8, 0.78, (0.10, 0.10), BACK),
    "lower back": _trunk(4.0, 0.5, 0.25, (0.08, 0.09), BACK),
    "thigh inner": _limb(5.0, "left_hip", "left_knee", 0.30, 0.30, (-1.0, 0.0, 0.0)),
    "thigh outer": _limb(6.0, "left_hip", "left_knee", 0.30, 0.35, OUT),
    "thigh front": _limb(5.0, "left_hip", "left_knee", 0.45, 0.35, FRONT),
    "thigh back": _limb(8.0, "left_hip", "left_knee", 0.45, 0.35, BACK),
    "knee": _limb(3.0, "left_hip", "left_knee", 1.0, 0.18),
    "calf": _limb(4.0, "left_knee", "left_ankle", 0.30, 0.25, BACK),
    "calf height": _limb_shifted(3.0, "left_knee", "left_ankle", 0.35, 0.25, BACK),
    "shoulder muscle": _limb(4.0, "left_shoulder", "left_elbow", 0.10, 0.30, (0.2, 1.0, 0.0), "arm"),
    "upper arm": _limb(3.0, "left_shoulder", "left_elbow", 0.55, 0.35, None, "arm"),
    "forearm": _limb(4.0, "left_elbow", "left_wrist", 0.30, 0.35, None, "arm"),
    "shoulder slope": lambda lay: _shoulders(lay, 0.008, (1.0, 1.0)),
    "round back": _spine(-7.0, 0.75, 0.30),
    "hollow back": _spine(6.0, 0.22, 0.25),
    "shoulder left higher": lambda lay: _shoulders(lay, 0.004, (1.0, -1.0)),
    "leg left stronger": _one_side(_limb(4.0, "left_hip", "left_knee", 0.4, 0.5)),
    "arm left stronger": _one_side(_limb(3.0, "left_shoulder", "left_elbow", 0.5, 0.5, None, "arm")),
}
"""Name and field of every component, in the order of the file."""


def local_components(
    v: Float[np.ndarray, "v 3"],
    f: Int[np.ndarray, "f 3"],
    joints: Float[np.ndarray, "24 3"],
    weights: Float[np.ndarray, "v 24"],
) -> Float[np.ndarray, "v 3 b"]:
    """Displacements (m) of one standard deviation of each of COMPONENTS on this body in its rest pose."""
    lay = Lay(v, vertex_normals(v, f), joints, weights)
    return np.stack([make(lay) for make in COMPONENTS.values()], -1)
