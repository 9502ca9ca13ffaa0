"""Plots of a recording's check: silhouette area over time, and how each camera's moment was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

_INK, _SOFT, _LINE, _BLUE, _WARN = "#1f2328", "#626a73", "#e2dfd8", "#2f6f9f", "#c2571a"
_N_COLUMNS = 4


def draw_areas(
    names: Sequence[str],
    frame_ids: Sequence[int],
    area: Float[np.ndarray, "c t"],
    border: Bool[np.ndarray, "c t"],
    marked: Sequence[str] = (),
) -> UInt8[np.ndarray, "h w 3"]:
    """Silhouette area (share of the picture) over frames, one small chart a camera, RGB.

    Grey bands: the person touches the picture's border. `marked` cameras are drawn in another colour.
    """
    figure, canvas, axes = _sheet(len(names))
    ids = np.asarray(frame_ids, dtype=np.float64)
    # Runs of frames are read, not always all: a line must not cross what was left out.
    steps = np.diff(ids)
    usual = float(np.median(steps)) if len(steps) else 1.0
    breaks: list[int] = (np.flatnonzero(steps > 1.5 * usual) + 1).tolist()
    top = 100 * float(area.max(initial=0.0)) * 1.15 or 1.0
    for axis, name, row, touched in zip(axes, names, area, border, strict=False):
        colour = _WARN if name in marked else _BLUE
        for part in np.split(np.arange(len(ids)), breaks):
            axis.plot(ids[part], 100 * row[part], color=colour, lw=1.2)
        for k in np.flatnonzero(touched):
            axis.axvspan(ids[k] - 0.5, ids[k] + 0.5, color=_LINE, lw=0, zorder=0)
        axis.set_ylim(0, top)
        _title(axis, name, colour)
    return _drawn(figure, canvas, "frame", "person, % of the picture")


def draw_offsets(
    names: Sequence[str], curves: Mapping[str, Sequence[tuple[int, float]]], marked: Sequence[str] = ()
) -> UInt8[np.ndarray, "h w 3"]:
    """How well each camera's silhouettes, so many frames later, fit the hull of the others; a peak away from
    zero is a camera that is not synchronised."""
    figure, canvas, axes = _sheet(len(names))
    for axis, name in zip(axes, names, strict=False):
        colour = _WARN if name in marked else _BLUE
        curve = np.array(curves.get(name, ()), dtype=np.float64).reshape(-1, 2)
        if len(curve):
            axis.plot(curve[:, 0], curve[:, 1], color=colour, lw=1.2, marker="o", ms=2)
        axis.axvline(0, color=_SOFT, lw=0.8, zorder=0)
        _title(axis, name, colour)
    return _drawn(figure, canvas, "frames later", "fit (overlap less surplus)")


def _sheet(n: int):  # type: ignore[no-untyped-def]
    # Imported here because it takes long to load; drawn without pyplot, so without a window.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(_N_COLUMNS if n <= 24 else 2 * _N_COLUMNS, max(n, 1))
    rows = -(-max(n, 1) // columns)
    figure = Figure(figsize=(11.5, 1.1 + 1.35 * rows), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for axis in axes[n:]:
        axis.axis("off")
    for axis in axes[:n]:
        axis.tick_params(colors=_SOFT, labelsize=7, length=0)
        axis.grid(axis="y", color=_LINE, lw=0.6)
        for side in ("top", "right", "left"):
            axis.spines[side].set_visible(False)
        axis.spines["bottom"].set_color(_LINE)
    return figure, canvas, axes


def _title(axis, name: str, colour: str) -> None:  # type: ignore[no-untyped-def]
    axis.set_title(name, fontsize=8, loc="left", pad=3, color=colour if colour == _WARN else _INK)


def _drawn(figure, canvas, across: str, up: str) -> UInt8[np.ndarray, "h w 3"]:  # type: ignore[no-untyped-def]
    figure.supxlabel(across, fontsize=8, color=_SOFT)
    figure.supylabel(up, fontsize=8, color=_SOFT)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()
