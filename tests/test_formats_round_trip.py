"""What is written is read back to the same pixels, in every format; what a format cannot hold is refused."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from bodyhull.convert_commands import FormatName
from capture.errors import RecordingError
from capture.rig import Rig
from capture.rig_formats import FORMATS, METRES_PER_UNIT, detect_format, read_rig_of, write_rig
from tests.rigs_for_formats import awkward_rig, worst_px

# Formats that are read by one reader.
READ_AS = {"colmap-text": "colmap", "pose2sim": "aniposelib", "caliscope": "aniposelib"}
N_TERMS = {"bodyhull": 8, "colmap": 8, "colmap-text": 8, "easymocap": 8, "opencv": 8, "pose2sim": 8,
           "zju-mocap": 8, "aniposelib": 5, "caliscope": 5, "qualisys": 5}  # fmt: skip
HOLD_SKEW = {"bodyhull", "inria", "easymocap", "opencv", "aniposelib", "pose2sim", "caliscope", "qualisys",
             "zju-mocap", "middlebury"}  # fmt: skip
NO_SIZES = {"inria", "zju-mocap", "middlebury"}
UNITS = {"bodyhull": "m", "easymocap": "m", "pose2sim": "m", "caliscope": "m", "actorshq": "m",
         "qualisys": "mm", "vicon": "mm", "zju-mocap": "mm"}  # fmt: skip


def back(rig: Rig, path: Path) -> tuple[Rig, str | None, tuple[str, ...]]:
    foreign = read_rig_of(path)
    sizes = dict(zip(foreign.names, [camera.size for camera in rig], strict=True))
    return foreign.with_sizes(sizes.get).rig(), foreign.unit, foreign.names


def test_the_command_knows_every_format() -> None:
    assert get_args(FormatName) == tuple(FORMATS)


@pytest.mark.parametrize("name", FORMATS)
def test_pinholes_come_back_to_the_same_pixels(tmp_path: Path, name: str) -> None:
    rig = awkward_rig()
    files, _ = write_rig(rig, tmp_path / "out", name)
    assert files and all(file.is_file() for file in files)
    assert detect_format(tmp_path / "out") == READ_AS.get(name, name)
    found, unit, names = back(rig, tmp_path / "out")
    assert unit == UNITS.get(name)
    assert names == rig.names
    assert worst_px(rig, found, METRES_PER_UNIT[unit or "m"]) < 1e-6
    stated = [camera.size for camera in read_rig_of(tmp_path / "out").cameras]
    assert stated == ([None] * 4 if name in NO_SIZES else [camera.size for camera in rig])


@pytest.mark.parametrize("n_terms", [4, 5, 8])
@pytest.mark.parametrize("name", FORMATS)
def test_lenses_come_back_or_are_refused(tmp_path: Path, name: str, n_terms: int) -> None:
    rig = awkward_rig(n_terms)
    if n_terms > N_TERMS.get(name, 0):
        with pytest.raises(RecordingError, match=r"--undistorted writes the cameras of undistorted pictures"):
            write_rig(rig, tmp_path / "out", name)
        assert not list((tmp_path / "out").iterdir()), "something was left of a refused conversion"
        write_rig(rig.pinholes(), tmp_path / "out", name)
        rig = rig.pinholes()
    else:
        write_rig(rig, tmp_path / "out", name)
    found, unit, _ = back(rig, tmp_path / "out")
    assert worst_px(rig, found, METRES_PER_UNIT[unit or "m"]) < 1e-6


@pytest.mark.parametrize("name", FORMATS)
def test_skew_comes_back_or_is_refused(tmp_path: Path, name: str) -> None:
    rig = awkward_rig(skew=0.8)
    if name not in HOLD_SKEW:
        with pytest.raises(RecordingError, match=r"no skew fits into .* \(0.8 px in cam-000\)"):
            write_rig(rig, tmp_path / "out", name)
        return
    write_rig(rig, tmp_path / "out", name)
    found, unit, _ = back(rig, tmp_path / "out")
    assert worst_px(rig, found, METRES_PER_UNIT[unit or "m"]) < 1e-6


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_opencv_writes_one_file_with_all_cameras(tmp_path: Path, ending: str) -> None:
    rig = awkward_rig(5)
    files, notes = write_rig(rig, tmp_path / f"rig.{ending}", "opencv")
    assert files == [tmp_path / f"rig.{ending}"]
    assert "states no unit" in notes[0]
    found, _, names = back(rig, files[0])
    assert names == rig.names and worst_px(rig, found) < 1e-6


def test_the_exact_matrix_of_a_camera_is_kept(tmp_path: Path) -> None:
    write_rig(awkward_rig(skew=0.3), tmp_path / "a", "inria")
    once = read_rig_of(tmp_path / "a").rig((1280, 720))
    write_rig(once, tmp_path / "b", "inria")
    for first in sorted((tmp_path / "a").iterdir()):
        assert np.abs(np.loadtxt(first) - np.loadtxt(tmp_path / "b" / first.name)).max() < 1e-12


def test_vicons_lens_is_turned_round(tmp_path: Path) -> None:
    """A mild radial lens goes to Vicon's direction and back to a few hundredths of a pixel; and what is read
    from Vicon is written to Vicon again."""
    rig = awkward_rig(n_cameras=2)
    mild = Rig(tuple(replace(c, distortion=np.array([-0.03, 0.004, 0, 0])) for c in rig))
    _, notes = write_rig(mild, tmp_path / "a.xcp", "vicon")
    assert "Vicon's lens runs the other way" in notes[0]
    found, _, _ = back(mild, tmp_path / "a.xcp")
    assert worst_px(mild, found, 1e-3) < 0.02
    assert worst_px(mild, found.pinholes(), 1e-3) > 0.3
    again = found.with_world_scaled(1e-3)
    write_rig(again, tmp_path / "b.xcp", "vicon")
    twice, _, _ = back(again, tmp_path / "b.xcp")
    assert worst_px(again, twice, 1e-3) < 1e-4


def test_a_calibration_that_is_there_is_not_replaced_unasked(tmp_path: Path) -> None:
    write_rig(awkward_rig(n_cameras=5), tmp_path / "setup", "inria")
    with pytest.raises(RecordingError, match=r"cam00\.txt: is there already; --overwrite replaces it"):
        write_rig(awkward_rig(n_cameras=3), tmp_path / "setup", "inria")
    write_rig(awkward_rig(n_cameras=3), tmp_path / "setup", "inria", overwrite=True)
    assert read_rig_of(tmp_path / "setup").names == ("cam-000", "cam-001", "cam-002"), (
        "old matrices were left"
    )
    write_rig(awkward_rig(), tmp_path / "model", "colmap")
    write_rig(awkward_rig(4), tmp_path / "model", "colmap-text", overwrite=True)
    assert not list((tmp_path / "model").glob("*.bin")), "an old binary model would be read first"


def test_cameras_keep_their_own_names(tmp_path: Path) -> None:
    rig = awkward_rig()
    named = Rig(
        tuple(replace(c, name=name) for c, name in zip(rig, ("01", "02", "left-3", "x"), strict=True))
    )
    for name in (
        "easymocap",
        "colmap",
        "opencv",
        "pose2sim",
        "aniposelib",
        "qualisys",
        "zju-mocap",
        "actorshq",
    ):
        write_rig(named, tmp_path / name, name)
        assert read_rig_of(tmp_path / name).names == named.names, name
    odd = Rig(tuple(replace(c, name=f"cam {k}: é") for k, c in enumerate(rig)))
    for name in ("easymocap", "colmap"):
        _, notes = write_rig(odd, tmp_path / f"odd-{name}", name)
        assert any("cam 0: é to cam_0___" in note for note in notes), notes
