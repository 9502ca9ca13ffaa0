"""Rig: load(save(x)) == x; layouts see the whole volume that a person moves in."""

import json

import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import cage_layout, dome_layout, ring_layout
from capture.projection_split import camera_from_projection
from capture.recording import RecordingError
from capture.rig import Rig

LAYOUTS = (dome_layout, ring_layout, cage_layout)


def test_load_gives_back_every_bit(tmp_path):
    ring = ring_layout(3)
    exact = camera_from_projection("matrix", (640, 480), ring[1].projection_matrix * np.pi)
    lens = Camera(
        "lens",
        (10, 20),
        ring[0].intrinsics / 3,
        ring[2].camera_from_world,
        np.array([0.1, 1 / 3, 0, 1e-17, 0]),
    )
    rig = Rig((*ring.cameras, exact, lens))
    rig.save(tmp_path / "rig.json")
    assert Rig.load(tmp_path / "rig.json") == rig
    assert [path.name for path in tmp_path.iterdir()] == ["rig.json"]


def test_a_foreign_file_is_refused(tmp_path):
    path = tmp_path / "rig.json"
    for text, words in (
        ("{", "not a JSON file"),
        ("[]", "no rig of ours"),
        ('{"format": "bodyhull-rig", "version": 99}', "rig version 99, this program reads version 1"),
        ('{"format": "bodyhull-rig", "version": 1, "cameras": [{"name": "a"}]}', "a camera lacks 'size'"),
    ):
        path.write_text(text)
        with pytest.raises(RecordingError, match=words):
            Rig.load(path)
    ring_layout(2).save(path)
    content = json.loads(path.read_text())
    content["cameras"][1]["camera_from_world"][0][0] = float("nan")
    path.write_text(json.dumps(content))
    with pytest.raises(
        RecordingError, match="camera cam-001: camera_from_world holds a value that is not a finite"
    ):
        Rig.load(path)


def test_names_are_unique():
    camera = ring_layout(1)[0]
    with pytest.raises(ValueError, match="two cameras share a name: cam-000"):
        Rig((camera, camera))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("size", [(1024, 1024), (640, 480), (1080, 1920)])
@pytest.mark.parametrize("n_cameras", [1, 4, 16, 68])
def test_every_camera_sees_a_tall_person_anywhere_near_the_middle(layout, size, n_cameras):
    rig = layout(n_cameras, size)
    assert len(rig) == n_cameras and len(set(rig.names)) == n_cameras
    angle = np.linspace(0, 2 * np.pi, 20)
    rim = np.column_stack([np.cos(angle), np.sin(angle)])
    # Person of 1.9 m with an arm's reach of 0.3 m over the head, within 1 m of the middle.
    volume = np.vstack([np.column_stack([rim, np.full(20, z)]) for z in (0, 1.0, 1.9, 2.2)])
    for camera in rig:
        pixels, depth = camera.project(volume)
        assert (depth > 0).all()
        assert (pixels >= -0.5).all() and (pixels <= np.array(size) - 0.5).all()
        assert camera.up[2] > 0.3, "upright pictures"
        assert 3.0 <= np.linalg.norm(camera.centre - [0, 0, 1.1]) <= 5.2


@pytest.mark.parametrize("layout", LAYOUTS)
def test_another_up_axis_turns_the_whole_rig(layout):
    upright, turned = layout(6), layout(6, up=(0.0, 1.0, 0.0))
    points = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    for a, b in zip(upright, turned, strict=True):
        assert np.isclose(b.centre[1], a.centre[2])
        assert np.isclose(np.linalg.det(b.camera_from_world[:3, :3]), 1)
    # The same heights above the floor are seen: a vertical line through the middle keeps its pixels.
    line = np.column_stack([np.zeros(30), np.zeros(30), points[:, 2] + 1])
    for a, b in zip(upright, turned, strict=True):
        assert np.allclose(a.project(line)[0], b.project(line[:, [0, 2, 1]])[0])
