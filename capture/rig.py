"""The cameras of a recording, in order, and their file: JSON with every number at full precision."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.errors import RecordingError
from capture.whole_file import write_whole

_FORMAT = "bodyhull-rig"
_VERSION = 1


@dataclass(frozen=True)
class Rig:
    """Cameras in order, names unique. Poses share one world frame; metres unless said otherwise."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", tuple(self.cameras))
        repeated = {name for name in self.names if self.names.count(name) > 1}
        if repeated:
            raise ValueError(f"two cameras share a name: {', '.join(sorted(repeated))}")

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, camera_idx: int) -> Camera:
        return self.cameras[camera_idx]

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    @property
    def centres(self) -> Float[np.ndarray, "c 3"]:
        """(C 3): where the cameras stand, world."""
        return np.array([camera.centre for camera in self.cameras]).reshape(-1, 3)

    def pinholes(self) -> Rig:
        """The same cameras with ideal lenses."""
        return Rig(tuple(camera.pinhole() for camera in self.cameras))

    def with_world_scaled(self, factor: float) -> Rig:
        """The same cameras in a world whose coordinates are multiplied by `factor`."""
        return Rig(tuple(camera.with_world_scaled(factor) for camera in self.cameras))

    def save(self, path: Path | str) -> None:
        """Write as JSON; the poses must be in metres by then. Appears whole or not at all."""
        write_whole(Path(path), (json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n").encode())

    def to_json(self) -> dict[str, Any]:
        """Plain lists and numbers; Python writes floats so that they read back to the last bit."""
        return {
            "format": _FORMAT,
            "version": _VERSION,
            "unit": "m",
            "cameras": [_to_json(c) for c in self.cameras],
        }

    @staticmethod
    def load(path: Path | str) -> Rig:
        """Read what `save` wrote. Raises RecordingError for anything else, naming the file."""
        path = Path(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
        except ValueError as error:
            raise RecordingError(f"{path}: not a JSON file ({error})") from error
        if isinstance(content, dict) and content.get("format") == "bodyhull-lenses":
            raise RecordingError(
                f"{path}: holds lenses without places, no rig; film a board with all cameras at once and run "
                f"bodyhull calibrate boards with --lenses {path}"
            )
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise RecordingError(f'{path}: a JSON file, but no rig of ours (expected "format": "{_FORMAT}")')
        if content.get("version") != _VERSION:
            raise RecordingError(
                f"{path}: rig version {content.get('version')}, this program reads version {_VERSION}; "
                "write it again with this program or update the program"
            )
        try:
            return Rig(tuple(_from_json(camera) for camera in content["cameras"]))
        except KeyError as error:
            raise RecordingError(f"{path}: a camera lacks {error}") from error
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{path}: {error}") from error


def _to_json(camera: Camera) -> dict[str, Any]:
    projection = camera.projection
    return {
        "name": camera.name,
        "size": list(camera.size),
        "intrinsics": camera.intrinsics.tolist(),
        "camera_from_world": camera.camera_from_world.tolist(),
        "distortion": camera.distortion.tolist(),
        "projection": None if projection is None else projection.tolist(),
    }


def _from_json(content: dict[str, Any]) -> Camera:
    projection = content.get("projection")
    return Camera(
        name=str(content["name"]),
        size=(int(content["size"][0]), int(content["size"][1])),
        intrinsics=np.array(content["intrinsics"], dtype=np.float64),
        camera_from_world=np.array(content["camera_from_world"], dtype=np.float64),
        distortion=np.array(content["distortion"], dtype=np.float64),
        projection=None if projection is None else np.array(projection, dtype=np.float64),
    )
