"""Stages capture and hull: silhouettes in, one visual hull a frame out, problems kept with their frame."""

from __future__ import annotations

import platform
import sys
import time
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from tqdm import tqdm

from bodyhull import __version__
from bodyhull.config import RunConfig
from bodyhull.errors import UserError
from bodyhull.folder import RunFolder, write_atomically
from bodyhull.look_ahead import silhouettes_ahead
from capture.recording import Recording, Silhouettes, open_recording
from hull.bounds import Bounds
from hull.colours import vertex_colours
from hull.errors import HullError
from hull.faults import WRONG_HULL, CameraFault
from hull.hull_file import facts_file, load_hull, save_hull
from hull.marks import size_mark
from hull.mesh_file import MeshFileError
from hull.quality import silhouette_agreement
from hull.soft_tables import as_mask
from hull.visual_hull import HullOptions, build_hull

OFTEN_SHARE = 1 / 3
# A person's hull does not change its volume by more than this factor within a recording: the first with very
# many cameras, and what so many times one over their number adds.
STEADY, LESS_STEADY, COMPARED_FROM = 1.2, 1.6, 5
COMPARED = "of the median over the frames"
AGAIN = "run with --overwrite to redo it, or choose another --out"
NOTED_PACKAGES = (
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "pycolmap",
    "scikit-image",
    "open3d",
    "jax",
    "pyrender",
)


@dataclass(frozen=True)
class CarvedFrame:
    """What is known of a frame's hull: status "ok", "degraded" (a camera gave no evidence or contradicts the
    others, there is a second subject, or one that leaves what the cameras see), "suspect" (so many contradict
    one another, or the volume is so far from a person's or from the other frames', that the hull is probably
    wrong; it is kept) or "failed"."""

    frame_id: int
    status: str
    problems: tuple[str, ...]
    agreement: tuple[float | None, ...] = ()
    volume_m3: float | None = None
    faults: tuple[CameraFault, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "status": self.status,
            "problems": list(self.problems),
            "agreement": list(self.agreement),
            "volume_m3": self.volume_m3,
            "faults": [fault.as_dict() for fault in self.faults],
        }


def open_for(config: RunConfig) -> Recording:
    """Open the recording of a configuration."""
    return open_recording(
        config.recording,
        sequence=config.sequence,
        calibration=config.calibration,
        frames=config.frames,
        units=config.units,
        up=config.up,
        background=config.background,
    )


def software() -> dict[str, str]:
    """Versions that a result depends on."""
    found = {"bodyhull": __version__, "python": platform.python_version()}
    for name in NOTED_PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


def claim(folder: RunFolder, config: RunConfig, fingerprint: str) -> dict[str, Any]:
    """Bind the run folder to this input and these settings, or refuse where it holds another's work.

    Returns the state of run.json. With --overwrite the earlier entries are dropped (the files are replaced
    one by one).
    """
    state: dict[str, Any] = {} if config.overwrite else folder.read_state()
    settings = config.carve_settings()
    if state:
        old = {k: state.get("configuration", {}).get(k) for k in settings}
        changed = [f"{k} was {old[k]!r}, now {v!r}" for k, v in settings.items() if old[k] != v]
        if changed:
            raise UserError(f"{folder.root}: made with other settings ({'; '.join(changed)}); {AGAIN}")
        refuse_other_input(folder, fingerprint)
        # The fit's own settings are taken over by the fit, once it has agreed to them.
        kept = (
            {k: state["configuration"].get(k) for k in config.fit_settings()}
            if "fit" in state["stages"]
            else {}
        )
        state["configuration"] = {**config.as_dict(), **kept}
    else:
        if folder.state_file.is_file():
            folder.remove_results()
        state = {
            "configuration": config.as_dict(),
            "inputs": {"recording": str(config.recording.absolute()), "fingerprint": fingerprint},
            "stages": {},
        }
    state["software"] = software()
    folder.write_state(state)
    return state


