"""Every calibration format that this project reads and writes: which one a file or folder is, told by its
content, and one function each to read and to write any of them.

What is written is read again and compared before it appears under its name: a format that would move a
point by more than `MOST_LOSS_PX` raises instead of losing accuracy in silence.
"""

from __future__ import annotations

import json
import re
import tempfile
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, GivenCamera, foreign_rig, of_rig
from capture.formats import (
    actorshq,
    colmap,
    easymocap,
    inria,
    middlebury,
    opencv,
    toml_cameras,
    vicon,
    zju_mocap,
)
from capture.formats.numpy_pickle import MAGIC as NPY_MAGIC
from capture.formats.opencv_tree import read_tree
from capture.formats.qualisys import UNIT as QUALISYS_UNIT
from capture.formats.qualisys import read_qualisys, write_qualisys
from capture.rig import Rig
from capture.silhouette_files import png_size

MOST_LOSS_PX = 1e-6
METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_N_PROBES = 200


@dataclass(frozen=True)
class RigFormat:
    """A format by name.

    title : what it is called in sentences. file : the file's usual name, or None where it is a folder.
    write : (rig in metres, path) -> sentences on what it cannot hold; the path is a file to make, or a folder
    that exists. tolerance_px : how far a point may move between what was asked for and what was written.
    """

    name: str
    title: str
    file: str | None
    write: Callable[[Rig, Path], list[str]]
    tolerance_px: float = MOST_LOSS_PX


def _write_own(rig: Rig, path: Path) -> list[str]:
    rig.save(path)
    return []


_ALL = (
    RigFormat("bodyhull", "a rig .json", "rig.json", _write_own),
    RigFormat("inria", "a folder of camNN.txt (3x4 matrices)", None, inria.write_inria),
    RigFormat("colmap", "a COLMAP model (binary)", None, colmap.write_colmap),
    RigFormat("colmap-text", "a COLMAP model (text)", None, partial(colmap.write_colmap, text=True)),
    RigFormat("easymocap", "EasyMocap's intri.yml and extri.yml", None, easymocap.write_easymocap),
    RigFormat("opencv", "OpenCV FileStorage (yml, xml, json)", "cameras.yml", opencv.write_opencv),
    RigFormat("aniposelib", "an aniposelib .toml", "calibration.toml", toml_cameras.write_aniposelib),
    RigFormat("pose2sim", "a Pose2Sim .toml", "Calib.toml", toml_cameras.write_pose2sim),
    RigFormat(
        "caliscope", "caliscope's camera_array.toml", "camera_array.toml", toml_cameras.write_caliscope
    ),
    RigFormat("qualisys", "a Qualisys .qca.txt", "calibration.qca.txt", write_qualisys),
    RigFormat("vicon", "a Vicon .xcp", "calibration.xcp", vicon.write_vicon, 2 * vicon.MOST_LENS_ERROR_PX),
    RigFormat("zju-mocap", "ZJU-MoCap's annots.npy", "annots.npy", zju_mocap.write_zju_mocap),
    RigFormat("actorshq", "ActorsHQ's calibration.csv", "calibration.csv", actorshq.write_actorshq),
    RigFormat("middlebury", "Middlebury's *_par.txt", "cameras_par.txt", middlebury.write_middlebury),
)
FORMATS: dict[str, RigFormat] = {rig_format.name: rig_format for rig_format in _ALL}
#: Endings of single files that may be calibrations, most telling first.
CALIBRATION_ENDINGS = (
    ".qca.txt",
    ".qca",
    ".xcp",
    "_par.txt",
    ".npy",
    ".csv",
    ".toml",
    ".json",
    ".yml",
    ".yaml",
    ".xml",
)


def known_formats() -> str:
    """All formats in one sentence's part."""
    return ", ".join(rig_format.title for rig_format in _ALL)


def detect_format(path: Path) -> str | None:
    """The format's name of a file or folder, by its content; None where it is none that is known.

    A folder stands for the format whose files it holds, or for the one calibration file in it; for a folder
    with several, RecordingError. A file that is broken counts by its name, so that reading it tells why.
    """
    found = _located(path)
    return None if found is None else found[0]


def read_rig_of(path: Path) -> ForeignRig:
    """The cameras of any known file or folder. Raises RecordingError: no such path, no known format, or what
    is wrong inside."""
    if not path.exists():
        raise RecordingError(f"{path}: no such calibration")
    found = _located(path)
    if found is None:
        raise RecordingError(f"{path}: unknown calibration format; known are {known_formats()}")
    name, place = found
    return _READERS[name](place)


