"""A few frames' pictures with their silhouettes drawn in, on one sheet: the quick look before a long run."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.silhouette_files import PERSON, UNKNOWN

_TILE = 240  # px of a tile's longer side
_OUTLINE, _UNKNOWN = (255, 220, 0), (200, 0, 200)  # RGB

Picture = UInt8[np.ndarray, "_h _w 3"]
Mask = UInt8[np.ndarray, "_h _w"]


def contact_sheet(rows: Sequence[Sequence[tuple[str, Picture | None, Mask | None]]]) -> bytes:
    """A JPEG of rows of tiles, each a label, the picture (RGB) and its mask of the same size; the person is
    bright with a yellow outline, the unknown violet, the rest dimmed. No picture: the mask alone."""
    lines = [[_tile(*entry) for entry in row] for row in rows]
    height = max(tile.shape[0] for line in lines for tile in line)
    width = max(tile.shape[1] for line in lines for tile in line)
    n_columns = max(len(line) for line in lines)
    sheet = np.full((height * len(lines), width * n_columns, 3), 255, np.uint8)
    for row_idx, line in enumerate(lines):
        for column_idx, tile in enumerate(line):
            y, x = row_idx * height, column_idx * width
            sheet[y : y + tile.shape[0], x : x + tile.shape[1]] = tile
    done, data = cv2.imencode(".jpg", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])
    assert done
    return data.tobytes()


def _tile(label: str, picture: Picture | None, mask: Mask | None) -> Picture:
    shape = picture.shape[:2] if picture is not None else mask.shape if mask is not None else (_TILE, _TILE)
    scale = min(1.0, _TILE / max(shape))
    size = (max(1, round(shape[1] * scale)), max(1, round(shape[0] * scale)))
    if picture is None:
        tile = np.full((size[1], size[0], 3), 90, np.uint8)
    else:
        tile = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    if mask is not None:
        small = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
        tile = np.where((small == PERSON)[..., None], tile, tile // 2).astype(np.uint8)
        tile[small == UNKNOWN] = _UNKNOWN
        contours, _ = cv2.findContours(
            np.where(small == PERSON, 255, 0).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(tile, contours, -1, _OUTLINE, 1)
    cv2.putText(tile, label, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1, cv2.LINE_AA)
    return tile
