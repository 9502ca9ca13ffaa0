"""`bodyhull convert` on the command line."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from bodyhull.config import Units
from bodyhull.errors import OK, UserError

if TYPE_CHECKING:
    from capture.foreign_rig import ForeignRig, Size
    from capture.rig import Rig

FormatName = Literal[
    "bodyhull",
    "inria",
    "colmap",
    "colmap-text",
    "easymocap",
    "opencv",
    "aniposelib",
    "pose2sim",
    "caliscope",
    "qualisys",
    "vicon",
    "zju-mocap",
    "actorshq",
    "middlebury",
]


@dataclass(frozen=True)
class Convert:
    """Turn a calibration into another format: direction, unit, axes and pixel centres are converted. What the
    format cannot hold is told, and refused where pixels would move."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN")]
    """Calibration file or folder in any of these formats, told by its content."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """File or folder to make."""
    to: FormatName
    """Format to write. bodyhull is the rig .json that --calibration takes."""
    units: Units = "auto"
    """Unit of the world that IN is in, where its format does not say."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Picture size, where IN does not say it and no pictures lie beside it."""
    undistorted: bool = False
    """Write the cameras of undistorted pictures: same camera matrix, no lens distortion."""
    invert_poses: bool = False
    """IN holds camera-to-world poses where its format has world-to-camera ones: invert every pose."""
    overwrite: bool = False
    """Replace a calibration that OUT holds already."""


def perform_convert(command: Convert) -> int:
    """Read, check, write; notes go to standard error. Returns the exit code."""
    from bodyhull.cli import parsed_size
    from capture.rig_checks import lens_doubts, placement_doubts, with_inverted_poses
    from capture.rig_formats import METRES_PER_UNIT, detect_format, read_rig_of, write_rig

    foreign = read_rig_of(command.source)
    size = None if command.size is None else parsed_size(command.size)
    read_as = detect_format(command.source)
    seen, notes = (None, []) if read_as != "inria" else _by_silhouettes(command)
    if seen is not None and seen.names == foreign.names and size is None and not command.invert_poses:
        rig, unit = seen, "m"
    else:
        rig = _sized(command, foreign, size)
        if command.invert_poses:
            rig = with_inverted_poses(rig)
        unit, unit_notes = _unit(command, foreign, rig)
        notes = [*notes, *unit_notes] if seen is None else unit_notes
    notes += [*foreign.notes, *lens_doubts(rig), *placement_doubts(rig, METRES_PER_UNIT[unit])]
    if command.undistorted:
        if all(camera.is_pinhole for camera in rig):
            notes.append("No camera has lens distortion: --undistorted changes nothing.")
        rig = rig.pinholes()
    files, lost = write_rig(
        rig.with_world_scaled(METRES_PER_UNIT[unit]), command.out, command.to, overwrite=command.overwrite
    )
    for note in [*notes, *lost]:
        print(f"bodyhull: note: {note}", file=sys.stderr)
    print(f"{len(rig)} cameras from {command.source} ({read_as}) as {command.to}:")
    for file in files:
        print(f"  {file}")
    return OK


def _by_silhouettes(command: Convert) -> tuple[Rig | None, list[str]]:
    """Cameras of 3x4 matrices in metres as the recording that they belong to would have them, with what its
    silhouettes tell about unit and pixels; None where no recording lies round them or it cannot be opened."""
    from capture.errors import RecordingError
    from capture.image_sequence import find_sequences
    from capture.recording import open_recording

    source = command.source if command.source.is_dir() else command.source.parent
    for root in (source, source.resolve().parent):
        sequences = find_sequences(root) if root.is_dir() else {}
        if not sequences:
            continue
        try:
            opened = open_recording(root, sequence=next(iter(sequences)), units=command.units)
        except RecordingError as error:
            return None, [f"The silhouettes beside the matrices were not used: {error}"]
        told = [note for note in opened.notes if note.startswith(("Unit", "Pixel", "The matrices", "With"))]
        return opened.calibration, told
    return None, []


def _sized(command: Convert, foreign: ForeignRig, size: Size | None) -> Rig:
    without = [camera.name for camera in foreign.cameras if camera.size is None]
    if without and size is None:
        raise UserError(
            f"{command.source}: does not say how large the pictures of {', '.join(without[:4])}"
            f"{' and others' if len(without) > 4 else ''} are, and none lie beside it; "
            "give --size, for example 1920x1080"
        )
    stated = sorted({camera.size for camera in foreign.cameras if camera.size is not None})
    if size is not None and stated and stated != [size]:
        listed = ", ".join(f"{width}x{height}" for width, height in stated)
        raise UserError(
            f"--size {command.size}: {command.source} says itself that its pictures are {listed} px; "
            "leave it out"
        )
    return foreign.rig(size)


def _unit(command: Convert, foreign: ForeignRig, rig: Rig) -> tuple[str, list[str]]:
    """The unit of the world that was read, and sentences on it."""
    from capture.rig_checks import guess_unit

    if command.units != "auto":
        differs = foreign.unit is not None and command.units != foreign.unit
        told = f"Unit {command.units} as asked; the format of {command.source} says {foreign.unit}."
        return command.units, [told] if differs else []
    if foreign.unit is not None:
        return foreign.unit, []
    unit, distance = guess_unit(rig) if len(rig) > 1 else (None, float("nan"))
    if unit is None:
        raise UserError(
            f"{command.source}: its format states no unit, and the cameras stand {distance:.4g} units from "
            "where they aim, which does not tell; give --units m, cm or mm"
        )
    return unit, [
        f"{command.source} states no unit: taken as {unit}, since its cameras stand {distance:.4g} units "
        "from where they aim; --units says otherwise."
    ]
