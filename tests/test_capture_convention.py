"""How 3x4 matrices count pixels is told from the silhouettes; sound ones are left as they are."""

import cv2
import numpy as np
import pytest

from capture.calibration_file import read_calibration
from capture.camera import Camera
from capture.convention import Convention, agreement, settle_convention
from capture.layouts import dome_layout, ring_layout
from capture.projection_split import camera_from_projection
from capture.recording import RecordingError, open_recording
from capture.rig import Rig
from tests.capture_scenes import PERSON, ball_mask, silhouette_path, write_inria

RIG = dome_layout(7, (360, 300))
CONVENTIONS = [
    Convention("rows counted from the bottom"),
    Convention("rows counted from the bottom", 1.0, 0.5),
    Convention("columns counted from the right"),
    Convention("rows from the bottom and columns from the right"),
    Convention("rows and columns swapped"),
    Convention("as given", 0.5),
    Convention("as given", 0.25),
    Convention("as given", 2.0),
    Convention("rows counted from the bottom", 0.5),
    Convention("as given", 1.0, 0.5),
]


def planted(rig: Rig, convention: Convention) -> Rig:
    """As another program would give it: every matrix in that convention."""

    def one(camera: Camera) -> Camera:
        matrix = np.linalg.inv(convention.ours_from_file(camera.size)) @ camera.projection_matrix
        return camera_from_projection(camera.name, camera.size, matrix)

    return Rig(tuple(one(camera) for camera in rig))


def frames_of(rig: Rig, n_frames: int = 2) -> list[list[np.ndarray]]:
    return [
        [ball_mask(c, PERSON + np.array([0.15 * k, 0.1 * k, 0, 0])) for c in rig] for k in range(n_frames)
    ]


def write_planted(root, rig: Rig, convention: Convention):
    """A recording whose silhouettes are right and whose matrices count otherwise."""
    write_inria(root, rig)
    for k, camera in enumerate(planted(rig, convention)):
        np.savetxt(root / "setup" / f"cam{k:02d}.txt", camera.projection_matrix, fmt="%.17g")
    return root


def test_a_convention_says_where_pixels_lie():
    """By hand: a picture of 300 columns and 200 rows."""

    def ours(convention: Convention, u: float, v: float) -> list[float]:
        return (convention.ours_from_file((300, 200)) @ [u, v, 1])[:2].round(9).tolist()

    assert ours(Convention(), 10, 20) == [10, 20]
    assert ours(Convention(first_px=0.5), 10.5, 20.5) == [10, 20]
    assert ours(Convention("rows counted from the bottom"), 10, 0) == [10, 199]
    assert ours(Convention("columns counted from the right"), 0, 20) == [299, 20]
    assert ours(Convention("rows and columns swapped"), 20, 10) == [10, 20]
    # The corner of the picture stays where it is when pixels get twice as large.
    assert ours(Convention(factor=0.5), -0.5, -0.5) == [-0.5, -0.5]
    assert ours(Convention(factor=0.5), 599.5, 399.5) == [299.5, 199.5]
    assert ours(Convention(factor=0.5, first_px=0.5), 600, 400) == [299.5, 199.5]


@pytest.mark.parametrize("convention", CONVENTIONS, ids=str)
def test_every_convention_is_recognised_and_undone(convention):
    given = planted(RIG, convention)
    found = settle_convention(given, frames_of(RIG))
    assert (found.convention.axes, found.convention.factor) == (convention.axes, convention.factor)
    points = PERSON[:, :3].copy()
    for camera, same in zip(RIG, found.rig, strict=True):
        moved = np.abs(camera.project(points)[0] - same.project(points)[0]).max()
        # In matrices for other picture sizes half a pixel is another length: it may stay undecided.
        assert moved < (1e-6 if convention.factor == 1 else 0.3), moved
        assert (same.project(points)[1] > 0).all()


