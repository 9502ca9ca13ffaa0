"""Which calibration a recording comes with: finds it, reads it in whatever format it is, and pairs its
cameras with the pictures.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from capture.camera import Camera
from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, GivenCamera
from capture.formats.colmap import find_model
from capture.formats.easymocap import find_pair
from capture.formats.inria import list_matrix_files, read_inria_camera
from capture.rig import Rig
from capture.rig_checks import lens_doubts
from capture.rig_formats import CALIBRATION_ENDINGS, detect_format, known_formats, read_rig_of


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
    notes : sentences on cameras that were left out, and on what looks odd.
    leaves_open : whether the format leaves open how pixels are counted (3x4 matrices).
    """

    rig: Rig
    unit: str | None
    files: tuple[Path, ...]
    notes: tuple[str, ...]
    leaves_open: bool = False


def find_calibrations(root: Path) -> list[Path]:
    """The calibrations that a recording holds, in its folder, in `calibration/` or `setup/`."""
    found: list[Path] = []
    for folder in (root, root / "calibration", root / "setup"):
        if not folder.is_dir():
            continue
        if list_matrix_files(folder):
            found.append(folder)
        pair, model = find_pair(folder), find_model(folder)
        if pair is not None:
            found.append(pair[0])
        if model is not None:
            found.append(model[0])
        single = [
            path
            for path in sorted(folder.iterdir())
            if path.is_file() and path.name.lower().endswith(CALIBRATION_ENDINGS)
        ]
        kinds = {path: detect_format(path) for path in single}
        one_a_camera = [path for path in single if kinds[path] == "opencv"]
        if len(one_a_camera) > 1:
            found.append(folder)
        found += [
            path
            for path in single
            if kinds[path] not in (None, "easymocap") and (len(one_a_camera) < 2 or path not in one_a_camera)
        ]
    return list(dict.fromkeys(found))


def read_calibration(path: Path, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    """Read the calibration at `path` for the cameras in `sizes` (camera name -> (width, height) px of its
    pictures).

    Names are paired when equal, else by their number (`cam-003` is `cam03`). Raises RecordingError for a
    camera with pictures but no calibration, and for pictures of another size than calibrated.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such calibration; give one with --calibration FILE")
    found = detect_format(path)
    if found == "inria":
        folder = path if path.is_dir() else path.parent
        return _read_matrix_folder(folder if list_matrix_files(folder) else folder / "setup", sizes)
    if found is None and path.is_dir():
        raise RecordingError(
            f"{path}: no camNN.txt in this folder; each camera needs its 3x4 projection matrix "
            f"(or another calibration: {known_formats()})"
        )
    return _paired(read_rig_of(path), path, sizes)


def read_rig_file(path: Path) -> tuple[Rig, str | None]:
    """Every camera of a calibration that states its picture sizes, and the file's unit (None: unknown).
    Raises RecordingError."""
    foreign = read_rig_of(path)
    return foreign.rig(), foreign.unit


def camera_number(name: str) -> int | None:
    """The last number in a camera's name; None where it has none."""
    numbers = re.findall(r"\d+", name)
    return int(numbers[-1]) if numbers else None


def _read_matrix_folder(folder: Path, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    files = list_matrix_files(folder)
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
    return Calibration(Rig(tuple(cameras)), None, tuple(used.values()), _spare_note(folder, spare), True)


def _paired(foreign: ForeignRig, path: Path, sizes: Mapping[str, tuple[int, int]]) -> Calibration:
    by_name = {camera.name: camera for camera in foreign.cameras}
    cameras: list[Camera] = []
    for name, size in sizes.items():
        camera = by_name.get(name) or _only_with_number(foreign, camera_number(name))
        if camera is None:
            raise RecordingError(
                f"{path}: camera {name} has pictures but is not in this calibration "
                f"(it has {', '.join(foreign.names)})"
            )
        if camera.size is not None and camera.size != size:
            raise PictureSizeError(
                f"{path}: camera {name} is calibrated for {camera.size[0]}x{camera.size[1]} px, "
                f"its pictures are {size[0]}x{size[1]} px; use pictures of the calibrated size",
                name,
                camera.size,
            )
        cameras.append(camera.sized(size, name))
        by_name.pop(camera.name, None)
    rig = Rig(tuple(cameras))
    notes = (*foreign.notes, *_spare_note(path, sorted(by_name)), *lens_doubts(rig))
    return Calibration(rig, foreign.unit, foreign.files, notes)


def _only_with_number(foreign: ForeignRig, number: int | None) -> GivenCamera | None:
    same = [c for c in foreign.cameras if number is not None and camera_number(c.name) == number]
    return same[0] if len(same) == 1 else None


def _spare_note(path: Path, spare: list[str]) -> tuple[str, ...]:
    if not spare:
        return ()
    return (f"{path}: calibrated but without pictures, left out: {', '.join(spare)}.",)
