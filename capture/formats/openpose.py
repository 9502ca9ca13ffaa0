"""OpenPose's JSON files: one a camera and frame, each person 25 x (x, y, score), pixels of the picture as
filmed.

Two of OpenPose's models have 25 points in different orders, and the files do not say which: BODY_25 (with
neck and middle of the hips) and the later BODY_25B (with upper neck and top of the head, no middle of the
hips). They are told apart by what must lie where in any person: the middle of the hips between the hips, or
the nose between the eyes.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from capture.errors import RecordingError

N_JOINTS = 25
_SEEN = 0.2
# BODY_25's joint: the BODY_25B joints whose mean it is.
_FROM_25B = (
    (0,), (5, 6), (6,), (8,), (10,), (5,), (7,), (9,), (11, 12), (12,), (14,), (16,), (11,), (13,), (15,),
    (2,), (1,), (4,), (3,), (19,), (20,), (21,), (22,), (23,), (24,),
)  # fmt: skip

People = Float[np.ndarray, "_p 25 3"]


def read_keypoints(folder: Path | str, camera_names: Sequence[str], frame_id: int) -> list[People]:
    """One frame's detections: for each camera (P 25 3), x y in pixels as filmed and a score; P is 0 where
    none.

    Files: FOLDER/<camera>/NNNNNN.json or FOLDER/<camera>/*NNNNNN_keypoints.json, the frame's number with any
    width. A missing file or camera means no detection; raises RecordingError where no camera has a folder,
    or a file is no OpenPose output.
    """
    folder = Path(folder)
    folders = [folder / name for name in camera_names]
    if not any(path.is_dir() for path in folders):
        raise RecordingError(
            f"{folder}: no keypoints for any camera; expected a folder a camera "
            f"({', '.join(camera_names[:3])}, ...) with one JSON file a frame"
        )
    result: list[People] = []
    for camera_folder in folders:
        path = _frame_file(camera_folder, frame_id) if camera_folder.is_dir() else None
        result.append(np.zeros((0, N_JOINTS, 3)) if path is None else _read_people(path))
    if _folder_is_body_25b(folder, tuple(camera_names)):
        return [_body_25_from_25b(people) for people in result]
    return result


@lru_cache(maxsize=8)
def _folder_is_body_25b(folder: Path, camera_names: tuple[str, ...]) -> bool:
    """The order of a whole folder of detections, from a dozen frames of every camera: single frames can
    mislead."""
    sample = []
    for name in camera_names:
        files = sorted((folder / name).glob("*.json"))
        sample += files[:: max(1, len(files) // 12)]
    return _is_body_25b([_read_people(path) for path in sample])


def _is_body_25b(per_camera: Sequence[People]) -> bool:
    """True where the detections, taken together, fit the order of BODY_25B better than
    BODY_25's."""
    misfits = []
    for person in (person for people in per_camera for person in people):
        seen = person[:, 2] > _SEEN
        if seen.sum() < 15:
            continue
        extent = float(np.ptp(person[seen, :2], axis=0).max())
        # (point, between these two): neck and middle of the hips in BODY_25; nose and upper neck in BODY_25B.
        misfit_25 = _off_middle(person, ((1, 2, 5), (8, 9, 12))) / extent
        misfit_25b = _off_middle(person, ((0, 1, 2), (17, 5, 6))) / extent
        misfits.append((misfit_25, misfit_25b))
    if not misfits:
        return False
    medians = np.median(misfits, axis=0)
    return bool(medians[1] < medians[0])


def _off_middle(person: Float[np.ndarray, "25 3"], triples: tuple[tuple[int, int, int], ...]) -> float:
    """Mean distance (px) of a point from the middle of two others."""
    off = [person[p, :2] - (person[a, :2] + person[b, :2]) / 2 for p, a, b in triples]
    return float(np.linalg.norm(off, axis=1).mean())


def _body_25_from_25b(people: People) -> People:
    """The same people in BODY_25 order; a point made of two has the lower score, 0 if either is missing."""
    result = np.zeros_like(people)
    for joint_idx, sources in enumerate(_FROM_25B):
        result[:, joint_idx, :2] = people[:, sources, :2].mean(axis=1)
        result[:, joint_idx, 2] = people[:, sources, 2].min(axis=1)
    return result


def _frame_file(folder: Path, frame_id: int) -> Path | None:
    usual = folder / f"{frame_id:06d}.json"
    if usual.is_file():
        return usual
    for path in sorted(folder.glob("*.json")):
        number = re.search(r"(\d+)(?:_keypoints)?$", path.stem)
        if number is not None and int(number[1]) == frame_id:
            return path
    return None


def _read_people(path: Path) -> People:
    try:
        people = json.loads(path.read_text(encoding="utf-8"))["people"]
        flat = [np.array(person["pose_keypoints_2d"], dtype=np.float64) for person in people]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: no OpenPose output ({type(error).__name__}: {error})") from error
    for values in flat:
        if values.shape != (3 * N_JOINTS,):
            raise RecordingError(
                f"{path}: a person with {values.size} numbers, BODY_25 has {3 * N_JOINTS}; "
                "run OpenPose with its BODY_25 model"
            )
        if not np.isfinite(values).all():
            raise RecordingError(f"{path}: a keypoint is not a finite number")
    return np.array(flat).reshape(-1, N_JOINTS, 3)
