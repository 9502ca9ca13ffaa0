"""Whether the free body has the measures that were asked for: random people, built, and measured with a tape.

    python -m benchmarks.body_tape                   # 200 women and 200 men
    python -m benchmarks.body_tape --people 40

People are drawn as the generator draws them (`fit.body.anthropometry`), with a seed of this benchmark's
own, so that none of them took part in the shape space. Each is measured twice: on the mesh built for that
person, and on the linear model that users load, with the anthropometric components that come nearest to
that mesh. Prints Markdown tables of errors in per cent: mean, RMS, the 1st and the 99th percentile, the
worst.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from jaxtyping import Float

from benchmarks.hull import machine
from fit.body.anatomy import make_person
from fit.body.anthropometry import GIRTHS, Measurements, draw_people, measure
from fit.body.build import load_or_build
from fit.body.correspondence import Carrier
from fit.body.density import weight_kg
from fit.body.half_mesh import load_half_mesh, mirror
from fit.body.model import BodyModel
from fit.body.sections import volume_m3
from fit.body.tape import Levels, Subject
from fit.surface import vertex_areas

SEED = 20_12
SEXES = {"female": 0.0, "male": 1.0}
EXTENTS = (
    "chest_breadth", "chest_depth", "waist_breadth", "waist_depth", "hip_breadth", "hip_depth", "biacromial",
    "crotch_height", "knee_height", "upper_arm", "lower_arm", "hand_length", "foot_length", "foot_breadth",
    "head_breadth", "head_length",
)  # fmt: skip
MEASURES = (*GIRTHS, "stature", "weight", *EXTENTS)


def errors_percent(
    person: Measurements,
    vertices: Float[np.ndarray, "v 3"],
    joints: Float[np.ndarray, "24 3"],
    model: BodyModel,
) -> list[float]:
    """Read over asked, in the order of MEASURES; the floor is y = 0."""
    subject = Subject(vertices, model.faces, joints, model.parts, Levels.of_person(person))
    lines = subject.girth_lines()
    read = {name: line.length_m(vertices) for name, line in lines.items()} | subject.extents(lines)
    own = Subject(vertices, model.faces, joints, model.parts, sex=person.sex)  # its crotch is the skin's
    read["crotch_height"] = own.levels.crotch - own.floor
    read["stature"] = subject.stature
    read["weight"] = weight_kg(1000 * volume_m3(vertices, model.faces), subject.stature, person.sex)
    return [100 * (read[name] / getattr(person, name) - 1) for name in MEASURES]


def nearest_of_model(
    model: BodyModel, vertices: Float[np.ndarray, "v 3"], area: Float[np.ndarray, "v"]
) -> Float[np.ndarray, "v 3"]:
    """The model's shape, of anthropometric components only, nearest to these vertices; at their place."""
    directions = model.shape_directions[:, :, : model.n_anthropometric]
    root = np.sqrt(area / area.sum())[:, None]

    def centred(x: np.ndarray) -> np.ndarray:
        return x - np.tensordot(area / area.sum(), x, 1)

    target = centred(vertices) - centred(model.template)
    columns = (root[:, :, None] * centred(directions)).reshape(-1, directions.shape[2])
    betas = np.linalg.lstsq(columns, (root * target).ravel(), rcond=None)[0]
    shaped = model.shaped(betas)
    return shaped - [0, shaped[:, 1].min(), 0]


def table(title: str, errors: Float[np.ndarray, "n m"]) -> None:
    print(f"\n{title}\n\n| measure | mean % | RMS % | 1st % | 99th % | worst % |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, e in zip(MEASURES, errors.T, strict=True):
        low, high = np.percentile(e, (1, 99))
        rms = np.sqrt((e**2).mean())
        print(f"| {name} | {e.mean():.1f} | {rms:.1f} | {low:.1f} | {high:.1f} | {np.abs(e).max():.1f} |")


def print_measures(n: int) -> None:
    """The tables for n people of each sex."""
    print(f"{n} people of each sex")
    for sex_name, sex in SEXES.items():
        model = load_or_build(sex_name, show_progress=False)
        half, half_faces = load_half_mesh()
        carrier = Carrier(half, half_faces, make_person(measure(0.5))[0])
        area = vertex_areas(model.template, model.faces)
        built, linear, seconds = [], [], 0.0
        sexes, scores = draw_people(n, SEED, sex)
        for coordinate, z in zip(sexes.tolist(), scores, strict=True):
            person = measure(coordinate, z)
            start = time.process_time()
            body, joints = make_person(person)
            vertices = mirror(carrier(body), half_faces)[0]
            seconds += time.process_time() - start
            built.append(errors_percent(person, vertices, joints, model))
            near = nearest_of_model(model, vertices, area)
            linear.append(errors_percent(person, near, model.joint_regressor @ near, model))
        table(f"{sex_name}, built ({1000 * seconds / n:.0f} ms of processor time a person)", np.array(built))
        table(f"{sex_name}, linear model with {model.n_anthropometric} components", np.array(linear))


def main() -> None:
    parser = argparse.ArgumentParser(description="Measures of the free body, asked and read.")
    parser.add_argument("--people", type=int, default=200, help="of each sex")
    n = parser.parse_args().people
    print(machine())
    print_measures(n)


if __name__ == "__main__":
    main()
