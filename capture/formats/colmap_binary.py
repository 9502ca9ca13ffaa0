"""COLMAP's binary files walked through before pycolmap reads them: a count that was damaged would make it ask
for all memory. Image points are left out on the way, which cameras have no need of.

Little endian: https://colmap.github.io/format.html, and colmap/scene/reconstruction_io for rigs and frames.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from capture.errors import RecordingError


class _Walk:
    """A file's bytes, taken one after the other; RecordingError where they end early."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error

    def skip(self, n_bytes: int) -> bytes:
        if n_bytes > len(self.data) - self.at:
            raise RecordingError(
                f"{self.path}: ends early or is damaged ({n_bytes} bytes announced at byte {self.at}, "
                f"{len(self.data) - self.at} are there); restore the file"
            )
        part = self.data[self.at : self.at + n_bytes]
        self.at += n_bytes
        return part

    def number(self, layout: str) -> int:
        return int(struct.unpack(layout, self.skip(struct.calcsize(layout)))[0])

    def word(self) -> bytes:
        end = self.data.find(b"\0", self.at)
        return self.skip((end if end >= 0 else len(self.data)) + 1 - self.at)

    def ended(self) -> None:
        if self.at != len(self.data):
            raise RecordingError(
                f"{self.path}: is damaged ({len(self.data) - self.at} bytes left over at its end); "
                "restore the file"
            )


def checked_cameras(path: Path, n_parameters: Callable[[int], int]) -> bytes:
    """The content of a whole cameras.bin. `n_parameters`: of a model's id, negative for an unknown one."""
    walk = _Walk(path)
    for _ in range(walk.number("<Q")):
        walk.skip(4)
        model = walk.number("<i")
        walk.skip(16)
        n = n_parameters(model)
        if n < 0:
            raise RecordingError(f"{path}: is damaged, or newer than this program (camera model {model})")
        walk.skip(8 * n)
    walk.ended()
    return walk.data


def images_without_points(path: Path) -> bytes:
    """The content of a whole images.bin with no image points in it."""
    walk = _Walk(path)
    n_images = walk.number("<Q")
    parts = [struct.pack("<Q", n_images)]
    for _ in range(n_images):
        parts += [walk.skip(4 + 7 * 8 + 4), walk.word(), bytes(8)]
        walk.skip(24 * walk.number("<Q"))
    walk.ended()
    return b"".join(parts)


def checked_rigs(path: Path) -> bytes:
    """The content of a whole rigs.bin."""
    walk = _Walk(path)
    for _ in range(walk.number("<Q")):
        walk.skip(4)
        n_sensors = walk.number("<I")
        walk.skip(8 if n_sensors else 0)
        for _ in range(n_sensors - 1):
            walk.skip(8)
            walk.skip(56 if walk.number("<B") else 0)
    walk.ended()
    return walk.data


def checked_frames(path: Path) -> bytes:
    """The content of a whole frames.bin."""
    walk = _Walk(path)
    for _ in range(walk.number("<Q")):
        walk.skip(8 + 56)
        walk.skip(16 * walk.number("<I"))
    walk.ended()
    return walk.data
