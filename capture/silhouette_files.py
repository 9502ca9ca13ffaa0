"""Silhouettes from image files: any bit depth or channel count to 255 person, 0 background, 128 unknown.

What cannot be trusted becomes no evidence and a sentence, never an exception: one bad file must not stop a
recording.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from capture.camera import Camera
from capture.whole_file import write_whole

PERSON, BACKGROUND, UNKNOWN = 255, 0, 128
# Person and background swapped, unknown kept.
_SWAPPED_GREY = np.arange(255, -1, -1, dtype=np.uint8)
_SWAPPED = _SWAPPED_GREY.copy()
_SWAPPED[UNKNOWN] = UNKNOWN
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class SilhouetteFile:
    """One file, read. `mask` (h w) is None where the file gives no evidence; `problem` then says why.

    `mask` holds probabilities, 0 to 255, where those were asked for. A mask that was usable but odd comes
    with a problem too. `looks_inverted`: the frame's border and most of the picture are person, as in files
    where black means person.
    """

    mask: UInt8[np.ndarray, "h w"] | None
    problem: str | None = None
    looks_inverted: bool = False


def read_silhouette(path: Path, *, inverted: bool = False, soft: bool = False) -> SilhouetteFile:
    """Read one silhouette; `inverted` swaps person and background, `soft` keeps its grey values as
    probabilities. Problems are phrases without camera and frame."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return SilhouetteFile(None, "file missing")
    except OSError as error:
        return SilhouetteFile(None, f"file cannot be read ({error.strerror})")
    damage = (
        png_damage(content) if content.startswith(_PNG_SIGNATURE) or path.suffix.lower() == ".png" else None
    )
    if damage is not None:
        return SilhouetteFile(None, damage)
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    if image is None:
        return SilhouetteFile(None, "not an image that OpenCV can decode")
    mask, problem = (probabilities_from_image(image), None) if soft else mask_from_image(image)
    if mask is None:
        return SilhouetteFile(None, problem)
    if inverted:
        mask = cv2.LUT(mask, _SWAPPED_GREY if soft else _SWAPPED).reshape(mask.shape)
    share = (int(np.count_nonzero(mask > 127)) if soft else _n_equal(mask, PERSON)) / mask.size
    if share == 0:
        return SilhouetteFile(None, "silhouette is empty (no pixel is person)")
    if share > 0.999:
        return SilhouetteFile(None, f"silhouette covers the whole picture ({100 * share:.1f} % person)")
    return SilhouetteFile(mask, problem, looks_inverted=share > 0.5 and _border_share(mask) > 0.5)


def write_silhouette(path: Path, mask: UInt8[np.ndarray, "h w"]) -> None:
    """Write an 8-bit PNG; it appears whole or not at all. OSError where it cannot be written."""
    done, data = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert done
    write_whole(path, data.tobytes())


