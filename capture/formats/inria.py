"""The INRIA layout's calibration: `setup/camNN.txt`, one 3x4 projection matrix a file, whitespace between
numbers.

A world point (x, y, z, 1) maps to (a u, a v, a). Neither the unit nor the matrix's sign is stated anywhere:
the unit is left to `capture.world`, the sign to `capture.projection_split`. Pixel centres are taken at whole
numbers.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.errors import RecordingError
from capture.foreign_rig import numbered_names
from capture.formats.limits import number_text, require_pinholes
from capture.projection_split import camera_from_projection
from capture.rig import Rig

_FILE = re.compile(r"^cam[-_]?(\d+)\.txt$", re.IGNORECASE)


def list_matrix_files(folder: Path) -> dict[int, Path]:
    """Camera number -> file, for every `camNN.txt` in the folder. Raises RecordingError for a number given
    twice."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = _FILE.match(path.name)
        if match is None or not path.is_file():
            continue
        number = int(match[1])
        if number in found:
            raise RecordingError(
                f"{folder}: {found[number].name} and {path.name} are both camera {number}; keep one"
            )
        found[number] = path
    return found


def is_matrix_file(path: Path) -> bool:
    """Whether a file is called `camNN.txt`."""
    return _FILE.match(path.name) is not None


def read_projection_matrix(path: Path) -> Float[np.ndarray, "3 4"]:
    """The twelve numbers of one file as they stand. Raises RecordingError that says what was found
    instead."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    words = [word for line in text.splitlines() for word in line.split("#")[0].replace(",", " ").split()]
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            raise RecordingError(
                f"{path}: {word[:30]!r} is no number; the file must hold the 3x4 projection matrix alone"
            ) from None
    if len(numbers) == 9:
        raise RecordingError(
            f"{path}: a 3x3 matrix found where a 3x4 projection matrix is due; intrinsics alone do not place "
            "the camera: write K [R | t]"
        )
    if len(numbers) != 12:
        raise RecordingError(f"{path}: {len(numbers)} numbers found, a 3x4 projection matrix has 12")
    matrix = np.array(numbers).reshape(3, 4)
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise RecordingError(
            f"{path}: {matrix[row, column]} in row {row + 1}, column {column + 1}; "
            "every value of the projection matrix must be a finite number: calibrate this camera again"
        )
    return matrix


def read_inria_camera(path: Path, name: str, size: tuple[int, int]) -> Camera:
    """The camera of one file, in file units; `size` (width, height) px comes from its pictures."""
    try:
        return camera_from_projection(name, size, read_projection_matrix(path))
    except RecordingError:
        raise
    except ValueError as error:
        raise RecordingError(f"{path}: no projection matrix ({error})") from error


def write_inria(rig: Rig, folder: Path) -> list[str]:
    """`camNN.txt` each, metres, every number at full precision; the exact matrices of cameras that came as
    such. Pinholes only."""
    require_pinholes(rig, "INRIA's 3x4 matrices")
    numbers = numbered_names(rig.names)
    for number, camera in zip(numbers, rig, strict=True):
        rows = (" ".join(number_text(value) for value in row) for row in camera.projection_matrix)
        (folder / f"cam{number:02d}.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    listed = ", ".join(f"{name} is cam{n:02d}" for name, n in zip(rig.names, numbers, strict=True))
    return [f"INRIA's matrices state neither picture sizes nor the unit: they are in metres. {listed}."]
