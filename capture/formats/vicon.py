"""Vicon's `.xcp` (XML): a `<Camera>` each, its values in the first `<KeyFrame>`.

`ORIENTATION` x y z w is the rotation from world to camera (x right, y down, z forward), `POSITION` the
camera's centre in millimetres, `FOCAL_LENGTH` in pixels (of the columns; rows: divided by
`PIXEL_ASPECT_RATIO`), `PRINCIPAL_POINT` px. Pixel centres are taken at whole numbers, as other readers do;
Vicon does not say. `VICON_RADIAL2` ("Vicon3Parameter" centre k1 k2 k3) or `VICON_RADIAL` (k1 k2) undo the
lens in pixels: ideal = centre + (1 + k1 r^2 + k2 r^4 + k3 r^6)(seen - centre), the reverse of OpenCV's
direction (`vicon_lens` turns one into the other).

Read in the readers of Pose2Sim and OpenCap, in IMS' writer, and in avialsync, whose authors tested the
direction of the lens on recordings that show the other cameras.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from capture.errors import RecordingError
from capture.foreign_rig import (
    ForeignRig,
    GivenCamera,
    foreign_rig,
    given_camera,
    numbered_names,
    picture_size,
)
from capture.formats.limits import number_text, require_no_skew
from capture.formats.vicon_lens import opencv_from_vicon, vicon_from_opencv
from capture.rig import Rig

UNIT = "mm"
#: A lens whose two descriptions differ by more than this is not written.
MOST_LENS_ERROR_PX = 0.05


def read_vicon(path: Path) -> ForeignRig:
    """The video cameras (all, where none is marked as one), millimetres. Raises RecordingError."""
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    except ElementTree.ParseError as error:
        raise RecordingError(f"{path}: no Vicon calibration, the XML does not parse ({error})") from error
    elements = list(root.iter("Camera"))
    if not elements:
        raise RecordingError(f"{path}: no <Camera> in this file; is it a Vicon .xcp?")
    video = [e for e in elements if "video" in e.get("TYPE", "").lower() or e.get("ISDV") == "2"]
    chosen = video or elements
    names = _names(chosen)
    notes = []
    if len(chosen) < len(elements):
        notes.append(f"{path}: {len(elements) - len(chosen)} marker cameras left out (no video).")
    cameras, unposed = [], []
    for name, element in zip(names, chosen, strict=True):
        frame = element.find("KeyFrames/KeyFrame")
        if frame is None:
            unposed.append(name)
            continue
        camera, found = _camera(path, name, element, frame)
        cameras.append(camera)
        notes += found
    if unposed:
        notes.append(f"{path}: never calibrated, left out: {', '.join(unposed)}.")
    return foreign_rig(cameras, UNIT, [path], notes)


def write_vicon(rig: Rig, path: Path) -> list[str]:
    """Millimetres; the lens as Vicon's three radial terms, refused where those cannot follow it."""
    require_no_skew(rig, "Vicon's .xcp")
    root = ElementTree.Element("Cameras", NAME="", VERSION="1.0")
    worst = 0.0
    for number, camera in zip(numbered_names(rig.names), rig, strict=True):
        k = camera.intrinsics
        radial, error_px = vicon_from_opencv(camera)
        if error_px > MOST_LENS_ERROR_PX:
            raise RecordingError(
                f"Vicon's .xcp has three radial lens terms, which miss the lens of camera {camera.name} by "
                f"up to {error_px:.2g} px; --undistorted writes the cameras of undistorted pictures, opencv "
                "and colmap hold the lens"
            )
        worst = max(worst, error_px)
        device = camera.name if camera.name.isdigit() else str(number)
        element = ElementTree.SubElement(
            root,
            "Camera",
            DEVICEID=device,
            NAME=camera.name,
            USERID=device,
            TYPE="VideoFile",
            DISPLAY_TYPE="Video",
            ISDV="2",
            SENSOR="",
            SENSOR_SIZE=f"{camera.size[0]} {camera.size[1]}",
            PIXEL_ASPECT_RATIO=number_text(k[0, 0] / k[1, 1]),
            SKEW="0",
            SYSTEM="",
            ACTIVE_THRESHOLD="1",
        )
        rotation = Rotation.from_matrix(camera.camera_from_world[:3, :3])
        frames = ElementTree.SubElement(element, "KeyFrames")
        ElementTree.SubElement(
            frames,
            "KeyFrame",
            FRAME="0",
            FOCAL_LENGTH=number_text(k[0, 0]),
            PRINCIPAL_POINT=_words(k[:2, 2]),
            ORIENTATION=_words(rotation.as_quat()),
            POSITION=_words(1000.0 * -camera.camera_from_world[:3, :3].T @ camera.camera_from_world[:3, 3]),
            VICON_RADIAL=_words(radial[:2]),
            VICON_RADIAL2=f"Vicon3Parameter {_words(k[:2, 2])} {_words(radial)}",
            IMAGE_ERROR="0",
            WORLD_ERROR="0",
        )
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    if worst == 0:
        return []
    return [f"Vicon's lens runs the other way: its three radial terms follow these lenses to {worst:.1g} px."]


