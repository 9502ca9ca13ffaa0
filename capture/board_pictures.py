"""Pictures and videos of a board, camera by camera, on disk.

    IN/<camera>/*.jpg | *.png ...        pictures; the same name in several cameras is the same moment
    IN/<camera>.mp4 or IN/<camera>/x.mp4 videos; the same frame number is the same moment
    IN/intrinsics/..., IN/extrinsics/... where both are there: the first serve the lenses only

A picture's name may begin or end with its camera's name (cam01_0007.jpg): that part does not count.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from os import cpu_count
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from tqdm import tqdm

from capture.board import Board
from capture.board_detection import find_board
from capture.board_view import BoardView, Sightings
from capture.errors import RecordingError
from capture.video_file import VideoFile

PICTURES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".m4v")
_MOST_FRAMES = 150  # of a video that are looked at, where it is not said
_FEWEST_FRAMES = 60
_ALL_FRAMES = 1500  # of all videos together, as long as that leaves each its fewest
_N_SAMPLES = 16  # pictures to tell the board by

Grey = UInt8[np.ndarray, "h w"]


@dataclass(frozen=True)
class Footage:
    """One camera's pictures or its video. keys: what is the same moment in every camera; files by key, for
    pictures."""

    name: str
    path: Path
    size: tuple[int, int]
    n_frames: int = 0
    files: Mapping[str, Path] = field(default_factory=dict)

    @property
    def is_video(self) -> bool:
        return self.n_frames > 0


@dataclass(frozen=True)
class BoardFootage:
    """What a folder holds: cameras that film together, and what is for the lenses only. notes: sentences on
    oddities."""

    together: tuple[Footage, ...]
    alone: tuple[Footage, ...]
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Every camera, those that film together first."""
        return tuple(dict.fromkeys(one.name for one in (*self.together, *self.alone)))


def find_footage(root: Path, *, only_intrinsics: bool = False) -> BoardFootage:
    """Look at a folder. Raises RecordingError, naming the file, for what cannot be used."""
    if not root.is_dir():
        raise RecordingError(
            f"{root}: no such folder; give one with a sub-folder of pictures or a video a camera"
        )
    lens, place = root / "intrinsics", root / "extrinsics"
    notes: list[str] = []
    alone = _cameras_in(lens, notes) if lens.is_dir() else ()
    together = _cameras_in(place, notes) if place.is_dir() else ()
    if not alone and not together:
        together = _cameras_in(root, notes)
    if not alone and not together:
        raise RecordingError(
            f"{root}: no pictures or videos of a board; expected <camera>/*.jpg or <camera>.mp4 for "
            "every camera"
        )
    if only_intrinsics:
        alone, together = (*alone, *together), ()
    _check_sizes(alone, together)
    return BoardFootage(together, alone, tuple(notes))


def _check_sizes(alone: Sequence[Footage], together: Sequence[Footage]) -> None:
    sizes = {one.name: one for one in together}
    for one in alone:
        other = sizes.get(one.name)
        if other is not None and other.size != one.size:
            raise RecordingError(
                f"{one.path}: pictures of {one.size[0]}x{one.size[1]} px, but {other.path} has "
                f"{other.size[0]}x{other.size[1]} px; a lens must be calibrated at the size that is filmed"
            )


def _cameras_in(root: Path, notes: list[str]) -> tuple[Footage, ...]:
    found: dict[str, Footage] = {}
    for path in sorted(root.iterdir()):
        if path.is_dir():
            one = _camera_folder(path, notes)
        elif path.suffix.lower() in VIDEOS:
            one = _video(path, path.stem)
        else:
            continue
        if one is None:
            continue
        if one.name in found:
            raise RecordingError(f"{path}: camera {one.name} is there twice, also as {found[one.name].path}")
        found[one.name] = one
    return tuple(found.values())


