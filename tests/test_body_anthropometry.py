"""Drawn people have the survey's measures, and a tape around the built mesh reads what was asked."""

import numpy as np
import pytest

from fit.body import half_mesh
from fit.body.anatomy import make_person
from fit.body.anthropometry import (
    BMI_RANGE,
    CIVILIAN_BMI,
    GIRTHS,
    draw_people,
    load_statistics,
    measure,
    n_scores,
    survey_mean,
)
from fit.body.build import load_or_build
from fit.body.correspondence import Carrier
from fit.body.density import weight_kg
from fit.body.remesh import SEAM_TOLERANCE_M
from fit.body.skeleton import LEFT_JOINTS, MIRROR
from fit.body.tape import Levels, Subject, volume_m3
from fit.surface import vertex_normals


@pytest.mark.parametrize(("sex", "name", "girth_m"), [(1.0, "waist", 0.94058), (0.0, "waist", 0.86091)])
def test_the_survey_mean_has_the_survey_s_measures(sex: float, name: str, girth_m: float) -> None:
    average = survey_mean(sex)
    assert average.stature == pytest.approx({1.0: 1.75621, 0.0: 1.62847}[sex], rel=2e-3)
    assert getattr(average, name) == pytest.approx(girth_m, rel=1.5e-2)  # a median is below its mean


def test_drawn_people_have_the_survey_s_spread_at_given_bmi_and_a_civilian_bmi() -> None:
    _, scores = draw_people(3000, 5, 1.0)
    men = [measure(1.0, z) for z in scores]
    stature = np.array([m.stature for m in men])
    assert stature.std() == pytest.approx(0.0686, rel=0.06)
    log_bmi = np.log([m.bmi for m in men])
    median, sd = CIVILIAN_BMI["male"]
    assert np.median(log_bmi) == pytest.approx(np.log(median), abs=0.01)
    assert log_bmi.std() == pytest.approx(sd, rel=0.06)
    assert min(m.bmi for m in men) >= BMI_RANGE[0]
    assert max(m.bmi for m in men) <= BMI_RANGE[1]
    # The survey's correlation of stature with acromial height survives the change of BMI.
    acromion = np.array([m.acromion_height for m in men])
    measures = load_statistics("male").measures
    i, j = measures.index("stature"), measures.index("acromialheight")
    covariance = load_statistics("male").covariance
    wanted = covariance[i, j] / np.sqrt(covariance[i, i] * covariance[j, j])
    assert np.corrcoef(np.log(stature), np.log(acromion))[0, 1] == pytest.approx(wanted, abs=0.01)


def test_the_sample_s_scores_cancel_in_pairs() -> None:
    sexes, scores = draw_people(40, 3, None)
    np.testing.assert_allclose(scores.sum(0), 0, atol=1e-12)
    assert sexes.mean() == pytest.approx(0.5)


def test_a_given_bmi_is_met_and_weight_follows() -> None:
    heavy = measure(0.0, bmi=40.0)
    assert heavy.bmi == pytest.approx(40.0)
    assert heavy.weight == pytest.approx(40.0 * heavy.stature**2)
    assert heavy.waist > measure(0.0, bmi=20.0).waist * 1.3


@pytest.mark.parametrize("sex", [0.0, 1.0])
@pytest.mark.parametrize("bmi", [17.0, 25.0, 36.0])
def test_a_tape_around_the_mesh_reads_what_was_asked(sex: float, bmi: float) -> None:
    parts = load_or_build("neutral", show_progress=False).parts

    half, faces = half_mesh.load_half_mesh()
    source, _ = make_person(measure(0.5))
    person = measure(sex, bmi=bmi)
    body, joints = make_person(person)
    carried = Carrier(half, faces, source)(body)
    vertices, whole_faces, _ = half_mesh.mirror(carried, faces)
    subject = Subject(vertices, whole_faces, joints, parts, Levels.of_person(person))
    read = {name: line.length_m(vertices) for name, line in subject.girth_lines().items()}
    errors = {name: 100 * (read[name] / getattr(person, name) - 1) for name in GIRTHS}
    assert max(abs(e) for e in errors.values()) < 2.0, f"girths off by per cent: {errors}"
    litres = 1000 * volume_m3(vertices, whole_faces)
    assert weight_kg(litres, person.stature, sex) == pytest.approx(person.weight, rel=0.03)
    found = Subject(vertices, whole_faces, joints, parts).levels.crotch
    assert found == pytest.approx(person.crotch_height, rel=0.01)
    assert np.ptp(vertices[:, 1]) == pytest.approx(person.stature, rel=0.01)
    # Correspondence keeps the seam, the sides and the orientation.
    seam = half[:, 0] < SEAM_TOLERANCE_M
    assert (carried[seam, 0] == 0).all()
    assert (carried[~seam, 0] > 0).all()
    before = vertex_normals(*half_mesh.mirror(half, faces)[:2])
    assert ((before * vertex_normals(vertices, whole_faces)).sum(1) > 0).mean() > 0.995


def test_joints_are_mirror_images() -> None:
    rng = np.random.default_rng(0)
    _, joints = make_person(measure(0.3, rng.standard_normal(n_scores())))
    for j in LEFT_JOINTS:
        np.testing.assert_array_equal(joints[MIRROR[j]], joints[j] * [-1, 1, 1])
