"""Difference to a plate's mean, beyond each pixel's own spread, shadows told apart by their colour.

A shadow dims all channels alike: the picture there is the plate times one factor below one (Horprasert,
Harwood, Davis 1999). Grey clothes before a grey wall look the same, so what looks like a shadow is one only
where it borders on the background rather than on the person.

OpenCV calls on bytes only, the fine look in the subject's box: a picture of four megapixels takes about as
long as the plain difference and threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.difference import Box, coarse_of, coarse_step, full_size, without_specks
from capture.plates import Plate

_SPREADS = 4.0  # how many standard deviations are still the background
_LEAST_LEVELS = 12.0  # rounding, compression, the scene's own small changes
_SINGLE_LEVELS = 22.0  # where a single picture tells nothing of the spread
_GAIN_NOTICED = 0.01
_SHADE_LOW, _SHADE_HIGH = 0.45, 0.985
_SHADE_RESIDUE = 9  # levels that a channel may be off the plate's colour, dimmed
_SHADE_BORDER = 0.35  # a shadow's rim touches the person by less
_UNIT = 128  # of ratios kept as bytes
_HALVED = (np.arange(256) // 2).astype(np.uint8)

Picture = UInt8[np.ndarray, "_h _w 3"]


@dataclass(frozen=True)
class PlateDifference:
    """A `Difference` to one camera's plate. low, high : (h w 3), the range that is still the background;
    plate : its mean; grey : (h w), its brightness; step : of the coarse look; small : the same three for it,
    and the plate."""

    low: Picture
    high: Picture
    plate: Picture
    grey: UInt8[np.ndarray, "_h _w"]
    step: int
    small: tuple[Picture, Picture, Picture, UInt8[np.ndarray, "_h _w"]]
    shadows: bool = True

    @staticmethod
    def of_plate(plate: Plate, shadows: bool = True) -> PlateDifference:
        """shadows: tell them apart, or call everything that differs the person."""
        if plate.spread is None:
            reach = np.full(plate.mean.shape, _SINGLE_LEVELS, np.float32)
            # Taken at another moment: edges may lie half a pixel elsewhere.
            kernel = np.ones((3, 3), np.uint8)
            top, bottom = cv2.dilate(plate.mean, kernel), cv2.erode(plate.mean, kernel)
        else:
            reach = np.maximum(_SPREADS * plate.spread, _LEAST_LEVELS)
            top = bottom = plate.mean
        low = np.clip(np.floor(bottom - reach), 0, 255).astype(np.uint8)
        high = np.clip(np.ceil(top + reach), 0, 255).astype(np.uint8)
        grey = np.maximum(cv2.cvtColor(plate.mean, cv2.COLOR_RGB2GRAY), 1)
        step = coarse_step(*plate.mean.shape[:2])
        low_s, high_s, mean_s, grey_s = (coarse_of(image, step) for image in (low, high, plate.mean, grey))
        return PlateDifference(low, high, plate.mean, grey, step, (low_s, high_s, mean_s, grey_s), shadows)

    def look(self, picture: Picture) -> PlateLook:
        """Compare one picture; a general change of brightness since the plate was taken is taken out."""
        return PlateLook.at(self, picture)


@dataclass(frozen=True)
class PlateLook:
    """One picture beside the plate. levels : (256 1 3), what each level of the picture would have been in the
    plate's light, or None; person : coarse, 255 where shadows are taken out."""

    model: PlateDifference
    picture: Picture
    levels: UInt8[np.ndarray, "256 1 3"] | None
    coarse: UInt8[np.ndarray, "_h _w"]
    shade: UInt8[np.ndarray, "_h _w"] | None
    changed: float

    @staticmethod
    def at(model: PlateDifference, picture: Picture) -> PlateLook:
        """The coarse look: the change of light, what differs, and which of it is shadow."""
        low, high, plate, grey = model.small
        small = coarse_of(picture, model.step)
        levels = light_table(light_gains(small, plate))
        even = small if levels is None else cv2.LUT(small, levels)
        differs = cv2.bitwise_not(cv2.inRange(even, low, high))
        changed = cv2.countNonZero(differs) / differs.size
        differs = without_specks(differs.astype(np.uint8, copy=False))
        shade = None
        x, y, width, height = cv2.boundingRect(differs)
        if model.shadows and width > 0:
            box = (slice(max(0, y - 2), y + height + 2), slice(max(0, x - 2), x + width + 2))
            looks_so = cv2.bitwise_and(shaded(even[box], plate[box], grey[box]), differs[box])
            shadows = _true_shadows(differs[box], looks_so.astype(np.uint8))
            if cv2.countNonZero(shadows):
                differs[box] = cv2.subtract(differs[box], shadows)
                shade = np.zeros_like(differs)
                shade[box] = cv2.dilate(shadows, np.ones((3, 3), np.uint8))
        return PlateLook(model, picture, levels, differs, shade, changed)

    def fine(self, box: Box) -> UInt8[np.ndarray, "_h _w"]:
        """255 in the box where the picture differs and is no shadow."""
        model = self.model
        picture = self.picture[box] if self.levels is None else cv2.LUT(self.picture[box], self.levels)
        differs = cv2.bitwise_not(cv2.inRange(picture, model.low[box], model.high[box]))
        if self.shade is not None:
            near = full_size(self.shade, model.step, box)
            x, y, width, height = cv2.boundingRect(near)
            if width:
                part = (slice(y, y + height), slice(x, x + width))
                dimmed = shaded(picture[part], model.plate[box][part], model.grey[box][part])
                dimmed = cv2.bitwise_and(dimmed, near[part])
                differs[part] = cv2.subtract(differs[part], dimmed)
        return _at_half_height(differs.astype(np.uint8, copy=False), picture, model.plate[box])


