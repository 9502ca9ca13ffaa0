"""`bodyhull calibrate world`: a recording's rig moved to its floor, z up, and scaled to the height of its
person."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from bodyhull.errors import FRAMES_FAILED, OK, UserError
from bodyhull.folder import write_atomically
from bodyhull.recording_choice import RecordingChoice

if TYPE_CHECKING:
    from jaxtyping import Float

    from capture.recording import Recording

_MOST_FRAMES = 24


@dataclass(frozen=True, kw_only=True)
class World(RecordingChoice):
    """Move a recording's calibration to its floor (z up, floor at 0), and scale it to the person's height."""

    out: Annotated[Path, tyro.conf.arg(metavar="FILE.json")]
    """Rig file to write; `run --calibration` takes it."""
    floor: Literal["feet", "cameras", "keep"] = "feet"
    """Where the floor is: under the person's feet (keypoints where there are any, else the lowest places
    that all silhouettes share); only the up axis, from the cameras' mounting; or as it was."""
    height_m: float | None = None
    """Height of the person, metres: the rig is scaled so that the silhouettes' space is as tall."""
    keypoints: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """OpenPose's or COCO's keypoints, as `bodyhull run` takes them."""


def perform_world(command: World) -> int:
    """Read, move, write, tell; returns the exit code (3 where the result is doubted)."""
    from capture.world_frame import settle_ground

    if command.out.is_dir() or command.out.suffix.lower() != ".json":
        raise UserError(f"--out {command.out}: give the name of a .json file")
    recording = command.opened()
    indices = np.linspace(0, len(recording.frame_ids) - 1, min(_MOST_FRAMES, len(recording.frame_ids)))
    frames = [recording.frame_ids[k] for k in sorted({int(k) for k in indices.round()})]
    wants_masks = command.height_m is not None or (command.floor == "feet" and command.keypoints is None)
    masks = [recording.silhouettes(frame).images for frame in frames] if wants_masks else []
    joints = (
        joints_of(recording, command.keypoints, frames)
        if command.keypoints and command.floor == "feet"
        else []
    )
    ground = settle_ground(
        recording.calibration,
        command.floor,
        joints=joints,
        masks=masks,
        height_m=command.height_m,
        up=recording.up,
    )
    write_atomically(command.out, ground.rig.save)
    for note in ground.notes:
        print(f"World: {note}")
    for doubt in ground.doubts:
        print(f"warning: {doubt}")
    heights = ", ".join(f"{camera.name} {camera.centre[2]:.2f}" for camera in ground.rig)
    print(f"camera heights, m: {heights}\nrig: {command.out}")
    return FRAMES_FAILED if ground.doubts else OK


def joints_of(recording: Recording, folder: Path, frames: list[int]) -> list[Float[np.ndarray, "25 4"]]:
    """The person's joints in these frames, in the recording's world, metres."""
    from capture.keypoints import read_keypoints, triangulate_keypoints

    rig = recording.calibration
    return [triangulate_keypoints(rig, read_keypoints(folder, rig.names, frame), None) for frame in frames]
