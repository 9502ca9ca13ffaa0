"""Silhouettes from files: any encoding gives the same mask; what is odd is noticed."""

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.silhouette_files import mask_from_image, read_silhouette, undistort_silhouette

PERSON = np.zeros((60, 50), bool)
PERSON[10:50, 15:35] = True
PERSON[30:50, 23:27] = False


def as_written(kind: str) -> np.ndarray:
    grey = np.where(PERSON, 255, 0).astype(np.uint8)
    alpha = np.dstack([np.full((*PERSON.shape, 3), 90, np.uint8), grey])
    return {
        "grey": grey,
        "16 bit": grey.astype(np.uint16) * 257,
        "16 bit labels": PERSON.astype(np.uint16) * 3,
        "labels": PERSON.astype(np.uint8),
        "colour": np.dstack([grey] * 3),
        "coloured": np.dstack([np.zeros_like(grey), np.zeros_like(grey), grey]),
        "alpha": alpha,
        "opaque": np.dstack([grey, grey, grey, np.full_like(grey, 255)]),
    }[kind]


@pytest.mark.parametrize(
    "kind", ["grey", "16 bit", "16 bit labels", "labels", "colour", "coloured", "alpha", "opaque"]
)
def test_every_encoding_gives_the_same_mask(tmp_path, kind):
    path = tmp_path / "silh_000000.png"
    cv2.imwrite(str(path), as_written(kind))
    found = read_silhouette(path)
    assert found.problem is None and not found.looks_inverted
    assert np.array_equal(found.mask, np.where(PERSON, 255, 0))


def test_one_bit_files_are_read(tmp_path):
    path = tmp_path / "silh_000000.png"
    cv2.imwrite(str(path), as_written("grey"), [cv2.IMWRITE_PNG_BILEVEL, 1])
    assert path.read_bytes()[24] == 1, "bit depth"
    assert np.array_equal(read_silhouette(path).mask, np.where(PERSON, 255, 0))


def test_unknown_stays_unknown():
    image = np.where(PERSON, 255, 0).astype(np.uint8)
    image[:, :5] = 128
    mask, problem = mask_from_image(image)
    assert problem is None and np.array_equal(mask, image)


def test_blurred_masks_are_cut_at_half_and_told():
    large = cv2.resize(as_written("grey"), None, fx=6, fy=6, interpolation=cv2.INTER_NEAREST)
    blurred = cv2.GaussianBlur(large, (0, 0), 2.0)
    mask, problem = mask_from_image(blurred)
    assert problem is not None and "not binary" in problem and "cut at half" in problem
    assert np.array_equal(mask == 255, blurred > 127)


def test_a_photograph_is_no_silhouette():
    photograph = np.random.default_rng(0).integers(0, 255, (60, 50, 3)).astype(np.uint8)
    mask, problem = mask_from_image(cv2.GaussianBlur(photograph, (0, 0), 1.0))
    assert mask is None and problem is not None and "not a silhouette" in problem


def test_inverted_masks_are_noticed_and_swapped_on_request(tmp_path):
    path = tmp_path / "silh_000000.png"
    cv2.imwrite(str(path), 255 - as_written("grey"))
    assert read_silhouette(path).looks_inverted
    swapped = read_silhouette(path, inverted=True)
    assert not swapped.looks_inverted and np.array_equal(swapped.mask, np.where(PERSON, 255, 0))


def test_undistortion_tells_background_from_never_seen():
    intrinsics = np.array([[60.0, 0, 49.5], [0, 60, 49.5], [0, 0, 1]])
    camera = Camera("a", (100, 100), intrinsics, np.eye(4), np.array([0.25, 0, 0, 0]))
    mask = np.zeros((100, 100), np.uint8)
    mask[40:60, 40:60] = 255
    mask[:, 90:] = 128
    seen = undistort_silhouette(camera, mask)
    assert set(np.unique(seen)) == {0, 128, 255}
    assert seen[0, 0] == 128, "outside the filmed picture"
    assert seen[50, 99] == 128, "unknown in the file"
    assert seen[50, 20] == 0 and seen[50, 50] == 255
    pixels = np.stack(np.meshgrid(np.arange(100.0), np.arange(100.0)), axis=-1).reshape(-1, 2)
    source = camera.distort(pixels).reshape(100, 100, 2)
    expected = (np.abs(source - 49.5) < 10).all(axis=2)
    differs = expected != (seen == 255)
    assert differs.sum() <= 4, "the edge lies where the half grey value lies"
