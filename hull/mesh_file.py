"""Meshes in files: PLY with double precision, and OBJ or OFF for other programs.

A file appears whole or not at all: it is written under a temporary name in the same folder, then renamed. PLY
keeps every bit of the vertices (and of the normals, if given); OBJ and OFF are text and keep what open3d
prints.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Integer, UInt8

FORMATS = (".ply", ".obj", ".off")

_PLY_BYTES = dict.fromkeys(("char", "uchar", "int8", "uint8"), 1)
_PLY_BYTES |= dict.fromkeys(("short", "ushort", "int16", "uint16"), 2)
_PLY_BYTES |= dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4)
_PLY_BYTES |= dict.fromkeys(("double", "float64"), 8)


class MeshFileError(ValueError):
    """A mesh cannot be read or written: which file, and why."""


def save_mesh(
    path: Path | str,
    vertices: Float[np.ndarray, "v 3"],
    faces: Integer[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"] | None = None,
    colours: UInt8[np.ndarray, "v 3"] | None = None,
) -> None:
    """Write vertices (V 3, metres), faces (F 3), and per vertex unit normals and RGB if given.

    The name's ending says the format: .ply, .obj or .off. The folder must exist. Raises MeshFileError.
    """
    import open3d as o3d

    path = Path(path)
    _check_format(path)
    if not path.parent.is_dir():
        raise MeshFileError(f"cannot write {path}: there is no folder {path.parent}")
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.ascontiguousarray(vertices, dtype=np.float64)),
        o3d.utility.Vector3iVector(np.ascontiguousarray(faces, dtype=np.int32)),
    )
    if normals is not None:
        mesh.vertex_normals = o3d.utility.Vector3dVector(np.ascontiguousarray(normals, dtype=np.float64))
    if colours is not None:
        mesh.vertex_colors = o3d.utility.Vector3dVector(np.asarray(colours, dtype=np.float64) / 255.0)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix.lower(), dir=path.parent)
    os.close(handle)
    part = Path(name)
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            written = o3d.io.write_triangle_mesh(
                part,
                mesh,
                write_ascii=path.suffix.lower() == ".off",
                write_vertex_normals=normals is not None,
                write_vertex_colors=colours is not None,
            )
        if not written:
            raise MeshFileError(
                f"cannot write {path}: is the disk full, or the mesh empty ({len(faces)} faces)?"
            )
        # mkstemp makes files that only the owner may read; results get the permissions of ordinary files.
        part.chmod(0o666 & ~_umask())
        part.replace(path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            part.unlink()


def load_mesh(path: Path | str) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices (V 3, as in the file) and faces (F 3) of a .ply, .obj or .off file. Raises MeshFileError."""
    mesh = _read(Path(path))
    return np.asarray(mesh.vertices, dtype=np.float64).copy(), np.asarray(
        mesh.triangles, dtype=np.int64
    ).copy()


def load_normals(path: Path | str) -> Float[np.ndarray, "v 3"] | None:
    """The file's vertex normals (V 3), or None where it has none. Raises MeshFileError."""
    mesh = _read(Path(path))
    return np.asarray(mesh.vertex_normals, dtype=np.float64).copy() if mesh.has_vertex_normals() else None


def load_colours(path: Path | str) -> UInt8[np.ndarray, "v 3"] | None:
    """The file's vertex colours (V 3) RGB, or None where it has none. Raises MeshFileError."""
    mesh = _read(Path(path))
    if not mesh.has_vertex_colors():
        return None
    return np.round(np.asarray(mesh.vertex_colors) * 255.0).astype(np.uint8)


def _read(path: Path):  # type: ignore[no-untyped-def]  # open3d ships no types
    import open3d as o3d

    _check_format(path)
    if not path.is_file():
        raise MeshFileError(f"there is no mesh file {path}")
    if path.suffix.lower() == ".ply":
        require_whole_ply(path)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(path)
    if not len(mesh.triangles):
        raise MeshFileError(f"{path} holds no triangles that can be read; is it cut short, or a point cloud?")
    if not np.isfinite(np.asarray(mesh.vertices)).all():
        raise MeshFileError(f"{path} holds vertices that are not finite numbers; is it cut short?")
    return mesh


def require_whole_ply(path: Path) -> None:
    """Refuse a PLY file that is shorter than its header promises: open3d silently reads what is there."""
    content = path.read_bytes()
    header, mark, body = content.partition(b"end_header\n")
    if not mark:
        header, mark, body = content.partition(b"end_header\r\n")
    least, n_lines, count = 0, 0, 0
    for line in header.decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            count = int(words[2])
            n_lines += count
        elif words[:2] == ["property", "list"] and len(words) == 5:
            # The shortest list of a mesh is a triangle.
            least += count * (_PLY_BYTES.get(words[2], 0) + 3 * _PLY_BYTES.get(words[3], 0))
        elif words[:1] == ["property"] and len(words) == 3:
            least += count * _PLY_BYTES.get(words[1], 0)
    is_text = b"format ascii" in header
    if not mark or (body.count(b"\n") + 1 < n_lines if is_text else len(body) < least):
        raise MeshFileError(f"{path} ends before the data that its header announces; is it cut short?")


def _check_format(path: Path) -> None:
    if path.suffix.lower() not in FORMATS:
        raise MeshFileError(
            f"{path}: meshes are {', '.join(FORMATS)} files, not {path.suffix or 'without ending'}"
        )


def _umask() -> int:
    # There is no way to read it but to set it; the value set in between is the strictest.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
