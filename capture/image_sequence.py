"""The INRIA layout on disk: silhouettes (and pictures) as image files, one folder a camera.

    RECORDING/setup/camNN.txt
    RECORDING/[SEQUENCE/]SilhouettesPictures/cam-NNN/silh_NNNNNN.png
    RECORDING/[SEQUENCE/]Pictures/cam-NNN/img_NNNNNN.png          where there are pictures

Described on the 4D repository's and Kinovis' download pages (INRIA Grenoble).
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.errors import RecordingError
from capture.rig import Rig
from capture.silhouette_files import (
    png_damage,
    png_size,
    read_silhouette,
    undistort_probabilities,
    undistort_silhouette,
)
from capture.silhouettes import Silhouettes, sentence

SILHOUETTES = "SilhouettesPictures"
PICTURES = "Pictures"
_CAMERA = re.compile(r"^cam[-_]?\d+$", re.IGNORECASE)
_FILE = re.compile(r"^(?:silh|img)_(\d+)\.(?:png|pgm|bmp|tif|tiff|jpg|jpeg)$", re.IGNORECASE)
_N_PROBED = 5


@dataclass(frozen=True)
class ImageFolders:
    """What lies on disk for one sequence. Camera names are the folders' names, in order of their numbers.

    sizes : camera -> (width, height) px, the most frequent among the first few readable silhouettes.
    silhouettes, pictures : camera -> frame number -> file.
    """

    name: str
    sizes: dict[str, tuple[int, int]]
    silhouettes: dict[str, dict[int, Path]]
    pictures: dict[str, dict[int, Path]]


def find_sequences(root: Path) -> dict[str, Path]:
    """Sequence name -> its folder; the name is "" where the silhouettes lie in the recording's own folder."""
    found = {"": root} if (root / SILHOUETTES).is_dir() else {}
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        if (folder / SILHOUETTES).is_dir():
            found[folder.name] = folder
    return found


def choose_sequence(root: Path, wanted: str | None) -> tuple[str, Path]:
    """The sequence asked for, or the only one there is. Raises RecordingError that lists them otherwise."""
    found = find_sequences(root)
    listing = ", ".join(name or "(unnamed)" for name in found)
    if not found:
        raise RecordingError(
            f"{root}: no recording here: neither [SEQUENCE/]{SILHOUETTES}/ nor videos/ in it"
        )
    if wanted:
        if wanted not in found:
            raise RecordingError(f"{root}: no sequence {wanted!r}; it has: {listing}")
        return wanted, found[wanted]
    if len(found) > 1:
        raise RecordingError(f"{root}: several sequences, choose one with --sequence: {listing}")
    return next(iter(found.items()))


def find_images(name: str, folder: Path, *, keep_unreadable: bool = False) -> ImageFolders:
    """List a sequence's files. Raises RecordingError where no camera has a silhouette that can be opened.

    `keep_unreadable`: such a camera is kept, its pictures taken to be as large as most others'.
    """
    silhouettes = camera_folders(folder / SILHOUETTES)
    if not silhouettes:
        raise RecordingError(f"{folder / SILHOUETTES}: no cam-NNN folder with silh_NNNNNN.png files in it")
    pictures = camera_folders(folder / PICTURES) if (folder / PICTURES).is_dir() else {}
    sizes: dict[str, tuple[int, int]] = {}
    for camera, files in silhouettes.items():
        size = _usual_size(files)
        if size is None and keep_unreadable:
            continue
        if size is None:
            raise RecordingError(
                f"{folder / SILHOUETTES / camera}: none of the first silhouettes can be opened; "
                "restore the files or move the folder out of the recording"
            )
        sizes[camera] = size
    if not sizes:
        raise RecordingError(
            f"{folder / SILHOUETTES}: none of the first silhouettes of any camera can be opened"
        )
    usual = Counter(sizes.values()).most_common(1)[0][0]
    sizes = {camera: sizes.get(camera, usual) for camera in silhouettes}
    return ImageFolders(name, sizes, silhouettes, {name: pictures.get(name, {}) for name in silhouettes})


