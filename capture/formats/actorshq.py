"""ActorsHQ's `calibration.csv`: one line a camera, with a header.

`rx ry rz` (rotation vector, rad) and `tx ty tz` (metres) take the camera's frame (x right, y down, z forward)
to the world's. Focal lengths and principal point are fractions: fx and px of the width, fy and py of the
height, measured from the picture's corner, so that the middle is 0.5 (0.5 px is taken off for our pixel
centres). The pictures are undistorted, landscape and portrait mixed. Read in actorshq/dataset/camera_data.py.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import cv2
import numpy as np

from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, foreign_rig, given_camera, picture_size
from capture.formats.limits import number_text, read_text, require_no_skew, require_pinholes
from capture.rig import Rig

COLUMNS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def is_actorshq(head: str) -> bool:
    """Whether a text's first line is the header."""
    first = head.lstrip("\ufeff").splitlines()[:1]
    names = {word.strip().strip('"') for word in first[0].split(",")} if first else set()
    return set(COLUMNS) <= names


def read_actorshq(path: Path) -> ForeignRig:
    """Every camera, metres. Raises RecordingError."""
    rows = list(csv.DictReader(io.StringIO(read_text(path))))
    cameras = []
    for line, row in enumerate(rows, start=2):
        values = {}
        for key in COLUMNS[1:]:
            try:
                values[key] = float(row[key])
            except (KeyError, TypeError, ValueError):
                raise RecordingError(
                    f"{path}: line {line}: {key} is {row.get(key)!r}, no number; is the file whole?"
                ) from None
        name = (row["name"] or "").strip()
        width, height = picture_size(f"{path}: camera {name}", values["w"], values["h"])
        world_from_camera = cv2.Rodrigues(np.array([values["rx"], values["ry"], values["rz"]]))[0]
        centre = np.array([values["tx"], values["ty"], values["tz"]])
        intrinsics = np.array(
            [
                [values["fx"] * width, 0, values["px"] * width - 0.5],
                [0, values["fy"] * height, values["py"] * height - 0.5],
                [0, 0, 1],
            ]
        )
        rotation = world_from_camera.T
        cameras.append(given_camera(path, name, (width, height), intrinsics, rotation, -rotation @ centre))
    return foreign_rig(cameras, "m", [path])


def write_actorshq(rig: Rig, path: Path) -> list[str]:
    """Pinholes without skew, metres."""
    require_pinholes(rig, "ActorsHQ's calibration.csv")
    require_no_skew(rig, "ActorsHQ's calibration.csv")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\r\n")
    writer.writerow(COLUMNS)
    for camera in rig:
        width, height = camera.size
        world_from_camera = camera.camera_from_world[:3, :3].T.copy()
        k = camera.intrinsics
        numbers = [
            *cv2.Rodrigues(world_from_camera)[0].ravel(),
            *(-world_from_camera @ camera.camera_from_world[:3, 3]),
            k[0, 0] / width,
            k[1, 1] / height,
            (k[0, 2] + 0.5) / width,
            (k[1, 2] + 0.5) / height,
        ]
        writer.writerow([camera.name, width, height, *map(number_text, numbers)])
    path.write_text(text.getvalue(), encoding="utf-8", newline="")
    return []
