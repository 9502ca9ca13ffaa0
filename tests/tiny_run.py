"""A small recording taken through all stages: 8 cameras of 256 x 256 pixels, 4 frames, 2 damaged."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from bodyhull.cli import run
from bodyhull.config import RunConfig
from bodyhull.folder import RunFolder
from fit.body.model import load_body
from fit.settings import FitSettings
from render.synthetic import film

N_CAMERAS, SIZE, VOXEL_MM = 8, 256, 12.0
GOOD, DEGRADED, FAILED = (0, 1), 2, 3
#: The camera that has no silhouette in the degraded frame.
BLIND = 5
#: Coarser and shorter than the usual fit, but every stage of it.
SETTINGS = replace(FitSettings(), n_points=4000, max_iterations=6)


@dataclass(frozen=True)
class TinyRun:
    """recording: folder; config: of the run; code: what `run` returned; made_times: of its files then."""

    recording: Path
    config: RunConfig
    code: int
    made_times: dict[str, int]

    @property
    def folder(self) -> RunFolder:
        """The run's paths."""
        return RunFolder(self.config.out)

    @property
    def truth(self) -> Path:
        """Folder of the true body."""
        return self.recording / "truth"

    def times(self) -> dict[str, int]:
        """When every file of the run was last written."""
        return times(self.config.out)

    def copy(self, place: Path) -> RunConfig:
        """A copy of the finished run that a test may change; its recording is still the shared one."""
        shutil.copytree(self.config.out, place)
        return replace(self.config, out=place)


def times(root: Path) -> dict[str, int]:
    """Path below root -> time of the last change, ns."""
    return {str(p.relative_to(root)): p.stat().st_mtime_ns for p in sorted(root.rglob("*")) if p.is_file()}


def silhouette(recording: Path, camera_idx: int, frame_id: int) -> Path:
    """File of one silhouette."""
    return recording / "SilhouettesPictures" / f"cam-{camera_idx:03d}" / f"silh_{frame_id:06d}.png"


def make_tiny_run(root: Path) -> TinyRun:
    """Film, damage two frames, run."""
    recording = root / "recording"
    film(
        recording,
        body=load_body("free:neutral", show_progress=False),
        n_cameras=N_CAMERAS,
        size=(SIZE, SIZE),
        n_frames=4,
        garment="tshirt-shorts",
        seed=3,
        progress=False,
    )
    silhouette(recording, BLIND, DEGRADED).unlink()
    for camera_idx in range(N_CAMERAS):
        cv2.imwrite(str(silhouette(recording, camera_idx, FAILED)), np.zeros((SIZE, SIZE), np.uint8))
    config = RunConfig(recording, root / "run", voxel_mm=VOXEL_MM)
    code = run(config, SETTINGS)
    return TinyRun(recording, config, code, times(config.out))
