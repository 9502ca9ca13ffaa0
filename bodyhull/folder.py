"""The run folder: where every stage writes, and `run.json`, which remembers what has been done with what.

Every file is written under a temporary name in its own folder and then renamed, so that a killed run leaves
no half file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodyhull.errors import UserError

#: Every file that a stage may leave in a run folder, besides run.json.
OWN_FILES = (
    "capture/rig.json",
    "hull/[0-9][0-9][0-9][0-9][0-9][0-9]*.ply",
    "hull/[0-9][0-9][0-9][0-9][0-9][0-9]*.npz",
    "fit/alignments/*.npz",
    "fit/skin.npz",
    "fit/fusion.npz",
    "fit/fusion.ply",
    "fit/track.npz",
    "fit/meshes/[0-9][0-9][0-9][0-9][0-9][0-9]*.ply",
    "render/overlay/*.mp4",
    "render/report.html",
    "evaluate/errors.json",
)


@dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    root: Path

    @property
    def state_file(self) -> Path:
        """run.json"""
        return self.root / "run.json"

    @property
    def rig_file(self) -> Path:
        """The cameras that silhouettes and pictures were seen by: pinholes, metres."""
        return self.root / "capture" / "rig.json"

    def hull(self, frame_id: int) -> Path:
        """Visual hull of a frame."""
        return self.root / "hull" / f"{frame_id:06d}.ply"

    def alignment(self, frame_id: int) -> Path:
        """Cloth alignment of a frame."""
        return self.root / "fit" / "alignments" / f"{frame_id:06d}.npz"

    @property
    def skin(self) -> Path:
        """Which vertices of the alignments are bare, where that is known."""
        return self.root / "fit" / "skin.npz"

    @property
    def fusion_mesh(self) -> Path:
        """The fusion shape in the zero pose, turned to the recording's up axis."""
        return self.root / "fit" / "fusion.ply"

    @property
    def fusion(self) -> Path:
        """The fusion shape with betas, joints, spread."""
        return self.root / "fit" / "fusion.npz"

    @property
    def track(self) -> Path:
        """Pose, translation, betas, templates, status a frame."""
        return self.root / "fit" / "track.npz"

    def mesh(self, frame_id: int) -> Path:
        """Posed naked body with detail, recording's world."""
        return self.root / "fit" / "meshes" / f"{frame_id:06d}.ply"

    def overlay(self, camera_name: str) -> Path:
        """Overlay film of a camera."""
        return self.root / "render" / "overlay" / f"{camera_name}.mp4"

    @property
    def report(self) -> Path:
        """The self-contained page."""
        return self.root / "render" / "report.html"

    @property
    def evaluation(self) -> Path:
        """Errors against the truth."""
        return self.root / "evaluate" / "errors.json"

    def read_state(self) -> dict[str, Any]:
        """Contents of run.json; empty if there is none yet."""
        try:
            state = json.loads(self.state_file.read_text())
            if not isinstance(state, dict):
                raise ValueError(f"a {type(state).__name__} where an object is due")
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            raise UserError(
                f"{self.state_file}: cannot be read ({error}); choose another --out or use --overwrite"
            ) from error
        return state

    def require_state(self) -> dict[str, Any]:
        """Contents of run.json, which must exist."""
        state = self.read_state()
        if not state:
            raise UserError(
                f"{self.root}: no run.json there; make the run first: "
                f"bodyhull carve RECORDING --out {self.root}"
            )
        return state

    def stage(self, name: str) -> dict[str, Any]:
        """What run.json knows of a stage; empty before its first run."""
        return self.read_state().get("stages", {}).get(name, {})

    def remove_results(self) -> None:
        """Delete what earlier stages wrote here (only names that bodyhull writes), so that no result outlives
        its input."""
        for pattern in OWN_FILES:
            for path in self.root.glob(pattern):
                path.unlink(missing_ok=True)

    def write_state(self, state: dict[str, Any]) -> None:
        """Write run.json."""
        text = json.dumps(state, indent=1, default=str)
        write_atomically(self.state_file, lambda path: path.write_text(text + "\n"))

    def update_stage(self, stage: str, **facts: object) -> dict[str, Any]:
        """Merge facts into one stage's entry of run.json."""
        state = self.read_state()
        state.setdefault("stages", {}).setdefault(stage, {}).update(facts)
        self.write_state(state)
        return state


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Call `write` on a temporary name beside `path`, then rename; a full disk leaves the old file as it
    was."""
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        temporary.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        temporary.unlink(missing_ok=True)


def save_arrays(path: Path, **arrays: Any) -> None:
    """An .npz of plain arrays, full precision, written atomically."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            np.savez_compressed(stream, allow_pickle=False, **arrays)

    write_atomically(path, write)


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of an .npz, or None where it is missing or damaged (a killed copy, a full disk)."""
    import zipfile

    try:
        # numpy leaves a file that it opened itself open when the archive is damaged
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            return {key: data[key] for key in data.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