def _names(elements: list[ElementTree.Element]) -> list[str]:
    """NAME where every camera has its own, else DEVICEID."""
    for key in ("NAME", "DEVICEID"):
        names = [element.get(key, "").strip() for element in elements]
        if all(names) and max(Counter(names).values()) == 1:
            return names
    return [f"{element.get('DEVICEID', '')}" or f"camera{k + 1}" for k, element in enumerate(elements)]


def _camera(
    path: Path, name: str, element: ElementTree.Element, frame: ElementTree.Element
) -> tuple[GivenCamera, list[str]]:
    where = f"{path}: camera {name}"

    def numbers(part: ElementTree.Element, key: str, count: int, missing: str | None = None) -> np.ndarray:
        text = part.get(key, missing)
        try:
            values = np.array([float(word) for word in (text or "").split()])
        except ValueError:
            values = np.zeros(0)
        if values.size != count or not np.isfinite(values).all():
            raise RecordingError(f"{where}: {key}={text!r} in <{part.tag}> is not {count} finite numbers")
        return values

    size = picture_size(where, *numbers(element, "SENSOR_SIZE", 2))
    focal = numbers(frame, "FOCAL_LENGTH", 1)[0]
    aspect = numbers(element, "PIXEL_ASPECT_RATIO", 1, "1")[0]
    if aspect <= 0:
        raise RecordingError(f"{where}: PIXEL_ASPECT_RATIO={aspect:g} must be positive")
    middle = numbers(frame, "PRINCIPAL_POINT", 2)
    quaternion = numbers(frame, "ORIENTATION", 4)
    if abs(np.linalg.norm(quaternion) - 1) > 1e-3:
        raise RecordingError(f"{where}: ORIENTATION is no rotation (its length is not 1)")
    rotation = Rotation.from_quat(quaternion).as_matrix()
    intrinsics = np.array([[focal, 0, middle[0]], [0, focal / aspect, middle[1]], [0, 0, 1.0]])
    centre, radial = middle, np.zeros(3)
    if "VICON_RADIAL2" in frame.attrib:
        words = frame.attrib["VICON_RADIAL2"].split()
        frame.set("VICON_RADIAL2", " ".join(words[1:] if words and words[0][:1].isalpha() else words))
        values = numbers(frame, "VICON_RADIAL2", 5)
        centre, radial = values[:2], values[2:]
    elif "VICON_RADIAL" in frame.attrib:
        radial[:2] = numbers(frame, "VICON_RADIAL", 2)
    lens, notes = np.zeros(0), []
    if radial.any():
        lens, error_px = opencv_from_vicon(size, intrinsics, centre, radial)
        if error_px > 1e-6:
            notes.append(f"{where}: Vicon's lens turned into OpenCV's, to {error_px:.1g} px.")
    translation = -rotation @ numbers(frame, "POSITION", 3)
    return given_camera(path, name, size, intrinsics, rotation, translation, lens), notes


def _words(values: np.ndarray) -> str:
    return " ".join(number_text(value) for value in values)
