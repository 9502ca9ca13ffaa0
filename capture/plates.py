"""Empty scenes: what each camera sees without a subject, its mean and its spread.

    BACKGROUND/<camera>.png                  one picture a camera
    BACKGROUND/<camera>/*.png                many pictures a camera, or
    BACKGROUND/<camera>.mp4                  a film of the empty scene

Many empty frames tell how much each pixel wavers (noise, lamps, compression at edges), so a threshold can be
as low as it may be there; one picture tells nothing of it, and a general threshold is used.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.calibration_file import camera_number
from capture.errors import RecordingError
from capture.picture_frames import read_picture
from capture.video_file import VideoFile

_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v")
_MOST_FRAMES = 60
# As if so many frames with this spread had been seen besides: a handful of frames knows its spread badly.
_PRIOR_FRAMES, _PRIOR_LEVELS = 4, 2.0

Picture = UInt8[np.ndarray, "_h _w 3"]


@dataclass(frozen=True)
class Plate:
    """mean : (h w 3) RGB, rounded. spread : (h w 3) standard deviation in levels; None: a single picture.
    n_frames : how many empty frames it is made of."""

    mean: Picture
    spread: Float[np.ndarray, "_h _w 3"] | None
    n_frames: int


@dataclass(frozen=True)
class EmptyScene:
    """The empty frames of one camera, not read yet. size : (width, height) px that they must have."""

    camera: str
    size: tuple[int, int]
    files: tuple[Path, ...]

    def frames(self) -> Iterator[Picture]:
        """At most 60 of the empty frames, evenly spread, RGB. Raises RecordingError where none is usable;
        single bad ones of many are left out."""
        n_good = 0
        if self.files[0].suffix.lower() in _VIDEOS:
            video = VideoFile(self.files[0])
            self._check(video.size, self.files[0])
            for frame_idx in _spread(video.n_frames):
                picture = video.read(frame_idx)
                if picture is not None:
                    n_good += 1
                    yield picture
            return
        problem = ""
        for file_idx in _spread(len(self.files)):
            picture, problem_here = read_picture(self.files[file_idx])
            if picture is not None and picture.shape[1::-1] == self.size:
                n_good += 1
                yield picture
            elif picture is not None and len(self.files) == 1:
                self._check(picture.shape[1::-1], self.files[file_idx])
            else:
                problem = problem or f"{self.files[file_idx]}: {problem_here or 'another size'}"
        if n_good == 0 and len(self.files) == 1:
            raise RecordingError(
                f"{self.files[0]}: background plate cannot be decoded "
                f"({problem.split(': ', 1)[-1]}); save it again"
            )
        if n_good == 0:
            raise RecordingError(
                f"{self.files[0].parent}: none of the {len(self.files)} empty frames can be used ({problem})"
            )

    def _check(self, size: tuple[int, int], path: Path) -> None:
        if tuple(size) != self.size:
            raise RecordingError(
                f"{path}: background plate of {size[0]}x{size[1]} px, but camera {self.camera} films "
                f"{self.size[0]}x{self.size[1]} px"
            )


def find_empty_scenes(folder: Path, sizes: dict[str, tuple[int, int]]) -> dict[str, EmptyScene]:
    """Camera -> its empty scene below `folder`, by name, else by the number in the name; cameras without one
    are missing. Raises RecordingError where the folder does not exist or has none at all."""
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder of background plates")
    entries = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    found = {}
    for camera, size in sizes.items():
        same_name = [path for path in entries if path.name == camera or path.stem == camera]
        number = camera_number(camera)
        same_number = [path for path in entries if number is not None and camera_number(path.stem) == number]
        for path in same_name or same_number:
            files = _files_of(path)
            if files:
                found[camera] = EmptyScene(camera, size, files)
                break
    if not found:
        raise RecordingError(
            f"{folder}: no background plate here; expected <camera>.png, <camera>.mp4 or a folder <camera>/ "
            f"of empty frames, for the cameras {', '.join(sizes)}"
        )
    return found


def _files_of(path: Path) -> tuple[Path, ...]:
    if path.is_dir():
        return tuple(sorted(file for file in path.iterdir() if file.suffix.lower() in _PICTURES))
    return (path,) if path.suffix.lower() in (*_PICTURES, *_VIDEOS) else ()


def _spread(n: int) -> list[int]:
    return sorted({int(idx) for idx in np.linspace(0, n - 1, min(n, _MOST_FRAMES)).round()})


def learn_plate(frames: Iterator[Picture]) -> Plate:
    """Mean and spread of empty frames (at least one), in one pass."""
    first = next(frames)
    total = first.astype(np.float32)
    # Squares of differences to the first frame: squares of the levels themselves would lose digits.
    offset, squares = np.zeros_like(total), np.zeros_like(total)
    n_frames = 1
    for picture in frames:
        difference = cv2.subtract(picture, first, dtype=cv2.CV_32F)
        cv2.accumulate(difference, offset)
        cv2.accumulateSquare(difference, squares)
        n_frames += 1
    mean_offset = offset / n_frames
    mean = np.clip(np.rint(total + mean_offset), 0, 255).astype(np.uint8)
    if n_frames == 1:
        return Plate(mean, None, 1)
    variance = np.maximum(squares - n_frames * mean_offset**2, 0)
    variance += _PRIOR_FRAMES * np.float32(_PRIOR_LEVELS**2)
    return Plate(mean, np.sqrt(variance / (n_frames - 1 + _PRIOR_FRAMES)), n_frames)


def median_plate(samples: UInt8[np.ndarray, "_t _h _w 3"], middle: Picture) -> Plate:
    """A plate from a film with a moving subject in it: `middle` its median over time, the spread from the
    median deviation, which a subject who covers a pixel in less than half of the frames leaves alone."""
    spread = np.empty(middle.shape, np.float32)
    for row in range(0, len(middle), 64):
        rows = slice(row, row + 64)
        here = np.ascontiguousarray(samples[:, rows]).reshape(len(samples), -1)
        strip = cv2.absdiff(here, np.repeat(middle[rows].reshape(1, -1), len(samples), axis=0))
        strip.partition(len(samples) // 2, axis=0)
        deviation = strip[len(samples) // 2].reshape(middle[rows].shape)
        spread[rows] = np.maximum(1.4826 * deviation.astype(np.float32), _PRIOR_LEVELS)
    return Plate(middle, spread, len(samples))
