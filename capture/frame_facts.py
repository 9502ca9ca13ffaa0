"""What all the silhouettes of a recording say by themselves, read once: areas over time, pictures' borders,
empty and repeated pictures; and every mask, small, for what compares cameras and moments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from capture.camera import Camera
from capture.recording import Recording
from capture.rig import Rig
from capture.silhouette_files import PERSON, UNKNOWN

# Small masks are about this wide: a person then is some hundred pixels tall, and fifty cameras fit in memory.
_SMALL_PX = 448
# What a check reads, in megapixels of silhouettes; lenses and segmentation cost so many times as much.
_BUDGET_MP, _LENS_FACTOR, _VIDEO_FACTOR = 4000.0, 3.0, 20.0
_FEWEST_FRAMES, _MOST_FRAMES, _BLOCK_FRAMES = 9, 240, 60
# The picture's border reaches so far in: what lies on it may go on beyond.
_BORDER_PX = 2


@dataclass(frozen=True, eq=False)
class FrameFacts:
    """All that was read. C cameras, T frames.

    Fields
    ------
    frame_ids : (T,) the frames read, ascending, in runs without gaps as far as the recording has none.
    rig : the cameras as the small masks were seen by (pinholes), in the recording's world.
    shrink : (C,) how many of a picture's pixels go into one of the small mask's, each way.
    present : (C T) whether there is a silhouette with a person in it.
    area : (C T) the person's share of the picture; 0 where the camera shows nobody or has nothing.
    changed : (C T) pixels that differ from the frame before, over the person's area; NaN without both.
    border : (C T) whether the person touches the picture's border.
    problems : of reading, a sentence each.
    """

    frame_ids: tuple[int, ...]
    rig: Rig
    shrink: tuple[int, ...]
    present: Bool[np.ndarray, "c t"]
    area: Float[np.ndarray, "c t"]
    changed: Float[np.ndarray, "c t"]
    border: Bool[np.ndarray, "c t"]
    problems: tuple[str, ...]
    packed: dict[tuple[int, int], tuple[UInt8[np.ndarray, "_n"], UInt8[np.ndarray, "_m"] | None]]

    def mask(self, camera_idx: int, k: int) -> UInt8[np.ndarray, "h w"] | None:
        """The small mask of the k-th frame read (255, 0, 128); None where there is none."""
        found = self.packed.get((camera_idx, k))
        if found is None:
            return None
        width, height = self.rig[camera_idx].size
        person = np.unpackbits(found[0], count=width * height).reshape(height, width)
        mask = person * np.uint8(PERSON)
        if found[1] is not None:
            unknown = np.unpackbits(found[1], count=width * height).reshape(height, width)
            mask[unknown.astype(bool)] = UNKNOWN
        return mask

    def masks(self, k: int) -> list[UInt8[np.ndarray, "_h _w"] | None]:
        """`mask` of every camera."""
        return [self.mask(camera_idx, k) for camera_idx in range(len(self.rig))]

    def after(self, k: int, step: int) -> int | None:
        """The place of the frame `step` places of the recording after the k-th, if it was read."""
        other = k + step
        if not 0 <= other < len(self.frame_ids):
            return None
        usual = self.usual_step
        return other if self.frame_ids[other] - self.frame_ids[k] == step * usual else None

    @property
    def usual_step(self) -> int:
        """Frame numbers from one frame to the next."""
        return int(np.median(np.diff(self.frame_ids))) if len(self.frame_ids) > 1 else 1


def frames_to_read(recording: Recording, is_video: bool, at_most: int | None = None) -> tuple[int, ...]:
    """All frames, or as many as are read in about a third of a minute: runs without gaps, spread."""
    megapixels = sum(camera.size[0] * camera.size[1] for camera in recording.rig) / 1e6
    if is_video:
        megapixels *= _VIDEO_FACTOR
    elif any(not camera.is_pinhole for camera in recording.calibration):
        megapixels *= _LENS_FACTOR
    n = at_most or int(np.clip(_BUDGET_MP / megapixels, _FEWEST_FRAMES, _MOST_FRAMES))
    ids = recording.frame_ids
    if len(ids) <= n:
        return ids
    n_blocks = max(n // _BLOCK_FRAMES, 1)
    length = n // n_blocks
    starts = (
        [(len(ids) - length) // 2]
        if n_blocks == 1
        else np.linspace(0, len(ids) - length, n_blocks).astype(int).tolist()
    )
    return tuple(ids[k] for k in sorted({k for start in starts for k in range(start, start + length)}))


def read_frame_facts(
    recording: Recording, frame_ids: tuple[int, ...], report: Callable[[int], object] | None = None
) -> FrameFacts:
    """Read the silhouettes of these frames. `report` is called with the number of frames done."""
    shrink = tuple(max(1, round(max(camera.size) / _SMALL_PX)) for camera in recording.rig)
    n_cameras, n_frames = len(recording.rig), len(frame_ids)
    present, border = (np.zeros((n_cameras, n_frames), dtype=bool) for _ in range(2))
    area, changed = np.zeros((n_cameras, n_frames)), np.full((n_cameras, n_frames), np.nan)
    packed: dict[tuple[int, int], tuple[UInt8[np.ndarray, "_n"], UInt8[np.ndarray, "_m"] | None]] = {}
    problems: list[str] = []
    before: list[UInt8[np.ndarray, "_h _w"] | None] = [None] * n_cameras
    for k, frame_id in enumerate(frame_ids):
        found = recording.silhouettes(frame_id)
        problems += found.problems
        for i, image in enumerate(found.images):
            n_person = 0 if image is None else int(np.count_nonzero(image == PERSON))
            if image is not None and n_person:
                present[i, k] = True
                area[i, k] = n_person / image.size
                border[i, k] = touches_border(image)
                last = before[i]
                if last is not None:
                    changed[i, k] = np.count_nonzero(image != last) / n_person
                packed[i, k] = _packed(image, shrink[i])
            before[i] = image if n_person else None
        if report is not None:
            report(k + 1)
    cameras = tuple(small_camera(camera, s) for camera, s in zip(recording.rig, shrink, strict=True))
    return FrameFacts(
        frame_ids, Rig(cameras), shrink, present, area, changed, border, tuple(problems), packed
    )


def touches_border(image: UInt8[np.ndarray, "h w"]) -> bool:
    """Whether the person reaches the picture's border, or what counts as unknown there."""
    b = _BORDER_PX
    edges = (image[:b], image[-b:], image[:, :b], image[:, -b:])
    return any(bool((edge == PERSON).any()) for edge in edges)