def _at_half_height(
    differs: UInt8[np.ndarray, "h w"], picture: Picture, plate: Picture
) -> UInt8[np.ndarray, "h w"]:
    """The mask without the rim where less than half of the picture is the person.

    A threshold just above the noise takes in every pixel that the person touches; at the outline the
    difference falls off over two or three pixels, and half of what it is just inside is the edge.
    """
    red, green, blue = cv2.split(cv2.absdiff(picture, plate))
    height = cv2.max(cv2.max(red, green), blue)
    half = cv2.LUT(cv2.dilate(height, np.ones((5, 5), np.uint8)), _HALVED)
    rim = cv2.subtract(differs, cv2.erode(differs, np.ones((5, 5), np.uint8)))
    low = cv2.compare(height, half, cv2.CMP_LT)
    return cv2.subtract(differs, cv2.bitwise_and(low, rim)).astype(np.uint8)


def light_gains(small: Picture, plate: Picture) -> Float[np.ndarray, "3"]:
    """How much brighter (factor a channel) the picture is than the plate: the median, which a subject on less
    than half of the picture leaves alone."""
    there, here = plate[::8, ::8].reshape(-1, 3), small[::8, ::8].reshape(-1, 3)
    clear = ((there > 30) & (there < 225)).all(axis=1)
    if clear.sum() < 100:
        return np.ones(3)
    ratio = here[clear].astype(np.float32) / there[clear]
    return np.median(ratio, axis=0).astype(np.float64)


def light_table(
    gains: Float[np.ndarray, "3"], noticed: float = _GAIN_NOTICED
) -> UInt8[np.ndarray, "256 1 3"] | None:
    """Table (for cv2.LUT) that takes the gains out of a picture; None where they are nearer to one than
    `noticed`, or where it is dark."""
    if np.abs(gains - 1).max() < noticed or (gains < 0.2).any():
        return None
    table = np.arange(256, dtype=np.float64)[:, None, None] / gains
    return np.clip(np.rint(table), 0, 255).astype(np.uint8)


def shaded(picture: Picture, plate: Picture, grey: UInt8[np.ndarray, "_h _w"]) -> UInt8[np.ndarray, "_h _w"]:
    """255 where the picture could be the plate, dimmed: darker, and of the plate's own colour."""
    ratio = cv2.divide(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.ascontiguousarray(grey), scale=_UNIT)
    dimmer = cv2.inRange(ratio, np.full(1, _SHADE_LOW * _UNIT), np.full(1, _SHADE_HIGH * _UNIT))
    dimmed = cv2.multiply(plate, cv2.merge([ratio] * 3), scale=1 / _UNIT)
    residue = cv2.absdiff(picture, dimmed)
    alike = cv2.inRange(residue, np.zeros(3), np.full(3, float(_SHADE_RESIDUE)))
    return cv2.bitwise_and(dimmer, alike).astype(np.uint8)


def _true_shadows(
    differs: UInt8[np.ndarray, "h w"], looks_so: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """Of what looks like a shadow, the parts whose rim is background more than person; what is left of the
    others is the person's own grey."""
    solid = cv2.morphologyEx(looks_so, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    n_parts, labels, stats, _ = cv2.connectedComponentsWithStats(solid)
    person = cv2.subtract(differs, looks_so)
    result = np.zeros_like(differs)
    for part in range(1, n_parts):
        x, y, width, height = (int(value) for value in stats[part, :4])
        box = (slice(max(0, y - 2), y + height + 2), slice(max(0, x - 2), x + width + 2))
        here = (labels[box] == part).astype(np.uint8)
        rim = cv2.subtract(cv2.dilate(here, np.ones((5, 5), np.uint8)), here) > 0
        if (person[box][rim] > 0).mean() < _SHADE_BORDER:
            result[box][here > 0] = 255
    return result
