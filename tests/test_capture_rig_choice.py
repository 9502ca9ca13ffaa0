"""A calibration without pictures: read, stood round the origin, thinned out, resized."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.camera import Camera
from capture.errors import RecordingError
from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from capture.rig_choice import numbered, read_rig, resized, spread_subset, stood_round_origin
from render.synthetic import write_setup

POINTS = np.array([[0.1, -0.2, 0.3], [0.4, 0.3, 1.2], [-0.3, 0.1, 1.9]])


def moved(rig: Rig, world_from_old: np.ndarray) -> Rig:
    old_from_world = np.linalg.inv(world_from_old)
    return Rig(tuple(replace(c, camera_from_world=c.camera_from_world @ old_from_world) for c in rig))


def test_a_matrix_folder_needs_a_picture_size_and_gives_the_same_pixels(tmp_path: Path) -> None:
    rig = dome_layout(5, (640, 480))
    write_setup(tmp_path, rig)
    with pytest.raises(RecordingError, match="matrices do not say how large the pictures are"):
        read_rig(tmp_path)
    back, unit = read_rig(tmp_path, (640, 480))
    assert unit is None
    for camera, same in zip(rig, back, strict=True):
        assert np.abs(camera.project(POINTS)[0] - same.project(POINTS)[0]).max() < 1e-6


def test_a_rig_file_is_read_with_its_sizes_and_an_unknown_one_is_refused(tmp_path: Path) -> None:
    rig = ring_layout(3, (320, 200))
    rig.save(tmp_path / "rig.json")
    back, unit = read_rig(tmp_path / "rig.json")
    assert unit == "m"
    assert [camera.size for camera in back] == [(320, 200)] * 3
    (tmp_path / "rig.yaml").write_text("cameras: 3")
    with pytest.raises(RecordingError, match="unknown calibration format"):
        read_rig(tmp_path / "rig.yaml")
    with pytest.raises(RecordingError, match="no such calibration"):
        read_rig(tmp_path / "absent.json")


def test_a_rig_in_another_world_and_unit_comes_to_stand_round_the_origin() -> None:
    rig = dome_layout(12, (400, 400))
    turn = np.array([[1.0, 0, 0, 2.0], [0, 0, -1, 3.0], [0, 1, 0, -1.0], [0, 0, 0, 1]])  # y is up there
    elsewhere = moved(rig, turn).with_world_scaled(1e3)
    back = stood_round_origin(elsewhere, "mm")
    # The layout aims 1.1 m above its floor; the floor of a calibration is guessed a metre under the aim.
    heights = back.centres[:, 2] - rig.centres[:, 2]
    assert np.abs(heights + 0.1).max() < 0.01
    from_axis = [np.linalg.norm(r.centres[:, :2], axis=1) for r in (back, rig)]
    assert np.abs(from_axis[0] - from_axis[1]).max() < 0.01
    with pytest.raises(RecordingError, match="--units"):
        stood_round_origin(elsewhere, None)


def test_the_chosen_few_stand_farther_apart_than_the_first_few() -> None:
    rig = ring_layout(24)
    target = np.array([0, 0, 1.0])

    def least_angle(some: Rig) -> float:
        away = some.centres - target
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        return float(np.degrees(np.arccos(np.clip(away @ away.T - 2 * np.eye(len(some)), -1, 1)).min()))

    chosen = spread_subset(rig, 4, target)
    assert len(set(chosen.names)) == 4
    assert least_angle(chosen) > 60
    assert least_angle(Rig(rig.cameras[:4])) < 20
    assert spread_subset(rig, 24, target).names == rig.names
    with pytest.raises(RecordingError, match="25 cameras asked for; the rig has 24"):
        spread_subset(rig, 25, target)


@pytest.mark.parametrize("given", [False, True])
def test_resized_pictures_show_the_same_view(given: bool) -> None:
    rig = ring_layout(2, (600, 400))
    if given:
        rig = Rig(tuple(replace(c, projection=c.projection_matrix.copy()) for c in rig))
    half = resized(rig, 300)
    for camera, small in zip(rig, half, strict=True):
        assert small.size == (300, 200)
        before, after = camera.project(POINTS)[0], small.project(POINTS)[0]
        assert np.abs((after + 0.5) - (before + 0.5) / 2).max() < 1e-9
    assert numbered(half).names == ("cam-000", "cam-001")
    assert isinstance(half[0], Camera)