def png_damage(content: bytes) -> str | None:
    """What is broken in a PNG's chain of chunks, or None. OpenCV hands out the upper part of a cut file
    silently."""
    if not content.startswith(_PNG_SIGNATURE):
        return "not a PNG (wrong signature)" if content else "file is empty (0 bytes)"
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(content):
        length = struct.unpack_from(">I", content, position)[0]
        kind = content[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(content):
            break
        if zlib.crc32(content[position + 4 : end - 4]) != struct.unpack_from(">I", content, end - 4)[0]:
            return f"PNG is damaged (checksum of its {kind.decode('ascii', 'replace')} chunk is wrong)"
        if kind == b"IEND":
            return None
        position = end
    return f"PNG is truncated (ends after {len(content)} bytes without its closing chunk)"


def png_size(path: Path) -> tuple[int, int] | None:
    """(width, height) px from a PNG's head without decoding it, or of another image by decoding; None:
    unreadable."""
    try:
        with path.open("rb") as file:
            head = file.read(26)
    except OSError:
        return None
    if head.startswith(_PNG_SIGNATURE) and len(head) >= 24 and head[12:16] == b"IHDR":
        width, height = struct.unpack_from(">II", head, 16)
        return (width, height) if width and height else None
    if path.suffix.lower() == ".png":
        return None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return None if image is None else (image.shape[1], image.shape[0])


def mask_from_image(
    image: Shaped[np.ndarray, "h w *channels"],
) -> tuple[UInt8[np.ndarray, "h w"] | None, str | None]:
    """Decoded image -> (mask of 0, 128, 255; problem). The mask is None for what is a photograph, no mask."""
    grey = _bytes(image)
    n_any, label = cv2.countNonZero(grey), int(grey.max(initial=0))
    if 0 < n_any < grey.size and label != UNKNOWN and _n_equal(grey, label) == n_any:
        # Nothing and one label: person, whichever number the label has.
        mask = grey if label == PERSON else cv2.threshold(grey, 0, PERSON, cv2.THRESH_BINARY)[1]
        return mask.astype(np.uint8, copy=False), None
    counts = cv2.calcHist([grey], [0], None, [256], [0, 256]).ravel()
    values = np.flatnonzero(counts)
    unknown = grey == UNKNOWN if counts[UNKNOWN] else None
    between = float(counts[24:232].sum() - counts[UNKNOWN]) / grey.size
    if between > 0.25:
        return None, f"not a silhouette: {100 * between:.0f} % of the pixels are neither dark nor bright"
    mask = cv2.threshold(grey, 127, PERSON, cv2.THRESH_BINARY)[1].astype(np.uint8, copy=False)
    if unknown is not None and len(values) <= 3:
        mask[unknown] = UNKNOWN
    if between > 0.01:
        return mask, f"not binary ({100 * between:.1f} % of the pixels in between), cut at half"
    return mask, None


def probabilities_from_image(image: Shaped[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h w"]:
    """Decoded image -> how surely each pixel shows the person, 0 to 255. A single label means 255."""
    grey = _bytes(image)
    label = int(grey.max(initial=0))
    if 0 < label < PERSON and _n_equal(grey, label) == cv2.countNonZero(grey):
        return cv2.threshold(grey, 0, PERSON, cv2.THRESH_BINARY)[1].astype(np.uint8, copy=False)
    return grey


def undistort_probabilities(camera: Camera, grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """As `camera.pinhole()` sees them: bilinear; what the camera never saw is one half."""
    if camera.is_pinhole:
        return grey
    seen = camera.undistort_image(np.full(grey.shape, 255, dtype=np.uint8))
    return np.where(seen > 127, camera.undistort_image(grey), np.uint8(UNKNOWN)).astype(np.uint8)


def undistort_silhouette(camera: Camera, mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """The mask as `camera.pinhole()` sees it: bilinear, cut at half; what the camera never saw is unknown.

    Person and unknown are warped apart, so that an edge between person and unknown does not turn into
    background.
    """
    if camera.is_pinhole:
        return mask
    person = camera.undistort_image(np.where(mask == PERSON, 255, 0).astype(np.uint8))
    known = camera.undistort_image(np.where(mask == UNKNOWN, 0, 255).astype(np.uint8))
    result = np.where(person > 127, PERSON, BACKGROUND).astype(np.uint8)
    result[(known <= 127) & (person <= 127)] = UNKNOWN
    return result


def _bytes(image: Shaped[np.ndarray, "h w *channels"]) -> UInt8[np.ndarray, "h w"]:
    """One channel of 0 to 255, whatever the depth; small label numbers stay as they are."""
    grey = _single_channel(image)
    if grey.dtype == np.bool_:
        grey = grey.astype(np.uint8) * 255
    if np.issubdtype(grey.dtype, np.integer) and grey.dtype != np.uint8:
        top = int(grey.max(initial=0))
        # 16-bit files hold either the full range or small label numbers.
        grey = (grey // 257 if top > 255 else grey).astype(np.uint8)
    elif np.issubdtype(grey.dtype, np.floating):
        grey = np.clip(np.nan_to_num(grey) * (255 if grey.max(initial=0) <= 1 else 1), 0, 255).astype(
            np.uint8
        )
    # OpenCV counts a picture of four megapixels in a tenth of numpy's time; it wants pixels side by side.
    return np.ascontiguousarray(grey)


def _single_channel(image: Shaped[np.ndarray, "h w *channels"]) -> Shaped[np.ndarray, "h w"]:
    if image.ndim == 2:
        return image
    channels = image.reshape(*image.shape[:2], -1)
    if channels.shape[2] in (2, 4) and channels[..., -1].min() != channels[..., -1].max():
        return channels[..., -1]  # a transparent background: the alpha channel is the mask
    brightest = channels[..., 0]
    for channel in range(1, min(channels.shape[2], 3)):
        brightest = np.maximum(brightest, channels[..., channel])
    return brightest


def _border_share(mask: UInt8[np.ndarray, "h w"]) -> float:
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return float((border > UNKNOWN).mean())


def _n_equal(image: UInt8[np.ndarray, "h w"], value: int) -> int:
    return int(np.count_nonzero(image == value))