def refuse_other_input(folder: RunFolder, fingerprint: str) -> None:
    """Raise UserError where the run folder was made from a recording with another fingerprint."""
    before = folder.require_state().get("inputs", {}).get("fingerprint")
    if before is not None and before != fingerprint:
        raise UserError(
            f"{folder.root}: made from another input (fingerprint {before[:12]}, the recording now has "
            f"{fingerprint[:12]}); {AGAIN}"
        )


def carve_stage(config: RunConfig) -> Recording:
    """Open the recording, carve every frame that is not carved yet, and record how each went.

    Raises UserError or RecordingError for what the user can cause; a frame that cannot be carved is marked
    "failed" and never stops the others.
    """
    if not 0.5 <= config.voxel_mm <= 100:
        raise UserError(
            f"--voxel-mm {config.voxel_mm:g}: choose a grid spacing between 0.5 and 100 mm; 8 is usual"
        )
    if config.votes < 1 or (config.soft and config.votes > 1):
        raise UserError(
            f"--votes {config.votes}{' --soft' * config.soft}: give 1 or more votes; "
            "soft silhouettes are summed and need none"
        )
    options = config.hull_options()
    recording = open_for(config)
    folder = RunFolder(config.out)
    state = claim(folder, config, recording.fingerprint())
    for note in recording.notes:
        tqdm.write(f"note: {note}", file=sys.stderr)
    if not folder.rig_file.is_file():
        write_atomically(folder.rig_file, recording.rig.save)
    state["recording"] = {
        "name": recording.name,
        "unit": recording.unit,
        "metres_per_unit": recording.metres_per_unit,
        "up": recording.up.tolist(),
        "frame_ids": list(recording.frame_ids),
        "cameras": list(recording.rig.names),
        "notes": list(recording.notes),
    }
    folder.write_state(state)
    known: dict[str, Any] = state["stages"].get("hull", {}).get("frames", {})
    frames = dict(known)
    started = time.perf_counter()
    todo = [k for k in recording.frame_ids if not _carved(folder, k, known)]
    near: Bounds | None = None
    with silhouettes_ahead(partial(recording.silhouettes, soft=options.soft), todo) as ahead:
        for silhouettes in tqdm(ahead, total=len(todo), desc="carve", unit="frame", disable=not todo):
            carved, near = carve_frame(
                recording, folder, silhouettes, config.voxel_mm, near, options, config.colours
            )
            frames[f"{carved.frame_id:06d}"] = carved.as_dict()
            folder.update_stage("hull", frames=frames)
    if todo:
        folder.update_stage(
            "hull", seconds=round(time.perf_counter() - started, 2), carved=len(todo), frames=frames
        )
    for frame_id, sentence in compare_volumes(frames, len(recording.rig)):
        tqdm.write(f"warning: frame {frame_id}: {sentence}", file=sys.stderr)
    folder.update_stage("hull", frames=frames)
    for sentence in often_at_fault(frames):
        tqdm.write(f"warning: {sentence}", file=sys.stderr)
    failed = [k for k in recording.frame_ids if frames[f"{k:06d}"]["status"] == "failed"]
    if len(failed) == len(recording.frame_ids):
        first = frames[f"{failed[0]:06d}"]["problems"]
        raise UserError(f"no frame of {config.recording} could be carved; frame {failed[0]:06d}: {first[0]}")
    return recording


def often_at_fault(frames: dict[str, Any]) -> list[str]:
    """A sentence for each camera that is at fault in a third of the frames (of run.json) or more: then it is
    the camera, and not the segmentation of a frame."""
    carved = [entry for entry in frames.values() if entry["status"] != "failed"]
    counts = Counter(fault["camera"] for entry in carved for fault in entry.get("faults", []))
    return [
        f"camera {name} contradicts the others in {n} of {len(carved)} frames; look at its calibration"
        for name, n in sorted(counts.items())
        if n >= max(2, OFTEN_SHARE * len(carved))
    ]


