"""Calibrations in OpenCV FileStorage (YAML, XML, JSON) or plain JSON. There is no standard for their names:
the common ones are known here (`KEYS`), with or without underscores, in any case.

Layouts: a file a camera in one folder (named by `camera_name` or the file); one file with a map or list of
cameras, at the root or under `cameras` (multical keeps poses apart under `camera_poses`); or one file whose
keys end in the camera's name (`K_left`, `R_left`). World to camera, pixel centres at whole numbers, as
OpenCV's functions take them; the unit is the board's and unstated.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.camera import Camera
from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, GivenCamera, Size, foreign_rig, given_camera, picture_size
from capture.formats.limits import key_names, skew_notes
from capture.formats.opencv_tree import read_tree
from capture.rig import Rig

ENDINGS = (".yml", ".yaml", ".xml", ".json")
#: What is meant: how it is called, small letters without underscores.
KEYS: dict[str, tuple[str, ...]] = {
    "K": ("cameramatrix", "k", "intrinsicmatrix", "intrinsics", "intrinsic", "m", "mtx", "matrix", "intri",
          "camint", "cameraintrinsics"),
    "D": ("distortioncoefficients", "distcoeffs", "distcoef", "distcoeff", "distortion", "distortions",
          "dist", "d", "distortionvector", "distortioncoeffs", "kc"),
    "R": ("r", "rotation", "rotationmatrix", "rot", "rvec", "rotationvector", "rodrigues", "rmat"),
    "T": ("t", "translation", "tvec", "translationvector", "trans", "tmat"),
    "RT": ("rt", "extrinsicmatrix", "extrinsics", "extrinsic", "extrinsicsmatrix", "camerafromworld",
           "worldtocamera", "w2c", "tcamworld", "camext", "extri"),
    # MC-Calib: the camera's own place in the world.
    "inverse RT": ("camerapose", "cameraposematrix", "cameratoworld", "worldfromcamera", "c2w", "cam2world"),
    "width": ("imagewidth", "width", "imgwidth", "w"),
    "height": ("imageheight", "height", "imgheight", "h"),
    "size": ("imagesize", "size", "resolution", "imgsize", "imshape"),
    "name": ("cameraname", "name", "id", "serial", "cameraid", "camid"),
    "fisheye": ("fisheye", "isfisheye"),
}  # fmt: skip
_MEANING = {spelling: meaning for meaning, spellings in KEYS.items() for spelling in spellings}


def has_cameras(content: dict[str, Any]) -> bool:
    """Whether a parsed file holds at least one camera matrix under a known name."""
    return any(True for _ in _entries(content, Path("x")))


def read_opencv(paths: list[Path]) -> ForeignRig:
    """The cameras of one file, or of a file each. Raises RecordingError, naming file and camera."""
    cameras: list[GivenCamera] = []
    notes: list[str] = []
    for path in paths:
        found = list(_entries(read_tree(path), path))
        if not found:
            raise RecordingError(
                f"{path}: no camera matrix under any of the usual names (camera_matrix, cameraMatrix, K, "
                "intrinsics, ...) in it"
            )
        for name, entry in found:
            if "K" not in entry:
                notes.append(f"{path}: {name} has a pose but no camera matrix, left out.")
                continue
            cameras.append(_camera(path, name, entry))
    return foreign_rig(cameras, None, paths, notes)


def write_opencv(rig: Rig, path: Path) -> list[str]:
    """One file with all cameras where `path` ends in .yml, .yaml, .xml or .json; else a folder, one .yml a
    camera. Metres."""
    notes = skew_notes(rig, "OpenCV FileStorage", "OpenCV's lens code")
    if path.suffix.lower() in ENDINGS:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.startWriteStruct("cameras", cv2.FileNode_SEQ)
        for camera in rig:
            storage.startWriteStruct("", cv2.FileNode_MAP)
            _write_camera(storage, camera)
            storage.endWriteStruct()
        storage.endWriteStruct()
        storage.release()
    else:
        names, renamed = key_names(rig, "-_.", "OpenCV FileStorage")
        notes += renamed
        for name, camera in zip(names, rig, strict=True):
            storage = cv2.FileStorage(str(path / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
            _write_camera(storage, camera)
            storage.release()
    return ["OpenCV FileStorage states no unit: this calibration is in metres, world to camera.", *notes]


def _write_camera(storage: cv2.FileStorage, camera: Camera) -> None:
    lens = np.zeros((1, max(5, camera.distortion.size)))
    lens[0, : camera.distortion.size] = camera.distortion
    storage.write("camera_name", camera.name)
    storage.write("image_width", camera.size[0])
    storage.write("image_height", camera.size[1])
    storage.write("camera_matrix", camera.intrinsics.copy())
    storage.write("distortion_coefficients", lens)
    storage.write("R", camera.camera_from_world[:3, :3].copy())
    storage.write("T", camera.camera_from_world[:3, 3:].copy())


def _entries(content: dict[str, Any], path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """(name, meaning -> value) of every camera in a parsed file, whatever its layout."""
    own = _meanings(content)
    if "K" in own and not _per_camera(content):
        yield _name(own, path.stem), own
        return
    below = next((content[key] for key in ("cameras", "Cameras", "calibration") if key in content), content)
    poses = content.get("camera_poses", content.get("poses"))
    listed = _listed(below)
    if any("K" in entry for _, entry in listed):
        for name, entry in listed:
            if isinstance(poses, dict):
                # multical: "left", or "left_to_middle" where middle is the master.
                pose = next(
                    (poses[key] for key in poses if key == name or key.startswith(f"{name}_to_")), None
                )
                entry = {**entry, **_meanings(pose)} if isinstance(pose, dict) else entry
            if "K" in entry or "R" in entry or "RT" in entry:
                yield _name(entry, name), entry
        return
    yield from _by_suffix(content)


def _listed(below: Any) -> list[tuple[str, dict[str, Any]]]:
    if isinstance(below, list):
        return [(str(k), _meanings(part)) for k, part in enumerate(below) if isinstance(part, dict)]
    if not isinstance(below, dict):
        return []
    parts = [(key, part) for key, part in below.items() if isinstance(part, dict)]
    if len(parts) == 1 and len(below) == 1 and not _meanings(parts[0][1]):
        return _listed(parts[0][1])  # one sequence, its cameras inside
    return [(key, _meanings(part)) for key, part in parts]


def _by_suffix(content: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Keys that end in a camera's name: K_left, cameraMatrix_0, T1."""
    cameras: dict[str, dict[str, Any]] = {}
    for key, value in content.items():
        match = re.fullmatch(r"([A-Za-z]+(?:_[A-Za-z]+)??)[_-]?([0-9]\w*|(?<=[_-])\w[\w.-]*)", key)
        meaning = _MEANING.get(_plain(match[1])) if match else None
        if match and meaning and isinstance(value, np.ndarray | list | float | int):
            cameras.setdefault(match[2], {}).setdefault(meaning, value)
    for name, entry in cameras.items():
        if "K" in entry:
            yield name, {**_meanings(content), **entry}


