"""Camera files in TOML, one table a camera: aniposelib (anipose, FreeMoCap), Pose2Sim and caliscope.

All three: `size` (width, height), `matrix` (3 3) px, `distortions` (OpenCV's), `rotation` (Rodrigues vector,
world to camera; old caliscope files: 3 3), `translation`; pixel centres at whole numbers. They differ in:

    aniposelib   [cam_0], [cam_1] ... with `name`; five distortions; the world's unit is the board's, unstated
    Pose2Sim     [NAME] with the same `name`; sizes as 1920.0; four distortions; metres
    caliscope    [cameras.N], `cam_id` (before: `port`); five distortions; metres; `ignore`d cameras

Read in the writers' sources: aniposelib/cameras.py, Pose2Sim/calibration.py and caliscope's camera_array.py.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from capture.camera import Camera
from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, foreign_rig, given_camera, numbered_names, picture_size
from capture.formats.limits import (
    read_text,
    require_terms,
    row_text,
    skew_notes,
)
from capture.rig import Rig


def camera_tables(content: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The tables that look like cameras, by key; empty where the file is of another kind."""
    tables = content.get("cameras") if isinstance(content.get("cameras"), dict) else content
    assert isinstance(tables, dict)
    return {
        key: table
        for key, table in tables.items()
        if isinstance(table, dict) and ("matrix" in table or "cam_id" in table or "port" in table)
    }


def read_toml_cameras(path: Path) -> ForeignRig:
    """Every camera with a pose; ignored and unposed ones are left out and noted. Raises RecordingError."""
    text = read_text(path)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RecordingError(f"{path}: not a TOML file ({error}); is it whole?") from error
    tables = camera_tables(content)
    if not tables:
        raise RecordingError(f"{path}: no camera tables (with size, matrix, rotation, translation) in it")
    kind = _kind(content, tables)
    cameras, left_out = [], []
    for key, table in tables.items():
        name = str(table.get("name") or (f"cam_{key}" if key.isdigit() else key))
        if table.get("ignore") or any(_absent(table.get(k)) for k in ("matrix", "rotation", "translation")):
            left_out.append(name)
            continue
        where = f"{path}: camera {name}"
        if table.get("fisheye"):
            raise RecordingError(
                f"{where} has a fisheye lens, which is not modelled here; undistort its pictures and give a "
                "camera without distortion"
            )
        given_size = table.get("size")
        size = None
        if isinstance(given_size, list) and len(given_size) == 2:
            size = picture_size(where, *given_size)
        cameras.append(
            given_camera(
                path,
                name,
                size,
                table["matrix"],
                table["rotation"],
                table["translation"],
                table.get("distortions") or [],
            )
        )
    notes = []
    if left_out:
        notes.append(f"{path}: without a pose or ignored there, left out: {', '.join(left_out)}.")
    if not cameras:
        raise RecordingError(
            f"{path}: none of its {len(tables)} cameras has matrix, rotation and translation; "
            "calibrate the extrinsics too"
        )
    return foreign_rig(cameras, None if kind == "aniposelib" else "m", [path], notes)


def write_aniposelib(rig: Rig, path: Path) -> list[str]:
    """Metres, five distortions."""
    require_terms(rig, 5, "an aniposelib TOML")
    parts = []
    for camera_idx, camera in enumerate(rig):
        parts.append(
            f"[cam_{camera_idx}]\nname = {_quoted(camera.name)}\n"
            f"size = [ {camera.size[0]}, {camera.size[1]},]\n{_numbers(camera, 5)}"
        )
    parts.append("[metadata]\nadjusted = false\nerror = 0.0\n")
    path.write_text("\n".join(parts), encoding="utf-8")
    notes = ["aniposelib states no unit: this file is in metres."]
    if any(camera.distortion[2:4].any() for camera in rig):
        notes.append(
            "Newer aniposelib projects with k1 k2 k3 only: its residuals leave out p1 p2, which the file has."
        )
    return notes + skew_notes(rig, "aniposelib", "the lens code of its programs")


def write_pose2sim(rig: Rig, path: Path) -> list[str]:
    """Metres, four distortions, more where a lens has them."""
    more = [camera.name for camera in rig if camera.distortion[4:].any()]
    parts = []
    for camera in rig:
        n_terms = max(4, camera.distortion.size)
        parts.append(
            f"[{_key(camera.name)}]\nname = {_quoted(camera.name)}\n"
            f"size = [ {float(camera.size[0])}, {float(camera.size[1])}]\n"
            f"{_numbers(camera, n_terms)}fisheye = false\n"
        )
    parts.append("[metadata]\nadjusted = false\nerror = 0.0\n")
    path.write_text("\n".join(parts), encoding="utf-8")
    notes = []
    if more:
        notes.append(
            f"Pose2Sim writes four distortions itself; this file has more for {', '.join(more)} (k3 and on)."
        )
    return notes + skew_notes(rig, "Pose2Sim", "OpenCV's lens code")


def write_caliscope(rig: Rig, path: Path) -> list[str]:
    """Metres, five distortions; cameras are numbered, their names kept in a field that caliscope ignores."""
    require_terms(rig, 5, "caliscope's camera_array.toml")
    numbers = numbered_names(rig.names)
    parts = []
    for number, camera in zip(numbers, rig, strict=True):
        parts.append(
            f"[cameras.{number}]\ncam_id = {number}\nname = {_quoted(camera.name)}\n"
            f"size = [ {camera.size[0]}, {camera.size[1]}]\nrotation_count = 0\nerror = 0.0\n"
            f"{_numbers(camera, 5)}grid_count = 0\nignore = false\nfisheye = false\n"
        )
    path.write_text("\n".join(parts), encoding="utf-8")
    listed = ", ".join(f"{name} is {number}" for name, number in zip(rig.names, numbers, strict=True))
    return [f"caliscope numbers its cameras: {listed}.", *skew_notes(rig, "caliscope", "OpenCV's lens code")]


def _kind(content: dict[str, Any], tables: dict[str, dict[str, Any]]) -> str:
    if isinstance(content.get("cameras"), dict):
        return "caliscope"
    # Pose2Sim names its tables like the cameras and writes four distortions; aniposelib counts cam_0, cam_1.
    as_pose2sim = all(str(table.get("name")) == key for key, table in tables.items()) and all(
        len(table.get("distortions") or []) == 4 or "fisheye" in table for table in tables.values()
    )
    return "pose2sim" if as_pose2sim else "aniposelib"


def _absent(value: object) -> bool:
    return value is None or value == "null" or value == [] or value == ""


def _numbers(camera: Camera, n_terms: int) -> str:
    lens = np.zeros(n_terms)
    used = camera.distortion[:n_terms]
    lens[: used.size] = used
    rows = ", ".join(f"[ {row_text(row)}]" for row in camera.intrinsics)
    rotation = cv2.Rodrigues(camera.camera_from_world[:3, :3].copy())[0].ravel()
    return (
        f"matrix = [ {rows}]\n"
        f"distortions = [ {row_text(lens)}]\n"
        f"rotation = [ {row_text(rotation)}]\n"
        f"translation = [ {row_text(camera.camera_from_world[:3, 3])}]\n"
    )


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _key(text: str) -> str:
    bare = bool(text) and all(c.isascii() and (c.isalnum() or c in "-_") for c in text)
    return text if bare else _quoted(text)
