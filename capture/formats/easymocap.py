"""EasyMocap's `intri.yml` and `extri.yml`, a pair of OpenCV FileStorage files.

`names`; `K_<name>` (3 3) px, `dist_<name>` (or `D_`), `H_`, `W_` in the first; `R_<name>` (Rodrigues),
`Rot_<name>` (3 3), `T_<name>` (3 1) in the second. World to camera, metres, pixel centres at whole numbers.
Its own writer leaves six decimals and no sizes; `R_` is what its reader uses. Names that look like numbers
lose their leading zeros in some tools: they are found again by their value.
Read in easymocap/mytools/camera_utils.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, foreign_rig, given_camera, picture_size
from capture.formats.limits import key_names, row_text, skew_notes
from capture.formats.opencv_tree import read_tree
from capture.rig import Rig
from capture.silhouette_files import png_size

_PICTURE_ENDINGS = (".jpg", ".png", ".jpeg", ".bmp")


def find_pair(folder: Path) -> tuple[Path, Path] | None:
    """(intri, extri) of a folder, .yml or .yaml; None where one is missing."""
    for ending in ("yml", "yaml"):
        pair = folder / f"intri.{ending}", folder / f"extri.{ending}"
        if pair[0].is_file() and pair[1].is_file():
            return pair
    return None


def read_easymocap(folder: Path) -> ForeignRig:
    """Every camera of the pair, metres; sizes from H_ and W_, else from `images/<name>/` beside the files.

    Raises RecordingError, naming file and camera.
    """
    pair = find_pair(folder)
    if pair is None:
        raise RecordingError(f"{folder}: EasyMocap needs both intri.yml and extri.yml in one folder")
    intri_path, extri_path = pair
    intri, extri = read_tree(intri_path), read_tree(extri_path)
    cameras, notes = [], []
    for listed in _names(intri, intri_path):
        name = _as_keyed(listed, intri)
        where = f"{intri_path}: camera {name}"
        matrix = intri.get(f"K_{name}")
        if matrix is None:
            raise RecordingError(f"{where} is listed in names, but K_{name} is missing; is the file whole?")
        lens = intri.get(f"dist_{name}", intri.get(f"D_{name}", ()))
        key = _as_keyed(name, extri, ("R_", "Rot_"))
        vector, turned = extri.get(f"R_{key}"), extri.get(f"Rot_{key}")
        translation = extri.get(f"T_{key}")
        if (vector is None and turned is None) or translation is None:
            missing = f"T_{key}" if translation is None else f"R_{key} and Rot_{key}"
            raise RecordingError(
                f"{extri_path}: camera {name} is calibrated in {intri_path.name}, but {missing} is missing "
                "here; is the file whole?"
            )
        rotation = turned if vector is None else vector
        notes += _disagreement(f"{extri_path}: camera {name}", vector, turned)
        height, width = intri.get(f"H_{name}"), intri.get(f"W_{name}")
        known = height is not None and width is not None and float(height) > 0 and float(width) > 0
        size = picture_size(where, width, height) if known else _size_beside(folder, name)
        cameras.append(given_camera(intri_path, name, size, matrix, rotation, translation, lens))
    return foreign_rig(cameras, "m", [intri_path, extri_path], notes)


def write_easymocap(rig: Rig, folder: Path) -> list[str]:
    """Both files, every number at full precision, with the sizes."""
    names, notes = key_names(rig, "-_", "EasyMocap")
    head = ["%YAML:1.0", "---", "names:", *(f'  - "{name}"' for name in names)]
    intri, extri = list(head), list(head)
    for name, camera in zip(names, rig, strict=True):
        lens = np.zeros(max(5, camera.distortion.size))
        lens[: camera.distortion.size] = camera.distortion
        rotation = camera.camera_from_world[:3, :3].copy()
        intri += _matrix(f"K_{name}", camera.intrinsics) + _matrix(f"dist_{name}", lens[None])
        intri += [f"H_{name}: {camera.size[1]}", f"W_{name}: {camera.size[0]}"]
        extri += _matrix(f"R_{name}", cv2.Rodrigues(rotation)[0]) + _matrix(f"Rot_{name}", rotation)
        extri += _matrix(f"T_{name}", camera.camera_from_world[:3, 3:])
    for file, lines in (("intri.yml", intri), ("extri.yml", extri)):
        (folder / file).write_text("\n".join(lines) + "\n", encoding="utf-8")
    longer = [camera.name for camera in rig if camera.distortion.size > 5]
    if longer:
        notes.append(
            f"EasyMocap writes five distortions itself; this pair has eight for {', '.join(longer)}, "
            "which OpenCV, and so its reader, takes."
        )
    return notes + skew_notes(rig, "EasyMocap", "OpenCV's lens code")


def _names(intri: dict[str, Any], path: Path) -> list[str]:
    listed = intri.get("names")
    if isinstance(listed, list) and listed:
        return [str(int(n)) if isinstance(n, float | int) else str(n) for n in listed if n != "none"]
    keyed = [key[2:] for key in intri if key.startswith("K_")]
    if not keyed:
        raise RecordingError(f"{path}: neither a list of names nor any K_<name> in it; is it EasyMocap's?")
    return keyed


def _as_keyed(name: str, content: dict[str, Any], prefixes: tuple[str, ...] = ("K_",)) -> str:
    """The name as the keys spell it: 1 is found as 01."""
    keyed = [key[len(p) :] for p in prefixes for key in content if key.startswith(p)]
    if name in keyed or not name.isdigit():
        return name
    alike = {other for other in keyed if other.isdigit() and int(other) == int(name)}
    return alike.pop() if len(alike) == 1 else name


def _disagreement(where: str, vector: Any, matrix: Any) -> list[str]:
    if not isinstance(vector, np.ndarray) or not isinstance(matrix, np.ndarray):
        return []
    if vector.size != 3 or matrix.shape != (3, 3) or not np.isfinite(vector).all():
        return []
    off = float(np.abs(cv2.Rodrigues(vector.ravel())[0] - matrix).max())
    return [f"{where}: R_ and Rot_ differ by {off:.2g}; R_ is used, as EasyMocap does."] if off > 1e-4 else []


def _size_beside(folder: Path, name: str) -> tuple[int, int] | None:
    for place in (folder / "images" / name, folder.parent / "images" / name):
        if place.is_dir():
            for picture in sorted(place.iterdir()):
                if picture.suffix.lower() in _PICTURE_ENDINGS:
                    return png_size(picture)
    return None


def _matrix(key: str, values: np.ndarray) -> list[str]:
    return [
        f"{key}: !!opencv-matrix",
        f"  rows: {values.shape[0]}",
        f"  cols: {values.shape[1]}",
        "  dt: d",
        f"  data: [{row_text(values.ravel())}]",
    ]
