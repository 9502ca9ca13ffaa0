"""Qualisys camera calibrations, read and written: `.qca.txt` (XML).

Conventions, as measured on a real recording: focal lengths and principal point in 1/64 pixel, pixel centres
at whole numbers; `transform` x y z is the camera's centre in the world, in millimetres; the 3x3 read row by
row, its second and third rows negated, is the world-to-camera rotation of a camera with x right, y down, z
forward. Distortion is OpenCV's k1 k2 p1 p2 k3 under other names.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.errors import RecordingError
from capture.formats.limits import number_text, require_terms
from capture.rig import Rig

_SUBPIXEL = 64.0
UNIT = "mm"


def read_qualisys(path: Path) -> Rig:
    """The active cameras of a `.qca.txt`, named by their serial; world units are millimetres (`UNIT`).

    Raises RecordingError that names the file, the camera and the attribute.
    """
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    except ElementTree.ParseError as error:
        raise RecordingError(f"{path}: no Qualisys calibration, the XML does not parse ({error})") from error
    elements = [element for element in root.iter("camera") if element.get("active", "1") != "0"]
    if not elements:
        raise RecordingError(f"{path}: no active <camera> in this file; is it a Qualisys calibration?")
    cameras = [_camera(path, element) for element in elements]
    try:
        return Rig(tuple(cameras))
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def _camera(path: Path, element: ElementTree.Element) -> Camera:
    name = element.get("serial", "")
    if not name:
        raise RecordingError(f"{path}: a <camera> without a serial, which is the camera's name")
    transform, intrinsic = element.find("transform"), element.find("intrinsic")
    view = element.find("fov_video")
    if transform is None or intrinsic is None or view is None:
        raise RecordingError(f"{path}: camera {name} lacks <transform>, <intrinsic> or <fov_video>")

    def number(part: ElementTree.Element, key: str, missing: float | None = None) -> float:
        text = part.get(key)
        if text is None and missing is not None:
            return missing
        try:
            value = float(text or "")
        except ValueError:
            value = float("nan")
        if not np.isfinite(value):
            raise RecordingError(
                f"{path}: camera {name}: {key}={text!r} in <{part.tag}> is not a finite number"
            )
        return value

    rows = np.array([[number(transform, f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)])
    rotation = np.diag([1.0, -1, -1]) @ rows
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise RecordingError(f"{path}: camera {name}: r11 to r33 are no rotation matrix")
    if np.linalg.det(rotation) < 0:
        raise RecordingError(
            f"{path}: camera {name}: mirrored calibration (r11 to r33 have determinant -1); "
            "export the calibration again from a right-handed world frame"
        )
    left, _, right = np.linalg.svd(rotation)
    pose = np.eye(4)
    pose[:3, :3] = left @ right  # the nearest rotation: text with few digits is none exactly
    pose[:3, 3] = -pose[:3, :3] @ [number(transform, axis) for axis in "xyz"]
    # The video's own pixels: a cropped video begins at `left`, `top` of the sensor that the intrinsics refer
    # to.
    left_px, top_px = number(view, "left"), number(view, "top")
    size = (int(number(view, "right") - left_px) + 1, int(number(view, "bottom") - top_px) + 1)
    intrinsics = np.array(
        [
            [
                number(intrinsic, "focalLengthU"),
                number(intrinsic, "skew", 0.0),
                number(intrinsic, "centerPointU"),
            ],
            [0.0, number(intrinsic, "focalLengthV"), number(intrinsic, "centerPointV")],
            [0.0, 0.0, _SUBPIXEL],
        ]
    )
    intrinsics /= _SUBPIXEL
    intrinsics[:2, 2] -= [left_px, top_px]
    # "tangental" is the format's own spelling.
    radial, tangential = "radialDistortion", "tangentalDistortion"
    keys = (f"{radial}1", f"{radial}2", f"{tangential}1", f"{tangential}2", f"{radial}3")
    distortion = np.array([number(intrinsic, key, 0.0) for key in keys])
    try:
        return Camera(name, size, intrinsics, pose, distortion if distortion.any() else np.zeros(0))
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from error


def write_qualisys(rig: Rig, path: Path) -> list[str]:
    """A `.qca.txt` of a rig in metres: millimetres, 1/64 px, five lens terms."""
    require_terms(rig, 5, "Qualisys' .qca.txt")
    root = ElementTree.Element("calibration", {"type": "regular", "qtm-version": "none"})
    ElementTree.SubElement(root, "results", {"std-dev": "0.0", "min-max-diff": "0.0"})
    cameras = ElementTree.SubElement(root, "cameras")
    for camera in rig:
        element = ElementTree.SubElement(
            cameras,
            "camera",
            {
                "active": "1",
                "avg-residual": "0.0",
                "serial": camera.name,
                "model": "none",
                "viewrotation": "0",
            },
        )
        view = {"left": 0, "top": 0, "right": camera.size[0] - 1, "bottom": camera.size[1] - 1}
        for tag in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            ElementTree.SubElement(element, tag, {key: str(value) for key, value in view.items()})
        rotation = camera.camera_from_world[:3, :3]
        rows = np.diag([1.0, -1, -1]) @ rotation
        centre_mm = 1000.0 * (-rotation.T @ camera.camera_from_world[:3, 3])
        place = {f"r{i + 1}{j + 1}": rows[i, j] for i in range(3) for j in range(3)}
        place |= dict(zip("xyz", centre_mm, strict=True))
        k = _SUBPIXEL * camera.intrinsics
        lens = np.zeros(5)
        lens[: camera.distortion[:5].size] = camera.distortion[:5]
        inside = {
            "focalLengthU": k[0, 0],
            "focalLengthV": k[1, 1],
            "centerPointU": k[0, 2],
            "centerPointV": k[1, 2],
            "skew": k[0, 1],
            "radialDistortion1": lens[0],
            "radialDistortion2": lens[1],
            "radialDistortion3": lens[4],
            "tangentalDistortion1": lens[2],
            "tangentalDistortion2": lens[3],
            "sensorMinU": 0.0,
            "sensorMaxU": _SUBPIXEL * (camera.size[0] - 1),
            "sensorMinV": 0.0,
            "sensorMaxV": _SUBPIXEL * (camera.size[1] - 1),
        }
        for tag, values in (("transform", place), ("intrinsic", inside)):
            ElementTree.SubElement(element, tag, {key: number_text(value) for key, value in values.items()})
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="ascii", xml_declaration=True)
    return []
