"""A shape with a number at every vertex, as a picture: the colour code of the paper's figure 2.

Frame: the body's own (y up, +z front).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from .turntable import Figure, draw_rows

VIEWS = (("front", 0.0), ("left", 0.5 * np.pi), ("back", np.pi))
TILE = (300, 400)


def value_colours(values: Float[np.ndarray, "v"], low: float, high: float) -> UInt8[np.ndarray, "v 3"]:
    """RGB (V 3) from dark blue at `low` and below to yellow at `high` and above (viridis: its lightness
    rises evenly, so it reads in grey and by colour-blind eyes)."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    level = np.round(255 * share).astype(np.uint8)
    return cv2.applyColorMap(level[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1].copy()


def shape_views(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    rows: Sequence[tuple[str, Float[np.ndarray, "v"], float, float]],
    tile: tuple[int, int] = TILE,
) -> UInt8[np.ndarray, "h w 3"]:
    """A row for each (name, value a vertex (V), lowest, highest): front, left and back view, coloured."""
    drawn = [
        [
            Figure(vertices, f"{name}, {side}", azimuth, value_colours(values, low, high))
            for side, azimuth in VIEWS
        ]
        for name, values, low, high in rows
    ]
    return draw_rows(drawn, faces, tile)
