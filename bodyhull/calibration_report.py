"""What a calibration from boards tells: a table, sentences, and the same numbers for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from capture.board_calibration import BoardCalibration
    from capture.board_findings import Finding
    from capture.world_frame import Ground


def rows_of(result: BoardCalibration) -> list[dict[str, Any]]:
    """One row of numbers a camera; None where there is none."""
    shared = set(result.sightings.shared_moments())
    agreement = result.agreement
    rows = []
    for c, name in enumerate(result.sightings.names):
        lens = result.intrinsics[c]
        rows.append(
            {
                "camera": name,
                "size": list(result.sightings.sizes[c]),
                "placed": c in result.placed,
                "boards": len(result.sightings.of(c)),
                "shared_boards": len(shared & result.sightings.views[c].keys()),
                "focal_px": _number(None if lens is None else lens.focal_px),
                "focal_sd_px": _number(None if lens is None else lens.focal_sd_px),
                "rms_px": _number(result.rms_px[c]),
                "held_out_corners_px": _number(None if agreement is None else agreement.corners_px[c]),
                "held_out_boards_px": _number(None if agreement is None else agreement.boards_px[c]),
                "coverage": _number(None if lens is None else lens.coverage),
                "edge_px": _number(None if lens is None else lens.edge_px),
            }
        )
    return rows


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


_COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("camera", "camera", ""),
    ("boards", "boards", "d"),
    ("shared", "shared_boards", "d"),
    ("focal px", "focal_px", ".1f"),
    ("+-", "focal_sd_px", ".1f"),
    ("rms px", "rms_px", ".2f"),
    ("held out px", "held_out_boards_px", ".3f"),
    ("corners px", "held_out_corners_px", ".2f"),
    ("covered", "coverage", ".0%"),
    ("edge px", "edge_px", ".1f"),
)


def table(result: BoardCalibration) -> str:
    """The report for the screen."""
    cells = [[heading for heading, _, _ in _COLUMNS]]
    for row in rows_of(result):
        cells.append([_cell(row[key], form) for _, key, form in _COLUMNS])
    widths = [max(len(line[k]) for line in cells) for k in range(len(_COLUMNS))]
    return "\n".join(
        "  ".join(
            text.ljust(width) if k == 0 else text.rjust(width)
            for k, (text, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in cells
    )


def _cell(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)


def told_lines(
    result: BoardCalibration, findings: Sequence[Finding], ground: Ground | None, extrinsics: bool
) -> list[str]:
    """What the numbers mean, a line each."""
    lines = []
    if result.agreement is not None:
        lines.append(
            f"Cameras agree to {result.agreement.overall_px:.3f} px inside the volume, on boards held "
            "out of the fit."
        )
    elif result.rig is not None:
        lines.append(
            "Too few shared boards to hold some out: the residuals are of the boards that were fitted."
        )
    if result.dropped:
        views = ", ".join(
            f"{result.sightings.names[c]} {result.sightings.labels.get(m, str(m))}"
            for c, m in result.dropped[:6]
        )
        more = f" and {len(result.dropped) - 6} more" if len(result.dropped) > 6 else ""
        lines.append(f"Left out, as they fit nothing: {views}{more}.")
    if result.rig is None:
        if extrinsics:
            lines.append(
                "No extrinsics: no two cameras saw the board in one place at one moment (same picture "
                "name or frame "
                "number). The lenses are written; film the board with all cameras at once, then add "
                "--lenses FILE."
            )
        else:
            lines.append("Lenses only, without places: give them to the next calibration with --lenses FILE.")
    if ground is not None:
        lines += [f"World: {note}" for note in ground.notes]
        lines += [f"warning: {doubt}" for doubt in ground.doubts]
    lines += [("BAD " if one.grave else "warning: ") + one.sentence for one in findings]
    return lines


def report(
    result: BoardCalibration,
    findings: Sequence[Finding],
    ground: Ground | None,
    shifts: Mapping[str, int],
) -> dict[str, Any]:
    """The report for programs."""
    return {
        "board": result.board.sentence(),
        "start": result.method,
        "agreement_px": _number(None if result.agreement is None else result.agreement.overall_px),
        "cameras": rows_of(result),
        "findings": [
            {"camera": one.camera, "kind": one.kind, "grave": one.grave, "sentence": one.sentence}
            for one in findings
        ],
        "frame_shifts": dict(shifts),
        "world": None if ground is None else [*ground.notes, *ground.doubts],
        "left_out": [
            {"camera": result.sightings.names[c], "moment": result.sightings.labels.get(m, str(m))}
            for c, m in result.dropped
        ],
    }
