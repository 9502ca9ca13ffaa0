"""The accuracy tables as Markdown and CSV, the paper's own numbers beside. Reads finished cells; computes no
fit."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from benchmarks.accuracy_cells import BASELINE, DETAILED, FUSION, MEAN, MEASURES, QUANTILE, RESULTS
from benchmarks.accuracy_protocol import DISTANCES_MM
from benchmarks.accuracy_subjects import HULLS_16, HULLS_68, INPUTS, LABELLED, LOOSENESS, MOTIONS, SCANS

Found = dict[str, Any]
"""A finished cell, as `accuracy_cells.measure` gives it."""

#: Table 1 of the paper: averages over its 11 cells of subject and outfit, RMS in mm, on BUFF's scans with
#: skin labelled: (Yang et al. 2016, fusion, detailed). And what it says of all cloth, over all motions.
PAPER = {
    "tilt-twist": (17.27, 2.47, 2.40),
    "hips": (19.51, 2.63, 2.55),
    "shoulders-mill": (17.59, 2.63, 2.55),
}
PAPER_ALL_CLOTH = "about 3 (all cloth) against about 2.5 (labelled)"
#: Bars for normal clothes, all cloth, detailed, paper's measure: RMS in mm.
BARS = {SCANS: 2.5, HULLS_68: 3.0, HULLS_16: 4.5}
NAMES = {
    BASELINE: "parameters only (as Yang 2016)",
    MEAN: "mean of unposed alignments",
    QUANTILE: "naive 10 % quantile",
    FUSION: "fusion",
    DETAILED: "detailed",
}
SOURCES = {
    SCANS: "scans, all cloth",
    LABELLED: "scans, labelled",
    HULLS_16: "hulls of 16 cameras",
    HULLS_68: "hulls of 68 cameras",
}


def markdown(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table with its title."""
    lines = [f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *rows)]
    return f"\n{title}\n\n" + "\n".join(lines)


def together(values: Sequence[float]) -> float:
    """Root mean square over cells: every cell counts the same; NaN where there is none."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def rms(cell: Found, result: str, measure: str = "paper") -> float:
    """RMS of one result in one cell, mm; NaN where it was not made."""
    return float(cell["errors"].get(result, {}).get(measure, {}).get("rms", float("nan")))


def bias(cell: Found, result: str, measure: str = "paper") -> float:
    """The same, bias (positive: too fat)."""
    return float(cell["errors"].get(result, {}).get(measure, {}).get("bias", float("nan")))


def with_bias(cells: Sequence[Found], result: str, measure: str = "paper") -> str:
    """RMS over cells and mean bias, as text."""
    found = [c for c in cells if np.isfinite(rms(c, result, measure))]
    if not found:
        return "-"
    middle = np.mean([bias(c, result, measure) for c in found])
    return f"{together([rms(c, result, measure) for c in found]):.2f} ({middle:+.1f})"


def pick(cells: Sequence[Found], **wanted: object) -> list[Found]:
    """The cells whose facts are these."""
    return [c for c in cells if all(c["cell"][k] == v for k, v in wanted.items())]


def present(cells: Sequence[Found], fact: str, order: Sequence[object] = ()) -> list[Any]:
    """The values of a fact that occur, in the order given (or sorted)."""
    values = {c["cell"][fact] for c in cells}
    return [v for v in order if v in values] or sorted(values)


def table_one(cells: Sequence[Found]) -> str:
    """The paper's table 1: a block a motion, a row a result and source, a column a person in an outfit."""
    columns = sorted({(c["cell"]["outfit"], c["cell"]["seed"]) for c in cells}, key=lambda x: (x[0], x[1]))
    header = ["", *(f"{seed} {outfit}" for outfit, seed in columns), "average", "paper (BUFF)"]
    out = []
    for motion in present(cells, "motion", MOTIONS):
        rows = []
        for source in present(cells, "source", INPUTS):
            here = pick(cells, motion=motion, source=source)
            for k, result in enumerate((BASELINE, FUSION, DETAILED)):
                values = [c for c in here if np.isfinite(rms(c, result))]
                if not values:
                    continue
                by_column = {(c["cell"]["outfit"], c["cell"]["seed"]): c for c in values}
                paper = f"{PAPER[motion][k]:.2f}" if source == LABELLED or k == 0 else ""
                rows.append(
                    [
                        f"{SOURCES[source]}: {NAMES[result]}",
                        *(f"{rms(by_column[c], result):.2f}" if c in by_column else "-" for c in columns),
                        f"**{with_bias(values, result)}**",
                        paper,
                    ]
                )
        out.append(markdown(f"{motion}: RMS in mm by the paper's measure (average with bias)", header, rows))
    return "\n".join(out)


