"""Synchronised videos with background plates.

    RECORDING/videos/<camera>.mp4
    RECORDING/background/<camera>.png                 the same view without the subject
    RECORDING/[calibration/]*                          one calibration in any known format, or setup/camNN.txt

Silhouettes are segmented when asked for, all cameras of a frame together; the backgrounds are made at the
first one.
"""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from tqdm import tqdm

from capture.background import Backgrounds, build_backgrounds
from capture.calibration_file import find_calibrations
from capture.errors import RecordingError
from capture.rig import Rig
from capture.rig_formats import known_formats
from capture.segmentation import segment
from capture.silhouette_files import undistort_silhouette
from capture.silhouettes import Silhouettes, sentence
from capture.video_file import VideoFile

VIDEOS = "videos"
BACKGROUND = "background"
_VIDEO_ENDINGS = (".mp4", ".mov", ".avi", ".mkv", ".m4v")
# A thousand frames of 16 cameras; a longer recording is segmented again where later stages ask for it.
_MOST_MASKS_BYTES = 256_000_000
_PLATE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_N_SAMPLES = 20
_SHORTEST_SPAN = 100  # frames that the samples cover at least, where the videos have them


def find_videos(root: Path) -> dict[str, VideoFile]:
    """Camera name -> video, by name. Raises RecordingError for a video that cannot be read, or none at
    all."""
    files = sorted(path for path in (root / VIDEOS).iterdir() if path.suffix.lower() in _VIDEO_ENDINGS)
    if not files:
        raise RecordingError(f"{root / VIDEOS}: no video here; expected one <camera>.mp4 a camera")
    return {path.stem: VideoFile(path) for path in files}


def find_calibration(root: Path) -> Path:
    """The recording's one calibration file or folder. Raises RecordingError for none, or for more than
    one."""
    found = find_calibrations(root)
    if not found:
        raise RecordingError(
            f"{root}: no calibration here or in calibration/ or setup/ (any of: {known_formats()}); "
            "give one with --calibration FILE"
        )
    if len(found) > 1:
        names = ", ".join(str(path.relative_to(root)) for path in found)
        raise RecordingError(f"{root}: several calibrations ({names}); choose one with --calibration FILE")
    return found[0]


def read_plates(folder: Path, videos: dict[str, VideoFile]) -> dict[str, Path]:
    """Camera name -> background plate's file. Raises RecordingError for a missing, unreadable or ill-sized
    one."""
    plates = {}
    for camera, video in videos.items():
        found = [
            folder / f"{camera}{ending}"
            for ending in _PLATE_ENDINGS
            if (folder / f"{camera}{ending}").is_file()
        ]
        if not found:
            raise RecordingError(
                f"{folder / camera}.png: background plate missing; film the scene without the subject, "
                "or give the plates' folder with --background DIR"
            )
        size = read_plate(found[0]).shape[1::-1]
        if size != video.size:
            raise RecordingError(
                f"{found[0]}: background plate of {size[0]}x{size[1]} px, "
                f"but {video.path.name} is {video.size[0]}x{video.size[1]} px"
            )
        plates[camera] = found[0]
    return plates


