"""Open a recording that may be wrong, and say what its files alone show.

`open_recording` refuses what no run could use; a check must look at it all the same. Here what stands in the
way is taken aside, told, and the rest is opened: cameras whose calibration is for pictures of another size,
left-handed poses, folders without a readable silhouette, calibrated cameras without pictures, and worlds
whose unit or up axis cannot be told.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capture.calibration_file import Calibration, PictureSizeError, read_calibration
from capture.convention import Convention, Settled, described, settle_convention
from capture.errors import RecordingError
from capture.finding import Finding, FindingKind
from capture.frame_choice import choose_frames
from capture.image_sequence import ImageFolders, ImageSequence, choose_sequence, find_images, find_inverted
from capture.projection_split import camera_from_projection
from capture.recording import Recording, gap_notes, own_calibration, own_sequence, probed_masks
from capture.rig import Rig
from capture.silhouettes import FrameSource
from capture.video_sequence import (
    BACKGROUND,
    VideoSequence,
    find_calibration,
    find_videos,
    length_notes,
    read_plates,
)
from capture.world import METRES_PER_UNIT, UP_AXES

_SPARE = "calibrated but without pictures, left out: "


@dataclass(frozen=True, eq=False)
class Opened:
    """A recording as far as it can be opened.

    Fields
    ------
    recording : its rig is in metres if `declared` says the unit (or it was asked for); else in file units.
        Its up axis is the one asked for, or z: whoever looks at the cameras settles it.
    findings : what the files alone show to be wrong.
    declared : the unit that the format or the user says, or None.
    asked : whether the user said the unit.
    where : the calibration's path.
    is_video : whether silhouettes must be segmented first.
    """

    recording: Recording
    findings: tuple[Finding, ...]
    declared: str | None
    asked: bool
    where: str
    is_video: bool


@dataclass(frozen=True)
class _Found:
    """Names and sizes of what was recorded, in order; how frames are read with a calibration."""

    name: str
    sizes: dict[str, tuple[int, int]]
    calibration: Path
    frame_ids: tuple[int, ...]
    images: ImageFolders | None
    inverted: frozenset[str]
    videos: dict[str, Any]
    plates: dict[str, Path]

    def source(self, rig: Rig) -> FrameSource:
        if self.images is not None:
            return ImageSequence(self.images, rig, self.inverted)
        return VideoSequence(self.videos, self.plates, rig, self.frame_ids)


def open_for_check(
    path: Path | str,
    *,
    sequence: str | None = None,
    calibration: Path | str | None = None,
    frames: str | None = None,
    units: str = "auto",
    up: str = "auto",
    background: Path | str | None = None,
) -> Opened:
    """As `open_recording`, but wrong cameras and worlds are told instead of refused.

    Raises RecordingError where there is nothing to look at: no such folder, no calibration, no pictures.
    """
    root = Path(path)
    if not root.is_dir():
        raise RecordingError(f"{root}: no such folder")
    if units not in ("auto", *METRES_PER_UNIT):
        raise RecordingError(f"--units {units}: unknown; choose auto, m, cm or mm")
    if up not in ("auto", *UP_AXES):
        raise RecordingError(f"--up {up}: unknown; choose auto or one of {', '.join(UP_AXES)}")
    chosen = None if calibration is None else Path(calibration)
    is_video = (root / "videos").is_dir()
    if is_video:
        if sequence:
            raise RecordingError(
                f"{root}: a folder of videos holds one sequence; leave out --sequence {sequence}"
            )
        found = _found_videos(root, chosen, None if background is None else Path(background), frames)
    else:
        found = _found_images(root, sequence, chosen, frames)
    read, findings = _read_calibration(found)
    declared = units if units != "auto" else read.unit
    where = str(found.calibration)
    notes = list(read.notes)
    if found.inverted:
        notes.append(
            f"Silhouettes are black on white, swapped on reading: {', '.join(sorted(found.inverted))}."
        )
    notes += length_notes(found.videos) if is_video else []
    if found.images is not None:
        probe = ImageSequence(found.images, read.rig, found.inverted)
        notes += gap_notes(probe, found.frame_ids)
        if read.leaves_open:
            pixels = settle_convention(read.rig, probed_masks(probe, found.frame_ids))
            read = replace(read, rig=pixels.rig)
            findings += _pixel_findings(pixels)
            notes += pixels.settled
    findings += _without_pictures(read.notes)
    per_unit = METRES_PER_UNIT[declared] if declared else 1.0
    axis = UP_AXES["z" if up == "auto" else up].copy()
    delivered = read.rig.with_world_scaled(per_unit)
    recording = Recording(
        name=found.name,
        rig=delivered.pinholes(),
        calibration=delivered,
        frame_ids=found.frame_ids,
        up=axis,
        unit=declared or "",
        metres_per_unit=per_unit,
        notes=tuple(notes),
        source=found.source(delivered),
    )
    return Opened(recording, tuple(findings), declared, units != "auto", where, is_video)


def _found_images(root: Path, sequence: str | None, calibration: Path | None, frames: str | None) -> _Found:
    root, sequence = own_sequence(root, sequence, calibration)
    name, folder = choose_sequence(root, sequence)
    images = find_images(name, folder, keep_unreadable=True)
    frame_ids = choose_frames(
        tuple(sorted({frame for files in images.silhouettes.values() for frame in files})), frames
    )
    return _Found(
        name,
        images.sizes,
        calibration or own_calibration(root),
        frame_ids,
        images,
        find_inverted(images),
        {},
        {},
    )


def _found_videos(
    root: Path, calibration: Path | None, background: Path | None, frames: str | None
) -> _Found:
    videos = find_videos(root)
    where = calibration or find_calibration(root)
    plates = read_plates(background or root / BACKGROUND, videos)
    frame_ids = choose_frames(tuple(range(max(video.n_frames for video in videos.values()))), frames)
    sizes = {name: video.size for name, video in videos.items()}
    return _Found("", sizes, where, frame_ids, None, frozenset(), videos, plates)


def _read_calibration(found: _Found) -> tuple[Calibration, list[Finding]]:
    """The calibration, every camera for its pictures' size, right-handed; and what had to be changed."""
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as scratch:
        path, left_handed = _right_handed(found.calibration, Path(scratch))
        sizes: dict[str, tuple[int, int]] = dict(found.sizes)
        wrong: dict[str, tuple[int, int]] = {}
        while True:
            try:
                read = read_calibration(path, sizes)
                break
            except PictureSizeError as error:
                assert error.camera not in wrong
                wrong[error.camera] = sizes[error.camera] = error.calibrated
            except RecordingError as error:
                raise RecordingError(str(error).replace(str(path), str(found.calibration))) from error
    names = read.rig.names
    if left_handed:
        listed = tuple(name for name in names if name in left_handed) or tuple(left_handed)
        whole = len(left_handed) >= len(names)
        findings.append(
            Finding(
                FindingKind.MIRRORED,
                names if whole else listed,
                "the pose's 3x3 part is a reflection, not a rotation (left-handed)",
                "negate one world axis of the calibration"
                if whole
                else "calibrate again, or negate the reflected axis",
                whole_rig=whole,
            )
        )
    cameras = []
    for camera in read.rig:
        if camera.name in wrong:
            size = found.sizes[camera.name]
            factor = size[0] / camera.size[0]
            cameras.append(camera.with_pixels_scaled(factor, factor, size))
        else:
            cameras.append(camera)
    findings += _size_findings(found.sizes, wrong, names)
    return replace(read, rig=Rig(tuple(cameras))), findings


