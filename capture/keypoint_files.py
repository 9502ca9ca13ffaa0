"""A folder of 2D keypoints, whoever wrote it: the files say by their content whether they are OpenPose's or
COCO's.

    FOLDER/<camera>/<frame>.json     OpenPose (people) or COCO (a list, or annotations) of one frame
    FOLDER/<camera>.json             COCO of all frames
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.errors import RecordingError
from capture.formats.coco import CocoFile, is_coco, read_coco
from capture.formats.openpose import (
    N_JOINTS,
    body_25_from_25b,
    is_body_25b,
    is_openpose,
    read_people,
)

#: So many files of every camera tell the order of OpenPose's points.
_SAMPLE = 12

People = Float[np.ndarray, "_p 25 3"]


def read_keypoints(folder: Path | str, camera_names: Sequence[str], frame_id: int) -> list[People]:
    """One frame's detections: for each camera (P 25 3) in BODY_25's order, x y in pixels as filmed and a
    score; P is 0 where none.

    Files: FOLDER/<camera>/NNNNNN.json or FOLDER/<camera>/*NNNNNN_keypoints.json, the frame's number with any
    width, or FOLDER/<camera>.json with all frames (COCO). A missing file or camera means no detection;
    raises RecordingError where no camera has any, or a file is neither OpenPose's nor COCO's.
    """
    folder = Path(folder)
    if not any((folder / name).is_dir() or (folder / f"{name}.json").is_file() for name in camera_names):
        raise RecordingError(
            f"{folder}: no keypoints for any camera; expected a folder a camera "
            f"({', '.join(camera_names[:3])}, ...) with one JSON file a frame, or COCO's <camera>.json"
        )
    result: list[People] = []
    for name in camera_names:
        whole = folder / f"{name}.json"
        path = _frame_file(folder / name, frame_id)
        if path is not None:
            result.append(_people_of_frame(path, folder, tuple(camera_names)))
        elif whole.is_file():
            result.append(_whole_camera(whole, whole.stat().st_mtime_ns).people(frame_id))
        else:
            result.append(np.zeros((0, N_JOINTS, 3)))
    return result


def _people_of_frame(path: Path, folder: Path, camera_names: tuple[str, ...]) -> People:
    content = _parsed(path)
    if is_coco(content):
        return read_coco(content, path).everybody()
    if not is_openpose(content):
        raise _unknown(path, content)
    people = read_people(content, path)
    return body_25_from_25b(people) if _folder_is_body_25b(folder, camera_names) else people


@lru_cache(maxsize=64)
def _whole_camera(path: Path, _changed_ns: int) -> CocoFile:
    """All frames of a camera, parsed once."""
    content = _parsed(path)
    if not is_coco(content):
        raise _unknown(path, content)
    return read_coco(content, path)


@lru_cache(maxsize=8)
def _folder_is_body_25b(folder: Path, camera_names: tuple[str, ...]) -> bool:
    """The order of a whole folder of OpenPose's detections, from a dozen frames of every camera: single
    frames can mislead."""
    sample = []
    for name in camera_names:
        files = sorted((folder / name).glob("*.json"))
        for path in files[:: max(1, len(files) // _SAMPLE)]:
            content = _parsed(path)
            if is_openpose(content):
                sample.append(read_people(content, path))
    return is_body_25b(sample)


def _frame_file(folder: Path, frame_id: int) -> Path | None:
    if not folder.is_dir():
        return None
    usual = folder / f"{frame_id:06d}.json"
    if usual.is_file():
        return usual
    for path in sorted(folder.glob("*.json")):
        number = re.search(r"(\d+)(?:_keypoints)?$", path.stem)
        if number is not None and int(number[1]) == frame_id:
            return path
    return None


def _parsed(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"{path}: cannot be read as JSON ({type(error).__name__}: {error}); write it again, or remove it"
        ) from error


def _unknown(path: Path, content: Any) -> RecordingError:
    found = f"keys {', '.join(sorted(content)[:5])}" if isinstance(content, dict) else type(content).__name__
    return RecordingError(
        f"{path}: neither OpenPose's output (people) nor COCO's keypoints (a list, or annotations); "
        f"found {found or 'nothing'}"
    )
