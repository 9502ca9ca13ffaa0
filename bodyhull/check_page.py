"""What `bodyhull check` tells: a table for the terminal, a JSON file, and one page with the same numbers."""

from __future__ import annotations

import json
from pathlib import Path

from bodyhull.check_numbers import CameraNumbers
from bodyhull.checking import Check
from bodyhull.folder import write_atomically
from render.check_plot import draw_areas, draw_offsets
from render.report import Image, ReportData, Table, write_report

HEADERS = (
    "camera", "px", "view deg", "distance m", "residual px", "overlap", "missing", "surplus", "sync frames",
    "area %", "shown %", "cropped %",
)  # fmt: skip
EXPLAINED = (
    "View: field of view across and down. Distance: to the person's middle. Residual: nine tenths of the "
    "camera's outline lie inside the hull of the other cameras, or outside it by at most so many pixels. "
    "Overlap, missing, surplus: the silhouette against that hull (intersection over union; what of the hull "
    "it lacks, which few cameras leave as room; what of it sticks out, which should be nothing). Sync: its "
    "frame t + n fits what the others show at t; a dash where the person moves too little to tell. Area: of "
    "the picture, mean, least to most. Shown, cropped: frames with a person, and with one that touches the "
    "border."
)


def _row(camera: CameraNumbers) -> tuple[str | float | None, ...]:
    def percent(value: float | None) -> str | None:
        return None if value is None else f"{100 * value:.0f}"

    offset = None if camera.offset_frames is None else f"{camera.offset_frames:+.1f}"
    return (
        camera.name,
        f"{camera.size[0]}x{camera.size[1]}",
        f"{camera.field_of_view_deg[0]:.0f} x {camera.field_of_view_deg[1]:.0f}",
        camera.distance_m,
        None if camera.residual_px is None else f"{camera.residual_px:.1f}",
        camera.agreement,
        camera.missing,
        camera.surplus,
        offset,
        f"{100 * camera.area:.1f} ({100 * camera.area_low:.1f}-{100 * camera.area_high:.1f})",
        percent(camera.shown),
        percent(camera.cropped),
    )


def rig_facts(check: Check) -> tuple[tuple[str, str], ...]:
    """(name, value) of the rig as a whole."""
    rig = check.rig

    def told(value: float | None, digits: int, unit: str) -> str:
        return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()

    heights = "-"
    if rig.lowest_camera_m is not None and rig.highest_camera_m is not None:
        heights = f"{rig.lowest_camera_m:.2f} to {rig.highest_camera_m:.2f} m above the person's lowest point"
    up = "-" if rig.up is None else " ".join(f"{value:g}" for value in rig.up)
    return (
        ("cameras", f"{rig.n_cameras}, of which {len(rig.agreeing)} agree"),
        ("frames", f"{rig.n_frames}, of which {rig.n_frames_read} were looked at"),
        ("calibration", f"unit {rig.unit}, up axis {up}"),
        ("camera heights", heights),
        ("person", f"{told(rig.person_height_m, 2, 'm')} tall, hull of {told(rig.volume_l, 0, 'litres')}"),
        ("witnesses a point", told(rig.witnesses, 1, "cameras (mean over the hull's points)")),
    )


def verdict(check: Check) -> list[str]:
    """One line a finding; one line where there is none."""
    if not check.findings:
        return ["verdict: sound, nothing was found"]
    return [f"verdict: {finding.sentence()}" for finding in check.findings]


def terminal(check: Check) -> str:
    """One screen: the table, the rig, the verdict."""
    rows = [HEADERS, *(tuple(_text(cell) for cell in _row(camera)) for camera in check.cameras)]
    widths = [max(len(str(row[k])) for row in rows) for k in range(len(HEADERS))]
    lines = [
        "  ".join(
            str(cell).ljust(width) if k == 0 else str(cell).rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    facts = [f"{name + ':':20}{value}" for name, value in rig_facts(check)]
    notes = [f"note: {note}" for note in check.notes]
    return "\n".join([*lines, "", *facts, *notes, "", *verdict(check)])


def _text(cell: str | float | None) -> str:
    if cell is None:
        return "-"
    return f"{cell:.2f}" if isinstance(cell, float) else str(cell)


def write_check(out: Path, check: Check) -> tuple[Path, Path]:
    """index.html and check.json in OUT, each whole or not at all; returns both paths."""
    data = out / "check.json"
    text = json.dumps(check.as_dict(), indent=1, allow_nan=False)
    write_atomically(data, lambda path: path.write_text(text + "\n", encoding="utf-8"))
    page = out / "index.html"
    facts, found = check.facts, check.examination
    names = facts.rig.names
    marked = [name for finding in check.findings if not finding.whole_rig for name in finding.cameras]
    curves = {names[i]: offset.curve for i, offset in found.offsets.items()}
    pictures = [
        Image(
            draw_areas(names, facts.frame_ids, facts.area, facts.border, marked),
            "Silhouette area over time; a jump in one camera alone is a bad silhouette. Grey: the person "
            "touches the picture's border.",
        )
    ]
    if any(curves.values()):
        pictures.append(
            Image(
                draw_offsets(names, curves, marked),
                "How well a camera's silhouettes so many frames later fit the hull of the others: the peak "
                "is its moment.",
            )
        )
    rig = check.rig
    write_report(
        page,
        ReportData(
            title="Check of a recording",
            subtitle=check.recording + (f", sequence {check.name}" if check.name else ""),
            headline=(
                ("verdict", "sound" if not check.findings else f"{len(check.findings)} found"),
                ("cameras that agree", f"{len(rig.agreeing)} of {rig.n_cameras}"),
                ("witnesses a point", "-" if rig.witnesses is None else f"{rig.witnesses:.1f}"),
                ("hull", "-" if rig.volume_l is None else f"{rig.volume_l:.0f} l"),
            ),
            problems=tuple(finding.sentence() for finding in check.findings),
            notes=check.notes,
            facts_title="The rig",
            facts=rig_facts(check),
            pictures=tuple(pictures),
            tables=(
                Table("Every camera", HEADERS, tuple(_row(camera) for camera in check.cameras), EXPLAINED),
            ),
        ),
    )
    return page, data
