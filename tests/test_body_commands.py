"""`bodyhull body`: what a file holds is told, converted without loss, drawn; a wrong file is named."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from fit.body import BodyModel, load_body
from fit.body.body_file import read_body_file
from render.turntable import N_VIEWS, PAPER, Figure, draw_rows, posed_body, sheet, turntable
from tests.body_formats import Arrays, fingered_arrays, posed, smpl_arrays, write_chumpy_pickle
from tests.command_line import call

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def free() -> BodyModel:
    return load_body("free:neutral", show_progress=False)


@pytest.fixture(scope="module")
def expressive() -> Arrays:
    return fingered_arrays("SMPL-X", 20)


def test_info_tells_what_a_file_holds(tmp_path: Path, expressive: Arrays, capsys: Capture) -> None:
    np.savez(tmp_path / "SMPLX_FEMALE.npz", **expressive)
    said = call(capsys, "body", "info", tmp_path / "SMPLX_FEMALE.npz")
    rows = dict(line.split(maxsplit=1) for line in said.out.splitlines())
    assert said.code == 0 and not said.err
    assert (rows["name"], rows["kind"], rows["gender"]) == ("SMPLX_FEMALE", "SMPL-X", "female")
    assert rows["joints"] == "55 (fitted as 24: hands and face at rest)"
    assert rows["betas"] == "10 and 10 of expression, unused"
    assert rows["correctives"] == "486" and rows["vertices"] == "6890" and rows["faces"] == "13776"
    assert rows["licence"] == "unknown (see the file's origin)"
    assert rows["hash"] == load_body(tmp_path / "SMPLX_FEMALE.npz").content_hash
    assert rows["note"].startswith("of 20 shape and expression components the first 10")


def test_info_measures_the_mean(free: BodyModel, capsys: Capture) -> None:
    said = call(capsys, "body", "info", "free:neutral").out
    tall = float(np.ptp(free.template[:, 1]))
    assert f"height        {100 * tall:.1f} cm" in said
    assert (
        "CC0-1.0" in said and "joints        24\n" in said and "waist" in said and " kg (estimated)" in said
    )


def test_convert_changes_nothing_and_leaves_no_pickle(tmp_path: Path, capsys: Capture) -> None:
    arrays = smpl_arrays()
    source, out = tmp_path / "basicmodel_m_lbs_10_207_0_v1.1.0.pkl", tmp_path / "out.npz"
    write_chumpy_pickle(source, arrays)
    assert call(capsys, "body", "convert", source, out).code == 0
    with np.load(out, allow_pickle=False) as stored:
        assert all(stored[name].dtype.kind in "fiubU" for name in stored.files)
        for key in ("v_template", "f", "shapedirs", "posedirs", "weights", "J_regressor"):
            np.testing.assert_array_equal(stored[key], arrays[key])
    file, model = read_body_file(out), load_body(out)
    assert (file.gender, file.name) == ("male", source.stem)
    assert model.content_hash == load_body(source).content_hash
    assert (
        "is there already; --overwrite replaces it" in call(capsys, "body", "convert", source, out).complaint
    )
    assert call(capsys, "body", "convert", source, out, "--overwrite").code == 0
    assert "written as .npz" in call(capsys, "body", "convert", source, tmp_path / "out.pkl").complaint


def test_convert_keeps_native_joints_and_expressions(
    tmp_path: Path, expressive: Arrays, capsys: Capture
) -> None:
    (tmp_path / "SMPLX_NEUTRAL.pkl").write_bytes(pickle.dumps(expressive, 2))
    assert call(capsys, "body", "convert", tmp_path / "SMPLX_NEUTRAL.pkl", tmp_path / "x.npz").code == 0
    with np.load(tmp_path / "x.npz", allow_pickle=False) as stored:
        for key in ("shapedirs", "posedirs", "weights", "J_regressor"):
            np.testing.assert_array_equal(stored[key], expressive[key])
        assert stored["kintree_table"].shape == (2, 55)


def test_show_writes_a_picture(tmp_path: Path, capsys: Capture) -> None:
    assert call(capsys, "body", "show", "free:neutral", "--out", tmp_path / "a" / "body.png").code == 0
    assert call(capsys, "body", "show", "free:neutral", "--out", tmp_path / "sheet.png", "--sheet").code == 0
    for path in (tmp_path / "a" / "body.png", tmp_path / "sheet.png"):
        picture = cv2.imread(str(path))
        assert picture is not None and min(picture.shape[:2]) > 600
        assert path.stat().st_size < 400_000
        drawn = (np.abs(picture[:, :, ::-1].astype(int) - PAPER) > 12).any(2)
        assert 0.05 < drawn.mean() < 0.5
    assert (
        "written as .png"
        in call(capsys, "body", "show", "free:neutral", "--out", tmp_path / "a.jpg").complaint
    )


def silhouettes(picture: np.ndarray, n_columns: int, caption_px: int = 24) -> list[np.ndarray]:
    """Masks of the tiles of a picture of one row."""
    drawn = (np.abs(picture.astype(int) - PAPER) > 12).any(2)[:-caption_px]
    return np.split(drawn, n_columns, axis=1)


def test_figures_stand_on_one_floor_at_one_scale(free: BodyModel) -> None:
    small = Figure(0.8 * free.template + [3.0, -1.0, 2.0], "small")
    row = [Figure(free.template, "whole"), small]
    large, less = silhouettes(draw_rows([row], free.faces, (300, 300)), 2)
    heights = [np.flatnonzero(mask.any(1)) for mask in (large, less)]
    assert abs(heights[0][-1] - heights[1][-1]) <= 1
    assert np.ptp(heights[1]) / np.ptp(heights[0]) == pytest.approx(0.8, abs=0.02)
    for mask in (large, less):
        columns = np.flatnonzero(mask.any(0))
        assert columns[0] + columns[-1] == pytest.approx(299, abs=2), "in the middle of its tile"


def test_opposite_views_are_mirror_images(free: BodyModel) -> None:
    for angle in (0.0, 0.7):
        row = [Figure(free.template, "", angle), Figure(free.template, "", angle + np.pi)]
        front, back = silhouettes(draw_rows([row], free.faces, (300, 300)), 2)
        assert (front == back[:, ::-1]).mean() > 0.985


def test_the_turntable_has_eight_sides_and_the_sheet_all_its_figures(free: BodyModel) -> None:
    picture = turntable(free, tile=(60, 100))
    assert picture.shape == (200, 60 * N_VIEWS // 2, 3)
    page = sheet(free, tile=(60, 100))
    assert page.shape == (300, 360, 3)
    for row in range(3):
        for tile in silhouettes(page[100 * row : 100 * (row + 1)], 6):
            assert tile.sum() > 100


def test_posing_follows_the_definition(free: BodyModel) -> None:
    arrays = smpl_arrays()
    pose = 0.3 * np.random.default_rng(0).standard_normal((24, 3))
    betas = np.random.default_rng(1).standard_normal(10)
    np.testing.assert_allclose(posed_body(free, betas, pose), posed(arrays, betas, pose), atol=1e-5)


@pytest.mark.parametrize("action", ["info", "convert", "show"])
def test_a_wrong_file_is_named_by_every_action(action: str, tmp_path: Path, capsys: Capture) -> None:
    more = {"info": (), "convert": (tmp_path / "o.npz",), "show": ("--out", tmp_path / "o.png")}[action]
    (tmp_path / "trap.pkl").write_bytes(b"cposix\nsystem\n(S'touch ran'\ntR.")
    np.savez(tmp_path / "thin.npz", v_template=np.zeros((3, 3)))
    arrays = smpl_arrays()
    np.savez(tmp_path / "odd.npz", **{**arrays, "weights": arrays["weights"][:, :20]})
    for name, complaint in (
        ("nowhere.npz", "no such body file"),
        ("trap.pkl", "names posix.system, which no body file needs"),
        ("thin.npz", "no f, shapedirs, posedirs, weights, J_regressor, kintree_table in this body file"),
        ("odd.npz", "weights has shape (6890, 20), expected (6890, 24)"),
        ("free:elf", "there is no such free body"),
    ):
        file = name if name.startswith("free") else tmp_path / name
        assert complaint in call(capsys, "body", action, file, *more).complaint
    assert not list(tmp_path.glob("o.*")) and not Path("ran").exists()
