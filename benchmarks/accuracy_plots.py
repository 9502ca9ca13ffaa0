"""The accuracy figures: pose curves (the paper's figure on INRIA's data), bias by looseness, table 1 as dots,
more frames, confidence. Drawn without a window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy_cells import BASELINE, DETAILED, FUSION, MEAN, QUANTILE
from benchmarks.accuracy_protocol import DISTANCES_MM
from benchmarks.accuracy_subjects import INPUTS, LABELLED, LOOSENESS, MOTIONS
from benchmarks.accuracy_tables import NAMES, PAPER, SOURCES, Found, bias, pick, present, rms, together
from bodyhull.folder import write_atomically

_INK, _SOFT, _LINE = "#1f2328", "#626a73", "#e2dfd8"
_OF_SOURCE = dict(zip(INPUTS, ("#2f6f9f", "#2d7a46", "#c2571a", "#8a5aa8"), strict=True))
_OF_RESULT = {
    BASELINE: "#9aa1a8",
    MEAN: "#c9b458",
    QUANTILE: "#c2571a",
    FUSION: "#2d7a46",
    DETAILED: "#2f6f9f",
}
_DASH = {BASELINE: (0, (4, 2)), DETAILED: "solid", FUSION: (0, (1, 1))}


def _drawn(
    path: Path, draw: Callable[[Sequence[Any]], None], n_panels: int, width: float, height: float = 3.9
) -> None:
    """Make a figure of panels side by side, let `draw` fill them, write it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, n_panels, squeeze=False)[0]
    draw(axes)
    for axis in axes:
        axis.grid(axis="y", color=_LINE, lw=0.8)
        axis.tick_params(colors=_SOFT, labelsize=8.5, length=0)
        axis.xaxis.label.set_color(_SOFT)
        axis.yaxis.label.set_color(_SOFT)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
        axis.spines["bottom"].set_color(_LINE)
        axis.set_axisbelow(True)
    handles, names = axes[0].get_legend_handles_labels()
    if names:
        # A name takes up to 2.8 inches.
        n = max(1, int(width / 2.8))
        figure.legend(handles, names, loc="outside lower center", ncols=n, frameon=False, fontsize=8.5)
    write_atomically(path, lambda temporary: canvas.print_png(temporary))


def _title(axis: Any, text: str) -> None:
    axis.set_title(text, color=_INK, fontsize=10.5, loc="left")


def pose_figure(path: Path, cells: Sequence[Found]) -> None:
    """Share of landmarks under a distance, and the mean error by place in the sequence."""

    def draw(axes: Sequence[Any]) -> None:
        for source in present(cells, "source", INPUTS):
            for result in (BASELINE, DETAILED):
                here = [c for c in pick(cells, source=source) if result in c["pose"]]
                if not here:
                    continue
                look = {"color": _OF_SOURCE[source], "ls": _DASH[result], "lw": 1.7}
                name = f"{SOURCES[source]}: {'parameters only' if result == BASELINE else NAMES[result]}"
                share = np.mean([c["pose"][result]["share_within"] for c in here], axis=0)
                axes[0].plot(DISTANCES_MM, 100 * share, label=name, **look)
                # Sequences may differ in length: all are laid over the length of the longest.
                n = max(len(c["pose"]["frame_ids"]) for c in here)
                at = np.linspace(0, 1, n)
                curves = [
                    np.interp(at, np.linspace(0, 1, len(c["pose"][result]["by_frame"])),
                              c["pose"][result]["by_frame"])
                    for c in here
                ]  # fmt: skip
                axes[1].plot(np.arange(n), np.mean(curves, axis=0), **look)
        _title(axes[0], "Landmarks with less error than")
        axes[0].set_xlabel("mm", fontsize=9)
        axes[0].set_ylabel("% of landmarks", fontsize=9)
        axes[0].set_xlim(0, 60)
        axes[0].set_ylim(0, 101)
        _title(axes[1], "Mean landmark error by frame")
        axes[1].set_xlabel("frame", fontsize=9)
        axes[1].set_ylabel("mm", fontsize=9)
        axes[1].set_ylim(bottom=0)

    _drawn(path, draw, 2, 9.2, 4.3)


def looseness_figure(path: Path, cells: Sequence[Found]) -> None:
    """Bias and RMS of fusion and detailed by looseness; a panel pair a source."""
    sources = present(cells, "source", INPUTS)

    def draw(axes: Sequence[Any]) -> None:
        for k, source in enumerate(sources):
            signed, size = axes[2 * k], axes[2 * k + 1]
            outfits = [o for o in LOOSENESS if pick(cells, source=source, outfit=o)]
            at = np.arange(len(outfits))
            signed.axhspan(-2, 2, color="#e8f1ea", zorder=0)
            signed.axhline(0, color=_LINE, lw=1)
            for result in (BASELINE, QUANTILE, FUSION, DETAILED):
                here = [pick(cells, source=source, outfit=o) for o in outfits]
                look = {"color": _OF_RESULT[result], "lw": 1.8}
                mean = [np.mean([bias(c, result) for c in group]) for group in here]
                signed.plot(at, mean, marker="o", ms=4.5, label=NAMES[result], **look)
                for x, group in zip(at, here, strict=True):
                    each = [bias(c, result) for c in group]
                    signed.plot([x] * len(each), each, ".", color=_OF_RESULT[result], ms=4, alpha=0.4)
                size.plot(
                    at, [together([rms(c, result) for c in g]) for g in here], marker="o", ms=4.5, **look
                )
            for axis in (signed, size):
                axis.set_xticks(at, [o.replace("tshirt-trousers", "normal") for o in outfits])
            _title(signed, f"Bias, {SOURCES[source]}")
            _title(size, f"RMS, {SOURCES[source]}")
            signed.set_ylabel("mm, positive: too fat", fontsize=9)
            size.set_ylabel("mm", fontsize=9)
            size.set_ylim(bottom=0)

    _drawn(path, draw, 2 * len(sources), 4.8 * 2 * len(sources))


