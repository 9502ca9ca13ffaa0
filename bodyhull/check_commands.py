"""`bodyhull check` on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from bodyhull.errors import FRAMES_FAILED, OK
from bodyhull.recording_choice import RecordingChoice


@dataclass(frozen=True, kw_only=True)
class CheckRecording(RecordingChoice):
    """Look at a recording before running anything: numbers per camera, and a verdict that names what is
    wrong, with which camera, and what to do. Exit code 0: sound; 3: something was found."""

    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the page (index.html) and the numbers (check.json); <recording>-check here by default."""
    sample: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """How many frames to read; by default as many as take about half a minute."""


def perform_check(command: CheckRecording) -> int:
    """Look, write, print; returns the exit code."""
    from tqdm import tqdm

    from bodyhull.check_page import terminal, write_check
    from bodyhull.checking import check_recording

    with tqdm(desc="reading", unit="frame", leave=False) as bar:

        def report(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        check = check_recording(
            command.recording,
            sequence=command.sequence,
            calibration=command.calibration,
            frames=command.frames,
            units=command.units,
            up=command.up,
            background=command.background,
            at_most=command.sample,
            report=report,
        )
    out = command.out or Path(f"{command.recording.resolve().name}-check")
    page, data = write_check(out, check)
    print(terminal(check))
    print(f"\npage: {page}\nnumbers: {data}   ({check.seconds:.0f} s)")
    return FRAMES_FAILED if check.findings else OK
