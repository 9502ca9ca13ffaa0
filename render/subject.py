"""A clothed synthetic person whose naked body is known: a body drawn from the model's spread, personal detail
that the model cannot say, hair, shoes and an outfit by name.

The detail matters: a subject made by the body model alone would let a method that trusts the model win too
easily.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from fit.body import BodyModel
from fit.body.parts import REGIONS, region_mask, region_of_vertices
from fit.body.skeleton import JOINT, axis_angle_to_matrix, blend_linearly, world_from_rest
from fit.surface import vertex_normals

from .garments import Garment, Landmarks, cut_out, drape
from .scene import Surface
from .wardrobe import OUTFITS, hair, shoes

DETAIL_MEAN_M = 0.0025
"""Mean size of the personal detail over the body (m)."""
SKIN_TONES = ((236, 200, 176), (214, 170, 140), (176, 128, 98), (118, 80, 60), (244, 212, 190))
BARE, CLOTH, SHOE, HAIR = 0, 1, 2, 3
"""Values of `Subject.covered`."""


class SubjectError(ValueError):
    """A subject that cannot be made: what was asked for and what there is."""


@dataclass(frozen=True)
class Subject:
    """One person. Body frame: y up, z front, x the body's left; m. Everything a film and its truth need.

    template: the naked body in the zero pose, detail included. garments: from the skin outwards.
    covered: a vertex is BARE, or under CLOTH, SHOE or HAIR.
    """

    body: BodyModel
    betas: Float[np.ndarray, " b"]
    template: Float[np.ndarray, "v 3"]
    joints: Float[np.ndarray, "j 3"]
    garments: tuple[Garment, ...]
    covered: Int[np.ndarray, " v"]
    skin_colours: UInt8[np.ndarray, "v 3"]

    @property
    def region(self) -> np.ndarray:
        """The region's name at each vertex: torso, arm, leg, neck, hand, foot, head."""
        return region_of_vertices(self.body)

    def posed(
        self, pose: Float[np.ndarray, "j 3"], translation: Float[np.ndarray, " 3"]
    ) -> Float[np.ndarray, "v 3"]:
        """The naked body's vertices in a pose (rad), moved by a translation (m): linear blend skinning."""
        turns = axis_angle_to_matrix(pose)
        offsets = self.body.pose_directions @ (turns[1:] - np.eye(3)).ravel()
        bones = world_from_rest(turns, self.joints, tuple(self.body.parents.tolist()))
        return blend_linearly(self.template + offsets, self.body.weights, bones)[0] + translation

    def dressed(
        self,
        posed: Float[np.ndarray, "v 3"],
        velocity: Float[np.ndarray, "v 3"],
        up: Float[np.ndarray, " 3"],
        moment: float,
    ) -> list[Surface]:
        """The posed body and what it wears, ready to be drawn. Arguments as `garments.drape`; any upright
        frame.
        """
        surfaces = [Surface(posed, self.body.faces, self.skin_colours, two_sided=False)]
        covered = np.zeros(len(posed))
        for garment in self.garments:
            vertices, covered = drape(garment, posed, self.body.faces, velocity, up, moment, covered)
            colours = np.concatenate([garment.colours, garment.colours[garment.rim]])
            surfaces.append(Surface(vertices, garment.faces, colours, two_sided=False))
        return surfaces


def make_subject(
    body: BodyModel,
    seed: int,
    garment: str = "tshirt-trousers",
    *,
    betas: Float[np.ndarray, " b"] | None = None,
    detail_m: float = DETAIL_MEAN_M,
    with_hair: bool = True,
) -> Subject:
    """A person drawn from `seed`.

    garment: a name of `wardrobe.OUTFITS`; "none" goes barefoot and bald-headed too, so that the silhouette is
    the body. betas: shape coefficients (standard deviations); where None they are drawn, held to 2. detail_m:
    mean size of the displacements outside the model's shape space. SubjectError for an outfit that is not
    there.
    """
    if garment not in OUTFITS:
        raise SubjectError(f"no outfit is called {garment!r}; there are: {', '.join(OUTFITS)}")
    rng = np.random.default_rng([seed, 3])
    drawn = np.zeros(body.n_betas)
    n_measured = body.n_anthropometric
    drawn[:n_measured] = np.clip(rng.standard_normal(n_measured), -2.0, 2.0)
    if betas is not None:
        drawn = np.zeros(body.n_betas)
        drawn[: len(betas)] = betas
    shaped = body.shaped(drawn)
    template = shaped + _detail(body, shaped, detail_m, rng)
    landmarks = Landmarks(body.joint_regressor @ template)

    worn, labels = [], []
    dressed_rng = np.random.default_rng([seed, 5])
    if garment != "none":
        barefoot = garment == "tight" and dressed_rng.uniform() < 0.5
        if not barefoot:
            worn.append(shoes(dressed_rng))
            labels.append(SHOE)
        if with_hair:
            worn.append(hair(dressed_rng))
            labels.append(HAIR)
    outfit = OUTFITS[garment](dressed_rng)
    worn += outfit
    labels += [CLOTH] * len(outfit)
    covered = np.full(body.n_vertices, BARE)
    garments = []
    parts = _eligible_parts(body)
    for cut, label in zip(worn, labels, strict=True):
        faces = body.faces[parts[label][body.faces].all(1)]
        garments.append(cut_out(cut, template, faces, landmarks, dressed_rng))
        covered[(cut.inside(template, landmarks) > 0) & parts[label] & (covered == BARE)] = label
    return Subject(
        body,
        drawn,
        template,
        landmarks.joints,
        tuple(garments),
        covered,
        _skin_colours(body, template, landmarks, rng),
    )


