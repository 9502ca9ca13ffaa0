"""A run's report: one HTML file with everything in it (pictures inlined), readable without a network, light
or dark.

The page knows nothing of the pipeline: it lays out what `ReportData` holds, so that the door decides what is
told.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from .overlay import shrunk

WIDE_PX = 2000
"""Longest side of `ReportData.pictures`."""


@dataclass(frozen=True)
class Image:
    """A picture and the line under it. pixels: RGB or grey."""

    pixels: UInt8[np.ndarray, "h w *c"]
    caption: str = ""


@dataclass(frozen=True)
class Row:
    """One row of the contact sheet: a title (frame, camera) and its pictures, in the order of the sheet's
    headers.
    """

    title: str
    images: tuple[Image | None, ...]


@dataclass(frozen=True)
class Table:
    """rows: cells are text or numbers; numbers are shown with `digits` after the point and stand to the
    right.

    note: a sentence under the table: what is measured, in which unit, better up or down.
    """

    caption: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str | float | int | None, ...], ...]
    note: str = ""
    digits: int = 2


@dataclass(frozen=True)
class ReportData:
    """What a report shows, top to bottom.

    title; subtitle: a sentence; headline: the few (name, value) that matter most, shown large; problems: a
    sentence each, what went wrong or was found odd (empty: the page says so); facts: (name, value) of the
    run, under facts_title; pictures: wide ones, one under the other; tables; sheet_headers and sheet: the
    contact sheet; films: (caption, path relative to the report's folder) of MP4 files; notes: a sentence
    each, what was settled without a doubt.
    """

    title: str
    subtitle: str = ""
    headline: tuple[tuple[str, str], ...] = ()
    problems: tuple[str, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    facts_title: str = "The run"
    pictures: tuple[Image, ...] = ()
    tables: tuple[Table, ...] = ()
    sheet_headers: tuple[str, ...] = ()
    sheet: tuple[Row, ...] = ()
    films: tuple[tuple[str, str], ...] = ()
    footer: str = field(default="")
    notes: tuple[str, ...] = ()


def write_report(path: Path | str, data: ReportData, *, image_px: int = 420) -> Path:
    """Write the page and return its path; it appears whole or not at all. image_px: longest side of the
    pictures.

    Photographs become JPEG, flat pictures (silhouettes) PNG, whichever is smaller. ValueError where a table's
    row or a sheet's row has another length than its headers.
    """
    path = Path(path)
    for table in data.tables:
        for row in table.rows:
            if len(row) != len(table.headers):
                raise ValueError(
                    f"table {table.caption!r}: a row has {len(row)} cells, the header {len(table.headers)}"
                )
    for line in data.sheet:
        if len(line.images) != len(data.sheet_headers):
            raise ValueError(
                f"contact sheet, row {line.title!r}: {len(line.images)} pictures for "
                f"{len(data.sheet_headers)} headers"
            )
    page = render_page(data, image_px)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(page, encoding="utf-8")
    partial.replace(path)
    return path


def render_page(data: ReportData, image_px: int = 420) -> str:
    """The page's HTML."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["inline"] = lambda image: data_url(image.pixels, image_px)
    environment.filters["inline_wide"] = lambda image: data_url(image.pixels, WIDE_PX)
    environment.globals["cell"] = _cell
    template = environment.from_string(
        (Path(__file__).parent / "report.html.jinja").read_text(encoding="utf-8")
    )
    return template.render(data=data)


def data_url(pixels: UInt8[np.ndarray, "h w *c"], longest_px: int) -> str:
    """The picture as a data: address, PNG or JPEG, whichever is smaller."""
    image = shrunk(pixels, longest_px)
    if image.ndim == 3:
        image = np.ascontiguousarray(image[:, :, ::-1])
    kinds = {
        "jpeg": (".jpg", [cv2.IMWRITE_JPEG_QUALITY, 86]),
        "png": (".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]),
    }
    coded = {}
    for kind, (suffix, options) in kinds.items():
        done, data = cv2.imencode(suffix, image, options)
        assert done
        coded[kind] = data.tobytes()
    kind = min(coded, key=lambda k: len(coded[k]))
    return f"data:image/{kind};base64,{base64.b64encode(coded[kind]).decode('ascii')}"


def _cell(value: str | float | int | None, digits: int) -> str:
    """A table's cell as text: a number that is not there is a dash, not 'nan'."""
    if value is None:
        return "–"
    if isinstance(value, (float, np.floating)):
        return f"{value:.{digits}f}" if np.isfinite(value) else "–"
    return str(value)


def contact_row(title: str, pictures: Sequence[UInt8[np.ndarray, "h w *c"] | None]) -> Row:
    """A row of pictures without captions; None leaves its place empty."""
    return Row(title, tuple(None if p is None else Image(p) for p in pictures))
