"""The pictures of a recording that need not have silhouettes: videos, or folders of pictures, frame by frame.

    RECORDING/videos/<camera>.mp4
    RECORDING/[SEQUENCE/]Pictures/cam-NNN/img_NNNNNN.png

A picture that cannot be read comes back as None with a phrase that says why: one bad file must not stop the
making of silhouettes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.errors import RecordingError
from capture.image_sequence import PICTURES, camera_folders
from capture.silhouette_files import png_damage, png_size
from capture.video_file import VideoFile
from capture.video_sequence import VIDEOS, find_videos, length_notes

Picture = UInt8[np.ndarray, "_h _w 3"]


@runtime_checkable
class PictureFrames(Protocol):
    """Where pictures come from. sizes: camera -> (width, height) px, in the cameras' order; notes: what was
    noticed on opening, a sentence each."""

    name: str
    sizes: dict[str, tuple[int, int]]
    notes: tuple[str, ...]

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """Every frame that at least one camera has, ascending."""

    def read(self, camera: str, frame_id: int) -> tuple[Picture | None, str]:
        """The frame as filmed (h w 3), RGB, and ""; or None and a phrase that says why there is none."""

    def read_several(self, camera: str, frame_ids: list[int]) -> Iterator[Picture]:
        """These frames (ascending) as RGB; another stands in for one that cannot be read."""

    def path(self, camera: str, frame_id: int | None = None) -> Path:
        """The file that this frame is read from; without a frame the camera's video or folder."""

    def files(self, frame_ids: tuple[int, ...]) -> list[Path]:
        """All files that these frames are read from, in a fixed order."""


class VideoFrames:
    """`PictureFrames` of synchronised videos."""

    def __init__(self, root: Path) -> None:
        """Raises RecordingError for a video that cannot be read, or none at all."""
        self._videos: dict[str, VideoFile] = find_videos(root)
        self.name = ""
        self.sizes = {camera: video.size for camera, video in self._videos.items()}
        self.notes = tuple(length_notes(self._videos))

    @property
    def frame_ids(self) -> tuple[int, ...]:
        return tuple(range(max(video.n_frames for video in self._videos.values())))

    def read(self, camera: str, frame_id: int) -> tuple[Picture | None, str]:
        video = self._videos[camera]
        picture = video.read(frame_id)
        if picture is not None:
            return picture, ""
        if frame_id >= video.n_frames:
            return None, f"frame missing in this camera, the video has {video.n_frames} frames"
        return None, "frame missing in this camera, the video cannot be decoded here"

    def read_several(self, camera: str, frame_ids: list[int]) -> Iterator[Picture]:
        return self._videos[camera].read_several(frame_ids)

    def path(self, camera: str, frame_id: int | None = None) -> Path:
        return self._videos[camera].path

    def files(self, frame_ids: tuple[int, ...]) -> list[Path]:
        return [video.path for video in self._videos.values()]


class FolderFrames:
    """`PictureFrames` of folders of pictures (INRIA layout)."""

    def __init__(self, name: str, folder: Path) -> None:
        """Raises RecordingError where no camera has a picture, or a camera none that can be opened."""
        self._files = camera_folders(folder / PICTURES)
        self.name = name
        if not self._files:
            raise RecordingError(f"{folder / PICTURES}: no cam-NNN folder with img_NNNNNN.png files in it")
        self.sizes = {}
        for camera, files in self._files.items():
            probed = [png_size(files[frame]) for frame in sorted(files)[:5]]
            sizes = Counter(size for size in probed if size is not None)
            if not sizes:
                raise RecordingError(
                    f"{folder / PICTURES / camera}: none of the first pictures can be opened; "
                    "restore the files or move the folder out of the recording"
                )
            self.sizes[camera] = sizes.most_common(1)[0][0]
        everywhere = self.frame_ids
        lacking = {camera: len(everywhere) - len(files) for camera, files in self._files.items()}
        self.notes = tuple(
            f"Camera {camera} lacks {n} of the {len(everywhere)} frames."
            for camera, n in lacking.items()
            if n
        )

    @property
    def frame_ids(self) -> tuple[int, ...]:
        return tuple(sorted({frame for files in self._files.values() for frame in files}))

    def read(self, camera: str, frame_id: int) -> tuple[Picture | None, str]:
        path = self._files[camera].get(frame_id)
        if path is None:
            return None, "frame missing in this camera"
        picture, problem = read_picture(path)
        if picture is not None and picture.shape[1::-1] != self.sizes[camera]:
            found, usual = picture.shape[1::-1], self.sizes[camera]
            return (
                None,
                f"picture is {found[0]}x{found[1]} px, this camera's others are {usual[0]}x{usual[1]} px",
            )
        return picture, problem

    def read_several(self, camera: str, frame_ids: list[int]) -> Iterator[Picture]:
        candidates = [*frame_ids, *sorted(self._files[camera])]
        readable = (self.read(camera, frame_id)[0] for frame_id in candidates)
        last = next((picture for picture in readable if picture is not None), None)
        if last is None:
            raise RecordingError(f"{self.path(camera)}: no picture in this folder can be read")
        for frame_id in frame_ids:
            picture, _ = self.read(camera, frame_id)
            last = last if picture is None else picture
            yield last

    def path(self, camera: str, frame_id: int | None = None) -> Path:
        files = self._files[camera]
        folder = next(iter(files.values())).parent
        return folder if frame_id is None else files.get(frame_id, folder)

    def files(self, frame_ids: tuple[int, ...]) -> list[Path]:
        return [
            files[frame_id] for files in self._files.values() for frame_id in frame_ids if frame_id in files
        ]


def read_picture(path: Path) -> tuple[Picture | None, str]:
    """A picture file as RGB and "", or None and a phrase that says what is wrong with it."""
    try:
        content = path.read_bytes()
    except OSError as error:
        return None, f"file cannot be read ({error.strerror})"
    if path.suffix.lower() == ".png" and (damage := png_damage(content)) is not None:
        return None, damage
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    if picture is None:
        return None, "not an image that OpenCV can decode" if content else "file is empty (0 bytes)"
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False), ""


def find_pictures(root: Path, sequence: str | None = None) -> PictureFrames:
    """The pictures below a recording's folder. Raises RecordingError where there are none, or several
    sequences and none chosen."""
    if not root.is_dir():
        raise RecordingError(f"{root}: no such folder")
    if (root / VIDEOS).is_dir():
        if sequence:
            raise RecordingError(
                f"{root}: a folder of videos holds one sequence; leave out --sequence {sequence}"
            )
        return VideoFrames(root)
    found = {"": root} if (root / PICTURES).is_dir() else {}
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        if (folder / PICTURES).is_dir():
            found[folder.name] = folder
    listing = ", ".join(name or "(unnamed)" for name in found)
    if not found:
        raise RecordingError(f"{root}: no pictures here: neither {VIDEOS}/ nor [SEQUENCE/]{PICTURES}/ in it")
    if sequence and sequence not in found:
        raise RecordingError(f"{root}: no sequence {sequence!r} with pictures; it has: {listing}")
    if not sequence and len(found) > 1:
        raise RecordingError(f"{root}: several sequences, choose one with --sequence: {listing}")
    name = sequence or next(iter(found))
    return FolderFrames(name, found[name])