def _camera_folder(folder: Path, notes: list[str]) -> Footage | None:
    files = sorted(path for path in folder.iterdir() if path.is_file())
    pictures = [path for path in files if path.suffix.lower() in PICTURES]
    videos = [path for path in files if path.suffix.lower() in VIDEOS]
    if videos and not pictures:
        if len(videos) > 1:
            raise RecordingError(
                f"{folder}: {len(videos)} videos of one camera; leave the one with the board"
            )
        return _video(videos[0], folder.name)
    if not pictures:
        return None
    kept: dict[str, Path] = {}
    size: tuple[int, int] | None = None
    for path in pictures:
        picture = read_grey(path)
        if picture is None:
            notes.append(f"{path}: cannot be decoded, left out.")
            continue
        found = (picture.shape[1], picture.shape[0])
        if size is not None and found != size:
            raise RecordingError(
                f"{path}: a picture of {found[0]}x{found[1]} px, the other pictures of camera "
                f"{folder.name} have "
                f"{size[0]}x{size[1]} px; all pictures of a camera must have one size and way up"
            )
        size = found
        kept[moment_key(path.stem, folder.name)] = path
    return None if size is None else Footage(folder.name, folder, size, 0, kept)


def _video(path: Path, name: str) -> Footage:
    video = VideoFile(path)
    return Footage(name, path, video.size, video.n_frames)


def moment_key(stem: str, camera: str) -> str:
    """What of a picture's name tells the moment: all but the camera's name; numbers without leading zeros."""
    name = re.escape(camera)
    key = re.sub(rf"^{name}[_\-. ]+|[_\-. ]+{name}$", "", stem, flags=re.IGNORECASE) or stem
    return str(int(key)) if key.isdecimal() else key


def read_grey(path: Path) -> Grey | None:
    """A picture as grey (h w), turned as its EXIF says; None where it cannot be decoded."""
    content = path.read_bytes()
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_GRAYSCALE) if content else None
    return None if picture is None else picture.astype(np.uint8, copy=False)


