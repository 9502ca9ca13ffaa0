"""Which recording a command looks at, and what its files leave open: the options that commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bodyhull.config import Units, Up

if TYPE_CHECKING:
    from capture.recording import Recording


@dataclass(frozen=True, kw_only=True)
class RecordingChoice:
    """A recording and how to read it."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """Folder of the recording, as `bodyhull run` takes it."""
    sequence: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which sequence, where the recording holds several."""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Calibration to use instead of the recording's own."""
    frames: Annotated[str | None, tyro.conf.arg(metavar="START:STOP:STEP")] = None
    """Which frame numbers; all by default. A part of them is looked at, spread over the time."""
    units: Units = "auto"
    """Unit of the calibration's world."""
    up: Up = "auto"
    """World axis that points up."""
    background: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of background plates, <camera>.png, for recordings of videos."""

    def opened(self) -> Recording:
        """The recording. Raises RecordingError where it cannot be opened."""
        from capture.recording import open_recording

        return open_recording(
            self.recording,
            sequence=self.sequence,
            calibration=self.calibration,
            frames=self.frames,
            units=self.units,
            up=self.up,
            background=self.background,
        )
