"""`bodyhull calibrate` on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from bodyhull.calibrate_boards import Boards, perform_boards
from bodyhull.calibrate_refine import Refine, perform_refine
from bodyhull.calibrate_world import World, perform_world

CalibrateCommand = (
    Annotated[Boards, tyro.conf.subcommand("boards")]
    | Annotated[Refine, tyro.conf.subcommand("refine")]
    | Annotated[World, tyro.conf.subcommand("world")]
)


@dataclass(frozen=True)
class Calibrate:
    """Calibrate cameras from a board (boards), refine a rig from what a recording holds anyway (refine), or
    move a rig to its floor and scale (world)."""

    action: CalibrateCommand


def perform_calibrate(command: Calibrate) -> int:
    """Carry out one of them; returns the exit code."""
    match command.action:
        case Boards():
            return perform_boards(command.action)
        case Refine():
            return perform_refine(command.action)
        case World():
            return perform_world(command.action)
