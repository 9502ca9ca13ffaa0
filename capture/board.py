"""A flat calibration board: a checkerboard, or a ChArUco board (a checkerboard with markers in its white
squares).

The board's frame: origin at the outer corner of its first square, x along the columns, y along the rows, z
into the board, away from who looks at its printed side. Its points are the inner corners, row by row, as
OpenCV counts them.

ChArUco boards with an even number of rows came in another layout before OpenCV 4.6 ("legacy"): the first
square was white there and is black now.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from capture.errors import RecordingError

Kind = Literal["checkerboard", "charuco"]


@dataclass(frozen=True)
class Board:
    """columns, rows: numbers of squares as printed; square_m, marker_m: their sides, metres; dictionary:
    OpenCV's name of the markers ("DICT_5X5_100"; "" for a checkerboard); legacy: the layout before OpenCV
    4.6.
    """

    kind: Kind
    columns: int
    rows: int
    square_m: float
    marker_m: float = 0.0
    dictionary: str = ""
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise RecordingError(
                f"a board of {self.columns}x{self.rows} squares: at least 3x3 squares, so that it has "
                "2x2 inner corners"
            )
        if not (np.isfinite(self.square_m) and self.square_m > 0):
            raise RecordingError(f"squares of {1000 * self.square_m:g} mm: their side must be positive")
        if self.kind == "charuco" and not 0 < self.marker_m < self.square_m:
            raise RecordingError(
                f"markers of {1000 * self.marker_m:g} mm in squares of {1000 * self.square_m:g} mm: "
                "a marker is smaller than its square"
            )

    @property
    def n_across(self) -> int:
        """Inner corners in a row."""
        return self.columns - 1

    @property
    def n_down(self) -> int:
        """Rows of inner corners."""
        return self.rows - 1

    @property
    def n_corners(self) -> int:
        return self.n_across * self.n_down

    @property
    def n_markers(self) -> int:
        """Markers of a ChArUco board; 0 for a checkerboard."""
        return self.columns * self.rows // 2 if self.kind == "charuco" else 0

    @property
    def corners(self) -> Float[np.ndarray, "n 3"]:
        """(N 3): the inner corners in the board's frame, metres, row by row."""
        down, across = np.mgrid[1 : self.rows, 1 : self.columns]
        flat = np.column_stack([across.ravel(), down.ravel(), np.zeros(self.n_corners)])
        return flat * self.square_m

    @property
    def looks_alike_turned(self) -> bool:
        """A checkerboard that a half turn maps onto itself: even by even, or odd by odd squares."""
        return self.kind == "checkerboard" and (self.columns + self.rows) % 2 == 0

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board. Only for kind "charuco"."""
        assert self.kind == "charuco"
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, marker_dictionary(self.dictionary)
        )
        board.setLegacyPattern(self.legacy)
        return board

    def sentence(self) -> str:
        """What it is, for people."""
        squares = f"{self.columns}x{self.rows} squares of {1000 * self.square_m:g} mm"
        if self.kind == "checkerboard":
            return f"checkerboard, {squares}, {self.n_across}x{self.n_down} inner corners"
        layout = "layout before OpenCV 4.6" if self.legacy else "layout since OpenCV 4.6"
        if self.rows % 2:
            layout = "layout the same in every OpenCV"
        return (
            f"ChArUco board, {squares}, markers of {1000 * self.marker_m:.3g} mm, {self.dictionary}, {layout}"
        )


def dictionary_names() -> list[str]:
    """OpenCV's predefined marker dictionaries, by name."""
    names = [name for name in dir(cv2.aruco) if name.startswith("DICT_") and name.upper() == name]
    return sorted(names)


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """A predefined dictionary by name, with or without "DICT_". Raises RecordingError for an unknown one."""
    full = name.upper() if name.upper().startswith("DICT_") else f"DICT_{name.upper()}"
    if full not in dictionary_names():
        known = ", ".join(known[5:] for known in dictionary_names())
        raise RecordingError(f"--dictionary {name}: OpenCV has no such marker dictionary; it has {known}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, full))
