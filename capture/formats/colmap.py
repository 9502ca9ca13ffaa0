"""COLMAP models (binary or text): read and written through pycolmap.

World to camera, x right, y down, z forward; no unit (a reconstruction is known up to scale); pixels are
counted from the picture's *corner*, so that the centre of the first pixel is (0.5, 0.5): half a pixel is
taken off the principal point on the way in and put on again on the way out.

A reconstruction has images, a rig has cameras. Images become cameras so:
- a rig of several sensors: one camera a sensor. Where the rig moved between frames (a board taken for the
  world), the cameras are given in the rig's own frame;
- else images whose folder names the camera (`cam01/0001.jpg`, `cam01/0002.jpg`) and which stand in the same
  place are one camera;
- else every image is its own camera.
https://colmap.github.io/format.html
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.errors import RecordingError
from capture.foreign_rig import ForeignRig, GivenCamera, foreign_rig, given_camera
from capture.formats.colmap_binary import (
    checked_cameras,
    checked_frames,
    checked_rigs,
    images_without_points,
)
from capture.formats.limits import key_names, require_no_skew
from capture.rig import Rig

PARTS = ("cameras", "images", "points3D", "rigs", "frames")
# Frames of one static camera that were solved apart agree to about this.
_SAME_ROTATION_RAD, _SAME_PLACE = 2e-3, 2e-3
#: COLMAP's models in OpenCV's order: indices of fx, fy, cx, cy, then of k1 k2 p1 p2 k3 k4 k5 k6.
_MODELS: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}


@dataclass(frozen=True)
class _View:
    """An image with a pose: its name, camera, rig and frame, and poses from the world and from the rig."""

    name: str
    camera_id: int
    camera_from_world: Float[np.ndarray, "4 4"]
    rig_id: int
    frame_id: int
    camera_from_rig: Float[np.ndarray, "4 4"]


def find_model(folder: Path) -> tuple[Path, str] | None:
    """(folder, "bin" or "txt") of the model in a folder, in its sparse/0, sparse or 0; None: none there."""
    for place in (folder, folder / "sparse" / "0", folder / "sparse", folder / "0"):
        for ending in ("bin", "txt"):
            if all((place / f"{part}.{ending}").is_file() for part in ("cameras", "images")):
                return place, ending
    return None


def read_colmap(folder: Path) -> ForeignRig:
    """The cameras of a model, unit unknown. Raises RecordingError."""
    found = find_model(folder)
    if found is None:
        raise RecordingError(
            f"{folder}: no COLMAP model here (cameras and images, .bin or .txt, also in sparse/0)"
        )
    place, ending = found
    model = _load(place, ending)
    views, unposed = _views(model, place)
    notes = []
    if unposed:
        notes.append(f"{place}: {unposed} images without a pose left out.")
    n_sensors = Counter(view.rig_id for view in {(v.rig_id, v.camera_id): v for v in views}.values())
    if len(n_sensors) == 1 and max(n_sensors.values()) > 1:
        chosen, found_notes = _of_sensors(views, place)
    else:
        chosen, found_notes = _of_images(views, place)
    cameras = [_given(model.cameras[view.camera_id], name, pose, place) for name, view, pose in chosen]
    files = [place / f"{part}.{ending}" for part in PARTS if (place / f"{part}.{ending}").is_file()]
    return foreign_rig(cameras, None, files, [*notes, *found_notes])


def write_colmap(rig: Rig, folder: Path, text: bool = False) -> list[str]:
    """One rig of all cameras and one frame, metres; images are called NAME.png."""
    import pycolmap

    require_no_skew(rig, "COLMAP")
    names, notes = key_names(rig, "-_.", "COLMAP")
    model = pycolmap.Reconstruction()
    cameras = [_colmap_camera(camera, k + 1) for k, camera in enumerate(rig)]
    rig_from_world = rig[0].camera_from_world
    colmap_rig = pycolmap.Rig(rig_id=1)
    for k, (camera, own) in enumerate(zip(cameras, rig, strict=True)):
        model.add_camera(camera)
        if k == 0:
            colmap_rig.add_ref_sensor(camera.sensor_id)
        else:
            colmap_rig.add_sensor(
                camera.sensor_id, _rigid(own.camera_from_world @ np.linalg.inv(rig_from_world))
            )
    model.add_rig(colmap_rig)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    images = []
    for camera, name in zip(cameras, names, strict=True):
        image = pycolmap.Image(name=f"{name}.png", camera_id=camera.camera_id, image_id=camera.camera_id)
        image.frame_id = 1
        frame.add_data_id(image.data_id)
        images.append(image)
    frame.rig_from_world = _rigid(rig_from_world)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(1)
    (model.write_text if text else model.write_binary)(str(folder))
    return ["COLMAP states no unit: this model is in metres. Its images are called NAME.png.", *notes]


def _load(place: Path, ending: str) -> Any:
    """The model, without its points."""
    import pycolmap

    model = pycolmap.Reconstruction()
    told, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 3  # the error says it all
    try:
        with tempfile.TemporaryDirectory() as scratch:
            if ending == "bin":
                _copy_checked(place, Path(scratch))
                model.read_binary(scratch)
            else:
                for part in PARTS:
                    if (place / f"{part}.txt").is_file():
                        shutil.copy(place / f"{part}.txt", scratch)
                if not (place / "points3D.txt").is_file():
                    (Path(scratch) / "points3D.txt").touch()
                model.read_text(scratch)
    except (RecordingError, OSError):
        raise
    except Exception as error:  # pycolmap hands out C++ errors of many kinds for a damaged file
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise RecordingError(
            f"{place}: pycolmap cannot read this model ({reason}); are cameras and images whole?"
        ) from error
    finally:
        pycolmap.logging.minloglevel = told
    return model


def _copy_checked(place: Path, scratch: Path) -> None:
    import pycolmap

    def n_parameters(model_id: int) -> int:
        try:
            camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model_id), 1.0, 2, 2)
        except Exception:  # a C++ error of whatever kind: no such model
            return -1
        return len(camera.params)

    (scratch / "cameras.bin").write_bytes(checked_cameras(place / "cameras.bin", n_parameters))
    (scratch / "images.bin").write_bytes(images_without_points(place / "images.bin"))
    (scratch / "points3D.bin").write_bytes(bytes(8))
    for part, checked in (("rigs", checked_rigs), ("frames", checked_frames)):
        if (place / f"{part}.bin").is_file():
            (scratch / f"{part}.bin").write_bytes(checked(place / f"{part}.bin"))


def _views(model: Any, place: Path) -> tuple[list[_View], int]:
    views, unposed = [], 0
    for image_id in sorted(model.images):
        image = model.images[image_id]
        if not image.has_pose:
            unposed += 1
            continue
        pose = _four(image.cam_from_world())
        frame = model.frames[image.frame_id]
        rig_from_world = _four(frame.rig_from_world)
        views.append(
            _View(
                image.name,
                image.camera_id,
                pose,
                frame.rig_id,
                image.frame_id,
                pose @ np.linalg.inv(rig_from_world),
            )
        )
    if not views:
        raise RecordingError(f"{place}: none of its {unposed} images has a pose")
    return views, unposed


def _of_sensors(views: list[_View], place: Path) -> tuple[list[tuple[str, _View, np.ndarray]], list[str]]:
    """A camera a sensor, in the world where the rig stood still, else in the rig's frame."""
    by_sensor: dict[int, list[_View]] = {}
    for view in views:
        by_sensor.setdefault(view.camera_id, []).append(view)
    still = all(_stand_together(group) for group in by_sensor.values())
    firsts = [group[0] for group in by_sensor.values()]
    names = _camera_names([view.name for view in firsts])
    n_frames = len({view.frame_id for view in views})
    notes = []
    if not still:
        notes.append(
            f"{place}: the rig has {n_frames} frames in different places; its cameras are given in the rig's "
            "own frame, so the world's axes are those of its reference camera."
        )
    poses = [view.camera_from_world if still else view.camera_from_rig for view in firsts]
    return list(zip(names, firsts, poses, strict=True)), notes