def write_rig(
    rig: Rig, path: Path, format_name: str, *, overwrite: bool = False
) -> tuple[list[Path], list[str]]:
    """Write a rig in metres; returns the files and sentences on what the format does not hold.

    `path`: the file to make, or the folder for it (a folder where it exists or has no ending); its parents
    are made. Files appear whole or not at all. Raises RecordingError where the format cannot hold this rig,
    or where a calibration is there already and `overwrite` is not given.
    """
    chosen = FORMATS[format_name]
    file = chosen.file
    in_folder = file is None or path.is_dir() or not path.suffix
    one_a_camera = format_name == "opencv" and in_folder
    if file is None or one_a_camera:
        if path.is_file():
            raise RecordingError(
                f"{path}: {chosen.title} is a folder of files, but this is a file; name a folder"
            )
        folder, only = path, None
    else:
        folder, only = (path, file) if in_folder else (path.parent, path.name)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".convert-", dir=folder) as scratch:
        made = Path(scratch) if only is None else Path(scratch) / only
        notes = chosen.write(rig, made)
        _check_written(rig, made, chosen)
        made_files = sorted(Path(scratch).iterdir())
        # COLMAP's other kind, or matrices of more cameras: left in place they would be read in their stead.
        stale = [*_relatives(folder, format_name), *(folder / file.name for file in made_files)]
        there = [file for file in dict.fromkeys(stale) if file.exists()]
        if there and not overwrite:
            raise RecordingError(f"{there[0]}: is there already; --overwrite replaces it")
        for old in there:
            old.unlink()
        for source in made_files:
            source.replace(folder / source.name)
    return [folder / file.name for file in made_files], notes


def _relatives(folder: Path, format_name: str) -> list[Path]:
    """Files in a folder that belong to a calibration of this format, whoever wrote it."""
    if format_name == "inria":
        return list(inria.list_matrix_files(folder).values())
    if format_name.startswith("colmap"):
        return [folder / f"{part}.{end}" for part in colmap.PARTS for end in ("bin", "txt")]
    return []


def largest_difference_px(rig: Rig, other: Rig) -> float:
    """How far the pixels of points spread over each camera's picture differ at most between two rigs with the
    same world and order."""
    worst = 0.0
    rng = np.random.default_rng(0)
    for camera, same in zip(rig, other, strict=True):
        width, height = camera.size
        pixels = rng.uniform([0, 0], [width - 1, height - 1], (_N_PROBES, 2))
        distance = max(float(np.linalg.norm(camera.centre)), 1e-3)
        points = camera.unproject(pixels, rng.uniform(0.5, 1.5, _N_PROBES) * distance)
        moved = np.abs(same.project(points)[0] - camera.project(points)[0])
        worst = max(worst, float(np.nan_to_num(moved, nan=0.0).max()))
        if np.isfinite(moved).all(axis=1).mean() < 0.5:
            return float("inf")
    return worst


def _check_written(rig: Rig, made: Path, chosen: RigFormat) -> None:
    """Read what was written and compare. `made`: the file, or the folder of files."""
    back = read_rig_of(made)
    sizes = dict(zip(back.names, [camera.size for camera in rig], strict=True))
    metric = back.with_sizes(sizes.get).rig().with_world_scaled(METRES_PER_UNIT[back.unit or "m"])
    off_px = largest_difference_px(rig, metric)
    if off_px > chosen.tolerance_px:
        raise RecordingError(
            f"{chosen.title} would move points by up to {off_px:.2g} px, so nothing was written; "
            "choose another format (bodyhull and opencv hold every number)"
        )


def _located(path: Path) -> tuple[str, Path] | None:
    """(format, what its reader takes)."""
    if path.is_file():
        name = _format_of_file(path)
        if name is None:
            return None
        # These are folders of several files, whichever of them was named.
        return name, path.parent if name in ("easymocap", "colmap", "inria") else path
    if easymocap.find_pair(path):
        return "easymocap", path
    if colmap.find_model(path):
        return "colmap", path
    for place in (path, path / "setup"):
        if place.is_dir() and inria.list_matrix_files(place):
            return "inria", place
    return _single_file_in(path)


def _single_file_in(folder: Path) -> tuple[str, Path] | None:
    """The one calibration file in a folder, or a folder of one OpenCV file a camera."""
    found: list[tuple[str, Path]] = []
    for file in sorted(path for path in folder.iterdir() if path.is_file()):
        if file.name.lower().endswith(CALIBRATION_ENDINGS):
            name = _format_of_file(file)
            if name is not None:
                found.append((name, file))
    if len(found) > 1 and {name for name, _ in found} == {"opencv"}:
        return "opencv", folder
    if len(found) > 1:
        listed = ", ".join(file.name for _, file in found)
        raise RecordingError(f"{folder}: several calibrations ({listed}); name the file")
    return found[0] if found else None