def _per_camera(content: dict[str, Any]) -> bool:
    """Whether K and the like are maps from camera to matrix themselves."""
    return any(isinstance(v, dict) for k, v in content.items() if _MEANING.get(_plain(k)) == "K")


def _meanings(part: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in part.items():
        meaning = _MEANING.get(_plain(key))
        if meaning is not None and value is not None:
            found.setdefault(meaning, value)
    return found


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _name(entry: dict[str, Any], fallback: str) -> str:
    name = entry.get("name", fallback)
    return str(int(name)) if isinstance(name, float) and name.is_integer() else str(name)


def _camera(path: Path, name: str, entry: dict[str, Any]) -> GivenCamera:
    where = f"{path}: camera {name}"
    if entry.get("fisheye") not in (None, 0, 0.0, False, "false", "False"):
        raise RecordingError(
            f"{where} has a fisheye lens, which is not modelled here; undistort its pictures and give a "
            "camera without distortion"
        )
    rotation, translation = _pose(where, entry)
    intrinsics = _array(where, entry["K"])
    if intrinsics.size == 4 and intrinsics.shape != (2, 2):
        fx, fy, cx, cy = intrinsics.ravel()
        intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    elif intrinsics.size == 9:
        intrinsics = intrinsics.reshape(3, 3)
    lens = _array(where, entry.get("D", [])).ravel()
    return given_camera(path, name, _size(where, entry), intrinsics, rotation, translation, lens)


def _pose(where: str, entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3 3 or 3) and translation (3), world to camera."""
    if "R" in entry and "T" in entry:
        rotation = _array(where, entry["R"])
        return (rotation.reshape(3, 3) if rotation.size == 9 else rotation.ravel()), _array(
            where, entry["T"]
        ).ravel()
    for meaning in ("RT", "inverse RT"):
        if meaning in entry:
            matrix = _array(where, entry[meaning])
            if matrix.size not in (12, 16):
                raise RecordingError(
                    f"{where}: its pose has {matrix.size} numbers, a 3x4 or 4x4 matrix is due"
                )
            given = np.vstack([matrix.reshape(-1, 4)[:3], [0, 0, 0, 1]])
            pose = given if meaning == "RT" else np.linalg.inv(given)
            return pose[:3, :3], pose[:3, 3]
    raise RecordingError(
        f"{where}: intrinsics without a pose (R and T, world to camera); calibrate the extrinsics too"
    )


def _size(where: str, entry: dict[str, Any]) -> Size | None:
    if "width" in entry and "height" in entry:
        return picture_size(where, entry["width"], entry["height"])
    if "size" in entry:
        values = _array(where, entry["size"]).ravel()
        if values.size == 2:
            return picture_size(where, *values)
    return None


def _array(where: str, values: Any) -> np.ndarray:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{where}: {str(values)[:60]!r} is not made of numbers") from error
