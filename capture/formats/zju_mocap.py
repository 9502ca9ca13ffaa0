"""ZJU-MoCap's `annots.npy`: a dictionary in a pickle, read here without running it (`numpy_pickle`).

`cams`: K (3 3), D (5 1), R (3 3), T (3 1), a list each over cameras; world to camera, T in *millimetres*
(its converters multiply EasyMocap's by 1000), OpenCV's distortion, pixel centres at whole numbers. `ims`: a
dictionary a frame, whose `ims` lists one picture a camera: their folders name the cameras, their files tell
the sizes where they lie beside. Read in zju3dv's neuralbody and its converters.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, foreign_rig, given_camera
from capture.formats.numpy_pickle import read_object_array
from capture.rig import Rig
from capture.silhouette_files import png_size

UNIT = "mm"


def read_zju_mocap(path: Path) -> ForeignRig:
    """Every camera, in the order of the file, millimetres. Raises RecordingError."""
    content = read_object_array(path)
    cams = content.get("cams") if isinstance(content, dict) else None
    if not isinstance(cams, dict) or not {"K", "R", "T"} <= set(cams):
        raise RecordingError(f"{path}: holds no cams with K, R and T; is it ZJU-MoCap's annots.npy?")
    lists = {key: list(cams[key]) for key in ("K", "D", "R", "T") if cams.get(key) is not None}
    n_cameras = len(lists["K"])
    for key, values in lists.items():
        if len(values) != n_cameras:
            raise RecordingError(
                f"{path}: {n_cameras} camera matrices but {len(values)} of {key}; is the file whole?"
            )
    pictures = _first_pictures(content, n_cameras)
    names = _names(pictures, n_cameras)
    cameras = []
    for k, name in enumerate(names):
        picture = path.parent / pictures[k] if pictures else None
        cameras.append(
            given_camera(
                path,
                name,
                png_size(picture) if picture is not None and picture.is_file() else None,
                lists["K"][k],
                lists["R"][k],
                lists["T"][k],
                lists["D"][k] if "D" in lists else (),
            )
        )
    return foreign_rig(cameras, UNIT, [path])


def write_zju_mocap(rig: Rig, path: Path) -> list[str]:
    """Millimetres; one frame of picture names, so that the cameras keep theirs."""
    cams: dict[str, list[np.ndarray]] = {"K": [], "D": [], "R": [], "T": []}
    for camera in rig:
        lens = np.zeros((max(5, camera.distortion.size), 1))
        lens[: camera.distortion.size, 0] = camera.distortion
        cams["K"].append(camera.intrinsics.copy())
        cams["D"].append(lens)
        cams["R"].append(camera.camera_from_world[:3, :3].copy())
        cams["T"].append(1000.0 * camera.camera_from_world[:3, 3:])
    pictures = [f"{camera.name}/000000.jpg" for camera in rig]
    with path.open("wb") as file:
        np.save(file, np.array({"cams": cams, "ims": [{"ims": pictures}]}, dtype=object), allow_pickle=True)
    notes = [
        "ZJU-MoCap's annots.npy states no picture sizes; its `ims` has one frame, NAME/000000.jpg: list your "
        "pictures there."
    ]
    longer = [camera.name for camera in rig if camera.distortion.size > 5]
    if longer:
        notes.append(f"ZJU-MoCap has five distortions; this file has eight for {', '.join(longer)}.")
    return notes


def _first_pictures(content: dict[Any, Any], n_cameras: int) -> list[str]:
    """The picture of every camera in the first frame that has all; none where the file lists none."""
    frames = content.get("ims")
    for frame in frames if isinstance(frames, list) else []:
        listed = frame.get("ims") if isinstance(frame, dict) else None
        if isinstance(listed, list) and len(listed) == n_cameras and all(isinstance(p, str) for p in listed):
            return listed
    return []


def _names(pictures: list[str], n_cameras: int) -> list[str]:
    folders = [PurePosixPath(picture.replace("\\", "/")).parent.name for picture in pictures]
    if folders and all(folders) and len(set(folders)) == n_cameras:
        return folders
    return [f"Camera_B{k + 1}" for k in range(n_cameras)]
