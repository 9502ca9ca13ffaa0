"""A screen of one colour behind the subject: how much of the screen's colour a pixel holds, two thresholds.

Colour differences (Cb, Cr) are divided by brightness, so that folds and shadows of the screen stay the
screen. Along the direction from grey to the key colour, the screen lies near one, the person near nought or
below, and the person's own parts that the screen lights up (spill, reflections on legs and shiny shoes) in
between; what lies beside that direction is another colour. Below the low threshold is the person, above the
high one the screen; what is between goes with the side that it has more of around it. Where an empty picture
shows no screen (the studio beyond its edge), the difference to that picture decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.difference import Box, coarse_of, full_size, without_specks
from capture.plate_difference import PlateDifference, PlateLook

_LOW, _HIGH = 0.45, 0.7  # of the key's strength
_ASIDE = 0.8  # what a unit beside the key's direction takes away
_NEAR_SHARE = 200  # of the longer side: the radius in which a doubtful pixel looks for its side
_STEEP = 3.0  # a level of colour in the tests' bytes
_LEAST_STRENGTH = 0.12  # of a key colour: colour difference over brightness
_SCREEN_SHARE = 0.25  # of a picture, that makes it one before a screen
_DARK = 24.0  # levels of brightness below which colours mean little

Picture = UInt8[np.ndarray, "_h _w 3"]
Mask = UInt8[np.ndarray, "_h _w"]


@dataclass(frozen=True)
class KeyDifference:
    """A `Difference` to a screen. key : (2,) Cb and Cr over brightness, of the screen; beyond : what to do
    where `screen` (coarse, 255 where the empty picture shows the screen) has none; None: screen
    everywhere."""

    key: Float[np.ndarray, "2"]
    step: int
    beyond: PlateDifference | None = None
    screen: Mask | None = None

    @staticmethod
    def of_plate(empty: PlateDifference, key: Float[np.ndarray, "2"]) -> KeyDifference:
        """Before a screen that `empty` shows, perhaps not all over."""
        step = empty.step
        small = coarse_of(empty.plate, step)
        screen = np.where(_keyness(small, key) > _HIGH, 255, 0).astype(np.uint8)
        screen = cv2.morphologyEx(screen, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)).astype(np.uint8)
        if screen.all():
            return KeyDifference(key, step)
        return KeyDifference(key, step, empty, screen)

    def look(self, picture: Picture) -> KeyLook:
        """How much of the key each pixel holds."""
        small = coarse_of(picture, self.step)
        other = None if self.beyond is None else self.beyond.look(picture)
        found = _person(small, self.key)
        if other is not None and self.screen is not None:
            found = np.where(self.screen > 0, found, other.coarse)
        coarse = without_specks(found.astype(np.uint8))
        return KeyLook(self, picture, other, coarse, cv2.countNonZero(coarse) / coarse.size)


@dataclass(frozen=True)
class KeyLook:
    """One picture before a screen."""

    model: KeyDifference
    picture: Picture
    other: PlateLook | None
    coarse: Mask
    changed: float

    def fine(self, box: Box) -> Mask:
        """255 in the box on what is no screen."""
        person = _person(np.ascontiguousarray(self.picture[box]), self.model.key)
        if self.other is None or self.model.screen is None:
            return person
        screen = full_size(self.model.screen, self.model.step, box)
        if screen.all():
            return person
        return np.where(screen > 0, person, self.other.fine(box)).astype(np.uint8)


def find_key(picture: Picture) -> tuple[Float[np.ndarray, "2"], float] | None:
    """The screen's colour in an empty picture (or the median over a film), as Cb and Cr over brightness, and
    what share of the picture it covers; None where no strong colour covers a quarter of it."""
    step = max(1, max(picture.shape) // 256)
    small = np.ascontiguousarray(picture[::step, ::step])
    brightness, chroma = _chroma(small)
    strength = np.linalg.norm(chroma, axis=-1)
    strong = (strength > _LEAST_STRENGTH) & (brightness > _DARK)
    if strong.mean() < _SCREEN_SHARE:
        return None
    angle = np.arctan2(chroma[..., 1], chroma[..., 0])[strong]
    counts, edges = np.histogram(angle, bins=36, range=(-np.pi, np.pi))
    around = counts + np.roll(counts, 1) + np.roll(counts, -1)
    middle = edges[int(around.argmax())] + np.pi / 36
    near = np.abs((angle - middle + np.pi) % (2 * np.pi) - np.pi) < np.pi / 12
    key = np.median(chroma[strong][near], axis=0)
    share = float((_keyness(small, key) > _HIGH).mean())
    return (key.astype(np.float64), share) if share >= _SCREEN_SHARE else None


def key_of_colour(red: int, green: int, blue: int) -> Float[np.ndarray, "2"] | None:
    """The same of a colour (0 to 255 each); None where it is too near to grey to be a key."""
    brightness, chroma = _chroma(np.array([[[red, green, blue]]], np.uint8))
    if np.linalg.norm(chroma) < _LEAST_STRENGTH or brightness[0, 0] < _DARK:
        return None
    return chroma[0, 0].astype(np.float64)


def _chroma(picture: Picture) -> tuple[Float[np.ndarray, "_h _w"], Float[np.ndarray, "_h _w 2"]]:
    converted = cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb).astype(np.float32)
    brightness = np.maximum(converted[..., 0], _DARK)
    return brightness, (converted[..., 2:0:-1] - 128.0) / brightness[..., None]


def _keyness(picture: Picture, key: Float[np.ndarray, "2"]) -> Float[np.ndarray, "_h _w"]:
    """How much of the key each pixel holds: 1 on the screen, 0 and less on other colours."""
    _, chroma = _chroma(picture)
    along, aside = _directions(key)
    return chroma @ along.astype(np.float32) - np.float32(_ASIDE) * np.abs(chroma @ aside.astype(np.float32))


def _directions(key: Float[np.ndarray, "2"]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    strength = float(np.linalg.norm(key))
    return key / strength**2, np.array([-key[1], key[0]]) / strength**2


def _tests(key: Float[np.ndarray, "2"]) -> Float[np.ndarray, "4 4"]:
    """Four linear functions of a picture's RGB (and 1), in bytes with 128 for nought.

    "Keyness below t" is min(along + aside, along - aside) < t times brightness, linear in the levels: the
    first two functions are at least 128 on what passes the low threshold, the others the high one.
    """
    grey = np.array([0.299, 0.587, 0.114, 0.0])
    blue = 0.564 * (np.array([0.0, 0.0, 1.0, 0.0]) - grey)
    red = 0.713 * (np.array([1.0, 0.0, 0.0, 0.0]) - grey)
    along, aside = (part[0] * blue + part[1] * red for part in _directions(key))
    lit = grey + np.array([0.0, 0.0, 0.0, _DARK / 4])
    rows = [along + side * _ASIDE * aside - t * lit for t in (_LOW, _HIGH) for side in (1, -1)]
    return _STEEP * np.array(rows) + np.array([0.0, 0.0, 0.0, 128.0])


def _person(picture: Picture, key: Float[np.ndarray, "2"]) -> Mask:
    passed = cv2.transform(picture, _tests(key))
    top = np.full(4, 255.0)
    sure = cv2.inRange(passed, np.array([0.0, 0.0, 128.0, 128.0]), top)  # the screen
    maybe = cv2.inRange(passed, np.array([128.0, 128.0, 0.0, 0.0]), top)
    person = cv2.bitwise_not(maybe)
    doubtful = cv2.subtract(maybe, sure)
    if cv2.countNonZero(doubtful):
        side = 2 * max(2, round(max(picture.shape) / _NEAR_SHARE)) + 1
        around = cv2.compare(cv2.blur(person, (side, side)), cv2.blur(sure, (side, side)), cv2.CMP_GE)
        person = cv2.bitwise_or(person, cv2.bitwise_and(doubtful, around))
    return person.astype(np.uint8, copy=False)
