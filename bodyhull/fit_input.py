"""What a run is fitted to: hulls that were carved in its folder, or scans that lie elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from bodyhull.config import LABEL_CHOICES, RunConfig, digest
from bodyhull.errors import UserError
from bodyhull.folder import RunFolder
from capture.frame_choice import choose_frames
from fit.closest import Container
from fit.frames import recording_from_body, scan_in_body_frame
from hull.errors import HullError, ScanError
from hull.hull_file import load_hull
from hull.mesh_file import MeshFileError, load_mesh
from hull.scan import Scan
from hull.scan_files import ScanFile, fingerprint_of, list_scans, read_labels, read_scan

#: So many frames, spread over the sequence, settle unit and up axis.
WORLD_FRAMES = 5
WORLD_POINTS = 4000


@dataclass
class HullInput:
    """The hulls of a carved run."""

    folder: RunFolder
    labels: Path | None
    by_colour: bool
    all_ids: list[int]
    frame_ids: list[int]
    failed: dict[int, str]
    print: str
    world_from_body: np.ndarray

    def scan(self, frame_id: int, n_points: int, seed: int) -> Scan:
        """Points of the hull."""
        path = self.folder.hull(frame_id)
        hull = load_hull(path)
        is_skin = None if self.labels is None else read_labels(path, len(hull.vertices), self.labels)
        scan = scan_in_body_frame(Scan.from_hull(hull, n_points, seed, is_skin), self.world_from_body)
        return scan if self.by_colour else replace(scan, colours=None)

    def container(self, frame_id: int) -> Container:
        """The hull: it contains the person by construction."""
        vertices, faces = load_mesh(self.folder.hull(frame_id))
        return Container.of(vertices @ self.world_from_body[:3, :3], faces)


@dataclass
class FilesInput:
    """Scan files, whose unit and up axis run.json knows."""

    files: dict[int, Path]
    labels: Path | None
    metres_per_unit: float
    all_ids: list[int]
    frame_ids: list[int]
    failed: dict[int, str]
    print: str
    world_from_body: np.ndarray

    def scan(self, frame_id: int, n_points: int, seed: int) -> Scan:
        """Points of the scan."""
        found = read_scan(self.files[frame_id], self.labels).scaled(self.metres_per_unit)
        return scan_in_body_frame(found.sampled(n_points, seed), self.world_from_body)

    def container(self, frame_id: int) -> None:
        """Scans have holes: nothing is known to contain the person."""


#: Scans of a run in the body's frame. all_ids: every frame; frame_ids: those that can be fitted; failed: why
#: not, of the others; print: changes when the scans do.
FitInput = HullInput | FilesInput


def is_of_scans(state: dict[str, Any]) -> bool:
    """Whether a run was made from scans instead of silhouettes."""
    return bool(state.get("inputs", {}).get("kind") == "scans")


def labels_folder(config: RunConfig) -> Path | None:
    """The folder that --labels names, if it names one. Raises UserError where there is none."""
    if config.labels in LABEL_CHOICES:
        return None
    folder = Path(config.labels)
    if not folder.is_dir():
        raise UserError(
            f"--labels {config.labels}: give auto, colour, none, or a folder of label files; there "
            f"is none there"
        )
    return folder


def input_of(config: RunConfig) -> FitInput:
    """The scans or hulls of a run folder. Raises UserError where there are none, or where they have
    changed."""
    folder = RunFolder(config.out)
    state = folder.require_state()
    labels = labels_folder(config)
    recording = state.get("recording", {})
    if is_of_scans(state):
        files = _chosen(Path(state["inputs"]["recording"]), config.frames)
        _refuse_other_scans(folder, state, fingerprint_of(list(files.values())))
        return FilesInput(
            files,
            labels,
            float(recording["metres_per_unit"]),
            list(files),
            list(files),
            {},
            digest([state["inputs"]["fingerprint"], _labels_print(labels)]),
            recording_from_body(np.asarray(recording["up"])),
        )
    hulls = state.get("stages", {}).get("hull", {}).get("frames", {})
    if not recording or not hulls:
        raise UserError(
            f"{folder.root}: there are no hulls to fit; run: bodyhull carve RECORDING --out {folder.root}"
        )
    if any(f"{k:06d}" not in hulls for k in recording["frame_ids"]):
        raise UserError(
            f"{folder.root}: only {len(hulls)} of {len(recording['frame_ids'])} frames are carved; "
            f"finish them first: bodyhull carve RECORDING --out {folder.root}"
        )
    frame_ids = [k for k in recording["frame_ids"] if hulls[f"{k:06d}"]["status"] != "failed"]
    if not frame_ids:
        raise UserError(f"{folder.root}: every frame's hull failed, so there is nothing to fit")
    volumes = {f: hulls[f]["volume_m3"] for f in sorted(hulls)}
    return HullInput(
        folder,
        labels,
        config.labels == "colour",
        recording["frame_ids"],
        frame_ids,
        {int(k): entry["problems"][-1] for k, entry in hulls.items() if entry["status"] == "failed"},
        digest([volumes, _labels_print(labels)]) if labels else digest(volumes),
        recording_from_body(np.asarray(recording["up"])),
    )


def read_frames(source: FitInput, n_points: int, seed: int) -> dict[int, Scan]:
    """All frames that can be read; those that cannot move to `source.failed`. Raises UserError if none
    can."""
    scans: dict[int, Scan] = {}
    for k in tqdm(list(source.frame_ids), desc="read scans", unit="frame", leave=False):
        try:
            scans[k] = source.scan(k, n_points, seed)
        except (ScanError, MeshFileError) as error:
            if isinstance(source, HullInput):
                raise
            source.failed[k] = f"frame {k:06d}: {error}"
    source.frame_ids = list(scans)
    if not scans:
        raise UserError(f"no scan can be read; {next(iter(source.failed.values()))}")
    return scans


def scan_stage(config: RunConfig) -> None:
    """Bind a run folder to a folder of scans: unit, up axis and fingerprint go to run.json.

    Raises UserError or ScanError: no scans, no person's size, or a folder that holds another run.
    """
    from bodyhull.carving import AGAIN, software

    if config.units not in ("auto", "m", "cm", "mm"):
        raise UserError(f"--units {config.units}: choose auto, m, cm or mm")
    labels_folder(config)
    files = _chosen(config.recording, config.frames)
    folder = RunFolder(config.out)
    fingerprint = fingerprint_of(list(files.values()))
    state: dict[str, Any] = {} if config.overwrite else folder.read_state()
    if state:
        if not is_of_scans(state):
            raise UserError(f"{folder.root}: holds a run made from silhouettes; {AGAIN}")
        _refuse_other_scans(folder, state, fingerprint)
        before = state["configuration"]
        for name in ("units", "up"):
            if before[name] != getattr(config, name):
                raise UserError(
                    f"{folder.root}: made with other settings ({name} was {before[name]!r}, now "
                    f"{getattr(config, name)!r}); {AGAIN}"
                )
        return
    if folder.state_file.is_file():
        folder.remove_results()
    world, notes = _world(config, files)
    for note in notes:
        tqdm.write(f"note: {note}", file=sys.stderr)
    folder.root.mkdir(parents=True, exist_ok=True)
    folder.write_state(
        {
            "configuration": config.as_dict(),
            "inputs": {
                "kind": "scans",
                "recording": str(config.recording.absolute()),
                "fingerprint": fingerprint,
            },
            "recording": {
                "name": config.recording.resolve().name,
                **world,
                "frame_ids": list(files),
                "cameras": [],
                "notes": list(notes),
            },
            "stages": {},
            "software": software(),
        }
    )


def _world(config: RunConfig, files: dict[int, Path]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Unit and up axis, from some frames and the body."""
    from capture.world import UP_AXES
    from fit.body.model import load_body
    from fit.body.pose_prior import PosePrior
    from fit.initialise import PoseFinder
    from fit.upright import settle_world

    frames = list(files)
    spread = sorted(
        {frames[i] for i in np.linspace(0, len(frames) - 1, min(WORLD_FRAMES, len(frames))).astype(int)}
    )
    points, problem = [], None
    for found in _readable([files[k] for k in spread] + [files[k] for k in frames if k not in spread]):
        if isinstance(found, ScanFile):
            scan = found.sampled(WORLD_POINTS)
            points.append((scan.points, scan.normals))
        else:
            problem = found
        if len(points) == len(spread):
            break
    if not points:
        raise UserError(f"{config.recording}: no scan can be read; {problem}")
    finder = PoseFinder.of(load_body(config.body), PosePrior.standard())
    try:
        world = settle_world(finder, points, config.units, config.up)
    except ValueError as error:
        raise UserError(f"{config.recording}: {error}") from error
    facts = {"unit": world.unit, "metres_per_unit": world.metres_per_unit, "up": UP_AXES[world.up].tolist()}
    return facts, world.notes


def _readable(files: Iterable[Path]) -> Iterable[ScanFile | Exception]:
    for path in files:
        try:
            yield read_scan(path)
        except (HullError, MeshFileError) as error:
            yield error


def _chosen(folder: Path, frames: str | None) -> dict[int, Path]:
    files = list_scans(folder)
    if frames is None:
        return files
    return {k: files[k] for k in choose_frames(tuple(files), frames)}


def _labels_print(folder: Path | None) -> str | None:
    if folder is None:
        return None
    return digest(
        [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in sorted(folder.iterdir()) if p.is_file()]
    )


def _refuse_other_scans(folder: RunFolder, state: dict[str, Any], fingerprint: str) -> None:
    before = state["inputs"]["fingerprint"]
    if before != fingerprint:
        raise UserError(
            f"{folder.root}: made from other scans (fingerprint {before[:12]}, now {fingerprint[:12]}); "
            "run with --overwrite to redo it, or choose another --out"
        )
