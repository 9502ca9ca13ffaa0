"""What cameras saw of a board: corners in one picture, and all of them by camera and moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from capture.board import Board


@dataclass(frozen=True, eq=False)
class BoardView:
    """Inner corners of one board in one picture.

    ids (N,): which corners, ascending, counted as `Board.corners`; pixels (N 2): where, px as filmed;
    edge_px: width of the edges between black and white (10 % to 90 %), px; what blur makes larger.
    """

    ids: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]
    edge_px: float = 1.0

    def __len__(self) -> int:
        return len(self.ids)

    def turned(self, board: Board) -> BoardView:
        """The same corners for who takes the board as turned by half a turn."""
        return BoardView(board.n_corners - 1 - self.ids[::-1], self.pixels[::-1].copy(), self.edge_px)


@dataclass(frozen=True, eq=False)
class Sightings:
    """Every view of the board. Moments are numbers; two cameras' views of one moment show the board in one
    place.

    names, sizes: the cameras' names and picture sizes (width, height) px.
    views: a mapping moment -> view for each camera.
    alone: further views for each camera that no other camera shares (pictures for the intrinsics).
    labels: moment -> the file's or frame's name, for messages.
    """

    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    views: tuple[Mapping[int, BoardView], ...]
    alone: tuple[Sequence[BoardView], ...] = ()
    labels: Mapping[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.alone:
            object.__setattr__(self, "alone", tuple(() for _ in self.names))
        assert len(self.names) == len(self.sizes) == len(self.views) == len(self.alone)

    @property
    def n_cameras(self) -> int:
        return len(self.names)

    @property
    def moments(self) -> list[int]:
        """All moments in which some camera saw the board, ascending."""
        return sorted(set().union(*(view.keys() for view in self.views)))

    def seen_at(self, moment: int) -> list[int]:
        """Which cameras saw the board then."""
        return [camera_idx for camera_idx, views in enumerate(self.views) if moment in views]

    def shared_moments(self) -> list[int]:
        """Moments in which at least two cameras saw the board."""
        return [moment for moment in self.moments if len(self.seen_at(moment)) > 1]

    def of(self, camera_idx: int) -> list[BoardView]:
        """All views of one camera, shared or not."""
        return [*self.views[camera_idx].values(), *self.alone[camera_idx]]

    def at(self, moments: Sequence[int]) -> Sightings:
        """Only these moments (what a camera saw alone stays)."""
        kept = set(moments)
        views = tuple({m: view for m, view in views.items() if m in kept} for views in self.views)
        return Sightings(self.names, self.sizes, views, self.alone, self.labels)

    def of_cameras(self, camera_indices: Sequence[int]) -> Sightings:
        """Only these cameras, in this order."""
        return Sightings(
            tuple(self.names[c] for c in camera_indices),
            tuple(self.sizes[c] for c in camera_indices),
            tuple(self.views[c] for c in camera_indices),
            tuple(self.alone[c] for c in camera_indices),
            self.labels,
        )

    def replaced(self, camera_idx: int, views: Mapping[int, BoardView]) -> Sightings:
        """With other views for one camera."""
        changed = tuple(views if c == camera_idx else old for c, old in enumerate(self.views))
        return Sightings(self.names, self.sizes, changed, self.alone, self.labels)
