"""The result over what the camera saw: on the picture, or on the silhouette where there is no picture.

Lenses: pictures and silhouettes are taken undistorted, as `Recording.picture` and `Recording.silhouettes`
hand them out, and the body is drawn by the pinhole camera that belongs to them. The picture is warped, never
the drawing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from capture.camera import Camera

from .scene import Picture, Stage, Surface

BODY_RGB = (122, 172, 214)
"""The body's colour over pictures: rare in clothes and skin."""
OUTLINE_RGB = (255, 214, 64)
"""The body's outline."""
MISSED_RGB = (232, 86, 60)
"""Person in the silhouette that the body does not cover."""
SPILLED_RGB = (86, 132, 240)
"""Body outside of the silhouette."""


def overlay(
    camera: Camera,
    surfaces: Sequence[Surface],
    picture: UInt8[np.ndarray, "_ _ 3"] | None,
    silhouette: UInt8[np.ndarray, "_ _"] | None = None,
    *,
    strength: float = 0.62,
) -> UInt8[np.ndarray, "h w 3"]:
    """RGB: the surfaces drawn by `camera` (a pinhole) over the undistorted picture, with their outline.

    Without a picture the silhouette is drawn in white on grey (unknown pixels darker); without either, plain
    grey. strength: how opaque the body is, 0..1. ValueError where picture or silhouette has another size than
    the camera.
    """
    behind = _background(camera, picture, silhouette)
    if not surfaces:
        return behind
    return blend_drawing(behind, Stage(surfaces).colour(camera), strength)


def blend_drawing(
    behind: UInt8[np.ndarray, "h w 3"], drawing: Picture, strength: float = 0.62
) -> UInt8[np.ndarray, "h w 3"]:
    """A drawing over a picture: see-through, edges smooth, its outline on the pixels just inside it."""
    out = behind.copy()
    rows, columns = _box(drawing.coverage)
    part = out[rows, columns].astype(np.float32)
    share = drawing.coverage[rows, columns].astype(np.float32)[:, :, None] / 255.0
    colour = drawing.colour[rows, columns].astype(np.float32) / np.maximum(share, 1e-3)
    part += strength * share * (np.minimum(colour, 255.0) - part)
    edge = outline(drawing.mask)[rows, columns]
    part[edge] = 0.25 * part[edge] + 0.75 * np.array(OUTLINE_RGB, np.float32)
    out[rows, columns] = np.clip(part + 0.5, 0, 255).astype(np.uint8)
    return out


def outline(mask: Bool[np.ndarray, "h w"], width_px: int = 0) -> Bool[np.ndarray, "h w"]:
    """The mask's pixels within `width_px` of its outside; 0: a width that suits the picture's size."""
    if width_px == 0:
        width_px = max(1, round(min(mask.shape) / 500))
    size = 2 * width_px + 1
    inner = cv2.erode(
        mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), borderValue=0
    )
    return mask & (inner == 0)


def agreement_picture(
    mask: Bool[np.ndarray, "h w"], silhouette: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Where body and silhouette differ: white both, red only silhouette, blue only body, dark unknown."""
    out = np.full((*mask.shape, 3), 58, np.uint8)
    person = silhouette == 255
    out[person & mask] = 236
    out[person & ~mask] = MISSED_RGB
    out[~person & mask] = SPILLED_RGB
    out[silhouette == 128] = 30
    return out


def overlay_frames(
    camera: Camera,
    views: Iterable[
        tuple[Sequence[Surface], UInt8[np.ndarray, "_ _ 3"] | None, UInt8[np.ndarray, "_ _"] | None]
    ],
    *,
    longest_px: int = 1280,
    captions: Sequence[str] | None = None,
) -> Iterator[UInt8[np.ndarray, "h2 w2 3"]]:
    """Frames for `video.write_video`: for every (surfaces, picture, silhouette) the overlay, made no larger
    than needed.

    captions: a line of text a frame (its number, a warning), written into the lower left corner.
    """
    for view_idx, (surfaces, picture, silhouette) in enumerate(views):
        frame = shrunk(overlay(camera, surfaces, picture, silhouette), longest_px)
        if captions is not None:
            frame = captioned(frame, captions[view_idx])
        yield frame


def shrunk(image: UInt8[np.ndarray, "h w *c"], longest_px: int) -> UInt8[np.ndarray, "h2 w2 *c"]:
    """The image with its longer side at most `longest_px`; smaller ones unchanged."""
    scale = longest_px / max(image.shape[:2])
    if scale >= 1.0:
        return image
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def captioned(image: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    """The image with a line of text, white on a dark band, in its lower left corner."""
    out = image.copy()
    if not text:
        return out
    scale = max(0.4, min(image.shape[:2]) / 1200)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    top = max(0, out.shape[0] - height - below - 10)
    out[top:, : width + 14] = (out[top:, : width + 14] * 0.35).astype(np.uint8)
    place = (7, out.shape[0] - below - 3)
    cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (245, 245, 245), 1, cv2.LINE_AA)
    return out


def crop_around(masks: Sequence[Bool[np.ndarray, "h w"]], margin: float = 0.08) -> tuple[slice, slice] | None:
    """The part of a picture that holds all masks' pixels, with a margin (share of its larger side); None: no
    pixel.
    """
    together = np.logical_or.reduce(list(masks))
    if not together.any():
        return None
    rows, columns = _box(together.astype(np.uint8))
    pad = int(margin * max(rows.stop - rows.start, columns.stop - columns.start)) + 2
    return (
        slice(max(rows.start - pad, 0), min(rows.stop + pad, together.shape[0])),
        slice(max(columns.start - pad, 0), min(columns.stop + pad, together.shape[1])),
    )


def intersection_over_union(mask: Bool[np.ndarray, "h w"], silhouette: UInt8[np.ndarray, "h w"]) -> float:
    """Agreement of a drawn mask with a silhouette over its known pixels; NaN where neither has a pixel."""
    known = silhouette != 128
    person = silhouette == 255
    union = int(((mask | person) & known).sum())
    return float((mask & person).sum()) / union if union else float("nan")


def _background(
    camera: Camera,
    picture: UInt8[np.ndarray, "_ _ 3"] | None,
    silhouette: UInt8[np.ndarray, "_ _"] | None,
) -> UInt8[np.ndarray, "h w 3"]:
    width, height = camera.size
    for name, image in (("picture", picture), ("silhouette", silhouette)):
        if image is not None and image.shape[:2] != (height, width):
            raise ValueError(
                f"camera {camera.name}: the {name} is {image.shape[1]} x {image.shape[0]} pixels, "
                f"the camera {width} x {height}"
            )
    if picture is not None:
        return picture.copy()
    grey = np.full((height, width), 96, np.uint8)
    if silhouette is not None:
        grey[silhouette == 255] = 255
        grey[silhouette == 128] = 64
    return np.repeat(grey[:, :, None], 3, 2)


def _box(image: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns that hold everything above zero; empty slices where nothing does."""
    rows, columns = np.flatnonzero(image.any(1)), np.flatnonzero(image.any(0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def body_surface(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, colour: tuple[int, int, int] = BODY_RGB
) -> Surface:
    """A fitted body ready to be drawn over pictures."""
    return Surface(vertices, faces, None, colour, roughness=0.7, two_sided=False)
