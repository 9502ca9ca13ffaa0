"""A recording of which there are pictures but no silhouettes yet: its pictures and, if calibrated, cameras.

The calibration serves two ends: to tell the subject from other people, and to write silhouettes as ideal
lenses would see them. Neither needs the world's up axis, and the unit only roughly, so both are guessed here
where nothing says them; the cameras' files are handed on in their own unit.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture.calibration_file import read_calibration
from capture.errors import RecordingError
from capture.frame_choice import choose_frames
from capture.picture_frames import PictureFrames, find_pictures
from capture.plates import EmptyScene, find_empty_scenes
from capture.rig import Rig
from capture.video_sequence import BACKGROUND, find_calibration
from capture.world import METRES_PER_UNIT, closest_point, settle_world

_USUAL_DISTANCE_M = 3.5
_ANY_UP = "z"  # nothing here depends on it


@dataclass(frozen=True)
class Filmed:
    """Pictures, cameras and empty scenes of a recording.

    frames : the pictures. rig : metres, lens included; None: not calibrated. delivered : the same in the
    calibration's own unit. chosen : the frames asked for. scenes : camera -> its empty scene, for those that
    have one. notes : a sentence each.
    """

    frames: PictureFrames
    rig: Rig | None
    delivered: Rig | None
    chosen: tuple[int, ...]
    scenes: dict[str, EmptyScene]
    notes: tuple[str, ...]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in order."""
        return tuple(self.frames.sizes)

    def fingerprint(self) -> str:
        """A hash (hex) that changes with the calibration, and with names or sizes of the files that the
        chosen frames and the empty scenes are read from."""
        digest = hashlib.sha256()
        digest.update(json.dumps(None if self.delivered is None else self.delivered.to_json()).encode())
        digest.update(f"{self.frames.name}|{self.frames.sizes}|{self.chosen}".encode())
        files = [*self.frames.files(self.chosen), *(f for s in self.scenes.values() for f in s.files)]
        for path in files:
            digest.update(f"{path.parent.name}/{path.name}:{path.stat().st_size}".encode())
        return digest.hexdigest()


def open_filmed(
    path: Path | str,
    *,
    sequence: str | None = None,
    calibration: Path | str | None = None,
    frames: str | None = None,
    units: str = "auto",
    background: Path | str | None = None,
) -> Filmed:
    """Open a folder of synchronised videos, or of pictures in the INRIA layout.

    sequence, calibration, frames, units : as for `capture.recording.open_recording`; a recording without
    calibration is opened all the same. background : folder of empty scenes (`capture.plates`); the
    recording's own background/ if not given. Raises RecordingError for what cannot be opened.
    """
    root = Path(path)
    pictures = find_pictures(root, sequence)
    chosen = choose_frames(pictures.frame_ids, frames)
    notes = list(pictures.notes)
    given = _calibration_path(root, None if calibration is None else Path(calibration), notes)
    rig, delivered = None, None
    if given is not None:
        read = read_calibration(given, pictures.sizes)
        notes += read.notes
        delivered = read.rig
        unit = read.unit or (units if units != "auto" else _likely_unit(delivered))
        if read.unit is None and units == "auto":
            notes.append(
                f"The calibration's unit is taken to be {unit}, from how far the cameras stand apart."
            )
        world = settle_world(delivered, None, declared_unit=unit, units=units, up=_ANY_UP, where=str(given))
        rig = delivered.with_world_scaled(world.metres_per_unit)
    folder = root / BACKGROUND if background is None else Path(background)
    scenes = {}
    if background is not None or folder.is_dir():
        scenes = find_empty_scenes(folder, pictures.sizes)
        without = [camera for camera in pictures.sizes if camera not in scenes]
        if without:
            notes.append(
                f"{folder}: no background plate for {', '.join(without)}; the median over time is used there."
            )
    return Filmed(pictures, rig, delivered, chosen, scenes, tuple(notes))


def _calibration_path(root: Path, given: Path | None, notes: list[str]) -> Path | None:
    if given is not None:
        return given
    try:
        return find_calibration(root)
    except RecordingError as error:
        if "several" in str(error):
            raise
        notes.append(
            "No calibration: each camera is worked on by itself, and silhouettes are written as filmed, lens "
            "distortion included."
        )
        return None


def _likely_unit(rig: Rig) -> str:
    """The unit in which the cameras stand at a distance usual for filming a person."""
    middle, _ = closest_point(rig.centres, np.array([camera.forward for camera in rig]))
    distance = float(np.median(np.linalg.norm(rig.centres - middle, axis=1)))
    return min(
        METRES_PER_UNIT,
        key=lambda unit: abs(np.log(max(distance, 1e-9) * METRES_PER_UNIT[unit] / _USUAL_DISTANCE_M)),
    )
