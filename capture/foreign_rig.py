"""What a foreign calibration file says, already in this project's conventions: cameras whose picture size may
not be known, the world's unit if the format states it, and sentences on what was left out.

Every reader in `capture.formats` hands out a `ForeignRig`; its cameras are made by `given_camera`, which
holds the checks that are the same for all formats (finite numbers, a rotation that is one, no mirror,
positive focal lengths, a lens model that OpenCV has).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.errors import RecordingError
from capture.rig import Rig

Size = tuple[int, int]
#: Text with six decimals leaves a rotation this far from being one.
_ROUNDED = 1e-3


@dataclass(frozen=True)
class GivenCamera:
    """One camera as a file gives it: as `capture.camera.Camera`, but `size` (width, height) px may be None.

    place : the file, for errors.
    """

    name: str
    size: Size | None
    intrinsics: Float[np.ndarray, "3 3"]
    camera_from_world: Float[np.ndarray, "4 4"]
    distortion: Float[np.ndarray, " d"]
    place: Path
    projection: Float[np.ndarray, "3 4"] | None = None

    def sized(self, size: Size | None = None, name: str | None = None) -> Camera:
        """As a Camera, `size` where the file gives none. Raises RecordingError without any size."""
        chosen = self.size or size
        if chosen is None:
            raise RecordingError(
                f"{self.place}: camera {self.name} comes without a picture size; give --size, "
                "for example 1920x1080"
            )
        try:
            return Camera(
                name or self.name,
                chosen,
                self.intrinsics,
                self.camera_from_world,
                self.distortion,
                self.projection,
            )
        except ValueError as error:
            raise RecordingError(f"{self.place}: {error}") from error


@dataclass(frozen=True)
class ForeignRig:
    """The cameras of a file or folder, in its order, names unique.

    unit : "m", "cm", "mm", or None where neither format nor file says it.
    files : what was read. notes : sentences on what was left out or looks odd.
    """

    cameras: tuple[GivenCamera, ...]
    unit: str | None
    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    def rig(self, size: Size | None = None) -> Rig:
        """As a Rig, in the file's unit; `size` (width, height) px for cameras that come without."""
        return Rig(tuple(camera.sized(size) for camera in self.cameras))

    def with_sizes(self, size_of: Callable[[str], Size | None]) -> ForeignRig:
        """Sizes filled in by camera name, where the file gives none."""
        filled = (c if c.size else replace(c, size=size_of(c.name)) for c in self.cameras)
        return replace(self, cameras=tuple(filled))


def foreign_rig(
    cameras: Sequence[GivenCamera], unit: str | None, files: Sequence[Path], notes: Sequence[str] = ()
) -> ForeignRig:
    """A ForeignRig. Raises RecordingError for no camera at all, or a name that is given twice."""
    if not cameras:
        raise RecordingError(f"{files[0]}: no calibrated camera in it")
    names = [camera.name for camera in cameras]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise RecordingError(f"{files[0]}: two cameras share a name: {', '.join(repeated)}")
    return ForeignRig(tuple(cameras), unit, tuple(files), tuple(notes))


def of_rig(rig: Rig, place: Path, unit: str = "m") -> ForeignRig:
    """Our own rig in the same form."""
    given = tuple(
        GivenCamera(c.name, c.size, c.intrinsics, c.camera_from_world, c.distortion, place, c.projection)
        for c in rig
    )
    return ForeignRig(given, unit, (place,))