def summary(cells: Sequence[Found]) -> str:
    """All results by source, over everything in the cells."""
    rows = []
    for source in present(cells, "source", INPUTS):
        here = pick(cells, source=source)
        rows.append(
            [
                f"{SOURCES[source]} ({len(here)})",
                *(with_bias(here, result) for result in RESULTS),
                with_bias(here, DETAILED, "under_cloth"),
                with_bias(here, DETAILED, "bare"),
                with_bias(here, DETAILED, "direct"),
                f"{np.mean([c['scan']['mean_mm'] for c in here]):.1f}",
                _cloth(here),
                f"{BARS[source]:g}" if source in BARS else "",
            ]
        )
    header = [
        "source (cells)",
        *(NAMES[r] for r in RESULTS),
        "detailed, under cloth",
        "detailed, bare parts",
        "detailed, direct",
        "input itself, mean mm outside",
        "cloth: true, expected mm",
        "bar",
    ]
    title = (
        "All cells, RMS in mm by the paper's measure unless told (bias: positive is too fat). "
        f"The paper: {PAPER_ALL_CLOTH}"
    )
    return markdown(title, header, rows)


Law = tuple[str, Callable[[Found], tuple[float, float]]]


def laws(cells: Sequence[Found]) -> str:
    """What must hold, in how many cells it does, and by how much: a margin above 0 is as it should be."""
    rows = []
    for name, source, better, worse in (
        ("detailed better than fusion", SCANS, DETAILED, FUSION),
        ("detailed better than fusion", LABELLED, DETAILED, FUSION),
        ("detailed better than fusion", HULLS_16, DETAILED, FUSION),
        ("detailed better than fusion", HULLS_68, DETAILED, FUSION),
        ("fusion better than the naive quantile", SCANS, FUSION, QUANTILE),
        ("fusion better than the naive quantile", HULLS_16, FUSION, QUANTILE),
        ("fusion better than the mean", SCANS, FUSION, MEAN),
        ("detailed better than parameters only", SCANS, DETAILED, BASELINE),
    ):
        rows.append(_law(f"{name}, {SOURCES[source]}", _pairs(cells, (source, better), (source, worse))))
    for name, better, worse in (
        ("labelled better than all cloth", LABELLED, SCANS),
        ("scans better than hulls of 16", SCANS, HULLS_16),
        ("68 cameras better than 16", HULLS_68, HULLS_16),
    ):
        rows.append(_law(f"{name}, detailed", _pairs(cells, (better, DETAILED), (worse, DETAILED))))
    for source, bar in BARS.items():
        values = [(rms(c, DETAILED), bar) for c in pick(cells, source=source)]
        rows.append(_law(f"{SOURCES[source]} within {bar:g} mm, detailed", values))
    header = ["should hold", "holds in", "margin mm: mean", "worst", "best"]
    return markdown("What should hold, cell by cell", header, [r for r in rows if r])


def _pairs(
    cells: Sequence[Found], better: tuple[str, str], worse: tuple[str, str]
) -> list[tuple[float, float]]:
    """RMS of two results on the same person, outfit and motion: (source, result) each."""

    def key(c: Found) -> tuple[object, ...]:
        return tuple(c["cell"][k] for k in ("seed", "outfit", "motion", "n_frames", "used"))

    first = {key(c): rms(c, better[1]) for c in pick(cells, source=better[0])}
    second = {key(c): rms(c, worse[1]) for c in pick(cells, source=worse[0])}
    return [(first[k], second[k]) for k in first if k in second]


def _law(name: str, pairs: Sequence[tuple[float, float]]) -> list[str]:
    margin = np.array([b - a for a, b in pairs if np.isfinite(a) and np.isfinite(b)])
    if not len(margin):
        return []
    holds = f"{int((margin > 0).sum())} of {len(margin)}"
    return [name, holds, *(f"{v:+.2f}" for v in (margin.mean(), margin.min(), margin.max()))]


def looseness_table(cells: Sequence[Found]) -> str:
    """RMS and signed bias by how loose the clothes are."""
    rows = []
    for source in present(cells, "source", INPUTS):
        for outfit in present(cells, "outfit", LOOSENESS):
            here = pick(cells, source=source, outfit=outfit)
            if not here:
                continue
            rows.append(
                [
                    f"{outfit} ({len(here)})",
                    SOURCES[source],
                    f"{np.mean([c['scan']['mean_mm'] for c in here]):.1f}",
                    _cloth(here),
                    *(with_bias(here, r) for r in RESULTS),
                    _within(np.array([bias(c, DETAILED) for c in here]), outfit),
                ]
            )
    header = [
        "clothes (cells)",
        "source",
        "input outside, mm",
        "cloth: true, expected mm",
        *(NAMES[r] for r in RESULTS),
        "within 2 mm",
    ]
    return markdown("By looseness of the clothes: RMS (bias), mm", header, rows)


