"""Middlebury multi-view stereo's `*_par.txt`: the number of pictures, then a line for each.

A line: picture's file name, K row by row (9), R row by row (9), t (3); P = K [R t] takes the world to pixels,
origin at the top left. The centre of the first pixel is taken as 0. Neither the picture's size (read from the
picture, if it lies beside) nor the unit is stated. https://vision.middlebury.edu/mview/data/
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, foreign_rig, given_camera
from capture.formats.limits import number_text, read_text, require_pinholes
from capture.rig import Rig
from capture.silhouette_files import png_size

_N_NUMBERS = 21


def is_middlebury(head: str) -> bool:
    """Whether a text begins with a count and a first line of a name and 21 numbers."""
    words = head.split()[: 2 + _N_NUMBERS]
    if len(words) < 2 + _N_NUMBERS or not words[0].isdigit():
        return False
    try:
        float(words[1])
    except ValueError:
        return all(_is_number(word) for word in words[2:])
    return False


def read_middlebury(path: Path) -> ForeignRig:
    """Every camera, named by its picture without the ending; the unit is unknown. Raises RecordingError."""
    words = read_text(path).split()
    if not words or not words[0].isdigit():
        raise RecordingError(f"{path}: begins with no count of pictures; is it a Middlebury *_par.txt?")
    count = int(words[0])
    per_camera = 1 + _N_NUMBERS
    if len(words) != 1 + count * per_camera:
        raise RecordingError(
            f"{path}: {count} pictures announced, {(len(words) - 1) / per_camera:.3g} lines of a name and "
            f"{_N_NUMBERS} numbers found; is the file whole?"
        )
    cameras = []
    for k in range(count):
        picture, *texts = words[1 + k * per_camera : 1 + (k + 1) * per_camera]
        try:
            numbers = np.array([float(text) for text in texts])
        except ValueError as error:
            raise RecordingError(f"{path}: picture {picture}: {error}") from error
        cameras.append(
            given_camera(
                path,
                Path(picture).stem,
                png_size(path.parent / picture) if (path.parent / picture).is_file() else None,
                numbers[:9].reshape(3, 3),
                numbers[9:18].reshape(3, 3),
                numbers[18:],
            )
        )
    return foreign_rig(cameras, None, [path])


def write_middlebury(rig: Rig, path: Path) -> list[str]:
    """Pinholes, metres; pictures are called NAME.png."""
    require_pinholes(rig, "Middlebury's *_par.txt")
    lines = [str(len(rig))]
    for camera in rig:
        pose = camera.camera_from_world
        numbers = [*camera.intrinsics.ravel(), *pose[:3, :3].ravel(), *pose[:3, 3]]
        lines.append(" ".join([f"{_word(camera.name)}.png", *map(number_text, numbers)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [
        "Middlebury's *_par.txt states neither picture sizes nor the unit: this file is in metres, "
        "and its pictures must be called NAME.png."
    ]


def _word(name: str) -> str:
    if not name or name.split() != [name]:
        raise RecordingError(f"Middlebury's *_par.txt: the camera name {name!r} is no single word; rename it")
    return name


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