def sample_pictures(footage: BoardFootage) -> list[Grey]:
    """Some pictures of all cameras, to tell the board by."""
    every = (*footage.together, *footage.alone)
    each = max(2, -(-_N_SAMPLES // len(every)))
    out: list[Grey] = []
    for one in every[:: max(1, len(every) // _N_SAMPLES)]:
        if one.is_video:
            wanted = sorted({int(k) for k in np.linspace(0, one.n_frames - 1, 2 * each + 2)[1:-1]})
            out += [grey for _, grey in _frames(one, wanted)]
        else:
            files = list(one.files.values())
            chosen = sorted({int(k) for k in np.linspace(0, len(files) - 1, each).round()})
            out += [grey for k in chosen if (grey := read_grey(files[k])) is not None]
    return out


def read_sightings(
    footage: BoardFootage,
    board: Board,
    *,
    every: int | None = None,
    delays: Mapping[str, int] | None = None,
) -> Sightings:
    """Find the board in all pictures, several cameras at once.

    every: look at each so many-th frame of a video; by itself, at 60 to 150 of them. delays: frames by which
    a camera's video runs late: its frame number less the delay is the moment. Raises RecordingError for an
    unusable value.
    """
    if every is not None and every < 1:
        raise RecordingError(f"--every {every}: must be 1 or more")
    names = footage.names
    keys = moment_numbers(footage.together)
    labels = {number: key for key, number in keys.items()}
    step = every or video_step(footage)
    n_looks = sum(
        len(range(0, one.n_frames, step)) if one.is_video else len(one.files)
        for one in (*footage.together, *footage.alone)
    )
    with (
        tqdm(total=n_looks, desc="boards", unit="picture", leave=False, delay=2) as bar,
        ThreadPoolExecutor(max_workers=cpu_count() or 1) as pool,
    ):

        def look(one: Footage) -> dict[int, BoardView]:
            delay = (delays or {}).get(one.name, 0)
            return _views_of(one, board, keys, step, delay, bar.update)

        together = dict(
            zip([f.name for f in footage.together], pool.map(look, footage.together), strict=True)
        )
        alone = dict(zip([f.name for f in footage.alone], pool.map(look, footage.alone), strict=True))
    sizes = {one.name: one.size for one in (*footage.alone, *footage.together)}
    return Sightings(
        names,
        tuple(sizes[name] for name in names),
        tuple(together.get(name, {}) for name in names),
        tuple(list(alone.get(name, {}).values()) for name in names),
        labels,
    )


def video_step(footage: BoardFootage) -> int:
    """Every how manieth frame is looked at, where it is not said."""
    longest = max((one.n_frames for one in (*footage.together, *footage.alone)), default=0)
    n_videos = sum(one.is_video for one in (*footage.together, *footage.alone))
    wanted = int(np.clip(_ALL_FRAMES // max(n_videos, 1), _FEWEST_FRAMES, _MOST_FRAMES))
    return max(1, longest // wanted)


def moment_numbers(together: Sequence[Footage]) -> dict[str, int]:
    """Moment key -> number, in the keys' order; keys that are numbers keep them."""
    keys = sorted(set().union(*(one.files.keys() for one in together)), key=_by_number)
    if all(key.isdecimal() for key in keys):
        return {key: int(key) for key in keys}
    return {key: number for number, key in enumerate(keys)}


def _by_number(key: str) -> tuple[int, str]:
    numbers = re.findall(r"\d+", key)
    return (int(numbers[0]) if numbers else -1, key)


def _views_of(
    one: Footage, board: Board, keys: Mapping[str, int], step: int, delay: int, looked: Callable[[], object]
) -> dict[int, BoardView]:
    views: dict[int, BoardView] = {}
    if one.is_video:
        wanted = [
            moment + delay for moment in range(0, one.n_frames, step) if 0 <= moment + delay < one.n_frames
        ]
        for frame, picture in _frames(one, wanted):
            view = find_board(picture, board, thorough=False)
            looked()
            if view is not None:
                views[frame - delay] = view
        return views
    for number, (key, path) in enumerate(one.files.items()):
        found = read_grey(path)
        looked()
        view = None if found is None else find_board(found, board)
        if view is not None:
            views[keys.get(key, number)] = view
    return views


def _frames(one: Footage, wanted: Sequence[int]) -> Iterator[tuple[int, Grey]]:
    video = VideoFile(one.path)
    for frame in wanted:
        picture = video.read(frame)
        if picture is not None:
            yield frame, cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.uint8, copy=False)


def views_at(
    footage: BoardFootage, board: Board, key: str, *, delays: Mapping[str, int] | None = None
) -> dict[str, BoardView]:
    """The board at one moment, searched for thoroughly: camera -> view. key: a picture's name or a video's
    frame number.

    Raises RecordingError where no camera has that moment, or none sees the board then.
    """
    views: dict[str, BoardView] = {}
    n_have = 0
    for one in footage.together:
        if one.is_video:
            frame = int(key) + (delays or {}).get(one.name, 0) if key.isdecimal() else -1
            wanted = [frame] if 0 <= frame < one.n_frames else []
            pictures = [grey for _, grey in _frames(one, wanted)]
        else:
            path = one.files.get(moment_key(key, one.name))
            grey = None if path is None else read_grey(path)
            pictures = [] if grey is None else [grey]
        n_have += len(pictures)
        for picture in pictures:
            view = find_board(picture, board)
            if view is not None:
                views[one.name] = view
    if not n_have:
        raise RecordingError(
            f"--floor board:{key}: no camera has a frame or picture {key}; give its number, or its "
            "name without the "
            "camera's and without ending"
        )
    if not views:
        raise RecordingError(f"--floor board:{key}: no camera sees the board in {key}; choose another one")
    return views
