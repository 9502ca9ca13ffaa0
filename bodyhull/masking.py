"""Stage before all others: a recording of pictures in, one silhouette a camera and frame out.

Frames that are finished and whole are kept on a further run; one at a time is read, several are worked on at
once, and what is done is remembered in `silhouettes.json` beside the pictures.
"""

from __future__ import annotations

import json
import sys
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from bodyhull.errors import UserError
from bodyhull.folder import write_atomically
from capture.contact_sheet import contact_sheet
from capture.filmed import Filmed
from capture.rig import Rig
from capture.silhouette_folder import SilhouetteFolder, folder_numbers
from capture.silhouette_maker import MakerOptions, SilhouetteMaker, prepare_maker
from capture.whole_file import write_whole

STATE, SHEET = "silhouettes.json", "silhouettes.jpg"
AGAIN = "pass --overwrite to make them again, or choose another --out"
_STATE_EVERY_S = 2.0
_SHEET_CAMERAS, _SHEET_FRAMES = 8, 3
# One camera's silhouette does not change by so much from its neighbours in time while the others' hardly do.
_JUMP, _QUIET, _NEIGHBOURS = 0.25, 0.08, 3


@dataclass(frozen=True)
class MaskingConfig:
    """out : folder to write to; as_filmed : keep the lens distortion; pictures : write the pictures as the
    same cameras see them; n_jobs : frames worked on at once; settings : what the masks depend on besides the
    files, JSON-ready."""

    out: Path
    options: MakerOptions
    as_filmed: bool
    pictures: bool
    n_jobs: int
    overwrite: bool
    settings: dict[str, Any]


@dataclass(frozen=True)
class Masked:
    """What came of it. frames : of silhouettes.json; calibration : the file or folder that belongs to the
    silhouettes, None where there is none; made : how many frames were not there before."""

    folder: SilhouetteFolder
    frames: dict[str, Any]
    calibration: Path | None
    made: int
    warnings: tuple[str, ...]

    @property
    def failed(self) -> list[str]:
        """Frames without a silhouette from any camera."""
        return [name for name, entry in self.frames.items() if not any(entry["person_px"].values())]


def masking_stage(filmed: Filmed, config: MaskingConfig) -> Masked:
    """Make every silhouette that is not there yet. Raises UserError or RecordingError for what the user can
    cause; a picture without a silhouette is marked and never stops the others."""
    folder = SilhouetteFolder(config.out, folder_numbers(filmed.cameras), dict(filmed.frames.sizes))
    state = _claim(folder, filmed, config)
    for note in filmed.notes:
        tqdm.write(f"note: {note}", file=sys.stderr)
    lenses = None if config.as_filmed or filmed.rig is None else filmed.rig
    calibration = _write_calibration(folder, filmed, lenses, state)
    frames: dict[str, Any] = state["frames"]
    todo = [k for k in filmed.chosen if f"{k:06d}" not in frames or not folder.has(k)]
    if todo:
        with tqdm(desc="silhouettes", bar_format="{desc}: {postfix}", leave=False) as bar:
            maker = prepare_maker(filmed, config.options, bar.set_postfix_str)
        state["methods"] = dict(zip(filmed.cameras, maker.methods, strict=True))
        _make_all(maker, folder, state, todo, lenses, config)
    state["frames"] = frames = dict(sorted(frames.items()))
    warnings = area_jumps(frames)
    for warning in warnings:
        tqdm.write(f"warning: {warning}", file=sys.stderr)
    state["warnings"] = warnings
    _write_state(folder, state)
    return Masked(folder, frames, calibration, len(todo), tuple(warnings))


def _claim(folder: SilhouetteFolder, filmed: Filmed, config: MaskingConfig) -> dict[str, Any]:
    """Bind the folder to this input and these settings, or refuse where it holds other silhouettes."""
    fingerprint = filmed.fingerprint()
    state = _read_state(folder)
    existing = folder.silhouettes()
    if config.overwrite:
        for path in existing:
            path.unlink()
        state = {}
    elif state:
        old = state.get("settings", {})
        changed = [
            f"{k} was {old.get(k)!r}, now {v!r}" for k, v in config.settings.items() if old.get(k) != v
        ]
        if changed:
            raise UserError(f"{folder.root}: made with other settings ({'; '.join(changed)}); {AGAIN}")
        if state.get("fingerprint") != fingerprint:
            raise UserError(f"{folder.root}: made from another input or calibration; {AGAIN}")
    elif existing:
        raise UserError(
            f"{folder.root}: holds {len(existing)} silhouettes that this command did not make; "
            "choose another --out, or pass --overwrite to replace them"
        )
    if not state:
        state = {"settings": config.settings, "fingerprint": fingerprint, "frames": {}}
    state["cameras"] = {camera: f"cam-{number:03d}" for camera, number in folder.numbers.items()}
    state["notes"] = list(filmed.notes)
    _write_state(folder, state)
    return state


def _write_calibration(
    folder: SilhouetteFolder, filmed: Filmed, lenses: Rig | None, state: dict[str, Any]
) -> Path | None:
    """The cameras that the silhouettes were seen by, unless they lie there already."""
    if filmed.rig is None or filmed.delivered is None:
        return None
    ideal = all(camera.is_pinhole for camera in filmed.rig)
    if lenses is None and not ideal:
        return folder.write_rig(filmed.rig)
    # Matrices without distortion go on in their own unit, to the last digit; others become metres.
    rig = filmed.delivered if ideal else filmed.rig.pinholes()
    if folder.has_setup(rig):
        return folder.setup
    if folder.setup.is_dir() and not state.get("setup_written"):
        raise UserError(
            f"{folder.setup}: holds another calibration, which this command did not write; "
            "choose another --out"
        )
    state["setup_written"] = True
    return folder.write_setup(rig)