def read_plate(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """A plate as RGB. Raises RecordingError where it cannot be decoded."""
    content = path.read_bytes()
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    if image is None:
        raise RecordingError(f"{path}: background plate cannot be decoded; save it again")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


class VideoSequence:
    """A `FrameSource` over videos. `calibration`: the rig, lens included, metres, in the videos' order."""

    def __init__(
        self, videos: dict[str, VideoFile], plates: dict[str, Path], calibration: Rig, chosen: tuple[int, ...]
    ) -> None:
        self.calibration = calibration
        self._videos = videos
        self._plates = plates
        self._chosen = chosen
        self._backgrounds: Backgrounds | None = None
        self._masks: OrderedDict[int, tuple[list[bytes | None], tuple[str, ...]]] = OrderedDict()
        self._masks_bytes = 0

    @property
    def frame_ids(self) -> tuple[int, ...]:
        return tuple(range(max(video.n_frames for video in self._videos.values())))

    def silhouettes(self, frame_id: int, soft: bool = False) -> Silhouettes:
        # What is unknown in a mask is one half as a probability: the same number.
        if frame_id not in self._masks:
            self._keep(frame_id, *self._segmented(frame_id))
        packed, problems = self._masks[frame_id]
        images = tuple(None if mask is None else _mask_from_png(mask) for mask in packed)
        return Silhouettes(frame_id, images, problems)

    def picture(self, camera_idx: int, frame_id: int) -> UInt8[np.ndarray, "h w 3"] | None:
        return self._videos[self.calibration[camera_idx].name].read(frame_id)

    def files(self, frame_ids: tuple[int, ...]) -> list[Path]:
        names = self.calibration.names
        return [self._videos[name].path for name in names] + [self._plates[name] for name in names]

    def _keep(self, frame_id: int, packed: list[bytes | None], problems: tuple[str, ...]) -> None:
        """Remember a frame's masks; the oldest ones are forgotten when all take too much room."""
        self._masks[frame_id] = packed, problems
        self._masks_bytes += _n_bytes(packed)
        while self._masks_bytes > _MOST_MASKS_BYTES and len(self._masks) > 1:
            _, (forgotten, _) = self._masks.popitem(last=False)
            self._masks_bytes -= _n_bytes(forgotten)

    def _segmented(self, frame_id: int) -> tuple[list[bytes | None], tuple[str, ...]]:
        """The frame's masks as PNG bytes (a few kB each: they are asked for again by later stages), and
        problems."""
        pictures = [self.picture(camera_idx, frame_id) for camera_idx in range(len(self.calibration))]
        backgrounds = self._prepared()
        outlines = backgrounds.outlines(pictures)
        packed: list[bytes | None] = []
        problems = []
        for camera_idx, camera in enumerate(self.calibration):
            picture, outline, video = pictures[camera_idx], outlines[camera_idx], self._videos[camera.name]
            mask, problem = None, None
            if picture is None:
                beyond = frame_id >= video.n_frames
                ended = (
                    f"the video has {video.n_frames} frames" if beyond else "the video cannot be decoded here"
                )
                problem = f"frame missing in this camera, {ended}"
            elif outline is not None:
                background, trusted = backgrounds.pictures[camera_idx], backgrounds.trusted[camera_idx]
                mask = segment(picture, background, outline, trusted)
            if problem is None and (mask is None or not mask.any()):
                mask, problem = (
                    None,
                    "silhouette is empty (nothing differs from the background where cameras agree)",
                )
            if problem is not None:
                problems.append(sentence(camera.name, frame_id, problem, video.path))
            packed.append(None if mask is None else _png(undistort_silhouette(camera, mask)))
        return packed, tuple(problems)

    def _prepared(self) -> Backgrounds:
        if self._backgrounds is None:
            samples = self._sample_frames()
            cameras = self.calibration
            with tqdm(
                total=2 * len(cameras) * len(samples), desc="backgrounds", unit="picture", leave=False
            ) as bar:

                def read_samples(camera_idx: int):  # type: ignore[no-untyped-def]
                    for picture in self._videos[cameras[camera_idx].name].read_several(samples):
                        bar.update()
                        yield picture

                plates = [read_plate(self._plates[camera.name]) for camera in cameras]
                self._backgrounds = build_backgrounds(cameras, plates, read_samples)
        return self._backgrounds

    def _sample_frames(self) -> list[int]:
        """Frames for the backgrounds: spread over the chosen ones, or wider if those are few."""
        n_common = min(video.n_frames for video in self._videos.values())
        first, last = min(self._chosen[0], n_common - 1), min(self._chosen[-1], n_common - 1)
        lacking = max(0, _SHORTEST_SPAN - 1 - (last - first))
        first = max(0, first - lacking // 2)
        last = min(n_common - 1, max(last, first + _SHORTEST_SPAN - 1))
        first = max(0, min(first, last - _SHORTEST_SPAN + 1))
        return sorted({int(frame) for frame in np.linspace(first, last, _N_SAMPLES).round()})


def length_notes(videos: dict[str, VideoFile]) -> list[str]:
    """A sentence where the videos differ in length, which may mean that they are not synchronised."""
    lengths = {camera: video.n_frames for camera, video in videos.items()}
    if len(set(lengths.values())) == 1:
        return []
    listing = ", ".join(f"{camera} {n_frames}" for camera, n_frames in lengths.items())
    return [f"The videos differ in length ({listing} frames): check that they start at the same moment."]


def _n_bytes(packed: list[bytes | None]) -> int:
    return sum(len(mask) for mask in packed if mask is not None)


def _png(mask: UInt8[np.ndarray, "h w"]) -> bytes:
    return cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _mask_from_png(content: bytes) -> UInt8[np.ndarray, "h w"]:
    mask = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert mask is not None, "our own PNG"
    return mask.astype(np.uint8, copy=False)