def _eligible_parts(body: BodyModel) -> dict[int, np.ndarray]:
    """Which vertices each kind of covering may lie on: a heavy arm hanging low is no leg, a chin no scalp."""
    return {
        CLOTH: region_mask(body.parts, "torso", "arm", "leg", "neck", "foot", "hand"),
        SHOE: region_mask(body.parts, "foot", "leg"),
        HAIR: region_mask(body.parts, "head", "neck"),
    }


def _detail(
    body: BodyModel, shaped: Float[np.ndarray, "v 3"], mean_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "v 3"]:
    """Smooth displacements along the normal, wavelengths of 12 to 40 cm, freed of what the shape space could
    say.

    Weaker on face, hands and feet, where a few millimetres are a deformity. Zero where mean_m is 0.
    """
    waves = rng.standard_normal((40, 3))
    waves /= np.linalg.norm(waves, axis=1, keepdims=True) * rng.uniform(0.12, 0.40, (40, 1))
    phase, size = rng.uniform(0, 2 * np.pi, 40), rng.standard_normal(40)
    height = np.sin(2 * np.pi * (shaped @ waves.T) + phase) @ size
    extremities = [JOINT[name] for region in ("hand", "foot", "head") for name in REGIONS[region]]
    height *= 1.0 - 0.75 * body.weights[:, extremities].sum(1)
    detail = height[:, None] * vertex_normals(shaped, body.faces)
    space = body.shape_directions.reshape(-1, body.n_betas)
    # normal equations: the components are independent, and a least-squares routine takes ten times as long
    said = np.linalg.solve(space.T @ space, space.T @ detail.ravel())
    detail -= (space @ said).reshape(-1, 3)
    trunk = region_mask(body.parts, "torso", "arm", "leg", "neck")
    return detail * (mean_m / np.linalg.norm(detail[trunk], axis=1).mean())


def _skin_colours(
    body: BodyModel, template: np.ndarray, landmarks: Landmarks, rng: np.random.Generator
) -> UInt8[np.ndarray, "v 3"]:
    """One tone, a little redder at hands, knees and cheeks, with a slow mottling; lips and eyes hinted."""
    tone = np.array(SKIN_TONES[int(rng.integers(len(SKIN_TONES)))], float)
    mottle = np.sin(template @ rng.normal(0, 25.0, (3, 6)) + rng.uniform(0, 6, 6)).mean(1)
    colours = tone * (1.0 + 0.03 * mottle[:, None])
    red = region_mask(body.parts, "hand", "foot").astype(float)
    for name in ("left_knee", "right_knee", "left_elbow", "right_elbow"):
        red += np.exp(-((np.linalg.norm(template - landmarks[name], axis=1) / 0.09) ** 2))
    colours *= 1.0 - np.clip(red, 0, 1)[:, None] * np.array([0.02, 0.09, 0.10])
    head = np.flatnonzero(body.parts == JOINT["head"])
    face = template[head] - landmarks["head"]
    crown = face[:, 1].max()
    in_front = face[:, 2] > 0.6 * face[:, 2].max()
    eyes = (
        in_front & (np.abs(face[:, 1] / crown - 0.42) < 0.035) & (np.abs(np.abs(face[:, 0]) - 0.032) < 0.014)
    )
    colours[head[eyes]] *= 0.45
    return np.clip(colours, 0, 255).astype(np.uint8)
