"""Silhouettes on disk in the INRIA layout, with the cameras that they were seen by.

OUT/SilhouettesPictures/cam-NNN/silh_NNNNNN.png    255 person, 0 background, 128 unknown
OUT/Pictures/cam-NNN/img_NNNNNN.png                where they are asked for
OUT/setup/camNN.txt                                3x4 matrices, for silhouettes without lens distortion
OUT/rig.json                                       the cameras with their lenses, for silhouettes as filmed
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.calibration_file import camera_number
from capture.errors import RecordingError
from capture.formats.inria import read_projection_matrix
from capture.image_sequence import PICTURES, SILHOUETTES
from capture.rig import Rig
from capture.silhouette_files import (
    UNKNOWN,
    png_damage,
    png_size,
    undistort_silhouette,
    write_silhouette,
)
from capture.whole_file import write_whole

_RIG = "rig.json"

Picture = UInt8[np.ndarray, "_h _w 3"]
Mask = UInt8[np.ndarray, "_h _w"]


@dataclass(frozen=True)
class SilhouetteFolder:
    """Where a recording's silhouettes go. numbers : camera -> the number in its folder's name; sizes : camera
    -> (width, height) px of its pictures."""

    root: Path
    numbers: Mapping[str, int]
    sizes: Mapping[str, tuple[int, int]]

    def silhouette(self, camera: str, frame_id: int) -> Path:
        """File of one silhouette."""
        return self.root / SILHOUETTES / f"cam-{self.numbers[camera]:03d}" / f"silh_{frame_id:06d}.png"

    def picture(self, camera: str, frame_id: int) -> Path:
        """File of one picture."""
        return self.root / PICTURES / f"cam-{self.numbers[camera]:03d}" / f"img_{frame_id:06d}.png"

    def silhouettes(self) -> list[Path]:
        """Every silhouette that is there already, whoever made it."""
        return sorted((self.root / SILHOUETTES).glob("cam-*/silh_*.png"))

    def has(self, frame_id: int) -> bool:
        """Are all cameras' files of a frame there, whole, and of the right size?"""
        return all(
            png_size(path := self.silhouette(camera, frame_id)) == tuple(size)
            and png_damage(path.read_bytes()) is None
            for camera, size in self.sizes.items()
        )

    def write_frame(self, frame_id: int, masks: Sequence[Mask | None], lenses: Rig | None) -> list[Mask]:
        """Write one frame; a camera without evidence gets a file that is unknown all over, so that no number
        is missing. lenses : the cameras whose distortion is to be taken out; None: as filmed. Returns what
        was written. OSError where it cannot be."""
        written = []
        for camera_idx, camera in enumerate(self.numbers):
            mask = masks[camera_idx]
            if mask is None:
                mask = np.full(tuple(self.sizes[camera])[::-1], UNKNOWN, np.uint8)
            elif lenses is not None:
                mask = undistort_silhouette(lenses[camera_idx], mask)
            write_silhouette(self.silhouette(camera, frame_id), mask)
            written.append(mask)
        return written

    def write_pictures(self, frame_id: int, pictures: Sequence[Picture | None], lenses: Rig | None) -> None:
        """Write one frame's pictures beside the silhouettes, as the same cameras see them."""
        for camera_idx, camera in enumerate(self.numbers):
            picture = pictures[camera_idx]
            if picture is None:
                continue
            if lenses is not None:
                picture = lenses[camera_idx].undistort_image(picture)
            bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
            done, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            assert done
            write_whole(self.picture(camera, frame_id), data.tobytes())

    @property
    def setup(self) -> Path:
        """Folder of the 3x4 matrices."""
        return self.root / "setup"

    def has_setup(self, rig: Rig) -> bool:
        """Does setup/ hold these pinholes already, as when the recording's own folder is written into?"""
        try:
            there = {
                name: read_projection_matrix(self.setup / f"cam{number:02d}.txt")
                for name, number in self.numbers.items()
            }
        except RecordingError:
            return False
        # A projection matrix is known up to its scale and sign.
        pairs = [(there[camera.name].ravel(), camera.projection_matrix.ravel()) for camera in rig]
        return all(abs(a @ b) > (1 - 1e-12) * np.linalg.norm(a) * np.linalg.norm(b) for a, b in pairs)

    def write_setup(self, rig: Rig) -> Path:
        """The pinholes' 3x4 matrices, every digit; the folder."""
        for camera in rig:
            rows = (" ".join(f"{value:.17g}" for value in row) for row in camera.projection_matrix)
            text = "\n".join(rows) + "\n"
            write_whole(self.setup / f"cam{self.numbers[camera.name]:02d}.txt", text.encode())
        return self.setup

    def write_rig(self, rig: Rig) -> Path:
        """The cameras with their lenses, metres, named like the folders; the file."""
        renamed = Rig(tuple(replace(c, name=f"cam-{self.numbers[c.name]:03d}") for c in rig))
        self.root.mkdir(parents=True, exist_ok=True)
        renamed.save(self.root / _RIG)
        return self.root / _RIG


def folder_numbers(cameras: Sequence[str]) -> dict[str, int]:
    """Camera -> the number of its folder: the one in its name (cam02 -> cam-002), where all have one of their
    own below a thousand; else counted from zero."""
    numbers = [camera_number(camera) for camera in cameras]
    known = [number for number in numbers if number is not None and number < 1000]
    if len(set(known)) == len(cameras):
        return dict(zip(cameras, known, strict=True))
    return {camera: idx for idx, camera in enumerate(cameras)}