def _make_all(
    maker: SilhouetteMaker,
    folder: SilhouetteFolder,
    state: dict[str, Any],
    todo: list[int],
    lenses: Rig | None,
    config: MaskingConfig,
) -> None:
    """Make and write the frames in `todo`; `state` learns of each as it is on disk, also when stopped."""
    shown = set(_spread(todo, _SHEET_FRAMES))
    rows: dict[int, list[tuple[str, Any, Any]]] = {}

    def work(frame_id: int, pictures: list[tuple[Any, str]]) -> tuple[int, dict[str, Any]]:
        made = maker.make(frame_id, pictures)
        written = folder.write_frame(frame_id, made.masks, lenses)
        plain = [picture for picture, _ in pictures]
        if config.pictures:
            folder.write_pictures(frame_id, plain, lenses)
        if frame_id in shown:
            rows[frame_id] = _row(maker.filmed.cameras, frame_id, plain, written, lenses)
        cameras = maker.filmed.cameras
        return frame_id, {
            "person_px": {
                camera: 0 if made.masks[idx] is None else int(np.count_nonzero(written[idx] == 255))
                for idx, camera in enumerate(cameras)
            },
            "problems": list(made.problems),
            "mended": made.mended,
        }

    last_written = time.monotonic()
    waiting: deque[Future[tuple[int, dict[str, Any]]]] = deque()
    with (
        ThreadPoolExecutor(max_workers=config.n_jobs, thread_name_prefix="silhouettes") as pool,
        tqdm(total=len(todo), desc="silhouettes", unit="frame") as bar,
    ):

        def take(done: tuple[int, dict[str, Any]]) -> None:
            frame_id, entry = done
            for problem in entry["problems"]:
                tqdm.write(f"warning: {problem}", file=sys.stderr)
            state["frames"][f"{frame_id:06d}"] = entry
            bar.update()

        try:
            # One thread reads, since videos only go forwards; the others work.
            for frame_id in todo:
                waiting.append(pool.submit(work, frame_id, maker.read(frame_id)))
                if len(waiting) > config.n_jobs:
                    take(waiting.popleft().result())
                if time.monotonic() - last_written > _STATE_EVERY_S:
                    _write_state(folder, state)
                    last_written = time.monotonic()
            while waiting:
                take(waiting.popleft().result())
        except BaseException:
            # Ctrl-C or a full disk: what is being worked on is finished, and remembered if that can be.
            pool.shutdown(wait=True, cancel_futures=True)
            for future in waiting:
                if not future.cancelled() and future.exception() is None:
                    take(future.result())
            with suppress(UserError):
                _write_state(folder, state)
            raise
    write_whole(folder.root / SHEET, contact_sheet([rows[k] for k in sorted(rows)]))


def _row(
    cameras: tuple[str, ...], frame_id: int, pictures: list[Any], masks: list[Any], lenses: Rig | None
) -> list[tuple[str, Any, Any]]:
    """One frame's line of the contact sheet."""
    row = []
    for idx in _spread(list(range(len(cameras))), _SHEET_CAMERAS):
        picture = pictures[idx]
        if picture is not None and lenses is not None:
            picture = lenses[idx].undistort_image(picture)
        row.append((f"{cameras[idx]} {frame_id}", picture, masks[idx]))
    return row


def _spread(values: list[int], n: int) -> list[int]:
    return [values[int(idx)] for idx in sorted(set(np.linspace(0, len(values) - 1, n).round().astype(int)))]


def area_jumps(frames: dict[str, Any]) -> list[str]:
    """A sentence for each camera and frame (of silhouettes.json) where this silhouette alone is far larger or
    smaller than a moment before and after: the commonest way for a segmentation to fail."""
    names = sorted(frames)
    if len(names) < 2 * _NEIGHBOURS + 1:
        return []
    cameras = list(frames[names[0]]["person_px"])
    areas = np.array([[frames[name]["person_px"].get(c, 0) for c in cameras] for name in names], float)
    areas[areas == 0] = np.nan
    sentences = []
    for idx, name in enumerate(names):
        low = min(max(0, idx - _NEIGHBOURS), len(names) - 2 * _NEIGHBOURS - 1)
        around = areas[low : low + 2 * _NEIGHBOURS + 1]
        known = np.isfinite(around).sum(axis=0) > _NEIGHBOURS
        if not known.any():
            continue
        change = np.full(len(cameras), np.nan)
        change[known] = np.log(areas[idx][known] / np.nanmedian(around[:, known], axis=0))
        for camera_idx, camera in enumerate(cameras):
            others = np.delete(change, camera_idx)
            others = others[np.isfinite(others)]
            quiet = others.size == 0 or np.median(np.abs(others)) < _QUIET
            if np.isfinite(change[camera_idx]) and abs(change[camera_idx]) > _JUMP and quiet:
                share = f"{100 * np.exp(change[camera_idx]):.0f} %"
                sentences.append(
                    f"Camera {camera}, frame {name}: this silhouette alone is {share} of its size a moment "
                    "before and after; look at it."
                )
    return sentences


def _read_state(folder: SilhouetteFolder) -> dict[str, Any]:
    path = folder.root / STATE
    try:
        state = json.loads(path.read_text())
        if not isinstance(state, dict) or not isinstance(state.get("frames"), dict):
            raise ValueError("not what this command writes")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({error}); {AGAIN}") from error
    return state


def _write_state(folder: SilhouetteFolder, state: dict[str, Any]) -> None:
    text = json.dumps(state, indent=1)
    write_atomically(folder.root / STATE, lambda path: path.write_text(text + "\n"))
