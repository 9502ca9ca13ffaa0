"""`bodyhull calibrate`: rigs made and mended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from bodyhull.calibrate_refine import Refine, perform_refine
from bodyhull.errors import OK


@dataclass(frozen=True)
class CalibrateList:
    """List the ways to a calibration."""


@dataclass(frozen=True)
class Calibrate:
    """Calibration: a rig refined from the recording itself (refine)."""

    action: (
        Annotated[Refine, tyro.conf.subcommand("refine")]
        | Annotated[CalibrateList, tyro.conf.subcommand("list")]
    )


def perform_calibrate(command: Calibrate) -> int:
    """Carry out the command; returns the exit code."""
    match command.action:
        case Refine():
            return perform_refine(command.action)
        case CalibrateList():
            print("bodyhull calibrate refine RECORDING --out FILE   from the recording's own pictures")
    return OK
