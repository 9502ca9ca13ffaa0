"""The true naked body of a synthetic recording, as evaluation needs it.

One file a sequence, `<sequence>.npz`: vertices (T V 3) m in the recording's world, faces, region (a name a
vertex), outer (on the outside of the body), and optionally frame_ids (T), else frame k is number k.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

#: Regions that a body under clothes is judged by; hands, feet and head are covered by gloves, shoes and hair.
SCORED_REGIONS = ("torso", "arm", "leg", "neck")


class TruthError(ValueError):
    """No usable truth: says what was looked for and where."""


@dataclass(frozen=True)
class Truth:
    """vertices (T V 3) m; faces; region a vertex; outer: the vertex is on the body's outside; frame_ids."""

    vertices: Float[np.ndarray, "t v 3"]
    faces: Int[np.ndarray, "f 3"]
    region: np.ndarray
    outer: Bool[np.ndarray, "v"]
    frame_ids: tuple[int, ...]

    @property
    def scored(self) -> Bool[np.ndarray, "v"]:
        """Vertices that count: outer ones of torso, arms, legs and neck."""
        return self.outer & np.isin(self.region, SCORED_REGIONS)

    def frame(self, frame_id: int) -> Float[np.ndarray, "v 3"] | None:
        """Vertices of a frame number, or None if the truth does not hold it."""
        if frame_id not in self.frame_ids:
            return None
        return self.vertices[self.frame_ids.index(frame_id)]


def load_truth(path: Path, sequence: str = "") -> Truth:
    """Read the truth of a sequence from its file, or from the folder that holds it.

    A folder may hold `<sequence>.npz`, or a single .npz of any name; `truth/` inside it is looked into as
    well.
    """
    path = Path(path)
    if path.is_dir():
        folders = [path, path / "truth"]
        candidates = [f / f"{sequence}.npz" for f in folders if sequence]
        found = [c for c in candidates if c.is_file()]
        if not found:
            found = [f for folder in folders if folder.is_dir() for f in sorted(folder.glob("*.npz"))]
            if len(found) != 1:
                names = ", ".join(f.name for f in found) or "no .npz file"
                raise TruthError(
                    f"{path}: no truth for sequence '{sequence}' (found {names}); "
                    "name the file itself with --truth"
                )
        path = found[0]
    if not path.is_file():
        raise TruthError(f"{path}: no such truth file or folder")
    try:
        # numpy leaves a file that it opened itself open when the archive is damaged
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            missing = [key for key in ("vertices", "faces") if key not in data]
            if missing:
                raise TruthError(f"{path}: the truth file lacks {', '.join(missing)}")
            vertices, faces = np.asarray(data["vertices"], float), np.asarray(data["faces"], np.int64)
            n = vertices.shape[1] if vertices.ndim == 3 else -1
            if vertices.ndim != 3 or vertices.shape[2] != 3 or not np.isfinite(vertices).all():
                raise TruthError(
                    f"{path}: vertices must be finite (frames, vertices, 3), found {vertices.shape}"
                )
            region = np.asarray(data["region"]).astype(str) if "region" in data else np.full(n, "torso")
            outer = np.asarray(data["outer"], bool) if "outer" in data else np.ones(n, dtype=bool)
            frame_ids = data["frame_ids"].tolist() if "frame_ids" in data else list(range(len(vertices)))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, TruthError):
            raise
        raise TruthError(f"{path}: cannot be read as a truth file ({error})") from error
    return Truth(vertices, faces, region, outer, tuple(int(k) for k in frame_ids))


@dataclass(frozen=True)
class ShapeTruth:
    """A person's shape without a pose: template (V 3) m in the zero pose, joints (J 3), and whose body's
    vertices they are (content hash)."""

    template: Float[np.ndarray, "v 3"]
    joints: Float[np.ndarray, "j 3"]
    body_hash: str


def load_shape_truth(path: Path) -> ShapeTruth | None:
    """The shape that `bodyhull ground-truth` wrote, or None where the file holds posed bodies or is no such
    file."""
    path = Path(path)
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            if "vertices" in data or not {"template", "joints", "body_hash"} <= set(data.files):
                return None
            return ShapeTruth(data["template"], data["joints"], str(data["body_hash"]))
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
