"""Which calibration a recording comes with: finds the format, reads it, and pairs its cameras with the
pictures.

Formats: a folder of `camNN.txt` (INRIA), a Qualisys `.qca.txt`, and this project's own rig JSON.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from capture.camera import Camera
from capture.errors import RecordingError
from capture.formats.inria import list_matrix_files, read_inria_camera
from capture.formats.qualisys import UNIT as QUALISYS_UNIT
from capture.formats.qualisys import read_qualisys
from capture.rig import Rig


class PictureSizeError(RecordingError):
    """A camera that is calibrated for pictures of another size. camera : its name in the recording."""

    def __init__(self, text: str, camera: str, calibrated: tuple[int, int]) -> None:
        super().__init__(text)
        self.camera, self.calibrated = camera, calibrated


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says, for the cameras that have pictures.

    rig : in the file's own world unit, in the order of the pictures, named like them.
    unit : "m", "cm", "mm", or None where the format does not say.
    files : what was read.
    notes : sentences on cameras that were left out.
    """

    rig: Rig
    unit: str | None
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def read_calibration(path: Path, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    """Read the calibration at `path` for the cameras in `sizes` (camera name -> (width, height) px of its
    pictures).

    Names are paired when equal, else by their number (`cam-003` is `cam03`). Raises RecordingError for a
    camera with pictures but no calibration, and for pictures of another size than calibrated.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such calibration; give one with --calibration FILE")
    if path.is_dir():
        return _read_matrix_folder(path, sizes)
    return _paired(*read_rig_file(path), path, sizes)


def read_rig_file(path: Path) -> tuple[Rig, str]:
    """Every camera of a rig .json or a Qualisys .qca.txt, and the file's unit. Raises RecordingError."""
    suffix = "".join(path.suffixes).lower()
    if suffix.endswith(".json"):
        return Rig.load(path), "m"
    if suffix.endswith((".qca.txt", ".qca", ".xml")) or path.read_bytes()[:512].lstrip().startswith(b"<"):
        return read_qualisys(path), QUALISYS_UNIT
    raise RecordingError(
        f"{path}: unknown calibration format; known are a folder of camNN.txt (3x4 matrices), "
        "a Qualisys .qca.txt and a rig .json"
    )


def camera_number(name: str) -> int | None:
    """The last number in a camera's name; None where it has none."""
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else None


def _read_matrix_folder(folder: Path, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    files = list_matrix_files(folder)
    if not files:
        raise RecordingError(
            f"{folder}: no camNN.txt in this folder; each camera needs its 3x4 projection matrix"
        )
    cameras: list[Camera] = []
    used: dict[str, Path] = {}
    for name, size in sizes.items():
        number = camera_number(name)
        file = files.get(number) if number is not None else None
        if file is None:
            expected = folder / (f"cam{number:02d}.txt" if number is not None else "camNN.txt")
            raise RecordingError(
                f"{expected}: missing, but camera {name} has pictures; "
                f"restore the file or move the folder {name} out of the recording"
            )
        cameras.append(read_inria_camera(file, name, size))
        used[name] = file
    spare = [file.name for file in files.values() if file not in used.values()]
    return Calibration(Rig(tuple(cameras)), None, tuple(used.values()), _spare_note(folder, spare))


def _paired(rig: Rig, unit: str, path: Path, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    by_name = {camera.name: camera for camera in rig}
    cameras: list[Camera] = []
    for name, size in sizes.items():
        camera = by_name.get(name) or _only_with_number(rig, camera_number(name))
        if camera is None:
            raise RecordingError(
                f"{path}: camera {name} has pictures but is not in this calibration "
                f"(it has {', '.join(rig.names)})"
            )
        if camera.size != size:
            raise PictureSizeError(
                f"{path}: camera {name} is calibrated for {camera.size[0]}x{camera.size[1]} px, "
                f"its pictures are {size[0]}x{size[1]} px; use pictures of the calibrated size",
                name,
                camera.size,
            )
        cameras.append(_renamed(camera, name))
        by_name.pop(camera.name, None)
    return Calibration(Rig(tuple(cameras)), unit, (path,), _spare_note(path, sorted(by_name)))


def _only_with_number(rig: Rig, number: int | None) -> Camera | None:
    same = [camera for camera in rig if number is not None and camera_number(camera.name) == number]
    return same[0] if len(same) == 1 else None


def _renamed(camera: Camera, name: str) -> Camera:
    return Camera(
        name, camera.size, camera.intrinsics, camera.camera_from_world, camera.distortion, camera.projection
    )


def _spare_note(path: Path, spare: list[str]) -> tuple[str, ...]:
    if not spare:
        return ()
    return (f"{path}: calibrated but without pictures, left out: {', '.join(spare)}.",)