def _cloth(cells: Sequence[Found]) -> str:
    """How far cloth (of hulls: with their own excess) stands away, and how far the fusion expects it to."""
    told = [c for c in cells if c.get("expected_cloth_mm") is not None]
    if not told:
        return "-"
    true = np.mean([c["scan"]["cloth_mm"] for c in told])
    return f"{true:.1f}, {np.mean([c['expected_cloth_mm'] for c in told]):.1f}"


def _within(off: np.ndarray, outfit: str) -> str:
    inside = int((np.abs(off) <= 2.0).sum())
    return f"{inside} of {len(off)}" + (" (not asked)" if outfit == LOOSENESS[-1] else "")


def frames_table(cells: Sequence[Found]) -> str:
    """More frames of the same sequence."""
    rows = []
    for n in sorted({c["cell"]["used"] for c in cells}):
        here = pick(cells, used=n)
        rows.append([f"{n}", f"{len(here)}", *(with_bias(here, r) for r in RESULTS)])
    header = ["frames", "cells", *(NAMES[r] for r in RESULTS)]
    return markdown("By number of frames, evenly of the same sequence: RMS (bias), mm", header, rows)


def confidence_table(cells: Sequence[Found]) -> str:
    """RMS of the fusion shape by fifths of its confidence."""
    rows = []
    for source in present(cells, "source", INPUTS):
        here = [
            np.array(c["confidence"])
            for c in pick(cells, source=source)
            if c["confidence"] and len(c["confidence"]) == 5
        ]
        if not here:
            continue
        middle = np.stack(here)
        falls = sum(bool((np.diff(one[:, 1]) < 0).all()) for one in here)
        rows.append(
            [
                f"{SOURCES[source]} ({len(here)})",
                *(f"{together(middle[:, k, 1]):.2f} ({middle[:, k, 0].mean():.2f})" for k in range(5)),
                f"{falls} of {len(here)}",
                f"{sum(bool(one[0, 1] > one[-1, 1]) for one in here)} of {len(here)}",
            ]
        )
    header = [
        "source (cells)", "least sure fifth", "2nd", "3rd", "4th", "surest", "falls at every step",
        "surest better than least sure",
    ]  # fmt: skip
    title = "Fusion shape: RMS in mm (mean confidence) by fifths of the surface in order of confidence"
    return markdown(title, header, rows)


def pose_table(cells: Sequence[Found]) -> str:
    """Markers: mean error, the worst frame's, and how many landmarks are near."""
    rows = []
    for source in present(cells, "source", INPUTS):
        for result in (BASELINE, DETAILED):
            here = [c["pose"][result] for c in pick(cells, source=source) if result in c["pose"]]
            if not here:
                continue
            share = np.mean([p["share_within"] for p in here], axis=0)
            rows.append(
                [
                    f"{SOURCES[source]} ({len(here)})",
                    NAMES[result],
                    f"{np.mean([np.mean(p['by_frame']) for p in here]):.1f}",
                    f"{np.max([np.max(p['by_frame']) for p in here]):.1f}",
                    *(f"{100 * share[int(d)]:.0f} %" for d in (10, 20, 30, 50)),
                ]
            )
    header = [
        "source (cells)", "result", "mean error mm", "worst frame", "within 10 mm", "20 mm", "30 mm", "50 mm",
    ]  # fmt: skip
    title = "Pose, as the paper on INRIA's data: markers of the true body against vertices tied to them"
    return markdown(title, header, rows)


def cells_csv(cells: Sequence[Found]) -> str:
    """A row a cell and result."""
    out = io.StringIO()
    facts = ["seed", "outfit", "motion", "source", "n_frames", "used"]
    numbers = ["rms", "mean", "bias", "p90"]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*facts, "result", *(f"{m}_{n}_mm" for m in MEASURES for n in numbers)])
    for c in cells:
        for result, errors in c["errors"].items():
            values = [f"{errors.get(m, {}).get(n, float('nan')):.4f}" for m in MEASURES for n in numbers]
            writer.writerow([*(c["cell"][f] for f in facts), result, *values])
    return out.getvalue()


def pose_csv(cells: Sequence[Found]) -> str:
    """Two kinds of rows: the mean error of a frame, and the share of landmarks within a distance."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["seed", "outfit", "motion", "source", "result", "kind", "frame_or_mm", "mm_or_share"])
    for c in cells:
        who = [c["cell"][f] for f in ("seed", "outfit", "motion", "source")]
        for result in (BASELINE, DETAILED):
            if result not in c["pose"]:
                continue
            curves = c["pose"][result]
            for frame, value in zip(c["pose"]["frame_ids"], curves["by_frame"], strict=True):
                writer.writerow([*who, result, "error by frame", frame, value])
            for distance, value in zip(DISTANCES_MM, curves["share_within"], strict=True):
                writer.writerow([*who, result, "share within", int(distance), value])
    return out.getvalue()
