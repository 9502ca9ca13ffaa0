"""`bodyhull rig-study`: one command, a table, a plot and a page; finished rigs are kept."""

import json
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyhull.study import Outcome, StudySubject, run_study
from bodyhull.study_commands import usual_jobs
from bodyhull.study_page import HEADERS, markdown, panels_of, write_study
from bodyhull.study_plan import Case, StudyPlan, plan_of
from capture.layouts import ring_layout
from render.study_plot import Curve, Panel, draw_panels
from tests.command_line import call

PLAN = StudyPlan(Case(8, 200), (3, 8), (200,), (0.0, 6.0), (0.0,))
SUBJECT = StudySubject(frames=2, seed=3)


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[Case, Outcome]]:
    out = tmp_path_factory.mktemp("study")
    return out, run_study(out, PLAN, SUBJECT, with_body=False)


def test_one_thing_changes_in_each_curve_and_no_rig_is_tried_twice() -> None:
    plan = StudyPlan(Case(16, 512), (4, 16, 8), (512, 256), (0.0, 1.0), (0.0, 2.0, 4.0))
    factors = plan.factors()
    assert [factor.title for factor in factors] == [
        "number of cameras", "picture width", "calibration noise", "mask noise",
    ]  # fmt: skip
    assert factors[0].values == (4.0, 8.0, 16.0)
    for factor in factors:
        for case in factor.cases:
            own, held = asdict(case), asdict(plan.base)
            assert sum(own[k] != held[k] for k in own) <= 1
    assert len(plan.cases()) == len(set(plan.cases())) == 1 + 2 + 1 + 1 + 2
    assert plan.cases()[0] == plan.base


def test_fewer_cameras_and_wrong_cameras_make_worse_hulls(
    studied: tuple[Path, dict[Case, Outcome]],
) -> None:
    _, outcomes = studied
    usual, few = outcomes[Case(8, 200)], outcomes[Case(3, 200)]
    wrong = outcomes[Case(8, 200, calibration_px=6.0)]
    assert usual.hull_rms is not None and few.hull_rms is not None and wrong.hull_rms is not None
    assert usual.hull_bias is not None and few.hull_bias is not None and wrong.hull_bias is not None
    assert few.hull_rms > 1.5 * usual.hull_rms
    assert few.hull_bias > usual.hull_bias > -2
    # Cones that miss each other cut into the person.
    assert wrong.hull_bias < usual.hull_bias - 1
    assert usual.shape_rms is None
    assert usual.frames_lost == 0
    assert usual.pixel_mm == pytest.approx(16.2, rel=0.1)


def test_finished_rigs_are_kept_and_another_person_is_studied_anew(
    studied: tuple[Path, dict[Case, Outcome]],
) -> None:
    out, outcomes = studied
    files = sorted((out / "cases").glob("*/outcome.json"))
    times = [path.stat().st_mtime_ns for path in files]
    assert run_study(out, PLAN, SUBJECT, with_body=False) == outcomes
    assert [path.stat().st_mtime_ns for path in files] == times
    files[0].write_text("{")
    again = run_study(out, PLAN, SUBJECT, with_body=False)
    assert {case: o.hull_rms for case, o in again.items()} == {c: o.hull_rms for c, o in outcomes.items()}


def test_table_plot_and_page_hold_every_rig(
    studied: tuple[Path, dict[Case, Outcome]], tmp_path: Path
) -> None:
    _, outcomes = studied
    write_study(tmp_path, PLAN, SUBJECT, outcomes, 12.0)
    lines = markdown(outcomes).splitlines()
    assert len(lines) == 2 + len(outcomes)
    assert all(line.count("|") == len(HEADERS) + 1 for line in lines)
    record = json.loads((tmp_path / "study.json").read_text())
    assert [o["case"]["cameras"] for o in record["outcomes"]] == [8, 3, 8]
    plot = cv2.imread(str(tmp_path / "plot.png"))
    assert plot is not None and plot.shape[0] >= 400
    page = (tmp_path / "index.html").read_text()
    assert page.count("data:image/") == 1
    assert f'<td class="number">{outcomes[Case(3, 200)].hull_rms:.2f}</td>' in page
    panels = panels_of(PLAN, outcomes)
    assert [panel.title for panel in panels] == ["number of cameras", "calibration noise"]
    assert all(len(panel.curves) == 1 for panel in panels), "no body was fitted"


def test_a_chart_draws_its_curves_and_leaves_gaps_where_values_lack() -> None:
    whole = draw_panels([Panel("t", "px", (1.0, 2.0, 4.0), (Curve("a", (3.0, 2.0, 1.0)),))], "mm")
    gap = draw_panels([Panel("t", "px", (1.0, 2.0, 4.0), (Curve("a", (3.0, None, 1.0)),))], "mm")

    def blue(picture: np.ndarray) -> int:
        return int((np.abs(picture.astype(int) - [0x2F, 0x6F, 0x9F]).sum(axis=2) < 30).sum())

    assert blue(whole) > 3 * blue(gap) > 0


def test_a_calibration_bounds_the_study(tmp_path: Path) -> None:
    ring_layout(6, (400, 300)).save(tmp_path / "rig.json")
    plan = plan_of(
        layout="dome", calibration=tmp_path / "rig.json", size=None, units="auto", up="auto",
        cameras=(4, 8, 16), widths=(512, 1024), calibration_px=(0.0,), mask_px=(0.0,),
        base_cameras=16, base_width=1024,
    )  # fmt: skip
    assert plan.base == Case(6, 400)
    assert [case.cameras for case in plan.factors()[0].cases] == [4, 6]
    assert [case.width_px for case in plan.factors()[1].cases] == [200, 400]
    rig = plan.rig(Case(4, 200))
    assert rig.names == ("cam-000", "cam-001", "cam-002", "cam-003")
    assert rig[0].size == (200, 150)


def test_the_command_refuses_what_makes_no_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refusal(*words: object) -> str:
        return call(capsys, "rig-study", "--out", tmp_path / "s", *words).complaint

    assert "--cameras 1" in refusal("--cameras", 1)
    assert "give numbers of 2 or more" in refusal("--cameras", 1)
    assert "there is no such motion" in refusal("--motion", "swim")
    assert "no such calibration" in refusal("--calibration", tmp_path / "x.json")
    assert usual_jobs() >= 1
