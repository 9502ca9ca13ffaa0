"""Masks mended by what the other cameras say, and left alone where these cannot know."""

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.layouts import ring_layout
from capture.mask_repair import MaskRepair
from capture.rig import Rig
from tests.capture_scenes import PERSON, ball_mask, ball_picture

RIG = ring_layout(8, (180, 240), camera_height_m=1.6)
WALL = np.full((240, 180, 3), (90, 120, 150), np.uint8)


@pytest.fixture(scope="module")
def scene():
    truth = [ball_mask(camera, PERSON) for camera in RIG]
    pictures = [ball_picture(camera, PERSON, WALL) for camera in RIG]
    return MaskRepair.build(RIG, [truth]), truth, pictures


def below_the_knee(camera: Camera) -> np.ndarray:
    """Rows of the picture that show the lower legs."""
    (_, knee), (_, floor) = camera.project(np.array([[0, 0, 0.45], [0, 0, -0.1]]))[0]
    rows = np.zeros((240, 180), bool)
    rows[int(knee) : int(floor)] = True
    return rows


def test_sound_masks_stay(scene):
    repair, truth, pictures = scene
    assert repair.tolerance is not None and repair.tolerance <= 1
    masks, said = repair.repaired(truth, pictures, [WALL] * 8)
    assert said == [""] * 8
    assert all(np.array_equal(a, b) for a, b in zip(masks, truth, strict=True))


def test_what_the_others_deny_is_taken_away(scene):
    repair, truth, pictures = scene
    broken = [mask.copy() for mask in truth]
    cv2.circle(broken[2], (22, 215), 12, 255, -1)
    masks, said = repair.repaired(broken, pictures, [WALL] * 8)
    assert (masks[2] != truth[2]).sum() <= 8 and said[2].endswith("px taken away")
    assert [text for idx, text in enumerate(said) if idx != 2] == [""] * 7


def test_what_the_others_see_comes_back_where_the_picture_agrees(scene):
    repair, truth, pictures = scene
    broken = [mask.copy() for mask in truth]
    lost = below_the_knee(RIG[3]) & (truth[3] > 0)
    broken[3][lost] = 0
    masks, said = repair.repaired(broken, pictures, [WALL] * 8)
    assert "px given back" in said[3]
    back = masks[3] == 255
    assert (back & lost).sum() > 0.8 * lost.sum()
    assert (back & (truth[3] == 0)).sum() < 0.05 * lost.sum()


def test_nobody_knows_before_a_background_of_the_persons_colours(scene):
    repair, truth, pictures = scene
    broken, shown, behind = [m.copy() for m in truth], list(pictures), [WALL] * 8
    lost = below_the_knee(RIG[3]) & (truth[3] > 0)
    broken[3][lost] = 0
    camouflage = WALL.copy()
    camouflage[below_the_knee(RIG[3])] = (205, 150, 125)  # the person's skin
    behind[3] = camouflage
    shown[3] = ball_picture(RIG[3], PERSON, camouflage)
    shown[3][lost] = (205, 150, 125)
    masks, said = repair.repaired(broken, shown, behind)
    assert "unknown" in said[3]
    assert (masks[3][lost] == 128).mean() > 0.3 and (masks[3] == 255)[lost].sum() < 0.05 * lost.sum()
    assert (masks[3][truth[3] == 0] == 255).sum() == 0


def test_a_plain_background_is_a_real_gap(scene):
    """The others' hull has parts of its own making; where the wall is in plain sight there is nobody."""
    repair, truth, pictures = scene
    broken, shown = [m.copy() for m in truth], list(pictures)
    lost = below_the_knee(RIG[3]) & (truth[3] > 0)
    broken[3][lost] = 0
    shown[3] = np.where(lost[..., None], WALL, pictures[3])
    masks, _ = repair.repaired(broken, shown, [WALL] * 8)
    assert ((masks[3] == 255) & lost).sum() < 0.05 * lost.sum()
    assert (masks[3] == 128).sum() < 0.05 * lost.sum()


def test_few_cameras_and_wrong_calibrations_change_nothing(scene):
    _, truth, pictures = scene
    three = Rig(RIG.cameras[:3])
    assert MaskRepair.build(three, [truth[:3]]).tolerance is None
    # Every second camera 6 degrees off: no widening of use makes the masks agree.
    turned = []
    for idx, camera in enumerate(RIG):
        turn = np.eye(4)
        turn[:3, :3] = cv2.Rodrigues(np.array([0, np.radians(6.0 if idx % 2 else -6.0), 0]))[0]
        turned.append(
            Camera(
                camera.name,
                camera.size,
                camera.intrinsics,
                turn @ camera.camera_from_world,
                camera.distortion,
            )
        )
    off = MaskRepair.build(Rig(tuple(turned)), [truth])
    masks, said = off.repaired(truth, pictures, [WALL] * 8)
    assert off.tolerance is None and said == [""] * 8
    assert all(np.array_equal(a, b) for a, b in zip(masks, truth, strict=True))
    # A camera without a mask asks and answers nothing.
    known = [*truth[:7], None]
    masks, _ = MaskRepair.build(RIG, [known]).repaired(known, [*pictures[:7], None], [WALL] * 8)
    assert masks[7] is None and all(np.array_equal(a, b) for a, b in zip(masks[:7], truth[:7], strict=True))
