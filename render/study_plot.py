"""A row of small line charts that share their vertical axis: one a factor of a rig study."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

_INK, _SOFT, _LINE = "#1f2328", "#626a73", "#e2dfd8"
_COLOURS = ("#2f6f9f", "#c2571a", "#2d7a46")
_MARKS = ("o", "s", "^")


@dataclass(frozen=True)
class Curve:
    """A named line; None where there is no value."""

    name: str
    values: tuple[float | None, ...]


@dataclass(frozen=True)
class Panel:
    """One chart. places: horizontal positions of the curves' values; note: what is held, under the title."""

    title: str
    unit: str
    places: tuple[float, ...]
    curves: tuple[Curve, ...]
    note: str = ""
    logarithmic: bool = False


def draw_panels(panels: Sequence[Panel], vertical: str) -> UInt8[np.ndarray, "h w 3"]:
    """The charts side by side, RGB, 400 pixels high or more."""
    # Imported here because it takes long to load; the figure is drawn without pyplot, so without a window.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(3.4 * len(panels), 4.2), 4.1), dpi=110, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, max(len(panels), 1), sharey=True, squeeze=False)[0]
    for axis, panel in zip(axes, panels, strict=False):
        for k, curve in enumerate(panel.curves):
            values = [np.nan if value is None else value for value in curve.values]
            axis.plot(
                panel.places,
                values,
                marker=_MARKS[k],
                color=_COLOURS[k],
                label=curve.name,
                ms=5,
                lw=1.8,
            )
        if panel.logarithmic:
            axis.set_xscale("log")
        axis.set_xticks(panel.places, [f"{place:g}" for place in panel.places])
        axis.minorticks_off()
        axis.set_title(panel.title, color=_INK, fontsize=11, loc="left", pad=20 if panel.note else 8)
        if panel.note:
            axis.text(0, 1.02, panel.note, transform=axis.transAxes, color=_SOFT, fontsize=8.5)
        axis.set_xlabel(panel.unit, color=_SOFT, fontsize=9)
        axis.grid(axis="y", color=_LINE, lw=0.8)
        axis.tick_params(colors=_SOFT, labelsize=9, length=0)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
        axis.spines["bottom"].set_color(_LINE)
        axis.set_ylim(bottom=0)
    axes[0].set_ylabel(vertical, color=_SOFT, fontsize=9)
    if panels:
        handles, names = axes[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=9)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()
