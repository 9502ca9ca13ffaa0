"""COCO's keypoint JSON: 17 points a person, as annotation files and as the lists that detectors write.

A list of {image_id, category_id, keypoints (51 numbers: x, y, third), score}; or an annotation file, {images,
annotations, categories}. The third number is a visibility in annotations (0 not labelled, 1 hidden, 2
visible) and a confidence in results. Pixels count from zero, as ours do. There is no neck and no middle of
the hips: they are made of shoulders and hips; feet are missing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.errors import RecordingError

N_COCO, N_BODY_25 = 17, 25
#: What an annotator's 0, 1 and 2 count for.
CONFIDENCE_OF_VISIBILITY = np.array([0.0, 0.5, 1.0])
#: BODY_25's joint: the COCO joints whose mean it is; none for the feet.
BODY_25_FROM_COCO: tuple[tuple[int, ...], ...] = (
    (0,), (5, 6), (6,), (8,), (10,), (5,), (7,), (9,), (11, 12), (12,), (14,), (16,), (11,), (13,), (15,),
    (2,), (1,), (4,), (3,), (), (), (), (), (), (),
)  # fmt: skip

People = Float[np.ndarray, "_p 25 3"]


@dataclass(frozen=True)
class CocoFile:
    """One file's people by frame number."""

    by_frame: dict[int, People]

    def people(self, frame_id: int) -> People:
        """The people of a frame (P 25 3) in BODY_25's order; none where the file has none."""
        return self.by_frame.get(frame_id, np.zeros((0, N_BODY_25, 3)))

    def everybody(self) -> People:
        """All people of the file, whatever the image: of a file that holds one frame."""
        return np.concatenate([np.zeros((0, N_BODY_25, 3)), *self.by_frame.values()])


def is_coco(content: Any) -> bool:
    """Whether parsed JSON looks like COCO's: a list, or a dictionary with annotations."""
    return isinstance(content, list) or (isinstance(content, dict) and "annotations" in content)


def read_coco(content: Any, path: Path) -> CocoFile:
    """People of a parsed file. RecordingError, naming file and entry, where it holds no COCO keypoints."""
    annotated = isinstance(content, dict)
    entries = content["annotations"] if annotated else content
    frames = _frames_of_images(content, path) if annotated else {}
    wanted = _person_categories(content) if annotated else {1}
    flat: list[np.ndarray] = []
    frame_ids: list[int] = []
    if not isinstance(entries, list):
        raise RecordingError(f"{path}: its annotations are no list ({type(entries).__name__})")
    for k, entry in enumerate(entries):
        if not isinstance(entry, dict) or "image_id" not in entry:
            raise RecordingError(
                f"{path}: entry {k} is no COCO keypoint entry (it lacks image_id); expected image_id, "
                "category_id, keypoints, score"
            )
        if entry.get("category_id", 1) not in wanted:
            continue
        flat.append(_points(entry, k, path))
        image_id = entry["image_id"]
        frame_ids.append(frames[image_id] if image_id in frames else _number(image_id, path))
    points = np.array(flat).reshape(-1, N_COCO, 3)
    third = points[..., 2]
    # Results with nothing but whole confidences exist too; only a 2 gives visibilities away there.
    if np.isin(third, (0, 1, 2)).all() and (annotated or (third == 2).any()):
        points[..., 2] = CONFIDENCE_OF_VISIBILITY[third.astype(int)]
    people = body_25_from_coco(points)
    by_frame = {k: people[np.array(frame_ids) == k] for k in dict.fromkeys(frame_ids)}
    return CocoFile(by_frame)


def body_25_from_coco(people: Float[np.ndarray, "_p 17 3"]) -> People:
    """The same people in BODY_25's order; a point made of two has the lower score, and is missing (0, 0, 0)
    if either is."""
    result = np.zeros((len(people), N_BODY_25, 3))
    for joint_idx, sources in enumerate(BODY_25_FROM_COCO):
        if sources:
            score = people[:, sources, 2].min(axis=1)
            mean = people[:, sources, :2].mean(axis=1)
            result[:, joint_idx] = np.column_stack([np.where(score[:, None] > 0, mean, 0.0), score])
    return result


def _points(entry: dict[str, Any], k: int, path: Path) -> Float[np.ndarray, "51"]:
    try:
        values = np.array(entry["keypoints"], dtype=np.float64).ravel()
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{path}: entry {k} has no keypoints ({type(error).__name__}: {error})"
        ) from error
    if values.shape != (3 * N_COCO,):
        raise RecordingError(
            f"{path}: entry {k} has {values.size} numbers, COCO's 17 keypoints have {3 * N_COCO}; "
            "export the 17 body keypoints"
        )
    if not np.isfinite(values).all():
        raise RecordingError(f"{path}: entry {k}: a keypoint is not a finite number")
    return values


def _frames_of_images(content: dict[str, Any], path: Path) -> dict[Any, int]:
    """Frame numbers by image id: the last number of the file's name, else the id itself."""
    frames: dict[Any, int] = {}
    for image in content.get("images", []):
        if isinstance(image, dict) and "id" in image:
            name = str(image.get("file_name", ""))
            found = re.findall(r"\d+", Path(name).stem)
            frames[image["id"]] = int(found[-1]) if found else _number(image["id"], path)
    if len(set(frames.values())) < len(frames):
        raise RecordingError(
            f"{path}: two of its images have the same frame number in their names; give a file a camera"
        )
    return frames


def _person_categories(content: dict[str, Any]) -> set[int]:
    named = {
        c["id"] for c in content.get("categories", []) if isinstance(c, dict) and c.get("name") == "person"
    }
    return named or {1}


def _number(image_id: Any, path: Path) -> int:
    """An image id as a frame number: a number, or a file's name that ends with one."""
    if isinstance(image_id, int):
        return image_id
    found = re.findall(r"\d+", Path(str(image_id)).stem)
    if not found:
        raise RecordingError(
            f"{path}: the image_id {image_id!r} holds no frame number; name the images by their numbers"
        )
    return int(found[-1])
