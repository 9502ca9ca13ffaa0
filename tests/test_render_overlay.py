"""Overlays change what the body covers and nothing else; agreement by closed forms."""

import numpy as np
import pytest

from capture.layouts import ring_layout
from render.overlay import (
    MISSED_RGB,
    OUTLINE_RGB,
    SPILLED_RGB,
    agreement_picture,
    captioned,
    crop_around,
    intersection_over_union,
    outline,
    overlay,
    overlay_frames,
    shrunk,
)
from render.scene import Renderer, Surface

SIZE = (160, 120)


@pytest.fixture(scope="module")
def scene():
    camera = ring_layout(3, SIZE)[1]
    square = np.array([[50.0, 30.0], [110.0, 30.0], [110.0, 90.0], [50.0, 90.0]])
    surface = Surface(camera.unproject(square, np.full(4, 4.0)), np.array([[0, 1, 2], [0, 2, 3]]))
    picture = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    return camera, surface, picture


def test_only_what_the_body_covers_changes(scene) -> None:
    camera, surface, picture = scene
    given = picture.copy()
    out = overlay(camera, [surface], picture)
    seen = Renderer(*SIZE).colour([surface], camera)
    assert np.array_equal(out[seen.coverage == 0], picture[seen.coverage == 0])
    assert (out[seen.mask] != picture[seen.mask]).any(1).mean() > 0.99
    assert np.array_equal(picture, given), "the picture handed in was written to"


def test_strength_0_shows_the_picture_and_1_the_body(scene) -> None:
    camera, surface, picture = scene
    seen = Renderer(*SIZE).colour([surface], camera)
    inner = seen.mask & ~outline(seen.mask, 2)
    assert np.array_equal(overlay(camera, [surface], picture, strength=0.0)[inner], picture[inner])
    solid = overlay(camera, [surface], picture, strength=1.0)[inner].astype(int)
    assert np.abs(solid - seen.colour[inner]).max() <= 1


def test_the_outline_is_drawn(scene) -> None:
    camera, surface, _ = scene
    out = overlay(camera, [surface], np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    edge = outline(Renderer(*SIZE).silhouette([surface], camera)[0])
    assert edge.sum() >= 4 * 55
    assert np.abs(out[edge].astype(int) - OUTLINE_RGB).mean() < 60


def test_without_a_picture_the_silhouette_is_white_on_grey(scene) -> None:
    camera, surface, _ = scene
    silhouette = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    silhouette[:20], silhouette[20:25] = 255, 128
    out = overlay(camera, [], None, silhouette)
    assert [out[k, 3].tolist() for k in (0, 22, 60)] == [[255] * 3, [64] * 3, [96] * 3]
    assert (overlay(camera, [], None)[:, :] == 96).all()
    assert (overlay(camera, [surface], None, silhouette)[60, 80] != 96).any()


def test_another_size_is_refused(scene) -> None:
    camera, _, picture = scene
    with pytest.raises(ValueError, match="cam-001: the picture is 100 x 120 pixels, the camera 160 x 120"):
        overlay(camera, [], picture[:, :100])
    with pytest.raises(ValueError, match="the silhouette is 160 x 60 pixels"):
        overlay(camera, [], picture, np.zeros((60, 160), np.uint8))


def test_intersection_over_union_of_shifted_rectangles() -> None:
    silhouette = np.zeros((100, 100), np.uint8)
    silhouette[20:60, 20:60] = 255
    for shift in (0, 7, 20, 40):
        mask = np.zeros((100, 100), bool)
        mask[20:60, 20 + shift : 60 + shift] = True
        assert intersection_over_union(mask, silhouette) == pytest.approx((40 - shift) / (40 + shift))


def test_unknown_pixels_do_not_count() -> None:
    silhouette = np.zeros((10, 10), np.uint8)
    silhouette[:, :4], silhouette[:, 4:] = 255, 128
    mask = np.ones((10, 10), bool)
    assert intersection_over_union(mask, silhouette) == 1.0
    assert np.isnan(intersection_over_union(mask, np.full((10, 10), 128, np.uint8)))
    assert np.isnan(intersection_over_union(~mask, np.zeros((10, 10), np.uint8)))


def test_the_difference_picture_s_colours() -> None:
    mask = np.array([[True, True, False, False, True]])
    silhouette = np.array([[255, 0, 255, 0, 128]], np.uint8)
    out = agreement_picture(mask, silhouette)[0].tolist()
    assert out == [[236] * 3, list(SPILLED_RGB), list(MISSED_RGB), [58] * 3, [30] * 3]


def test_crop_holds_every_pixel() -> None:
    mask = np.zeros((80, 60), bool)
    mask[10:30, 40:58] = True
    rows, columns = crop_around([mask, np.zeros_like(mask)])
    assert mask[rows, columns].sum() == mask.sum()
    assert (rows.stop - rows.start) < 40 and columns.stop == 60
    assert crop_around([np.zeros((5, 5), bool)]) is None


def test_frames_for_a_film(scene) -> None:
    camera, surface, picture = scene
    views = [([surface], picture, None), ([], None, None)]
    frames = list(overlay_frames(camera, views, longest_px=80, captions=["frame 0", ""]))
    assert [f.shape for f in frames] == [(60, 80, 3)] * 2
    plain = list(overlay_frames(camera, views, longest_px=80))
    assert (frames[0] != plain[0]).any() and np.array_equal(frames[1], plain[1])
    changed = np.flatnonzero((frames[0] != plain[0]).any((1, 2)))
    assert changed.min() > 30, "the caption belongs into the lower corner"


def test_small_pictures_stay_as_they_are() -> None:
    image = np.zeros((30, 40, 3), np.uint8)
    assert shrunk(image, 40) is image
    assert captioned(image, "") is not image