def _format_of_file(path: Path) -> str | None:
    try:
        with path.open("rb") as file:
            head = file.read(65536)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    suffix = path.name.lower()
    if head.startswith(NPY_MAGIC) or suffix.endswith(".npy"):
        holds_objects = b"|O" in head[:256] or path.name == "annots.npy"
        return "zju-mocap" if holds_objects else None
    model = colmap.find_model(path.parent) if path.stem.lower() in ("cameras", "images") else None
    if model is not None and model[0] == path.parent:
        return "colmap"
    text = head.decode("utf-8-sig", errors="replace").lstrip()
    if text.startswith("<") and (found := _format_of_xml(text)) is not None:
        return found
    if suffix.endswith((".qca.txt", ".qca")):
        return "qualisys"
    if suffix.endswith(".xcp"):
        return "vicon"
    if text.startswith("{") or suffix.endswith(".json"):
        return _format_of_json(path)
    if suffix.endswith((".yml", ".yaml")) or text.startswith("%YAML"):
        return _format_of_yaml(path)
    if suffix.endswith(".toml") or re.match(r"\[[^\]\s]+\]\s", text):
        return _format_of_toml(path)
    if actorshq.is_actorshq(text):
        return "actorshq"
    if middlebury.is_middlebury(text) or suffix.endswith("_par.txt"):
        return "middlebury"
    if inria.is_matrix_file(path):
        return "inria"
    return None


def _format_of_xml(text: str) -> str | None:
    if "<opencv_storage" in text:
        return "opencv"
    if re.search(r"<Cameras?[\s>]", text):
        return "vicon"
    return "qualisys" if re.search(r"<(calibration|cameras?)[\s>/]", text) else None


def _format_of_json(path: Path) -> str | None:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return "bodyhull"  # half a file: our own reader says so
    if not isinstance(content, dict):
        return None
    if str(content.get("format", "")).startswith("bodyhull"):
        return "bodyhull"
    return "opencv" if opencv.has_cameras(read_tree(path)) else None


def _format_of_yaml(path: Path) -> str | None:
    if easymocap.find_pair(path.parent) and path.stem in ("intri", "extri"):
        return "easymocap"
    if path.stem in ("intri", "extri"):
        return "easymocap"  # its reader says that the other half is missing
    try:
        return "opencv" if opencv.has_cameras(read_tree(path)) else None
    except RecordingError:
        # OpenCV's own, but broken: its reader says so.
        return "opencv" if b"%YAML" in path.read_bytes()[:64] else None


def _format_of_toml(path: Path) -> str | None:
    try:
        tables = toml_cameras.camera_tables(tomllib.loads(path.read_text(encoding="utf-8-sig")))
    except (OSError, ValueError):
        return "aniposelib" if path.suffix.lower() == ".toml" else None  # its reader tells what is broken
    return "aniposelib" if tables else None


def _read_own(path: Path) -> ForeignRig:
    return of_rig(Rig.load(path), path)


def _read_qualisys(path: Path) -> ForeignRig:
    return of_rig(read_qualisys(path), path, QUALISYS_UNIT)


def _read_inria(folder: Path) -> ForeignRig:
    files = inria.list_matrix_files(folder)
    cameras = []
    for number, file in files.items():
        name = f"cam-{number:03d}"
        size = _inria_size(folder, number)
        # The split into K, R and t does not depend on the size.
        made = inria.read_inria_camera(file, name, size or (1, 1))
        cameras.append(
            GivenCamera(
                name, size, made.intrinsics, made.camera_from_world, made.distortion, file, made.projection
            )
        )
    return foreign_rig(cameras, None, list(files.values()))


def _inria_size(setup: Path, number: int) -> tuple[int, int] | None:
    """From the first silhouette or picture of that camera beside the folder, or, where it is called setup, in
    the sequences beside it: whatever else lies around a folder of matrices need not belong to them."""
    root = setup.resolve().parent
    beside = ("", "*/") if setup.resolve().name.lower() == "setup" else ("",)
    for pictures in ("SilhouettesPictures", "Pictures"):
        for folder in sorted(f for where in beside for f in root.glob(f"{where}{pictures}/cam*")):
            digits = re.findall(r"\d+", folder.name)
            if digits and int(digits[-1]) == number and folder.is_dir():
                first = min((file for file in folder.iterdir() if file.is_file()), default=None)
                size = None if first is None else png_size(first)
                if size is not None:
                    return size
    return None


def _read_opencv(path: Path) -> ForeignRig:
    if path.is_file():
        return opencv.read_opencv([path])
    files = sorted(f for f in path.iterdir() if f.is_file() and f.name.lower().endswith(opencv.ENDINGS))
    return opencv.read_opencv([file for file in files if _format_of_file(file) == "opencv"])


_READERS: dict[str, Callable[[Path], ForeignRig]] = {
    "bodyhull": _read_own,
    "inria": _read_inria,
    "colmap": colmap.read_colmap,
    "easymocap": easymocap.read_easymocap,
    "opencv": _read_opencv,
    "aniposelib": toml_cameras.read_toml_cameras,
    "qualisys": _read_qualisys,
    "vicon": vicon.read_vicon,
    "zju-mocap": zju_mocap.read_zju_mocap,
    "actorshq": actorshq.read_actorshq,
    "middlebury": middlebury.read_middlebury,
}
