"""`bodyhull silhouettes` on the command line."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from bodyhull.config import Units
from bodyhull.errors import FRAMES_FAILED, OK, UserError


@dataclass(frozen=True)
class MakeSilhouettes:
    """Make the silhouettes of a recording of videos or pictures, in the INRIA layout, with the cameras that
    see them: `bodyhull run OUT` goes on from there. They are written without lens distortion
    (setup/camNN.txt holds the ideal cameras), unless --as-filmed."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """Folder of the recording: videos/, or [SEQUENCE/]Pictures/cam-NNN/img_NNNNNN.png, with a calibration."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder to write SilhouettesPictures/, the calibration, silhouettes.json and a contact sheet to.
    Finished frames in it are kept. May be the recording's own folder."""
    method: Literal["auto", "plate", "median", "mog2", "knn", "gsoc", "cnt", "chroma"] = "auto"
    """auto: colours and minimum cut before a background that the film corrects, or chroma before a screen.
    plate: difference to empty pictures, shadows told apart. median: to the median over time. mog2, knn:
    OpenCV's models, trained and held still. gsoc, cnt: difference to the picture that these have learnt.
    chroma: a screen of one colour."""
    refine: Literal["auto", "guided", "grabcut", "none"] = "auto"
    """Move the border to the picture's edge: guided filter, or GrabCut in a band. auto: as the method does it
    itself."""
    repair: bool = True
    """Let the other cameras mend each silhouette (4 cameras or more): what they deny goes, what they all see
    comes back where the picture agrees, or becomes unknown."""
    background: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Empty pictures: <camera>.png, a folder <camera>/ of many, or a film <camera>.mp4. The recording's own
    background/ if not given; none: the median over time, the person cut out of the film roughly first."""
    key: Annotated[str | None, tyro.conf.arg(metavar="R,G,B")] = None
    """Colour of the screen, 0 to 255 each, where it is not found by itself."""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Calibration to use instead of the recording's own. Without any, each camera is worked on by itself."""
    sequence: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which sequence, where the recording holds several."""
    frames: Annotated[str | None, tyro.conf.arg(metavar="START:STOP:STEP")] = None
    """Which frame numbers; all by default."""
    units: Units = "auto"
    """Unit of the calibration's world."""
    as_filmed: bool = False
    """Keep the lens distortion: silhouettes lie on the original pictures, and rig.json holds the cameras with
    their lenses, for `bodyhull run DIR --calibration DIR/rig.json`."""
    pictures: bool = False
    """Write the pictures too, as the same cameras see them: for coloured hulls and overlay films."""
    jobs: int = 0
    """Frames worked on at once; 0: one a core."""
    overwrite: bool = False
    """Replace the silhouettes that DIR holds."""


def perform_silhouettes(command: MakeSilhouettes) -> int:
    """Open, make, write, print; returns the exit code (3 where a frame has no silhouette at all)."""
    from bodyhull.masking import SHEET, MaskingConfig, masking_stage
    from bodyhull.study_commands import usual_jobs
    from capture.filmed import open_filmed
    from capture.silhouette_maker import MakerOptions

    if command.jobs < 0:
        raise UserError(f"--jobs {command.jobs}: give 0 (one a core) or more")
    if command.key is not None and command.method not in ("auto", "chroma"):
        raise UserError(f"--key is for --method chroma; leave it out with --method {command.method}")
    filmed = open_filmed(
        command.recording,
        sequence=command.sequence,
        calibration=command.calibration,
        frames=command.frames,
        units=command.units,
        background=command.background,
    )
    named = ("method", "refine", "repair", "key", "frames", "sequence", "as_filmed")
    config = MaskingConfig(
        command.out,
        MakerOptions(command.method, command.refine, command.repair, parsed_key(command.key)),
        command.as_filmed,
        command.pictures,
        command.jobs or usual_jobs(),
        command.overwrite,
        {name: getattr(command, name) for name in named},
    )
    masked = masking_stage(filmed, config)
    failed, n_frames = masked.failed, len(masked.frames)
    marked = sum(bool(entry["problems"]) for entry in masked.frames.values())
    print(f"silhouettes: {masked.folder.silhouette(filmed.cameras[0], filmed.chosen[0]).parents[1]}")
    print(f"             {len(filmed.cameras)} cameras, {n_frames} frames ({masked.made} made now)", end="")
    print(f", {marked} with problems (see silhouettes.json)" if marked else "")
    if (command.out / SHEET).is_file():
        print(f"look at:     {command.out / SHEET}")
    if masked.calibration is None:
        print(f"no calibration: go on with bodyhull run {command.out} --out RUN --calibration FILE")
    elif masked.calibration.is_file():
        print(f"go on with:  bodyhull run {command.out} --out RUN --calibration {masked.calibration}")
    else:
        print(f"go on with:  bodyhull run {command.out} --out RUN")
    if failed:
        listed = ", ".join(failed[:8]) + (f" and {len(failed) - 8} more" if len(failed) > 8 else "")
        print(
            f"bodyhull: {len(failed)} of {n_frames} frames have no silhouette at all: {listed}",
            file=sys.stderr,
        )
    return FRAMES_FAILED if failed else OK


def parsed_key(text: str | None) -> tuple[int, int, int] | None:
    """ "0,180,60" as (red, green, blue)."""
    if text is None:
        return None
    try:
        red, green, blue = (int(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"--key {text}: give R,G,B, 0 to 255 each, for example 0,180,60") from None
    if not all(0 <= value <= 255 for value in (red, green, blue)):
        raise UserError(f"--key {text}: give R,G,B, 0 to 255 each, for example 0,180,60")
    return red, green, blue
