"""A hull in two files: the mesh, `<frame>.ply`, and what every vertex carries, `<frame>.npz` beside it.

The second file names the first by a checksum of its vertices, so that files of two different hulls are not
taken for one when a run was stopped between them. Both appear whole or not at all.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hull.fault_kinds import CameraFault, FaultAction, FaultKind
from hull.mesh_file import MeshFileError, load_colours, load_mesh, load_normals, save_mesh
from hull.visual_hull import Hull

# Whole numbers are small, and slack is not known to a hundredth of a millimetre.
_KINDS = {
    "n_witnesses": np.int16,
    "n_bounding": np.int16,
    "cut_by": np.int16,
    "slack_m": np.float32,
    "is_phantom": bool,
}


def facts_file(path: Path | str) -> Path:
    """The file beside a hull's mesh that holds what its vertices carry."""
    return Path(path).with_suffix(".npz")


def save_hull(path: Path | str, hull: Hull) -> None:
    """Write mesh (`path`, a .ply) and the facts beside it. Slack is rounded to single precision.

    Raises MeshFileError where they cannot be written; a full disk raises OSError.
    """
    path = Path(path)
    save_mesh(path, hull.vertices, hull.faces, normals=hull.normals, colours=hull.colours)
    temporary = path.with_name(f".{os.getpid()}.{path.stem}.npz")
    try:
        with temporary.open("wb") as stream:
            np.savez_compressed(
                stream,
                checksum=np.int64(_checksum(hull.vertices)),
                problems=np.array(json.dumps(list(hull.problems))),
                marks=np.array(json.dumps(list(hull.marks))),
                faults=np.array(json.dumps([asdict(fault) for fault in hull.faults])),
                **{name: getattr(hull, name).astype(kind) for name, kind in _KINDS.items()},
            )
        temporary.replace(facts_file(path))
    finally:
        temporary.unlink(missing_ok=True)


def load_hull(path: Path | str) -> Hull:
    """The hull whose mesh is `path`. Raises MeshFileError: either file is missing, damaged or not the
    other's.
    """
    path = Path(path)
    vertices, faces = load_mesh(path)
    normals = load_normals(path)
    if normals is None:
        raise MeshFileError(f"{path} holds no normals; it is not a hull that bodyhull wrote")
    beside = facts_file(path)
    try:
        # numpy leaves a file that it opened itself open when the archive is damaged
        with beside.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
        problems = tuple(json.loads(str(found["problems"])))
        marks = tuple(json.loads(str(found["marks"])))
        faults = tuple(_fault(values) for values in json.loads(str(found["faults"])))
        checksum = int(found["checksum"])
        facts = {name: found[name] for name in _KINDS}
    except FileNotFoundError as error:
        raise MeshFileError(f"{path} lacks {beside.name} beside it; carve the frame again") from error
    except (OSError, KeyError, ValueError, EOFError, TypeError, zlib.error, zipfile.BadZipFile) as error:
        raise MeshFileError(f"{beside} is damaged ({error}); carve the frame again") from error
    if checksum != _checksum(vertices) or any(len(fact) != len(vertices) for fact in facts.values()):
        raise MeshFileError(f"{beside} belongs to another mesh than {path.name}; carve the frame again")
    return Hull(
        vertices=vertices,
        faces=faces,
        normals=normals,
        n_witnesses=facts["n_witnesses"].astype(np.int64),
        n_bounding=facts["n_bounding"].astype(np.int64),
        cut_by=facts["cut_by"].astype(np.int64),
        slack_m=facts["slack_m"].astype(np.float64),
        is_phantom=facts["is_phantom"].astype(bool),
        colours=load_colours(path),
        problems=problems,
        faults=faults,
        marks=marks,
    )


def _fault(values: dict[str, Any]) -> CameraFault:
    moved = values["moved_px"]
    given = values | {"kind": FaultKind(values["kind"]), "action": FaultAction(values["action"])}
    return CameraFault(**(given | {"moved_px": None if moved is None else tuple(moved)}))


def _checksum(vertices: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(vertices, dtype="<f8").tobytes())
