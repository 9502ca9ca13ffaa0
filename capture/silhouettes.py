"""What a recording hands out for one frame, and what every kind of recording must be able to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8


@dataclass(frozen=True)
class Silhouettes:
    """One frame's silhouettes as the pinhole rig sees them.

    images : one a camera, (h w) uint8: 255 person, 0 background, 128 unknown, or probabilities of the person,
    0 to 255, where they were asked for; None: no evidence from this camera.
    problems : a sentence each, naming camera, frame and file.
    """

    frame_id: int
    # The leading underscores: cameras may differ in size, so the names bind nothing across the tuple.
    images: tuple[UInt8[np.ndarray, "_h _w"] | None, ...]
    problems: tuple[str, ...]


@runtime_checkable
class FrameSource(Protocol):
    """Where a recording's frames come from: image files or videos."""

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """Every frame that at least one camera has, ascending."""

    def silhouettes(self, frame_id: int, soft: bool = False) -> Silhouettes:
        """The frame's silhouettes, undistorted; `soft`: as probabilities. Never raises for a bad file."""

    def picture(self, camera_idx: int, frame_id: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """The frame's picture as filmed (lens distortion included), RGB; None where there is none."""

    def files(self, frame_ids: tuple[int, ...]) -> list[Path]:
        """The files that these frames are read from, in a fixed order."""


def sentence(camera: str, frame_id: int, problem: str, path: Path | str | None) -> str:
    """The one form in which a frame's problem is told: camera, frame, what, file."""
    return f"Camera {camera}, frame {frame_id:06d}: {problem}" + (f" ({path})." if path is not None else ".")