def _size_findings(
    sizes: Mapping[str, tuple[int, int]], wrong: Mapping[str, tuple[int, int]], names: tuple[str, ...]
) -> list[Finding]:
    def told(name: str) -> str:
        (w, h), (own_w, own_h) = wrong[name], sizes[name]
        return f"calibrated for {w}x{h} px, its pictures are {own_w}x{own_h} px"

    action = "calibrate with pictures of this size, or scale its intrinsics and size in the file"
    if len(wrong) == len(names) and len({told(name) for name in wrong}) == 1:
        return [Finding(FindingKind.PICTURE_SIZE, names, told(names[0]), action, whole_rig=True)]
    return [Finding(FindingKind.PICTURE_SIZE, (name,), told(name), action) for name in wrong]


def _pixel_findings(pixels: Settled) -> list[Finding]:
    """Matrices that are for other pictures than these, in a way that a run undoes."""
    convention = pixels.convention
    if (convention.axes, convention.factor) == (Convention.axes, Convention.factor):
        return []
    kind = FindingKind.MIRRORED if convention.factor == Convention.factor else FindingKind.PICTURE_SIZE
    return [
        Finding(
            kind,
            pixels.rig.names,
            f"the matrices are for other pictures: {described(convention)}",
            "`bodyhull run` undoes that; if it is not how they were meant, look at pictures and calibration, "
            "else write them anew with `bodyhull convert`",
            whole_rig=True,
            numbers={"axes": convention.axes, "ratio": convention.factor},
        )
    ]


def _without_pictures(notes: tuple[str, ...]) -> list[Finding]:
    """Cameras that are calibrated, but were left out since there is no picture of theirs."""
    return [
        Finding(
            FindingKind.DEAD,
            tuple(Path(name).stem for name in note.split(_SPARE)[1].rstrip(".").split(", ")),
            "calibrated, but the recording has no picture of it",
            "restore its pictures, or take it out of the calibration",
        )
        for note in notes
        if _SPARE in note
    ]


def _right_handed(path: Path, scratch: Path) -> tuple[Path, list[str]]:
    """A rig .json whose poses hold reflections, written anew below `scratch` as plain matrices; the path
    itself for anything else. And the names of those cameras."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return path, []
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found, left_handed = [], []
        for entry in content["cameras"]:
            pose = np.array(entry["camera_from_world"], dtype=np.float64)
            if pose.shape != (4, 4) or np.linalg.det(pose[:3, :3]) >= 0:
                continue
            left_handed.append(str(entry["name"]))
            matrix = np.array(entry["intrinsics"], dtype=np.float64) @ pose[:3]
            size = (int(entry["size"][0]), int(entry["size"][1]))
            camera = camera_from_projection(str(entry["name"]), size, matrix)
            found.append((entry, camera))
        for entry, camera in found:
            entry |= Rig((replace(camera, projection=None),)).to_json()["cameras"][0]
    except (OSError, ValueError, KeyError, TypeError, IndexError, RecordingError):
        return path, []  # read_calibration says what is wrong with it
    if not left_handed:
        return path, []
    copy = scratch / path.name
    copy.write_text(json.dumps(content), encoding="utf-8")
    return copy, left_handed
