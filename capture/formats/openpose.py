"""OpenPose's JSON files: one a camera and frame, each person 25 x (x, y, score), pixels of the picture as
filmed.

Two of OpenPose's models have 25 points in different orders, and the files do not say which: BODY_25 (with
neck and middle of the hips) and the later BODY_25B (with upper neck and top of the head, no middle of the
hips). They are told apart by what must lie where in any person: the middle of the hips between the hips, or
the nose between the eyes. The older COCO model has 18 points: those of BODY_25 without the middle of the hips
and the feet, and hips before eyes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.errors import RecordingError

N_JOINTS, N_COCO_18 = 25, 18
_SEEN = 0.2
# BODY_25's joint: the BODY_25B joints whose mean it is.
_FROM_25B = (
    (0,), (5, 6), (6,), (8,), (10,), (5,), (7,), (9,), (11, 12), (12,), (14,), (16,), (11,), (13,), (15,),
    (2,), (1,), (4,), (3,), (19,), (20,), (21,), (22,), (23,), (24,),
)  # fmt: skip

# The same of the 18 points of OpenPose's COCO model.
_FROM_18 = (
    (0,), (1,), (2,), (3,), (4,), (5,), (6,), (7,), (8, 11), (8,), (9,), (10,), (11,), (12,), (13,),
    (14,), (15,), (16,), (17,), (), (), (), (), (), (),
)  # fmt: skip

People = Float[np.ndarray, "_p 25 3"]


def is_openpose(content: Any) -> bool:
    """Whether parsed JSON looks like OpenPose's: a dictionary with people."""
    return isinstance(content, dict) and "people" in content


def is_body_25b(per_camera: Sequence[People]) -> bool:
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


def body_25_from_25b(people: People) -> People:
    """The same people in BODY_25 order; a point made of two has the lower score, 0 if either is missing."""
    result = np.zeros_like(people)
    for joint_idx, sources in enumerate(_FROM_25B):
        result[:, joint_idx, :2] = people[:, sources, :2].mean(axis=1)
        result[:, joint_idx, 2] = people[:, sources, 2].min(axis=1)
    return result


def read_people(content: Any, path: Path) -> People:
    """The people of a parsed file (P 25 3), in the order of the file, or from COCO's 18 points."""
    try:
        flat = [np.array(person["pose_keypoints_2d"], dtype=np.float64) for person in content["people"]]
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{path}: no OpenPose output ({type(error).__name__}: {error})") from error
    people = []
    for values in flat:
        if values.shape not in ((3 * N_JOINTS,), (3 * N_COCO_18,)):
            raise RecordingError(
                f"{path}: a person with {values.size} numbers, BODY_25 has {3 * N_JOINTS} and COCO "
                f"{3 * N_COCO_18}; run OpenPose with its BODY_25 model"
            )
        if not np.isfinite(values).all():
            raise RecordingError(f"{path}: a keypoint is not a finite number")
        points = values.reshape(-1, 3)
        people.append(points if len(points) == N_JOINTS else _body_25_from_18(points))
    return np.array(people).reshape(-1, N_JOINTS, 3)


def _body_25_from_18(person: Float[np.ndarray, "18 3"]) -> Float[np.ndarray, "25 3"]:
    """A person of the older COCO model: the middle of the hips is made of them, feet are missing."""
    result = np.zeros((N_JOINTS, 3))
    for joint_idx, sources in enumerate(_FROM_18):
        if sources and person[list(sources), 2].min() > 0:
            result[joint_idx, :2] = person[list(sources), :2].mean(axis=0)
            result[joint_idx, 2] = person[list(sources), 2].min()
    return result