def small_camera(camera: Camera, shrink: int) -> Camera:
    """The camera as pictures see it of which `shrink` x `shrink` pixels were made one."""
    width, height = camera.size
    return camera.with_pixels_scaled(1 / shrink, 1 / shrink, (-(-width // shrink), -(-height // shrink)))


def _packed(
    image: UInt8[np.ndarray, "h w"], shrink: int
) -> tuple[UInt8[np.ndarray, "_n"], UInt8[np.ndarray, "_m"] | None]:
    unknown = image == UNKNOWN
    person = _shrunk(np.where(unknown, np.uint8(0), image), shrink) > 127
    doubt = None
    if unknown.any():
        doubt = np.packbits((_shrunk(unknown.astype(np.uint8) * 255, shrink) > 0) & ~person)
    return np.packbits(person), doubt


def _shrunk(image: UInt8[np.ndarray, "h w"], shrink: int) -> UInt8[np.ndarray, "h2 w2"]:
    if shrink == 1:
        return image
    height, width = image.shape
    # So that blocks at the picture's end are whole.
    padded = cv2.copyMakeBorder(image, 0, -height % shrink, 0, -width % shrink, cv2.BORDER_REPLICATE)
    size = (padded.shape[1] // shrink, padded.shape[0] // shrink)
    return cv2.resize(padded, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
