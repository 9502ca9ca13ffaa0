"""An empty scene from a film that somebody is in all the time."""

import cv2
import numpy as np

from capture.emptied_film import emptied

SIZE = (200, 260)  # width, height


def scene() -> np.ndarray:
    """A wall that darkens upwards and a floor with lines."""
    width, height = SIZE
    rows = np.linspace(70, 170, height)[:, None, None] * np.array([1.0, 0.98, 0.95])
    picture = np.repeat(rows, width, axis=1)
    picture[200::15] -= 12
    return picture.round().astype(np.uint8)


def film(sway_px: float, n_frames: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Somebody in a light shirt who sways about one place: pictures (T h w 3), and who is where (T h w)."""
    rng = np.random.default_rng(3)
    pictures, masks = [], []
    for k in range(n_frames):
        person = np.zeros(SIZE[::-1], np.uint8)
        x = round(100 + sway_px * np.sin(2 * np.pi * k / n_frames))
        cv2.ellipse(person, (x, 120), (22, 50), 0, 0, 360, 1, cv2.FILLED)
        cv2.circle(person, (x, 55), 14, 1, cv2.FILLED)
        cv2.rectangle(person, (x - 12, 160), (x + 12, 225), 1, cv2.FILLED)
        arm = (round(x + 45 * np.sin(k)), 95 + k)
        cv2.line(person, (x, 90), arm, 1, 9)
        picture = scene().astype(float)
        colours = np.array([[150, 60, 40], [235, 230, 220], [30, 30, 50]])
        bands = np.digitize(np.arange(SIZE[1]), [70, 160])
        picture[person > 0] = colours[np.broadcast_to(bands[:, None], person.shape)[person > 0]]
        picture += rng.normal(0, 2, picture.shape)
        pictures.append(np.clip(picture.round(), 0, 255).astype(np.uint8))
        masks.append(person > 0)
    return np.stack(pictures), np.stack(masks)


def test_somebody_who_stays_in_one_place_is_not_in_the_empty_scene() -> None:
    pictures, masks = film(sway_px=12)
    always = masks.mean(axis=0) > 0.9
    assert always.sum() > 1000, "much is never free"
    plain = np.median(pictures, axis=0)
    found, painted = emptied(pictures)
    wrong = np.abs(found.astype(float) - scene())
    assert np.abs(plain - scene())[always].mean() > 60, "the plain median shows the person"
    assert wrong[always].mean() < 8, f"{wrong[always].mean():.1f} levels where it is never free"
    assert wrong.mean() < 2
    # The person is painted over in the samples too.
    shown = np.abs(painted.astype(float) - scene())[masks]
    assert shown.mean() < 8, f"{shown.mean():.1f} levels of the person are left in the samples"


def test_where_nobody_moves_the_plain_median_stands() -> None:
    pictures = np.stack([film(sway_px=0)[0][0]] * 6)
    found, painted = emptied(pictures)
    np.testing.assert_array_equal(found, pictures[0])
    np.testing.assert_array_equal(painted, pictures)


def test_somebody_who_leaves_every_place_is_left_to_the_median() -> None:
    pictures, _ = film(sway_px=70, n_frames=24)
    found, _ = emptied(pictures)
    assert np.abs(found.astype(float) - scene()).mean() < 2
