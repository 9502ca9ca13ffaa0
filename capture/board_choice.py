"""Which board was filmed: what the user left open is found out from some of the pictures.

Checkerboard or ChArUco; the dictionary of the markers; the layout before or since OpenCV 4.6; columns and
rows the other way round; inner corners counted in place of squares; the size of the markers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.board import Board, dictionary_names, marker_dictionary
from capture.board_detection import find_board
from capture.errors import RecordingError

Grey = UInt8[np.ndarray, "_h _w"]
#: The largest dictionary of each family: the smaller ones are its first markers.
_FAMILIES = (
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36H12",
    "DICT_APRILTAG_16H5",
    "DICT_APRILTAG_25H9",
    "DICT_APRILTAG_36H10",
    "DICT_APRILTAG_36H11",
)
_N_FOR_MARKERS = 5  # pictures in which all dictionaries are looked for
_N_SURE = 3  # pictures that show the same, to believe it
_SQUARE_PX = 50.0  # large enough for the smallest bits
_LEAST_MARKERS = 4  # in one picture, to believe in a ChArUco board


@dataclass(frozen=True)
class BoardWish:
    """What the user says of the board. columns, rows: squares as printed; sizes in metres; None and "auto":
    find out."""

    columns: int
    rows: int
    square_m: float
    kind: Literal["auto", "checkerboard", "charuco"] = "auto"
    marker_m: float | None = None
    dictionary: str = "auto"


def choose_board(pictures: Sequence[Grey], wish: BoardWish) -> tuple[Board, tuple[str, ...]]:
    """The board in these grey pictures, and sentences on what was found out.

    Raises RecordingError where no picture shows such a board, saying what it shows instead if that can be
    told.
    """
    notes: list[str] = []
    if wish.dictionary != "auto":
        marker_dictionary(wish.dictionary)
    if wish.kind != "checkerboard":
        found = _choose_charuco(pictures, wish, notes)
        if found is not None:
            return found, tuple(notes)
        if wish.kind == "charuco" or wish.dictionary != "auto" or wish.marker_m is not None:
            raise RecordingError(
                f"no ChArUco board of {wish.columns}x{wish.rows} squares in {len(pictures)} pictures "
                "looked at"
                f"{_markers_told(pictures, wish)}; check --squares, --dictionary and that pictures are "
                "not mirrored"
            )
    return _choose_checkerboard(pictures, wish, notes), tuple(notes)


# -- checkerboards -----------------------------------------------------------------------------------------


def _choose_checkerboard(pictures: Sequence[Grey], wish: BoardWish, notes: list[str]) -> Board:
    asked = Board("checkerboard", wish.columns, wish.rows, wish.square_m)
    n_found = _count_views(pictures, asked)
    if n_found:
        if asked.looks_alike_turned:
            notes.append(
                f"A checkerboard of {asked.columns}x{asked.rows} squares looks alike after half a "
                "turn; cameras may take "
                "it the other way round. They are brought together by agreement here; a board with one "
                "side even and one "
                "odd, or a ChArUco board, leaves no doubt."
            )
        return asked
    for columns, rows, told in (
        (wish.columns + 1, wish.rows + 1, "inner corners were given; --squares counts squares"),
        (wish.columns - 1, wish.rows - 1, "the outermost squares are cut or missing"),
    ):
        if min(columns, rows) < 3:
            continue
        other = replace(asked, columns=columns, rows=rows)
        if _count_views(pictures, other):
            raise RecordingError(
                f"no checkerboard of {wish.columns}x{wish.rows} squares in {len(pictures)} pictures "
                "looked at, but one of "
                f"{columns}x{rows} ({told}): give --squares {columns}x{rows}"
            )
    raise RecordingError(
        f"no checkerboard of {wish.columns}x{wish.rows} squares ({wish.columns - 1}x{wish.rows - 1} "
        "inner corners) in "
        f"{len(pictures)} pictures looked at; check --squares, and that the whole board with a white "
        "border is seen"
    )


def _count_views(pictures: Sequence[Grey], board: Board) -> int:
    """In how many of the pictures the board is found; no more than `_N_SURE` are counted."""
    quick = 0
    for picture in pictures:
        quick += find_board(picture, board, thorough=False) is not None
        if quick == _N_SURE:
            break
    if quick:
        return quick
    # The thorough search takes a second a picture: some will do.
    few = pictures[:: max(1, len(pictures) // 6)]
    return sum(find_board(picture, board) is not None for picture in few)


# -- ChArUco -----------------------------------------------------------------------------------------------


def _choose_charuco(pictures: Sequence[Grey], wish: BoardWish, notes: list[str]) -> Board | None:
    counted = _markers_of(_board_parts(pictures, wish), wish)
    n_markers = wish.columns * wish.rows // 2
    names = [name for name, ids in counted.items() if len(ids) >= _LEAST_MARKERS]
    if not names:
        return None
    family = max(names, key=lambda name: _n_telling(counted[name], n_markers))
    dictionary = family if wish.dictionary != "auto" else smallest_dictionary(family, n_markers)
    best: tuple[int, Board] | None = None
    for columns, rows in dict.fromkeys([(wish.columns, wish.rows), (wish.rows, wish.columns)]):
        for legacy in (False, True) if rows % 2 == 0 else (False,):
            board = Board(
                "charuco",
                columns,
                rows,
                wish.square_m,
                wish.marker_m or 0.75 * wish.square_m,
                dictionary,
                legacy,
            )
            n_corners = _count_corners(pictures, board)
            if n_corners and (best is None or n_corners > best[0]):
                best = (n_corners, board)
    if best is None:
        raise RecordingError(
            f"markers of {family[5:].removesuffix('_1000')} are seen, but no ChArUco board of "
            f"{wish.columns}x{wish.rows} "
            "squares in either layout; check --squares (squares as printed, not inner corners)"
        )
    board = best[1]
    if (board.columns, board.rows) != (wish.columns, wish.rows):
        notes.append(
            f"--squares {wish.columns}x{wish.rows}: the board has {board.columns} columns and "
            f"{board.rows} rows as its "
            "markers are numbered; taken so."
        )
    measured = _measured_marker(pictures, board)
    if measured is not None:
        share = measured / board.square_m
        if wish.marker_m is None:
            board = replace(board, marker_m=round(measured, 4))
        elif abs(measured - wish.marker_m) > 0.06 * board.square_m:
            notes.append(
                f"--marker-mm {1000 * wish.marker_m:g}: in the pictures a marker is {share:.2f} of a square, "
                f"{1000 * measured:.1f} mm with --square-mm {1000 * board.square_m:g}; check both. "
                "Taken as measured."
            )
            board = replace(board, marker_m=round(measured, 4))
    return board


def _board_parts(pictures: Sequence[Grey], wish: BoardWish) -> list[Grey]:
    """The part of each picture where a checkerboard of the wished size was found at once, else the whole
    picture.

    A ChArUco board is a checkerboard too, so its markers lie there. Nothing, where white squares are empty.
    """
    parts: list[Grey] = []
    whole: list[Grey] = []
    shape = (wish.columns - 1, wish.rows - 1)
    n_plain = 0
    for picture in pictures:
        found, corners = cv2.findChessboardCorners(picture, shape, flags=cv2.CALIB_CB_FAST_CHECK)
        if not found:
            whole.append(picture)
            continue
        corners = corners.reshape(-1, 2)
        if wish.kind == "auto" and wish.dictionary == "auto" and _is_plain(picture, corners, shape):
            n_plain += 1
            if n_plain == _N_SURE:
                return []
            continue
        margin = 2 * np.ptp(corners, axis=0).max() / min(shape)
        low = np.maximum(corners.min(axis=0) - margin, 0).astype(int)
        high = (corners.max(axis=0) + margin).astype(int)
        part = np.ascontiguousarray(picture[low[1] : high[1], low[0] : high[0]])
        # Markers need few pixels, and looking at many takes seconds.
        shrink = _SQUARE_PX / float(np.linalg.norm(corners[1:] - corners[:-1], axis=1).min())
        if shrink < 0.8:
            part = cv2.resize(part, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        parts.append(part)
        if len(parts) == _N_FOR_MARKERS:
            break
    return parts or ([] if n_plain else whole)


def _is_plain(picture: Grey, corners: Float[np.ndarray, "n 2"], shape: tuple[int, int]) -> bool:
    """Whether all squares between these inner corners are of one brightness each: no markers in the white
    ones."""
    across, down = shape
    px = 16
    grid = np.stack(np.meshgrid(np.arange(across), np.arange(down)), axis=-1).reshape(-1, 2) * float(px)
    homography, _ = cv2.findHomography(corners.astype(np.float64), grid, 0)
    if homography is None:
        return False
    flat = cv2.warpPerspective(picture, homography, ((across - 1) * px, (down - 1) * px)).astype(np.float64)
    cells = flat.reshape(down - 1, px, across - 1, px).transpose(0, 2, 1, 3)[:, :, 4:-4, 4:-4]
    contrast = float(np.quantile(flat, 0.95) - np.quantile(flat, 0.05))
    return bool(np.quantile(cells.std(axis=(2, 3)), 0.9) < 0.12 * max(contrast, 1.0))


def _n_telling(ids: list[int], n_markers: int) -> int:
    """Markers that the board can have, less those that it cannot."""
    return sum(1 if i < n_markers else -1 for i in ids)


def _markers_of(pictures: Sequence[Grey], wish: BoardWish) -> dict[str, list[int]]:
    """Ids of all markers found, by dictionary (the one asked for, or the largest of each family).

    Looking takes time where a picture shows no marker: as soon as a dictionary explains half a board it is
    taken.
    """
    names = _FAMILIES if wish.dictionary == "auto" else (_full(wish.dictionary),)
    found: dict[str, list[int]] = {name: [] for name in names if name in dictionary_names()}
    for picture in pictures[:: max(1, len(pictures) // _N_FOR_MARKERS)]:
        for name, all_ids in found.items():
            _, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary(name)).detectMarkers(picture)
            if ids is not None and len(ids) >= _LEAST_MARKERS:
                all_ids += [int(i) for i in ids.ravel()]
                if _n_telling(all_ids, wish.columns * wish.rows // 2) * 4 >= wish.columns * wish.rows:
                    return {name: all_ids}
    return found


def smallest_dictionary(family: str, n_markers: int) -> str:
    """The smallest predefined dictionary that begins with the family's first `n_markers` markers.

    Fewer markers are told apart with more wrong bits allowed. Families of one size stay as they are.
    """
    if not family.endswith("_1000"):
        return family
    stem = family[: -len("1000")]
    return next(f"{stem}{n}" for n in (50, 100, 250, 1000) if n >= n_markers or n == 1000)


def _full(name: str) -> str:
    return name.upper() if name.upper().startswith("DICT_") else f"DICT_{name.upper()}"


def _count_corners(pictures: Sequence[Grey], board: Board) -> int:
    detector = cv2.aruco.CharucoDetector(board.charuco())
    total = 0
    for picture in pictures:
        _, ids, _, _ = detector.detectBoard(picture)
        total += 0 if ids is None else len(ids)
    return total


def _measured_marker(pictures: Sequence[Grey], board: Board) -> float | None:
    """Side of the markers, metres: their corners taken to the board's plane by their own centres."""
    drawn = board.charuco()
    centres = np.array([np.asarray(corners).mean(axis=0)[:2] for corners in drawn.getObjPoints()])
    detector = cv2.aruco.ArucoDetector(marker_dictionary(board.dictionary))
    sides = []
    for picture in pictures:
        corners, ids, _ = detector.detectMarkers(picture)
        if ids is None:
            continue
        kept = [k for k, i in enumerate(ids.ravel()) if i < len(centres)]
        if len(kept) < 6:
            continue
        seen = np.array([corners[k].reshape(4, 2) for k in kept], np.float64)
        middle = _crossing(seen)
        homography, inliers = cv2.findHomography(
            middle, centres[ids.ravel()[kept]], cv2.RANSAC, board.square_m / 4
        )
        if homography is None or inliers.sum() < 6:
            continue
        flat = cv2.perspectiveTransform(seen.reshape(-1, 1, 2), homography).reshape(-1, 4, 2)
        sides.append(np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2)[inliers.ravel() > 0].ravel())
    return float(np.median(np.concatenate(sides))) if sides else None


def _crossing(quads: Float[np.ndarray, "n 4 2"]) -> Float[np.ndarray, "n 2"]:
    """Where the diagonals of quadrilaterals cross: the picture of a square's centre."""
    homogeneous = np.concatenate([quads, np.ones((len(quads), 4, 1))], axis=2)
    one = np.cross(homogeneous[:, 0], homogeneous[:, 2])
    other = np.cross(homogeneous[:, 1], homogeneous[:, 3])
    point = np.cross(one, other)
    return point[:, :2] / point[:, 2:]


def _markers_told(pictures: Sequence[Grey], wish: BoardWish) -> str:
    """What markers there are instead, for an error's text."""
    counted = {
        name: len(ids) for name, ids in _markers_of(pictures, replace(wish, dictionary="auto")).items()
    }
    most = max(counted, key=lambda name: counted[name])
    if not counted[most]:
        return " (no markers of any dictionary were seen)"
    return f" (markers of {most[5:].removesuffix('_1000')} were seen)"