def _of_images(views: list[_View], place: Path) -> tuple[list[tuple[str, _View, np.ndarray]], list[str]]:
    """A camera an image, or a camera a folder whose images stand in one place."""
    by_folder: dict[str, list[_View]] = {}
    for view in views:
        by_folder.setdefault(str(PurePosixPath(view.name).parent), []).append(view)
    grouped = len(by_folder) > 1 and all(_stand_together(group) for group in by_folder.values())
    notes = []
    if grouped:
        firsts = [group[0] for group in by_folder.values()]
        n_more = len(views) - len(firsts)
        if n_more:
            notes.append(
                f"{place}: {len(views)} images in {len(firsts)} folders are {len(firsts)} cameras that stand "
                "still; the pose of the first image is taken."
            )
    else:
        firsts = views
    names = _camera_names([view.name for view in firsts])
    return [(name, view, view.camera_from_world) for name, view in zip(names, firsts, strict=True)], notes


def _stand_together(group: list[_View]) -> bool:
    first = group[0].camera_from_world
    centre = -first[:3, :3].T @ first[:3, 3]
    size = max(float(np.linalg.norm(centre)), float(np.linalg.norm(first[:3, 3])), 1e-12)
    for view in group[1:]:
        other = view.camera_from_world
        turn = first[:3, :3].T @ other[:3, :3]
        angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
        away = np.linalg.norm(-other[:3, :3].T @ other[:3, 3] - centre)
        if angle > _SAME_ROTATION_RAD or away > _SAME_PLACE * size:
            return False
    return True


