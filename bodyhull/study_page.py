"""What a rig study tells: a table for the terminal and for files, a plot, and one page with both."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from bodyhull.folder import write_atomically
from bodyhull.study import Outcome, StudySubject
from bodyhull.study_plan import Case, StudyPlan
from render.report import Image, ReportData, Table, write_report
from render.study_plot import Curve, Panel, draw_panels
from render.turntable import png_bytes

HEADERS = (
    "cameras", "width px", "calibration px", "mask px", "mm a pixel", "hull bias", "hull RMS", "hull 95 %",
    "shape RMS", "shape bias", "posed RMS", "frames lost",
)  # fmt: skip
PROTOCOL = (
    "Millimetres. Hull: points even over the hull's surface against the true clothed surface, all frames "
    "(bias: positive outside). Shape: true body vertices of torso, arms, legs and neck against the fusion "
    "shape, the truth re-posed to fit it (paper's measure; bias: positive too fat). Posed: the same against "
    "the detailed body as it stands in its frame. Noises are standard deviations in pixels."
)


def table_rows(outcomes: dict[Case, Outcome]) -> list[tuple[str | float | int | None, ...]]:
    """One row a rig, under HEADERS."""
    return [
        (
            o.case.cameras,
            o.case.width_px,
            o.case.calibration_px,
            o.case.mask_px,
            o.pixel_mm,
            o.hull_bias,
            o.hull_rms,
            o.hull_p95,
            o.shape_rms,
            o.shape_bias,
            o.posed_rms,
            o.frames_lost,
        )
        for o in outcomes.values()
    ]


def markdown(outcomes: dict[Case, Outcome]) -> str:
    """The table as Markdown, millimetres."""

    def text(value: str | float | int | None) -> str:
        if value is None:
            return "-"
        return f"{value:.2f}" if isinstance(value, float) and not value.is_integer() else f"{value:g}"

    lines = ["| " + " | ".join(HEADERS) + " |", "|" + " ---: |" * len(HEADERS)]
    lines += ["| " + " | ".join(text(v) for v in row) + " |" for row in table_rows(outcomes)]
    return "\n".join(lines) + "\n"


def panels_of(plan: StudyPlan, outcomes: dict[Case, Outcome]) -> tuple[Panel, ...]:
    """One panel a factor, with the hull's curve and the body's."""
    panels = []
    for factor in plan.factors():
        of = [outcomes[case] for case in factor.cases]
        curves = (
            Curve("hull, RMS to the clothed surface", tuple(o.hull_rms for o in of)),
            Curve("body shape, RMS (paper's measure)", tuple(o.shape_rms for o in of)),
            Curve("body as it stands, RMS", tuple(o.posed_rms for o in of)),
        )
        shown = tuple(curve for curve in curves if any(v is not None for v in curve.values))
        held = [
            f"{plan.base.cameras} cameras" if factor.unit != "cameras" else "",
            f"{plan.base.width_px} px wide" if factor.title != "picture width" else "",
        ]
        note = ", ".join(part for part in held if part)
        panels.append(Panel(factor.title, factor.unit, factor.values, shown, note, factor.unit == "cameras"))
    return tuple(panels)


def write_study(
    out: Path, plan: StudyPlan, subject: StudySubject, outcomes: dict[Case, Outcome], seconds: float
) -> None:
    """study.json, table.md, plot.png and index.html in OUT, each whole or not at all."""
    record = {
        "plan": plan.as_dict(),
        "subject": asdict(subject),
        "protocol": PROTOCOL,
        "outcomes": [asdict(outcome) for outcome in outcomes.values()],
        "seconds": round(seconds, 1),
    }
    write_atomically(out / "study.json", lambda path: path.write_text(json.dumps(record, indent=1) + "\n"))
    table = f"{markdown(outcomes)}\n{PROTOCOL}\n"
    write_atomically(out / "table.md", lambda path: path.write_text(table))
    plot = draw_panels(panels_of(plan, outcomes), "millimetres")
    write_atomically(out / "plot.png", lambda path: path.write_bytes(png_bytes(plot)))
    rig = plan.layout if plan.calibration is None else plan.calibration.name
    write_report(
        out / "index.html",
        ReportData(
            title="Rig study",
            subtitle=f"{rig}; {subject.frames} frames of {subject.motion} in {subject.garment}, "
            f"person {subject.seed} of {subject.body}",
            problems=tuple(f"{o.case.name}: {o.failure}" for o in outcomes.values() if o.failure),
            pictures=(Image(plot, "Each panel changes one thing and holds the others."),),
            tables=(Table("Every rig", HEADERS, tuple(table_rows(outcomes)), PROTOCOL),),
        ),
    )