def given_camera(
    place: Path,
    name: str,
    size: Size | None,
    intrinsics: object,
    rotation: object,
    translation: object,
    distortion: object = (),
) -> GivenCamera:
    """A camera after the checks that every format needs.

    Lists or arrays as they were read: intrinsics (3 3) px, OpenCV's pixels; rotation: world to camera, (3 3)
    or a Rodrigues vector (3), rad; translation (3), world units; distortion in OpenCV's order, all zero
    meaning a pinhole. Raises RecordingError that names the file and the camera.
    """
    where = f"{place}: camera {name}"
    matrix = _numbers(where, "camera matrix", intrinsics, (3, 3))
    lens = _lens(where, _numbers(where, "distortion", distortion, None))
    pose = np.eye(4)
    pose[:3, :3] = _rotation(where, rotation)
    moved = _numbers(where, "translation", translation, None)
    pose[:3, 3] = _numbers(where, "translation", moved, (3,))
    if size is not None and min(size) < 1:
        raise RecordingError(f"{where}: picture size {size[0]}x{size[1]} px is not positive")
    if abs(matrix[2, 2]) < 1e-12 or np.abs(matrix[2, :2]).max() > 1e-9 * abs(matrix[2, 2]):
        raise RecordingError(
            f"{where}: the last row of its camera matrix is {matrix[2].tolist()}, expected 0 0 1; "
            "is the matrix transposed?"
        )
    matrix = matrix / matrix[2, 2]
    if abs(matrix[1, 0]) > 1e-9 * abs(matrix[0, 0]):
        raise RecordingError(f"{where}: its camera matrix is not upper triangular ({matrix[1, 0]} in row 2)")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise RecordingError(
            f"{where}: focal lengths {matrix[0, 0]:g} and {matrix[1, 1]:g} px must both be positive"
        )
    return GivenCamera(name, size, matrix, pose, lens, place)


def picture_size(where: str, width: object, height: object) -> Size:
    """(width, height) px from what a file holds, whole numbers though some write them as 1920.0."""
    try:
        values = float(width), float(height)  # type: ignore[arg-type]
        size = round(values[0]), round(values[1])
    except (TypeError, ValueError, OverflowError):
        size = (0, 0)
    if min(size) < 1:
        raise RecordingError(f"{where}: picture size {width} x {height} is not one in pixels")
    return size


def numbered_names(names: Sequence[str]) -> list[int]:
    """A number a camera for formats that count them: the last one in each name if all have one and no two
    are the same, else their order."""
    found = [re.findall(r"\d+", name) for name in names]
    numbers = [int(digits[-1]) for digits in found if digits]
    return numbers if len(set(numbers)) == len(names) else list(range(len(names)))


def _numbers(where: str, what: str, values: object, shape: tuple[int, ...] | None) -> np.ndarray:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{where}: its {what} is not made of numbers ({error})") from error
    array = array.ravel() if shape is None else array
    if shape is not None and array.shape != shape:
        wanted = " x ".join(map(str, shape))
        raise RecordingError(f"{where}: its {what} has shape {array.shape}, expected {wanted} numbers")
    if not np.isfinite(array).all():
        bad = array[~np.isfinite(array)][0]
        raise RecordingError(
            f"{where}: its {what} holds {bad}; every value must be a finite number: calibrate it again"
        )
    return array


def _rotation(where: str, given: object) -> Float[np.ndarray, "3 3"]:
    flat = _numbers(where, "rotation", given, None)
    if flat.size == 3:
        return cv2.Rodrigues(flat)[0]
    matrix = _numbers(where, "rotation", given, (3, 3))
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _ROUNDED:
        raise RecordingError(
            f"{where}: its 3x3 rotation is none (its rows are not perpendicular unit vectors); "
            "restore the file or calibrate this camera again"
        )
    if np.linalg.det(matrix) < 0:
        raise RecordingError(
            f"{where}: mirrored calibration (its rotation has determinant -1); "
            "export it again from a right-handed world frame"
        )
    left, _, right = np.linalg.svd(matrix)
    return left @ right  # the nearest rotation: text with few digits is none exactly


def _lens(where: str, values: Float[np.ndarray, "_given"]) -> Float[np.ndarray, "_kept"]:
    """Without zeros at the end, in one of the lengths that Camera takes."""
    n_used = int(np.flatnonzero(values)[-1]) + 1 if values.any() else 0
    if n_used == 0:
        return np.zeros(0)
    if n_used > 8:
        raise RecordingError(
            f"{where}: {values.size} distortion values; the thin prism and tilt terms are not modelled here. "
            "Undistort the pictures and give the camera without distortion"
        )
    length = 4 if n_used <= 4 else 5 if n_used == 5 else 8
    kept = np.zeros(length)
    kept[:n_used] = values[:n_used]
    return kept
