"""COCO's keypoints beside OpenPose's: layouts of files, derived points, visibilities, errors' sentences."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture.formats.coco import BODY_25_FROM_COCO, body_25_from_coco
from capture.keypoints import read_keypoints, triangulate_keypoints
from capture.recording import RecordingError
from fit.body.marks import COCO_17
from fit.body.parts import BODY_25
from tests.test_capture_keypoints import BODY, detected, lensed_rig, write_frame

OF_BODY_25 = [BODY_25.index(name) for name in COCO_17]
#: BODY_25's points that COCO lacks.
FEET = [k for k, name in enumerate(BODY_25) if "toe" in name or "heel" in name]


def as_coco(person: np.ndarray) -> list[float]:
    """The 51 numbers of a person in BODY_25's order."""
    return [float(value) for value in person[OF_BODY_25].ravel()]


def entry(person: np.ndarray, image_id: Any, **more: Any) -> dict[str, Any]:
    return {"image_id": image_id, "category_id": 1, "keypoints": as_coco(person), "score": 0.9} | more


def write(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def person(camera_idx: int = 0, shift_px: float = 0.0) -> np.ndarray:
    found = detected(lensed_rig(3)[camera_idx], BODY)
    found[:, :2] += shift_px
    return found


def test_every_point_goes_where_its_name_is() -> None:
    for name, sources in zip(BODY_25, BODY_25_FROM_COCO, strict=True):
        made = {
            "neck": ["left_shoulder", "right_shoulder"],
            "mid_hip": ["left_hip", "right_hip"],
        }.get(name, [name] if name in COCO_17 else [])
        assert [COCO_17[k] for k in sources] == made, name


def test_points_made_of_two_need_both() -> None:
    coco = person()[OF_BODY_25]
    coco[COCO_17.index("left_hip"), 2] = 0.0
    coco[COCO_17.index("right_shoulder"), 2] = 0.3
    (found,) = body_25_from_coco(coco[None])
    assert (found[BODY_25.index("mid_hip")] == 0).all()
    assert found[BODY_25.index("neck"), 2] == 0.3
    assert (found[FEET] == 0).all(), "COCO has no feet"


def test_results_of_a_camera_in_one_file(tmp_path: Path) -> None:
    """A list over all frames, image ids as numbers or as the images' names."""
    write(
        tmp_path / "cam-000.json", [entry(person(), 7), entry(person(shift_px=40.0), 7), entry(person(), 8)]
    )
    write(tmp_path / "cam-001.json", [entry(person(), "walk_000007.jpg"), entry(person(), 7, category_id=3)])
    found = read_keypoints(tmp_path, ("cam-000", "cam-001", "cam-002"), 7)
    assert [len(people) for people in found] == [2, 1, 0]
    np.testing.assert_allclose(found[0][0][OF_BODY_25], person()[OF_BODY_25])
    assert [len(people) for people in read_keypoints(tmp_path, ("cam-000", "cam-001"), 9)] == [0, 0]


def test_annotations_count_by_visibility_and_find_frames_by_the_images_names(tmp_path: Path) -> None:
    labelled = person()
    labelled[:, 2] = 2
    labelled[BODY_25.index("left_wrist"), 2] = 1
    labelled[BODY_25.index("nose")] = 0
    content = {
        "images": [{"id": 901, "file_name": "cam-000/img_000012.png"}, {"id": 902, "file_name": "13.png"}],
        "annotations": [entry(labelled, 902, category_id=5), entry(labelled, 901, category_id=1)],
        "categories": [{"id": 1, "name": "dog"}, {"id": 5, "name": "person"}],
    }
    write(tmp_path / "cam-000.json", content)
    assert len(read_keypoints(tmp_path, ("cam-000",), 12)[0]) == 0, "that is the dog"
    (found,) = read_keypoints(tmp_path, ("cam-000",), 13)[0]
    names = ("left_elbow", "left_wrist", "nose", "neck")
    assert [found[BODY_25.index(name), 2] for name in names] == [1.0, 0.5, 0.0, 1.0]


def test_a_file_a_frame_and_both_formats_side_by_side(tmp_path: Path) -> None:
    rig = lensed_rig(3)
    write(tmp_path / "cam-000" / "000004.json", [entry(detected(rig[0], BODY), 1234)])
    write(tmp_path / "cam-001.json", [entry(detected(rig[1], BODY), 4)])
    write_frame(tmp_path / "cam-002" / "000004.json", [detected(rig[2], BODY)])
    joints = triangulate_keypoints(rig, read_keypoints(tmp_path, rig.names, 4), None)
    made = [BODY_25.index("neck"), BODY_25.index("mid_hip")]
    plain = [k for k in range(25) if k not in (*FEET, *made)]
    assert np.abs(joints[plain, :3] - BODY[plain]).max() < 1e-4
    assert np.linalg.norm(joints[made, :3] - BODY[made], axis=1).max() < 0.02
    assert np.isnan(joints[FEET, :3]).all(), "one view saw the feet"


def test_openposes_older_model_of_18_points(tmp_path: Path) -> None:
    rig = lensed_rig(3)
    order = [*range(8), *range(9, 15), *range(15, 19)]
    for camera in rig:
        write_frame(tmp_path / camera.name / "000000.json", [detected(camera, BODY)[order]])
    joints = triangulate_keypoints(rig, read_keypoints(tmp_path, rig.names, 0), None)
    assert np.abs(joints[order, :3] - BODY[order]).max() < 1e-4
    assert np.linalg.norm(joints[8, :3] - BODY[8]) < 0.02
    assert np.isnan(joints[19:, :3]).all()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ([{"bbox": [1, 2]}], "entry 0 is no COCO keypoint entry (it lacks image_id); expected image_id"),
        ([{"image_id": 1, "bbox": []}], "entry 0 has no keypoints (KeyError: 'keypoints')"),
        (
            [{"image_id": 1, "keypoints": [0.0] * 69}],
            "entry 0 has 69 numbers, COCO's 17 keypoints have 51; export the 17 body keypoints",
        ),
        ([{"image_id": 1, "keypoints": [None] * 51}], "entry 0: a keypoint is not a finite number"),
        ([entry(BODY, "left")], "the image_id 'left' holds no frame number; name the images by their"),
        (
            {
                "images": [{"id": 1, "file_name": "a/01.png"}, {"id": 2, "file_name": "b/01.png"}],
                "annotations": [],
            },
            "two of its images have the same frame number in their names; give a file a camera",
        ),
        ({"info": {}}, "neither OpenPose's output (people) nor COCO's keypoints (a list, or annotations)"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, content: Any, sentence: str) -> None:
    path = write(tmp_path / "cam-000.json", content)
    with pytest.raises(RecordingError) as error:
        read_keypoints(tmp_path, ("cam-000",), 1)
    assert str(error.value).startswith(f"{path}: ")
    assert sentence in str(error.value)