def camera_folders(folder: Path) -> dict[str, dict[int, Path]]:
    """Camera folder's name -> frame number -> file, cameras in order of their numbers; empty folders left
    out."""
    cameras = [path for path in folder.iterdir() if path.is_dir() and _CAMERA.match(path.name)]
    found: dict[str, dict[int, Path]] = {}
    for camera in sorted(cameras, key=lambda path: (int(re.sub(r"\D", "", path.name)), path.name)):
        files = {
            int(match[1]): path for path in sorted(camera.iterdir()) if (match := _FILE.match(path.name))
        }
        if files:
            found[camera.name] = files
    return found


def _usual_size(files: dict[int, Path]) -> tuple[int, int] | None:
    probed = [files[frame] for frame in sorted(files)[:_N_PROBED]]
    sizes = Counter(size for size in map(png_size, probed) if size is not None)
    return sizes.most_common(1)[0][0] if sizes else None


@dataclass(frozen=True)
class ImageSequence:
    """A `FrameSource` over image files. `calibration`: the rig the silhouettes were taken with, lens
    included.

    inverted : cameras whose files show the person in black throughout; they are swapped on reading.
    """

    folders: ImageFolders
    calibration: Rig
    inverted: frozenset[str]

    @property
    def frame_ids(self) -> tuple[int, ...]:
        return tuple(sorted({frame for files in self.folders.silhouettes.values() for frame in files}))

    def silhouettes(self, frame_id: int, soft: bool = False) -> Silhouettes:
        images: list[UInt8[np.ndarray, "h w"] | None] = []
        problems: list[str] = []
        for camera in self.calibration:
            files = self.folders.silhouettes[camera.name]
            mask, problem = None, "frame missing in this camera"
            path = files.get(frame_id, next(iter(files.values())).parent)
            if frame_id in files:
                mask, problem = self._read(camera.name, camera.size, path, soft)
            undistort = undistort_probabilities if soft else undistort_silhouette
            images.append(None if mask is None else undistort(camera, mask))
            if problem:
                problems.append(sentence(camera.name, frame_id, problem, path))
        return Silhouettes(frame_id, tuple(images), tuple(problems))

    def _read(
        self, name: str, size: tuple[int, int], path: Path, soft: bool
    ) -> tuple[UInt8[np.ndarray, "h w"] | None, str]:
        found = read_silhouette(path, inverted=name in self.inverted, soft=soft)
        if found.mask is None:
            return None, found.problem or "unreadable"
        height, width = found.mask.shape
        if (width, height) != size:
            return None, f"silhouette is {width}x{height} px, this camera's others are {size[0]}x{size[1]} px"
        if found.looks_inverted:
            return None, "silhouette looks inverted (the border and most of the picture are person)"
        return found.mask, found.problem or ""

    def picture(self, camera_idx: int, frame_id: int) -> UInt8[np.ndarray, "h w 3"] | None:
        camera = self.calibration[camera_idx]
        path = self.folders.pictures[camera.name].get(frame_id)
        if path is None:
            return None
        content = path.read_bytes()
        if path.suffix.lower() == ".png" and png_damage(content) is not None:
            return None
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
        if image is None or image.shape[1::-1] != camera.size:
            return None
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)

    def files(self, frame_ids: tuple[int, ...]) -> list[Path]:
        groups = (self.folders.silhouettes, self.folders.pictures)
        return [
            group[camera.name][frame_id]
            for group in groups
            for camera in self.calibration
            for frame_id in frame_ids
            if frame_id in group[camera.name]
        ]


def find_inverted(folders: ImageFolders) -> frozenset[str]:
    """Cameras whose first, middle and last readable silhouettes all look inverted: then it is how they were
    written."""
    inverted = set()
    for camera, files in folders.silhouettes.items():
        frames = sorted(files)
        looks = set()
        for frame in sorted({frames[0], frames[len(frames) // 2], frames[-1]}):
            if (probe := read_silhouette(files[frame])).mask is not None:
                looks.add(probe.looks_inverted)
            if False in looks:
                break  # one that is not settles it, without reading the others
        if looks == {True}:
            inverted.add(camera)
    return frozenset(inverted)
