"""Intrinsics without poses on disk: what pictures for the lenses alone can give. JSON, every number at full
precision.

No rig: a rig file's cameras have places. `bodyhull calibrate boards --lenses FILE` takes it, and takes a rig
file too.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.errors import RecordingError
from capture.rig import Rig
from capture.whole_file import write_whole

_FORMAT = "bodyhull-lenses"
_VERSION = 1


@dataclass(frozen=True, eq=False)
class Lens:
    """One camera's intrinsics. size (width, height) px; matrix (3 3) px; distortion: OpenCV's order, 0, 4, 5
    or 8 values."""

    name: str
    size: tuple[int, int]
    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, " d"]

    def __post_init__(self) -> None:
        # The same checks as a camera's, with its texts.
        Camera(self.name, self.size, self.matrix, np.eye(4), self.distortion)


def save_lenses(path: Path, lenses: list[Lens]) -> None:
    """Write; appears whole or not at all."""
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "cameras": [
            {
                "name": lens.name,
                "size": list(lens.size),
                "intrinsics": lens.matrix.tolist(),
                "distortion": lens.distortion.tolist(),
            }
            for lens in lenses
        ],
    }
    write_whole(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def load_lenses(path: Path) -> list[Lens]:
    """What `save_lenses` wrote, or the lenses of a rig file. Raises RecordingError for anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise RecordingError(f"{path}: not a JSON file ({error})") from error
    if isinstance(content, dict) and content.get("format") == _FORMAT:
        try:
            return [
                Lens(
                    str(one["name"]),
                    (int(one["size"][0]), int(one["size"][1])),
                    np.array(one["intrinsics"], dtype=np.float64),
                    np.array(one["distortion"], dtype=np.float64),
                )
                for one in content["cameras"]
            ]
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise RecordingError(
                f"{path}: a lens file that lacks something ({error}); write it again"
            ) from error
    rig = Rig.load(path)
    return [Lens(camera.name, camera.size, camera.intrinsics, camera.distortion) for camera in rig]
