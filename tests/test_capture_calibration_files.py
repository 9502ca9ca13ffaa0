"""Foreign calibrations: Qualisys conventions against a camera built by hand; pairing by name and number."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from capture.calibration_file import read_calibration
from capture.camera import Camera
from capture.formats.qualisys import read_qualisys
from capture.layouts import look_at
from capture.recording import RecordingError
from capture.rig import Rig

BALANCING = Path(__file__).resolve().parents[1] / ".." / "shared" / "recordings" / "balancing"


def hand_made(name: str, distance_mm: float) -> Camera:
    pose = look_at(np.array([distance_mm, 500.0, 1600]), np.array([0.0, 0, 900]), np.array([0.0, 0, 1]))
    intrinsics = np.array([[1680.25, 0.5, 540.5], [0, 1681.0, 951.25], [0, 0, 1]])
    return Camera(name, (1088, 1920), intrinsics, pose, np.array([-0.05, 0.14, 6e-4, 7e-4, 0.0]))


def as_qualisys(cameras: list[Camera]) -> str:
    """The file that Qualisys' conventions make of these cameras: 1/64 px, millimetres, rows 2 and 3
    negated."""
    text = "<?xml version='1.0' encoding='ASCII'?><calibration><cameras>"
    for camera in cameras:
        rows = np.diag([1.0, -1, -1]) @ camera.camera_from_world[:3, :3]
        r = " ".join(f'r{i + 1}{j + 1}="{rows[i, j]!r}"' for i in range(3) for j in range(3)).replace(
            "np.float64", ""
        )
        x, y, z = (float(value) for value in camera.centre)
        k = 64 * camera.intrinsics
        d = [float(value) for value in camera.distortion]
        text += f"""<camera active="1" serial="{camera.name}">
        <fov_video bottom="{camera.size[1] - 1}" left="0" right="{camera.size[0] - 1}" top="0"/>
        <transform {r.replace("(", "").replace(")", "")} x="{x!r}" y="{y!r}" z="{z!r}"/>
        <intrinsic focalLengthU="{k[0, 0]}" focalLengthV="{k[1, 1]}" centerPointU="{k[0, 2]}"
          centerPointV="{k[1, 2]}" skew="{k[0, 1]}" radialDistortion1="{d[0]}" radialDistortion2="{d[1]}"
          radialDistortion3="{d[4]}" tangentalDistortion1="{d[2]}" tangentalDistortion2="{d[3]}"/></camera>"""
    return text + "</cameras></calibration>"


def test_qualisys_conventions(tmp_path):
    given = [hand_made("cam01", 3000), hand_made("cam02", -4000)]
    path = tmp_path / "x.qca.txt"
    path.write_text(as_qualisys(given))
    for camera, found in zip(given, read_qualisys(path), strict=True):
        assert (found.name, found.size) == (camera.name, camera.size)
        points = np.random.default_rng(0).uniform(-500, 500, (20, 3)) + np.array([0, 0, 900])
        assert np.allclose(found.project(points)[0], camera.project(points)[0], atol=1e-6)
        assert np.allclose(found.project(points)[1], camera.project(points)[1])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("focalLengthU=", "otherU=", "camera cam01: focalLengthU=None in <intrinsic> is not a finite number"),
        (' y="', ' y="wide', "camera cam01: y='wide.*' in <transform> is not a finite number"),
        ("<calibration>", "<calibration", "no Qualisys calibration, the XML does not parse"),
        ("<camera ", "<kamera ", "no Qualisys calibration, the XML does not parse"),
        ('serial="cam02"', 'serial="cam01"', "two cameras share a name: cam01"),
        ('active="1"', 'active="0"', "no active <camera> in this file"),
    ],
)
def test_what_is_wrong_in_a_qualisys_file_is_named(tmp_path, old, new, words):
    path = tmp_path / "x.qca.txt"
    path.write_text(as_qualisys([hand_made("cam01", 3000), hand_made("cam02", -4000)]).replace(old, new))
    with pytest.raises(RecordingError, match=r"x\.qca\.txt: " + words):
        read_qualisys(path)


def test_a_mirrored_qualisys_rotation_is_named(tmp_path):
    path = tmp_path / "x.qca.txt"
    text = as_qualisys([hand_made("cam01", 3000)])
    for column in "123":
        text = text.replace(f'r1{column}="-', f'r1{column}="+').replace(f'r1{column}="', f'r1{column}="-')
        text = text.replace(f'r1{column}="-+', f'r1{column}="')
    path.write_text(text)
    with pytest.raises(RecordingError, match="camera cam01: mirrored calibration"):
        read_qualisys(path)


def test_cameras_are_paired_by_name_then_by_number(tmp_path):
    rig = Rig((hand_made("cam02", 3000), hand_made("cam01", -4000), hand_made("side7", 3500)))
    rig.save(tmp_path / "rig.json")
    found = read_calibration(tmp_path / "rig.json", {"cam-001": (1088, 1920), "cam02": (1088, 1920)})
    assert found.rig.names == ("cam-001", "cam02") and found.unit == "m"
    assert np.allclose(found.rig[0].centre, rig[1].centre) and np.allclose(found.rig[1].centre, rig[0].centre)
    assert found.notes == (f"{tmp_path / 'rig.json'}: calibrated but without pictures, left out: side7.",)


def test_pictures_that_do_not_fit_the_calibration_are_named(tmp_path):
    path = tmp_path / "rig.json"
    Rig((hand_made("cam01", 3000),)).save(path)
    with pytest.raises(
        RecordingError, match=r"camera cam02 has pictures but is not in this calibration .it has cam01"
    ):
        read_calibration(path, {"cam02": (1088, 1920)})
    with pytest.raises(
        RecordingError, match="camera cam01 is calibrated for 1088x1920 px, its pictures are 1080x1920"
    ):
        read_calibration(path, {"cam01": (1080, 1920)})
    other = tmp_path / "calibration.xcp2"
    other.write_text("no idea")
    with pytest.raises(RecordingError, match="unknown calibration format; known are"):
        read_calibration(other, {"cam01": (1088, 1920)})


@pytest.mark.skipif(not BALANCING.is_dir(), reason="../shared/recordings/balancing is not here")
def test_the_real_calibration_looks_at_the_subject(tmp_path):
    path = BALANCING / "calibration" / "Calib.qca.txt"
    shutil.copy(path, tmp_path / "copy.qca.txt")
    rig = read_qualisys(tmp_path / "copy.qca.txt").with_world_scaled(1e-3)
    assert rig.names == ("cam01", "cam02", "cam03", "cam04")
    for camera in rig:
        assert camera.size == (1088, 1920)
        pixels, depth = camera.project(np.array([[-1.0, 0.0, 1.0]]))
        assert 3 < depth[0] < 5 and (pixels > 0).all() and (pixels < camera.size).all()
        assert camera.up[2] > 0.5
