"""A recording: calibrated cameras, frame numbers, silhouettes and pictures on demand. The door of the
capture room."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from capture.calibration_file import Calibration, find_calibrations, read_calibration
from capture.convention import settle_convention
from capture.errors import RecordingError
from capture.formats.inria import list_matrix_files
from capture.frame_choice import choose_frames
from capture.image_sequence import ImageSequence, choose_sequence, find_images, find_inverted
from capture.rig import Rig
from capture.silhouettes import FrameSource, Silhouettes
from capture.video_sequence import (
    BACKGROUND,
    VideoSequence,
    find_calibration,
    find_videos,
    length_notes,
    read_plates,
)
from capture.world import Masks, World, settle_world

__all__ = ["Recording", "RecordingError", "Silhouettes", "open_recording"]


@dataclass(frozen=True)
class Recording:
    """A recording that has been opened; frames are read when asked for.

    name : the sequence's name ("" if it has none).
    rig : pinholes, metres: what the pictures and silhouettes handed out were seen by.
    calibration : the same cameras as delivered, lens distortion included, metres.
    frame_ids : the frames chosen; a frame is here if at least one camera has it.
    up : (3,) unit vector, world.
    unit, metres_per_unit : the calibration's own world unit.
    notes : what was found out or repaired on opening, a sentence each.
    source : where frames come from.
    settled : those of the notes that give no reason for doubt (unit, up axis).
    """

    name: str
    rig: Rig
    calibration: Rig
    frame_ids: tuple[int, ...]
    up: Float[np.ndarray, " 3"]
    unit: str
    metres_per_unit: float
    notes: tuple[str, ...]
    source: FrameSource
    settled: tuple[str, ...] = ()

    def silhouettes(self, frame_id: int, soft: bool = False) -> Silhouettes:
        """The frame's silhouettes, undistorted, one a camera of `rig`; what could not be had is None and
        told. `soft`: probabilities of the person, 0 to 255, instead of masks."""
        self._check(frame_id)
        return self.source.silhouettes(frame_id, soft)

    def picture(self, camera_idx: int, frame_id: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """The frame's picture (h w 3) RGB, undistorted, as camera `rig[camera_idx]` sees it; None where
        there is none."""
        self._check(frame_id)
        image = self.source.picture(camera_idx, frame_id)
        return None if image is None else self.calibration[camera_idx].undistort_image(image)

    def fingerprint(self) -> str:
        """A hash (hex) that changes when an input of this recording changes.

        Over the calibration, unit and up axis, the names and sizes of all files of the chosen frames, and
        the content of the first and the last of them in each folder: a replaced file of equal size in
        between goes unnoticed.
        """
        digest = hashlib.sha256()
        digest.update(json.dumps(self.calibration.to_json()).encode())
        digest.update(f"{self.name}|{self.unit}|{self.up.tolist()}|{self.frame_ids}".encode())
        by_folder: dict[Path, list[Path]] = {}
        for path in self.source.files(self.frame_ids):
            by_folder.setdefault(path.parent, []).append(path)
        for folder, files in by_folder.items():
            digest.update(folder.name.encode())
            for path in files:
                digest.update(f"{path.name}:{path.stat().st_size}".encode())
            for path in {files[0]: None, files[-1]: None}:
                with path.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
        return digest.hexdigest()

    def _check(self, frame_id: int) -> None:
        if frame_id not in self.frame_ids:
            raise KeyError(f"frame {frame_id} is not among the chosen frames")


def open_recording(
    path: Path | str,
    *,
    sequence: str | None = None,
    calibration: Path | str | None = None,
    frames: str | None = None,
    units: str = "auto",
    up: str = "auto",
    background: Path | str | None = None,
) -> Recording:
    """Open a folder in the INRIA layout, or a folder of synchronised videos with calibration and background
    plates.

    sequence : which sequence, where the folder has several.
    calibration : a file or folder in any format of `capture.rig_formats`, instead of the recording's own.
    frames : "START:STOP:STEP" over frame numbers.
    units, up : "auto", or the calibration's unit (m, cm, mm) and the world's up axis (x, y, z, -x, -y, -z).
    background : folder of background plates (videos only).

    Raises RecordingError for whatever cannot be opened; single bad files are marked in `Silhouettes` instead.
    """
    root = Path(path)
    if not root.is_dir():
        raise RecordingError(f"{root}: no such folder")
    chosen_calibration = None if calibration is None else Path(calibration)
    if (root / "videos").is_dir():
        plates = None if background is None else Path(background)
        return _open_videos(root, sequence, chosen_calibration, plates, frames, units, up)
    return _open_images(root, sequence, chosen_calibration, frames, units, up)


def _open_videos(
    root: Path,
    sequence: str | None,
    calibration_path: Path | None,
    background: Path | None,
    frames: str | None,
    units: str,
    up: str,
) -> Recording:
    if sequence:
        raise RecordingError(
            f"{root}: a folder of videos holds one sequence; leave out --sequence {sequence}"
        )
    videos = find_videos(root)
    calibration_path = calibration_path or find_calibration(root)
    calibration = read_calibration(calibration_path, {name: video.size for name, video in videos.items()})
    plates = read_plates(background or root / BACKGROUND, videos)
    available = tuple(range(max(video.n_frames for video in videos.values())))
    chosen = choose_frames(available, frames)
    world = settle_world(
        calibration.rig,
        None,
        declared_unit=calibration.unit,
        units=units,
        up=up,
        where=str(calibration_path),
    )
    delivered = calibration.rig.with_world_scaled(world.metres_per_unit)
    notes = [*calibration.notes, *length_notes(videos)]
    return _recording("", calibration, world, chosen, notes, VideoSequence(videos, plates, delivered, chosen))


def _open_images(
    root: Path, sequence: str | None, calibration_path: Path | None, frames: str | None, units: str, up: str
) -> Recording:
    root, sequence = own_sequence(root, sequence, calibration_path)
    name, folder = choose_sequence(root, sequence)
    images = find_images(name, folder)
    calibration_path = calibration_path or own_calibration(root)
    calibration = read_calibration(calibration_path, images.sizes)
    inverted = find_inverted(images)
    probe = ImageSequence(images, calibration.rig, inverted)
    chosen = choose_frames(probe.frame_ids, frames)
    probed = probed_masks(probe, chosen)
    told: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    if calibration.leaves_open:
        pixels = settle_convention(calibration.rig, probed)
        calibration, doubts, told = replace(calibration, rig=pixels.rig), pixels.doubts, pixels.settled
    world = settle_world(
        calibration.rig,
        probed[0],
        declared_unit=calibration.unit,
        units=units,
        up=up,
        where=str(calibration_path),
    )
    world = replace(world, notes=(*world.notes, *told), settled=(*world.settled, *told))
    notes = [*calibration.notes, *doubts]
    if inverted:
        notes.append(f"Silhouettes are black on white, swapped on reading: {', '.join(sorted(inverted))}.")
    notes += gap_notes(probe, chosen)
    delivered = calibration.rig.with_world_scaled(world.metres_per_unit)
    return _recording(name, calibration, world, chosen, notes, ImageSequence(images, delivered, inverted))


def probed_masks(source: ImageSequence, frame_ids: tuple[int, ...]) -> list[Masks]:
    """Silhouettes of one or two frames to learn from, the fuller ones first."""
    found = [
        source.silhouettes(frame).images for frame in sorted({frame_ids[0], frame_ids[len(frame_ids) // 2]})
    ]
    return sorted(found, key=lambda images: -sum(image is not None for image in images))


def own_calibration(root: Path) -> Path:
    """`setup/`, or the one calibration that lies there, in `calibration/` or beside them.

    A JSON file beside them must be called rig.json: other programs leave theirs there too.
    """
    if (root / "setup").is_dir() and list_matrix_files(root / "setup"):
        return root / "setup"
    found = [
        path
        for path in find_calibrations(root)
        if path.parent != root or path.suffix != ".json" or path.name == "rig.json"
    ]
    if len(found) > 1:
        names = ", ".join(str(path.relative_to(root)) for path in found)
        raise RecordingError(f"{root}: several calibrations ({names}); choose one with --calibration FILE")
    return found[0] if found else root / "setup"


def own_sequence(root: Path, sequence: str | None, calibration: Path | None) -> tuple[Path, str | None]:
    """The recording's folder and the sequence, where the sequence's own folder was given."""
    if (root / "SilhouettesPictures").is_dir() and not (root / "setup").is_dir() and sequence is None:
        parent = root.resolve().parent
        if calibration is None and (parent / "setup").is_dir():
            # Its calibration lies one level up.
            return parent, root.resolve().name
    return root, sequence


def _recording(
    name: str,
    calibration: Calibration,
    world: World,
    frame_ids: tuple[int, ...],
    notes: list[str],
    source: FrameSource,
) -> Recording:
    delivered = calibration.rig.with_world_scaled(world.metres_per_unit)
    return Recording(
        name=name,
        rig=delivered.pinholes(),
        calibration=delivered,
        frame_ids=frame_ids,
        up=world.up,
        unit=world.unit,
        metres_per_unit=world.metres_per_unit,
        notes=(*notes, *world.notes),
        settled=world.settled,
        source=source,
    )


def gap_notes(source: ImageSequence, chosen: tuple[int, ...]) -> list[str]:
    """Sentences on frames that some cameras lack, and on numbers that no camera has."""
    notes = []
    for camera in source.calibration:
        files = source.folders.silhouettes[camera.name]
        missing = [frame for frame in chosen if frame not in files]
        if missing:
            notes.append(
                f"Camera {camera.name} lacks {len(missing)} of the {len(chosen)} frames: {_listed(missing)}."
            )
    available = source.frame_ids
    absent = sorted(set(range(available[0], available[-1] + 1)) - set(available))
    usual_step = min(np.diff(available), default=1)
    if absent and usual_step == 1:
        notes.append(f"No camera has frame {_listed(absent)}.")
    return notes


def _listed(numbers: list[int]) -> str:
    shown = ", ".join(map(str, numbers[:8]))
    return shown + (f" and {len(numbers) - 8} more" if len(numbers) > 8 else "")
