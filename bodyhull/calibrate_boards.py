"""`bodyhull calibrate boards`: pictures or videos of a board to a rig file, and a report, camera by
camera."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from bodyhull.calibration_report import report, table, told_lines
from bodyhull.errors import FRAMES_FAILED, OK, UserError
from bodyhull.folder import write_atomically

if TYPE_CHECKING:
    from capture.board import Board
    from capture.board_calibration import BoardCalibration
    from capture.board_intrinsics import Intrinsics
    from capture.board_pictures import BoardFootage
    from capture.world_frame import Ground


@dataclass(frozen=True)
class Boards:
    """Calibrate cameras from a checkerboard or ChArUco board that was shown to them: a rig file, in metres.

    IN holds a sub-folder of pictures or a video for every camera. The same picture name (the camera's own
    name in it does not count) or video frame number in several cameras is the same moment. Pictures for the
    lenses only, which need not be simultaneous, go into IN/intrinsics/<camera>, the others then into
    IN/extrinsics/<camera>.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN")]
    """Folder with <camera>/*.jpg, <camera>.mp4, or both kinds."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.json")]
    """Rig file to write; `run --calibration` takes it. A report in numbers goes beside it
    (FILE.report.json)."""
    squares: Annotated[str, tyro.conf.arg(metavar="COLSxROWS")]
    """Squares of the board as printed, black and white, columns x rows: one more each way than the inner
    corners that OpenCV counts."""
    square_mm: float
    """Side of a square, millimetres, as measured on the print."""
    board: Literal["auto", "checkerboard", "charuco"] = "auto"
    """Kind of board; told by its markers."""
    marker_mm: float | None = None
    """Side of a ChArUco marker, millimetres; measured in the pictures by itself."""
    dictionary: str = "auto"
    """Marker dictionary of a ChArUco board, as OpenCV names it (5X5_100, 6X6_250, APRILTAG_36H11, ...);
    found by itself, as is the layout, old or new."""
    floor: Annotated[str, tyro.conf.arg(metavar="board:FRAME|cameras|keep")] = "cameras"
    """Where the world's floor is: the board as it lay on the floor in a picture (board:NAME) or video frame
    (board:120); only the up axis, from the cameras' mounting; or keep the first camera's axes."""
    lenses: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """Intrinsics that are known already: a lens file of an earlier run, or a rig file; they are not
    changed."""
    intrinsics_only: bool = False
    """Calibrate the lenses only: pictures of different cameras have nothing to do with each other."""
    wide: bool = False
    """Lenses that bend strongly: three more distortion terms (k3 to k6 of OpenCV)."""
    every: int | None = None
    """Look at every so many-th frame of videos; by itself at 60 to 150 of each."""


_MOST_SHIFTS = (
    2  # a camera that was in the rig with a delay bends it, so that the first guess may be a frame off
)


def perform_boards(command: Boards) -> int:
    """Read, calibrate, write, tell; returns the exit code (3 where a camera could not be calibrated or
    trusted)."""
    from capture.board_calibration import calibrate
    from capture.board_choice import BoardWish, choose_board
    from capture.board_findings import find_delays, find_faults
    from capture.board_pictures import find_footage, read_sightings, sample_pictures

    started = time.perf_counter()
    columns, rows = parsed_squares(command.squares)
    floor_key = parsed_floor(command.floor)
    if command.out.is_dir() or command.out.suffix.lower() != ".json":
        raise UserError(f"--out {command.out}: give the name of a .json file")
    if not command.square_mm > 0 or (command.marker_mm is not None and not command.marker_mm > 0):
        raise UserError("--square-mm and --marker-mm: sides in millimetres, larger than nought")
    footage = find_footage(command.folder, only_intrinsics=command.intrinsics_only)
    wish = BoardWish(
        columns,
        rows,
        command.square_mm / 1000,
        command.board,
        None if command.marker_mm is None else command.marker_mm / 1000,
        command.dictionary,
    )
    board, notes = choose_board(sample_pictures(footage), wish)
    print(f"board: {board.sentence()}")
    for note in (*footage.notes, *notes):
        print(f"note: {note}")
    sightings = read_sightings(footage, board, every=command.every)
    known = None if command.lenses is None else known_lenses(command.lenses, sightings.names, sightings.sizes)
    extrinsics = not command.intrinsics_only and len(footage.together) > 1
    result = calibrate(sightings, board, known=known, wide=command.wide, extrinsics=extrinsics)
    delays = find_delays(result)
    shifts: dict[str, int] = {}
    videos = {one.name for one in footage.together if one.is_video}
    found = delays
    for _ in range(_MOST_SHIFTS):
        more = {name: round(d.frames) for name, d in found.items() if name in videos and round(d.frames)}
        if not more:
            break
        shifts |= {name: shifts.get(name, 0) + shift for name, shift in more.items()}
        sightings = read_sightings(footage, board, every=command.every, delays=shifts)
        result = calibrate(sightings, board, known=known, wide=command.wide, extrinsics=extrinsics)
        found = find_delays(result)
    if shifts:
        listed = ", ".join(f"{name} by {shift}" for name, shift in shifts.items())
        print(f"note: not synchronised, frames shifted and calibrated again: {listed}")
    findings = find_faults(result, delays, extrinsics=extrinsics)
    ground = (
        None if result.rig is None else grounded(result, footage, board, floor_key, command.floor, shifts)
    )
    write_result(command.out, result, ground)
    told = json.dumps(report(result, findings, ground, shifts), indent=1, ensure_ascii=False)
    write_atomically(report_path(command.out), lambda path: path.write_text(told + "\n", encoding="utf-8"))
    print(table(result))
    for line in told_lines(result, findings, ground, extrinsics):
        print(line)
    print(f"{'rig' if ground else 'lenses'}: {command.out}   ({time.perf_counter() - started:.0f} s)")
    print(f"report: {report_path(command.out)}")
    unasked = result.rig is None and extrinsics
    doubted = ground is not None and bool(ground.doubts)
    return FRAMES_FAILED if unasked or doubted or any(one.grave for one in findings) else OK


def parsed_squares(text: str) -> tuple[int, int]:
    """ "9x6" as (columns, rows) of squares."""
    match = re.fullmatch(r"(\d+)\s*[xX]\s*(\d+)", text.strip())
    if match is None:
        raise UserError(f"--squares {text}: give the board's squares as COLSxROWS, for example 9x6")
    columns, rows = int(match[1]), int(match[2])
    if min(columns, rows) < 3 or max(columns, rows) > 60:
        raise UserError(f"--squares {text}: a board has 3 to 60 squares each way")
    return columns, rows


def parsed_floor(text: str) -> str | None:
    """The frame of `board:FRAME`; None for the other choices."""
    if text in ("cameras", "keep"):
        return None
    if text.startswith("board:") and text[6:].strip():
        return text[6:].strip()
    if text == "feet":
        raise UserError(
            "--floor feet: boards have no feet; use bodyhull calibrate refine --floor feet on the recording"
        )
    raise UserError(
        f"--floor {text}: choose board:FRAME (the board lay on the floor in that picture or frame), "
        "cameras or keep"
    )


def report_path(out: Path) -> Path:
    """Where the report beside a rig file goes."""
    return out.with_name(out.stem + ".report.json")


def known_lenses(
    path: Path, names: Sequence[str], sizes: Sequence[tuple[int, int]]
) -> list[Intrinsics | None]:
    """Lenses of a file for these cameras, by name; None for cameras that it lacks."""
    from capture.board_intrinsics import Intrinsics
    from capture.lens_file import load_lenses

    by_name = {lens.name: lens for lens in load_lenses(path)}
    if not set(by_name) & set(names):
        raise UserError(
            f"{path}: has the lenses of {', '.join(by_name)}, none of the cameras {', '.join(names)}"
        )
    out: list[Intrinsics | None] = []
    for name, size in zip(names, sizes, strict=True):
        lens = by_name.get(name)
        if lens is None:
            out.append(None)
            continue
        if lens.size != size:
            raise UserError(
                f"{path}: camera {name} has a lens for {lens.size[0]}x{lens.size[1]} px, its pictures are "
                f"{size[0]}x{size[1]} px"
            )
        nan = float("nan")
        padded = lens.distortion if lens.distortion.size in (4, 8) else np.pad(lens.distortion, (0, 8))
        distortion = padded[: 4 if not padded[4:8].any() else 8]
        out.append(Intrinsics(lens.matrix, distortion, nan, nan, 0, 0, 1.0, nan))
    return out


def grounded(
    result: BoardCalibration,
    footage: BoardFootage,
    board: Board,
    key: str | None,
    floor: str,
    shifts: Mapping[str, int],
) -> Ground:
    """The rig on its floor, as asked."""
    from capture.world_frame import Ground, ground_from_cameras

    rig = result.rig
    assert rig is not None
    if key is not None:
        return ground_on_board(result, footage, board, key, shifts)
    if floor == "keep":
        return Ground(
            rig, np.eye(4), 1.0, ("World: the axes of the first camera (x right, y down, z forward).",)
        )
    return ground_from_cameras(rig)


def ground_on_board(
    result: BoardCalibration, footage: BoardFootage, board: Board, key: str, shifts: Mapping[str, int]
) -> Ground:
    """The rig on the plane of a board that lay on the floor."""
    from capture.board_agreement import locate_board
    from capture.board_pictures import views_at
    from capture.board_start import board_poses
    from capture.world_frame import ground_from_board

    solution, rig = result.solution, result.rig
    assert solution is not None and rig is not None
    names = result.sightings.names
    seen = {
        names.index(name): view
        for name, view in views_at(footage, board, key, delays=shifts).items()
        if names.index(name) in result.placed
    }
    if not seen:
        raise UserError(f"--floor board:{key}: only cameras that could not be placed see the board in {key}")
    pose = locate_board(seen, board, result.intrinsics, solution.camera_from_rig)
    if pose is None:
        raise UserError(f"--floor board:{key}: the board's pose cannot be told in {key}; choose another one")
    other = None
    if len(seen) == 1:
        (camera_idx, view), lens = next(iter(seen.items())), None
        lens = result.intrinsics[camera_idx]
        assert lens is not None
        both = board_poses(view, board, lens)
        if len(both) > 1:
            rig_from_camera = np.linalg.inv(solution.camera_from_rig[camera_idx])
            pose, other = (rig_from_camera @ one.pose for one in both[:2])
    return ground_from_board(rig, board, pose, mirrored_pose=other)


def write_result(out: Path, result: BoardCalibration, ground: Ground | None) -> None:
    """The rig file, or the lens file where cameras could not be placed."""
    from capture.lens_file import Lens, save_lenses

    if ground is not None:
        write_atomically(out, ground.rig.save)
        return
    lenses = [
        Lens(name, size, one.matrix, one.distortion)
        for name, size, one in zip(
            result.sightings.names, result.sightings.sizes, result.intrinsics, strict=True
        )
        if one is not None
    ]
    write_atomically(out, lambda path: save_lenses(path, lenses))
