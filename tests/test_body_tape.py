"""The tape reads closed forms exactly, follows a body's scale, and lies on the mesh in every shape."""

import numpy as np
import pytest

from fit.body.anthropometry import GIRTHS
from fit.body.build import load_or_build
from fit.body.density import fat_share, volume_litres, weight_kg
from fit.body.girth_lines import girth_lines, measure_body
from fit.body.sections import Cutter, unique_edges, volume_m3
from fit.body.skeleton import JOINT
from fit.body.tape import measures_of

UP = np.array([0.0, 1.0, 0.0])
NOT_METRES = ("litres", "kilograms", "bmi")


def everything(edges: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.ones(len(points), dtype=bool)


def cylinder(radius: float) -> tuple[np.ndarray, np.ndarray]:
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = radius * np.stack([np.cos(turns), np.zeros(400), np.sin(turns)], 1)
    i = np.arange(400)
    j = (i + 1) % 400
    faces = np.concatenate([np.stack([i, i + 400, j], 1), np.stack([j, i + 400, j + 400], 1)])
    return np.concatenate([ring - UP, ring + UP]), faces


def test_the_girth_of_a_cylinder_is_its_circumference() -> None:
    vertices, faces = cylinder(0.1)
    line = Cutter(vertices, unique_edges(faces)).girth_line(np.array([0, 0.3, 0]), UP, everything)
    assert line.length_m(vertices) == pytest.approx(2 * np.pi * 0.1, rel=1e-4)
    np.testing.assert_allclose(line.points(vertices)[:, 1], 0.3, atol=1e-12)
    # The line rides on the mesh: a wider cylinder has a longer one.
    assert line.length_m(vertices * [1.5, 1, 1.5]) == pytest.approx(1.5 * 2 * np.pi * 0.1, rel=1e-4)


def test_a_tape_bridges_hollows() -> None:
    vertices, faces = cylinder(0.1)
    dented = vertices.copy()
    dented[np.abs(dented[:, 0]) < 0.03, 2] *= 0.6
    there = np.zeros(3)
    full = Cutter(vertices, unique_edges(faces)).girth(there, UP, everything)
    assert Cutter(dented, unique_edges(faces)).girth(there, UP, everything) > 0.98 * full


def test_a_girth_that_misses_the_body_says_so() -> None:
    vertices, faces = cylinder(0.1)
    with pytest.raises(ValueError, match="the plane does not cut the part of the body"):
        Cutter(vertices, unique_edges(faces)).girth(np.array([0, 5.0, 0]), UP, everything)


def test_volume_of_a_tetrahedron() -> None:
    corner = np.array([[0, 0, 0], [2.0, 0, 0], [0, 3.0, 0], [0, 0, 1.0]])
    assert volume_m3(corner, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])) == pytest.approx(1.0)


@pytest.mark.parametrize("sex", [0.0, 1.0])
@pytest.mark.parametrize("bmi", [17.0, 24.0, 42.0])
def test_litres_and_kilograms_are_inverse_and_people_weigh_about_a_kilogram_a_litre(
    sex: float, bmi: float
) -> None:
    weight = bmi * 1.7**2
    litres = volume_litres(weight, 1.7, sex)
    assert weight_kg(litres, 1.7, sex) == pytest.approx(weight, rel=1e-9)
    assert 0.95 < weight / litres < 1.05
    assert fat_share(bmi, 0.0) > fat_share(bmi, 1.0)


def test_all_measures_follow_the_scale_of_a_body_and_not_its_place() -> None:
    model = load_or_build("neutral", show_progress=False)
    joints = model.joint_regressor @ model.template
    read = measures_of(model.template, model.faces, joints, model.parts)
    offset = np.array([0.4, -2.0, 1.0])
    for factor in (1.0, 1.2):
        other = measures_of(
            factor * model.template + offset, model.faces, factor * joints + offset, model.parts
        )
        for name, value in read.items():
            if name not in NOT_METRES and name != "thigh":
                assert other[name] == pytest.approx(factor * value, rel=2e-3), name
        assert other["litres"] == pytest.approx(factor**3 * read["litres"], rel=1e-9)
    assert tuple(read)[: len(GIRTHS)] == GIRTHS
    assert read["waist"] < read["hip"]
    assert read["ankle"] < read["calf"] < read["thigh"]


def test_girth_lines_ride_along_with_the_shape() -> None:
    model = load_or_build("neutral", show_progress=False)
    lines = girth_lines(model)
    betas = np.zeros(4)
    betas[:2] = [1.0, 1.5]
    on_mean, on_shape = measure_body(model, np.zeros(1)), measure_body(model, betas)
    shaped = model.shaped(betas)
    for name, line in lines.items():
        assert line.length_m(model.template) == pytest.approx(on_mean[name], rel=1e-12)
        assert line.length_m(shaped) == pytest.approx(on_shape[name], rel=0.04), name
        points = line.points(model.template)
        if name in ("biceps", "forearm", "wrist"):
            assert points[:, 0].min() > model.joint_regressor[JOINT["left_shoulder"]] @ model.template[:, 0]


def test_a_body_without_a_section_names_the_girth() -> None:
    model = load_or_build("neutral", show_progress=False)
    joints = (model.joint_regressor @ model.template).copy()
    joints[JOINT["left_knee"], 1] -= 5.0
    with pytest.raises(ValueError, match="knee girth: the plane does not cut"):
        measures_of(model.template, model.faces, joints, model.parts)