def compare_volumes(frames: dict[str, Any], n_cameras: int) -> list[tuple[str, str]]:
    """Mark the frames (of run.json, changed in place) whose hull is far larger or smaller than the others'.

    Two people who touch are one subject to the silhouettes, and what a few cameras wrongly take away nobody
    contradicts; but one person's volume is steady. Returns frames and sentences. Nothing is said of a few
    frames.
    """
    for entry in frames.values():
        kept = [problem for problem in entry["problems"] if COMPARED not in problem]
        if len(kept) < len(entry["problems"]):
            entry["problems"], entry["status"] = kept, entry["status_alone"]
    volumes = {k: entry["volume_m3"] for k, entry in frames.items() if entry["status"] != "failed"}
    if len(volumes) < COMPARED_FROM:
        return []
    median = float(np.median(list(volumes.values())))
    limit = STEADY + LESS_STEADY / n_cameras
    told = []
    for name in sorted(volumes):
        factor = volumes[name] / median
        if not 1 / limit < factor < limit:
            why = "a second person, or somebody's things?" if factor > 1 else "is a part missing?"
            sentence = f"the hull holds {1e3 * volumes[name]:.0f} L, {factor:.0%} {COMPARED}: {why}"
            entry = frames[name]
            entry["status_alone"] = entry["status"]
            entry["problems"], entry["status"] = [*entry["problems"], sentence], "suspect"
            told.append((name, sentence))
    return told


def _carved(folder: RunFolder, frame_id: int, known: dict[str, Any]) -> bool:
    entry = known.get(f"{frame_id:06d}")
    if entry is None:
        return False
    if entry["status"] == "failed":
        return True
    try:
        load_hull(folder.hull(frame_id))
    except (OSError, MeshFileError):
        return False
    return True


def carve_frame(
    recording: Recording,
    folder: RunFolder,
    silhouettes: Silhouettes,
    voxel_mm: float,
    near: Bounds | None,
    options: HullOptions,
    colours: bool = True,
) -> tuple[CarvedFrame, Bounds | None]:
    """Carve one frame and write its hull; a frame that cannot be carved comes back marked.

    `near`: the box around the hull of the frame before, and the second result is that of this one.
    """
    frame_id = silhouettes.frame_id
    for problem in silhouettes.problems:
        tqdm.write(f"warning: {problem}", file=sys.stderr)
    try:
        hull = build_hull(
            recording.rig, silhouettes.images, voxel_m=voxel_mm / 1e3, options=options, near=near
        )
    except HullError as error:
        message = f"frame {frame_id:06d}: {error}"
        tqdm.write(f"warning: {message}", file=sys.stderr)
        folder.hull(frame_id).unlink(missing_ok=True)
        facts_file(folder.hull(frame_id)).unlink(missing_ok=True)
        return CarvedFrame(frame_id, "failed", (*silhouettes.problems, message)), None
    of_a_person = size_mark(hull.volume_m3, sum(image is not None for image in silhouettes.images))
    for sentence in (*of_a_person, *hull.marks, *(fault.sentence() for fault in hull.faults)):
        tqdm.write(f"warning: frame {frame_id:06d}: {sentence}", file=sys.stderr)
    masks = silhouettes.images
    if options.soft:
        masks = tuple(None if image is None else as_mask(image) for image in masks)
    agreement = silhouette_agreement(hull.vertices, hull.faces, recording.rig, masks)
    if colours:
        rgb = vertex_colours(
            hull.vertices,
            hull.faces,
            hull.normals,
            recording.rig.cameras,
            lambda camera_idx: recording.picture(camera_idx, frame_id),
        )
        hull = replace(hull, colours=rgb)
    path = folder.hull(frame_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_hull(path, hull)
    problems = (*silhouettes.problems, *of_a_person, *hull.problems)
    status = "degraded" if silhouettes.problems or hull.faults or hull.marks else "ok"
    if of_a_person or hull.contradiction > WRONG_HULL:
        status = "suspect"
    carved = CarvedFrame(
        frame_id,
        status,
        problems,
        tuple(None if np.isnan(v) else round(float(v), 5) for v in agreement),
        round(hull.volume_m3, 6),
        hull.faults,
    )
    return carved, Bounds(hull.vertices.min(axis=0), hull.vertices.max(axis=0))
