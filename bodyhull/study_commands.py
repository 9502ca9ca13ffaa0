"""`bodyhull rig-study` on the command line."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from bodyhull.config import Units, Up
from bodyhull.errors import FRAMES_FAILED, OK, UserError


@dataclass(frozen=True)
class RigStudy:
    """Try rigs before building one: hull and body error against the number of cameras, picture size,
    calibration noise and mask noise, on a synthetic person with a known body."""

    out: Annotated[Path, tyro.conf.arg(metavar="STUDY")]
    """Folder for the table, the plot, the page and every rig's run; finished rigs in it are kept."""
    layout: Literal["dome", "ring", "cage"] = "dome"
    """Where the cameras stand."""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Study these cameras instead of a layout: a rig.json, a .qca.txt, or a folder of camNN.txt (with
    --size). Fewer of them are chosen so that they stand far apart; widths keep their ratio to
    --base-width."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Picture size of a calibration that does not say it."""
    units: Units = "auto"
    """Unit of the calibration's world."""
    up: Up = "auto"
    """World axis of the calibration that points up."""
    cameras: tuple[int, ...] = (4, 8, 16, 32, 68)
    """Numbers of cameras to try."""
    widths: tuple[int, ...] = (512, 1024, 2048)
    """Picture widths to try, pixels; the pictures of a layout are square."""
    calibration_px: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0)
    """Calibration noises to try: each camera is turned so that its picture shifts by this much."""
    mask_px: tuple[float, ...] = (0.0, 1.0, 2.0, 4.0)
    """Mask noises to try: outlines wander by this much."""
    base_cameras: int = 16
    """How many cameras where something else is tried; all of them with --calibration."""
    base_width: int = 1024
    """Picture width where something else is tried."""
    frames: int = 8
    """Frames of the motion."""
    motion: str = "tilt-twist"
    """What the person does; an unknown name lists them all."""
    garment: str = "tshirt-trousers"
    """What the person wears; an unknown name lists them all."""
    seed: int = 7
    """Another number, another person and other errors."""
    body: str = "free:neutral"
    """Body model that the person is drawn from and that is fitted."""
    hull_only: bool = False
    """Carve, but do not fit a body: much faster."""
    jobs: int = 0
    """Rigs worked on at once; 0: one a core, and one for every 3 GB of free memory at most."""
    overwrite: bool = False
    """Redo rigs that the folder holds."""


def perform_rig_study(command: RigStudy) -> int:
    """Run, write, print; returns the exit code (3 where some rig gave nothing)."""
    from bodyhull.cli import parsed_size
    from bodyhull.study import StudySubject, run_study
    from bodyhull.study_page import PROTOCOL, markdown, write_study
    from bodyhull.study_plan import plan_of
    from render.motions import MOTIONS
    from render.wardrobe import OUTFITS

    for option, value, known in (("motion", command.motion, MOTIONS), ("garment", command.garment, OUTFITS)):
        if value not in known:
            raise UserError(f"--{option} {value}: there is no such {option}; there are: {', '.join(known)}")
    if command.frames < 1 or command.seed < 0 or command.jobs < 0:
        raise UserError(
            f"--frames {command.frames} --seed {command.seed} --jobs {command.jobs}: at least 1 frame, and "
            "a seed and jobs of 0 or more"
        )
    plan = plan_of(
        layout=command.layout,
        calibration=command.calibration,
        size=None if command.size is None else parsed_size(command.size),
        units=command.units,
        up=command.up,
        cameras=command.cameras,
        widths=command.widths,
        calibration_px=command.calibration_px,
        mask_px=command.mask_px,
        base_cameras=command.base_cameras,
        base_width=command.base_width,
    )
    subject = StudySubject(command.body, command.seed, command.garment, command.motion, command.frames)
    started = time.perf_counter()
    command.out.mkdir(parents=True, exist_ok=True)
    if command.overwrite:
        for kept in (command.out / "cases").glob("*/outcome.json"):
            kept.unlink()
    outcomes = run_study(
        command.out,
        plan,
        subject,
        with_body=not command.hull_only,
        n_jobs=command.jobs or usual_jobs(),
    )
    seconds = time.perf_counter() - started
    write_study(command.out, plan, subject, outcomes, seconds)
    print(markdown(outcomes))
    print(PROTOCOL)
    print(f"\ntable: {command.out / 'table.md'}\nplot:  {command.out / 'plot.png'}")
    print(f"page:  {command.out / 'index.html'}   ({seconds:.0f} s)")
    return FRAMES_FAILED if any(o.failure for o in outcomes.values()) else OK


def usual_jobs() -> int:
    """One process a core that this one may use, and not more than free memory allows (3 GB each)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return cores
    return max(min(cores, int(free // 3e9)), 1)
