"""The report is one file that says what it was given."""

import base64
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from render.report import Image, ReportData, Row, Table, contact_row, data_url, write_report


def example() -> ReportData:
    noise = np.random.default_rng(0).integers(0, 256, (90, 60, 3), dtype=np.uint8)
    flat = np.zeros((90, 60), np.uint8)
    flat[20:60, 10:50] = 255
    return ReportData(
        title="people/<f11>",
        subtitle="16 cameras & 12 frames",
        headline=(("RMS", "3.2 mm"),),
        problems=("cam-003, frame 000004: the silhouette is empty",),
        notes=("Up axis: z",),
        facts=(("body", "free:female"),),
        tables=(
            Table(
                "Errors", ("region", "rms", "n"), (("arm", 3.14159, 12), ("leg", float("nan"), None)), "in mm"
            ),
        ),
        sheet_headers=("picture", "silhouette"),
        sheet=(Row("frame 0", (Image(noise, "IoU 0.9"), Image(flat))), contact_row("frame 1", [noise, None])),
        films=(("cam-000", "overlay/cam-000.mp4"),),
    )


def test_everything_is_in_the_one_file(tmp_path: Path) -> None:
    page = write_report(tmp_path / "render" / "report.html", example()).read_text(encoding="utf-8")
    assert [p.name for p in (tmp_path / "render").iterdir()] == ["report.html"]
    outside = [a for a in re.findall(r'(?:src|href)="([^"]*)"', page) if not a.startswith("data:")]
    assert set(outside) == {"overlay/cam-000.mp4"}, "only the films lie beside the page"
    assert "http" not in page and "@import" not in page and "<script" not in page
    for said in ("3.2 mm", "frame 000004: the silhouette is empty", "free:female", "in mm", "IoU 0.9"):
        assert said in page
    assert page.count('src="data:image/') == 3


def test_what_is_settled_is_no_problem(tmp_path: Path) -> None:
    page = write_report(tmp_path / "r.html", example()).read_text(encoding="utf-8")
    problems = page.split('<ul class="problems">')[1].split("</ul>")[0]
    notes = page.split('<ul class="notes">')[1].split("</ul>")[0]
    assert "Up axis: z" in notes and "Up axis: z" not in problems
    bare = write_report(tmp_path / "b.html", ReportData("t", notes=("a note",))).read_text(encoding="utf-8")
    assert "No problems were found." in bare and "a note" in bare


def test_text_is_escaped(tmp_path: Path) -> None:
    page = write_report(tmp_path / "r.html", example()).read_text(encoding="utf-8")
    assert "people/&lt;f11&gt;" in page and "<f11>" not in page and "16 cameras &amp; 12" in page


def test_numbers_are_rounded_and_missing_ones_are_dashes(tmp_path: Path) -> None:
    page = write_report(tmp_path / "r.html", example()).read_text(encoding="utf-8")
    assert ">3.14<" in page and "3.14159" not in page and ">12<" in page
    assert page.count(">–<") == 2 and "nan" not in page.lower().replace("data:image", "").split("base64")[0]


def test_no_problems_is_said(tmp_path: Path) -> None:
    page = write_report(tmp_path / "r.html", ReportData("empty")).read_text(encoding="utf-8")
    assert "No problems were found." in page
    assert "<img" not in page and "<video" not in page


@pytest.mark.parametrize("kind", ["noise", "flat"])
def test_pictures_survive(kind: str) -> None:
    rng = np.random.default_rng(1)
    image = np.full((64, 48, 3), (200, 120, 40), np.uint8)
    if kind == "noise":
        image = cv2.GaussianBlur(rng.integers(0, 256, (64, 48, 3), dtype=np.uint8), (9, 9), 0)
    url = data_url(image, 100)
    assert url.startswith("data:image/jpeg" if kind == "noise" else "data:image/png")
    coded = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    found = cv2.imdecode(coded, cv2.IMREAD_COLOR)[:, :, ::-1].astype(int)
    assert np.abs(found - image).mean() < 4, "red and blue exchanged?"


def test_large_pictures_are_shrunk() -> None:
    coded = np.frombuffer(
        base64.b64decode(data_url(np.zeros((900, 300), np.uint8), 450).split(",")[1]), np.uint8
    )
    assert cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE).shape == (450, 150)


def test_rows_must_fit_their_headers(tmp_path: Path) -> None:
    table = ReportData("t", tables=(Table("Errors", ("a", "b"), ((1,),)),))
    with pytest.raises(ValueError, match="table 'Errors': a row has 1 cells, the header 2"):
        write_report(tmp_path / "r.html", table)
    sheet = ReportData("t", sheet_headers=("a",), sheet=(Row("frame 3", (None, None)),))
    with pytest.raises(ValueError, match="contact sheet, row 'frame 3': 2 pictures for 1 headers"):
        write_report(tmp_path / "r.html", sheet)
    assert list(tmp_path.iterdir()) == []