def table_figure(path: Path, cells: Sequence[Found]) -> None:
    """Every cell of table 1 as a dot: a panel a motion, a column a source; the paper's averages as lines."""
    motions, sources = present(cells, "motion", MOTIONS), present(cells, "source", INPUTS)
    most = max([rms(c, r) for c in cells for r in (BASELINE, FUSION, DETAILED) if np.isfinite(rms(c, r))])

    def draw(axes: Sequence[Any]) -> None:
        for axis, motion in zip(axes, motions, strict=True):
            for k, source in enumerate(sources):
                for shift, result in ((-0.22, BASELINE), (0.0, FUSION), (0.22, DETAILED)):
                    values = [rms(c, result) for c in pick(cells, motion=motion, source=source)]
                    values = [v for v in values if np.isfinite(v)]
                    colour = _OF_RESULT[result]
                    axis.plot([k + shift] * len(values), values, ".", color=colour, ms=5, alpha=0.45)
                    if values:
                        middle = together(values)
                        axis.plot([k + shift - 0.09, k + shift + 0.09], [middle] * 2, color=colour, lw=2.6)
                        axis.plot([], [], color=colour, lw=2.6, label=NAMES[result] if k == 0 else None)
            axis.axhline(PAPER[motion][2], color=_INK, lw=1, ls=(0, (3, 3)))
            axis.plot([], [], color=_INK, lw=1, ls=(0, (3, 3)), label="the paper, detailed, labelled (BUFF)")
            axis.set_xticks(range(len(sources)), [_short(s) for s in sources])
            axis.set_xlim(-0.5, len(sources) - 0.5)
            axis.set_ylim(0, 1.08 * most)
            _title(axis, motion)
        axes[0].set_ylabel("RMS, mm, paper's measure", fontsize=9)

    _drawn(path, draw, len(motions), max(1.4 + 1.15 * len(sources), 3.4) * len(motions), 4.4)


def _short(source: str) -> str:
    return (
        "scans,\nlabelled"
        if source == LABELLED
        else source.replace("-", "\n").replace("scans", "scans,\nall cloth")
    )


def frames_figure(path: Path, cells: Sequence[Found]) -> None:
    """RMS by number of frames."""

    def draw(axes: Sequence[Any]) -> None:
        numbers = sorted({c["cell"]["used"] for c in cells})
        for result in (BASELINE, QUANTILE, FUSION, DETAILED):
            values = [together([rms(c, result) for c in pick(cells, used=n)]) for n in numbers]
            axes[0].plot(numbers, values, marker="o", ms=4.5, color=_OF_RESULT[result], label=NAMES[result])
        axes[0].set_xscale("log")
        axes[0].set_xticks(numbers, [str(n) for n in numbers])
        axes[0].minorticks_off()
        axes[0].set_ylim(bottom=0)
        axes[0].set_xlabel("frames of the sequence", fontsize=9)
        axes[0].set_ylabel("RMS, mm, paper's measure", fontsize=9)
        _title(axes[0], "More frames")

    _drawn(path, draw, 1, 6.4)


def confidence_figure(path: Path, cells: Sequence[Found]) -> None:
    """RMS of the fusion shape in fifths of its confidence, a thin line a cell."""
    there = [c for c in cells if c["confidence"] and len(c["confidence"]) == 5]

    def draw(axes: Sequence[Any]) -> None:
        for source in present(there, "source", INPUTS):
            each = np.stack([np.array(c["confidence"])[:, 1] for c in pick(there, source=source)])
            axes[0].plot(each.T, color=_OF_SOURCE[source], lw=0.7, alpha=0.3)
            middle = np.sqrt((each**2).mean(0))
            axes[0].plot(middle, color=_OF_SOURCE[source], marker="o", ms=4.5, lw=2, label=SOURCES[source])
        axes[0].set_xticks(range(5), ["least sure", "2nd", "3rd", "4th", "surest"])
        axes[0].set_ylim(bottom=0)
        axes[0].set_xlabel("fifth of the surface", fontsize=9)
        axes[0].set_ylabel("RMS, mm, paper's measure", fontsize=9)
        _title(axes[0], "Fusion shape: error by confidence")

    if there:
        _drawn(path, draw, 1, 6.0)