@pytest.mark.parametrize("n_cameras", [4, 9])
@pytest.mark.parametrize("layout", [ring_layout, dome_layout])
def test_sound_matrices_are_not_touched(layout, n_cameras):
    rig = planted(layout(n_cameras, (240, 320)), Convention())
    found = settle_convention(rig, frames_of(rig))
    assert found.rig is rig and found.convention == Convention() and not found.doubts
    assert agreement(rig, frames_of(rig)[0]) > 0.97


def test_a_rough_calibration_is_not_taken_for_another_convention():
    """Cameras that are 3 px off and silhouettes that lack a leg agree badly, but nothing else is better."""
    rng = np.random.default_rng(3)
    rough = Rig(
        tuple(
            camera_from_projection(
                c.name, c.size, np.array([[1, 0, u], [0, 1, v], [0, 0, 1]]) @ c.projection_matrix
            )
            for c, (u, v) in zip(RIG, rng.normal(0, 3, (len(RIG), 2)), strict=True)
        )
    )
    frames = frames_of(RIG)
    for mask in frames[0][:2]:
        mask[200:] = 0
    found = settle_convention(rough, frames)
    assert (found.convention.axes, found.convention.factor) == ("as given", 1.0)


def test_without_three_silhouettes_nothing_is_told():
    given = planted(RIG, Convention("rows counted from the bottom"))
    masks = [mask if k < 2 else None for k, mask in enumerate(frames_of(RIG)[0])]
    assert settle_convention(given, [masks]).rig is given


def test_a_recording_says_what_was_inferred(tmp_path):
    root = write_planted(tmp_path, RIG, Convention("rows counted from the bottom", 0.5))
    recording = open_recording(root)
    told = [note for note in recording.notes if note.startswith("The matrices count pixels otherwise")]
    assert len(told) == 1 and told[0] not in recording.settled
    assert "rows counted from the bottom, for pictures 2 times as large" in told[0]
    points = PERSON[:, :3].copy()
    for camera, same in zip(RIG, recording.rig, strict=True):
        assert np.abs(camera.project(points)[0] - same.project(points)[0]).max() < 0.3


def test_half_a_pixel_is_converted_and_told(tmp_path):
    recording = open_recording(write_planted(tmp_path, RIG, Convention(first_px=0.5)))
    told = [note for note in recording.settled if note.startswith("Pixel centres of the matrices: at 0.5")]
    assert len(told) == 1 and "they were converted" in told[0]
    points = PERSON[:, :3].copy()
    for camera, same in zip(RIG, recording.rig, strict=True):
        assert np.abs(camera.project(points)[0] - same.project(points)[0]).max() < 1e-6
    plain = open_recording(write_inria(tmp_path / "plain", RIG))
    assert any(note.startswith("Pixel centres of the matrices: at whole numbers") for note in plain.settled)


def test_a_mirrored_world_is_still_refused(tmp_path):
    root = write_inria(tmp_path, RIG, world_change=np.diag([1.0, -1, 1, 1]))
    with pytest.raises(RecordingError, match="mirrored calibration"):
        open_recording(root)


def test_a_rig_of_known_convention_is_taken_as_it_is(tmp_path):
    """Our own file says how it counts: silhouettes do not overrule it."""
    root = write_planted(tmp_path, RIG, Convention(first_px=0.5))
    shifted = open_recording(root).calibration
    planted(RIG, Convention(first_px=0.5)).save(tmp_path / "mine.json")
    assert read_calibration(root / "setup", dict.fromkeys(RIG.names, RIG[0].size)).leaves_open
    recording = open_recording(root, calibration=tmp_path / "mine.json")
    assert not any("Pixel centres" in note for note in recording.notes)
    assert np.abs(recording.rig[0].intrinsics[:2, 2] - shifted[0].intrinsics[:2, 2] - 0.5).max() < 1e-6


def test_a_frame_that_cannot_be_read_does_not_stop_it(tmp_path):
    root = write_planted(tmp_path, RIG, Convention("rows counted from the bottom"))
    for k in range(len(RIG)):
        cv2.imwrite(str(silhouette_path(root, k, 1)), np.zeros((300, 360), np.uint8))
    assert any("rows counted from the bottom" in note for note in open_recording(root).notes)