def _camera_names(images: list[str]) -> list[str]:
    """What tells the images apart: their files' names, else their folders, else both."""
    paths = [PurePosixPath(name.replace("\\", "/")) for name in images]
    stems, folders = [path.stem for path in paths], [path.parent.name for path in paths]
    # Folders first: in cam01/0001.jpg, cam02/0002.jpg the file only counts frames.
    for names in (folders, stems, [path.name for path in paths]):
        if all(names) and len(set(names)) == len(names):
            return names
    return [str(path.with_suffix("")).replace("/", "_") for path in paths]


def _given(camera: Any, name: str, pose: Float[np.ndarray, "4 4"], place: Path) -> GivenCamera:
    model = camera.model.name
    if model not in _MODELS:
        raise RecordingError(
            f"{place}: camera {name} has the lens model {model}, which is not modelled here "
            f"({', '.join(_MODELS)} are); run `colmap image_undistorter` and give the undistorted model"
        )
    inside, lens = _MODELS[model]
    parameters = np.array(camera.params, dtype=np.float64)
    fx, fy, cx, cy = parameters[list(inside)]
    intrinsics = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    size = (int(camera.width), int(camera.height))
    return given_camera(place, name, size, intrinsics, pose[:3, :3], pose[:3, 3], parameters[list(lens)])


def _colmap_camera(camera: Camera, camera_id: int) -> Any:
    import pycolmap

    k = camera.intrinsics
    lens = np.zeros(8)
    lens[: camera.distortion.size] = camera.distortion
    inside = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5]
    if not lens.any():
        model, values = "PINHOLE", inside
    elif not lens[4:].any():
        model, values = "OPENCV", [*inside, *lens[:4]]
    else:
        model, values = "FULL_OPENCV", [*inside, *lens]
    return pycolmap.Camera(
        model=model, width=camera.size[0], height=camera.size[1], params=values, camera_id=camera_id
    )


def _rigid(pose: Float[np.ndarray, "4 4"]) -> Any:
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3].copy()), pose[:3, 3].copy())


def _four(rigid: Any) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3] = rigid.matrix()
    return pose
