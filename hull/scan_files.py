"""Scans in files: one PLY, OBJ, OFF or NPZ a frame, a mesh or a point cloud, with colours and labels where
there are any.

Beside a scan `walk.000012.ply` its labels may lie in `walk.000012.labels.npy`, `.labels.txt` or `.labels.npz`
(array `labels`): one number a vertex, in the file's order, 1 for skin and 0 for cloth, hair or shoes. An NPZ
scan holds `vertices` (or `points`, `pts`), and if it has them `faces`, `normals`, `colours` (or `colors`; 0
to 255, or 0 to 1) and `labels`.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from hull.errors import ScanError
from hull.mesh_file import MeshFileError, require_whole_ply
from hull.scan import Scan, even_samples

MESHES = (".ply", ".obj", ".off")
SCANS = (*MESHES, ".npz")
LABELS = (".npy", ".txt", ".npz")
#: Points of a cloud whose normals are estimated and made to agree: the fit takes fewer.
_CLOUD_POINTS = 40_000
_NEIGHBOURS = 24
#: So much of both ends of a large file stands for its content in the fingerprint.
_PRINTED_BYTES = 1 << 16


@dataclass(frozen=True, eq=False)
class ScanFile:
    """A scan as its file gives it: vertices (V 3), faces (F 3) or None for a cloud, outward unit normals (V
    3), colours (V 3) RGB or None, is_skin (V) or None where nobody labelled it."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"] | None
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"] | None
    is_skin: Bool[np.ndarray, " v"] | None

    def scaled(self, factor: float) -> ScanFile:
        """The same in another unit."""
        return replace(self, vertices=factor * self.vertices)

    def sampled(self, n_points: int, seed: int = 0) -> Scan:
        """A scan of `n_points` points, even in area; of a cloud at most its own points, weighted by the area
        that each stands for. The same file, number and seed give the same points."""
        if self.faces is not None:
            face_idx, barycentric = even_samples(self.vertices, self.faces, n_points, seed)
            corners = self.faces[face_idx]

            def at_points(values: np.ndarray) -> np.ndarray:
                return np.einsum("nk,nk...->n...", barycentric, values[corners].astype(float))

            weight = np.ones(n_points)
        else:
            order = np.random.default_rng(seed).permutation(len(self.vertices))
            chosen = np.sort(order[:n_points])

            def at_points(values: np.ndarray) -> np.ndarray:
                return values[chosen].astype(float)

            points = self.vertices[chosen]
            n_near = min(9, len(points))
            reach = cKDTree(points).query(points, k=n_near)[0][:, -1]
            area = reach**2
            weight = np.clip(area / max(float(np.median(area)), 1e-30), 0.2, 5.0)
            weight = weight / weight.mean()
        normals = at_points(self.normals)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        n = len(weight)
        is_skin = np.zeros(n, dtype=bool) if self.is_skin is None else at_points(self.is_skin) > 0.5
        colours = None if self.colours is None else np.round(at_points(self.colours)).astype(np.uint8)
        return Scan(at_points(self.vertices), normals, None, is_skin, weight, colours)


def list_scans(folder: Path) -> dict[int, Path]:
    """Frame number -> scan file of a folder, in order. The number is the last run of digits in the file's
    name.

    Raises ScanError: no folder, no scans, a name without a number, two files of one frame.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ScanError(f"{folder}: there is no such folder of scans")
    files = [
        p
        for p in sorted(folder.iterdir())
        if p.is_file() and p.suffix.lower() in SCANS and not p.stem.endswith(".labels")
    ]
    if not files:
        raise ScanError(f"{folder}: holds no scans; put one {', '.join(SCANS)} file a frame there")
    out: dict[int, Path] = {}
    for path in files:
        numbers = re.findall(r"\d+", path.stem)
        if not numbers:
            raise ScanError(
                f"{path}: its name holds no frame number; call it {path.stem}.000000{path.suffix}"
            )
        frame_id = int(numbers[-1])
        if frame_id in out:
            raise ScanError(
                f"{folder}: frame {frame_id} is there twice, {out[frame_id].name} and {path.name}"
            )
        out[frame_id] = path
    return dict(sorted(out.items()))


def fingerprint_of(files: list[Path]) -> str:
    """A hash over names, sizes, and both ends of the files' contents, labels beside them included."""
    found = sha256()
    for path in files:
        for file in (path, *(q for q in _labels_beside(path, path.parent) if q.is_file())):
            size = file.stat().st_size
            found.update(f"{file.name} {size};".encode())
            with file.open("rb") as stream:
                found.update(stream.read(_PRINTED_BYTES))
                stream.seek(max(0, size - _PRINTED_BYTES))
                found.update(stream.read(_PRINTED_BYTES))
    return found.hexdigest()


def read_scan(path: Path, labels: Path | None = None) -> ScanFile:
    """One scan in the file's own unit. labels: folder to find its labels in; None: beside the file.

    Normals come from the faces, else from the file, else from the neighbourhood, and are turned outwards.
    Raises ScanError or MeshFileError: unreadable, cut short, too few points, labels that do not fit.
    """
    path = Path(path)
    read = _read_npz if path.suffix.lower() == ".npz" else _read_mesh
    vertices, faces, normals, colours, is_skin = read(path)
    if len(vertices) < 100 or not np.isfinite(vertices).all():
        raise ScanError(f"{path}: a scan needs 100 points or more, all finite; found {len(vertices)}")
    found = read_labels(path, len(vertices), labels)
    is_skin = is_skin if found is None else found
    if faces is not None:
        used = np.unique(faces)
        normals = _normals_of_faces(vertices, faces)
        if _points_inwards(vertices[used], normals[used]):
            faces, normals = faces[:, ::-1].copy(), -normals
        return ScanFile(vertices, faces, normals, colours, is_skin)
    if normals is None:
        keep = np.random.default_rng(0).permutation(len(vertices))[:_CLOUD_POINTS]
        keep.sort()
        vertices = vertices[keep]
        colours = None if colours is None else colours[keep]
        is_skin = None if is_skin is None else is_skin[keep]
        normals = estimated_normals(vertices)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return ScanFile(
        vertices, None, -normals if _points_inwards(vertices, normals) else normals, colours, is_skin
    )


def read_labels(path: Path, n_vertices: int, folder: Path | None = None) -> Bool[np.ndarray, " v"] | None:
    """(V,) true for skin, of the scan or hull in `path`; None where there is no file of labels.

    folder : where to look; there the files may also be called `<name>.npy`, `.txt` or `.npz`.
    """
    where = path.parent if folder is None else folder
    candidates = list(_labels_beside(path, where))
    if folder is not None and where.resolve() != path.parent.resolve():
        candidates += [where / f"{path.stem}{ending}" for ending in LABELS]
    file = next((c for c in candidates if c.is_file()), None)
    if file is None:
        return None
    try:
        if file.suffix == ".txt":
            values = np.loadtxt(file)
        else:
            with file.open("rb") as stream:
                loaded = np.load(stream, allow_pickle=False)
                values = loaded if isinstance(loaded, np.ndarray) else loaded["labels"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ScanError(f"{file}: cannot be read as labels, one number a vertex ({error})") from error
    return _checked_labels(values, n_vertices, file)


def _checked_labels(values: np.ndarray, n_vertices: int, file: Path) -> Bool[np.ndarray, " v"]:
    values = np.asarray(values).reshape(-1)
    if len(values) != n_vertices:
        raise ScanError(f"{file}: holds {len(values)} labels for {n_vertices} vertices")
    if not np.isin(values, (0, 1)).all():
        odd = np.unique(values[~np.isin(values, (0, 1))])[:4].tolist()
        raise ScanError(f"{file}: labels are 1 for skin and 0 for cloth; found {odd}")
    return values.astype(bool)


def _labels_beside(path: Path, folder: Path) -> list[Path]:
    return [folder / f"{path.stem}.labels{ending}" for ending in LABELS]


_Arrays = tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray | None, np.ndarray | None]


def _read_mesh(path: Path) -> _Arrays:
    import open3d as o3d

    if path.suffix.lower() not in MESHES:
        raise ScanError(f"{path}: scans are {', '.join(SCANS)} files")
    if path.suffix.lower() == ".obj":
        return _read_obj(path)
    if path.suffix.lower() == ".ply":
        require_whole_ply(path)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(path)
        faces = np.asarray(mesh.triangles, dtype=np.int64)
        cloud: Any = mesh
        if not len(faces) and path.suffix.lower() == ".ply":
            cloud = o3d.io.read_point_cloud(path)
    is_cloud = cloud is not mesh
    vertices = np.array(cloud.points if is_cloud else mesh.vertices, dtype=float)
    if not len(vertices):
        raise MeshFileError(f"{path} holds no points that can be read; is it cut short?")
    has_normals = cloud.has_normals() if is_cloud else mesh.has_vertex_normals()
    has_colours = cloud.has_colors() if is_cloud else mesh.has_vertex_colors()
    normals = (
        np.array(cloud.normals if is_cloud else mesh.vertex_normals, dtype=float) if has_normals else None
    )
    shades = np.asarray(cloud.colors if is_cloud else mesh.vertex_colors) if has_colours else None
    colours = None if shades is None else np.round(255.0 * shades).astype(np.uint8)
    return vertices, faces if len(faces) else None, normals, colours, None


def _read_obj(path: Path) -> _Arrays:
    """Vertices in the file's order, which labels follow (open3d sorts them by use), and faces as
    triangles."""
    rows: list[list[float]] = []
    faces: list[list[int]] = []
    try:
        for line in path.read_text("ascii", errors="replace").splitlines():
            words = line.split()
            if words[:1] == ["v"]:
                rows.append([float(word) for word in words[1:7]])
            elif words[:1] == ["f"]:
                corners = [int(word.split("/")[0]) for word in words[1:]]
                around = [c - 1 if c > 0 else len(rows) + c for c in corners]
                faces += [[around[0], b, c] for b, c in pairwise(around[1:])]
        values = np.array(rows, dtype=float).reshape(len(rows), -1)
        triangles = np.array(faces, dtype=np.int64).reshape(-1, 3)
    except (OSError, ValueError) as error:
        raise ScanError(f"{path}: cannot be read as a scan ({error})") from error
    if values.shape[1] not in (3, 6) or triangles.max(initial=-1) >= len(values):
        raise ScanError(f"{path}: cannot be read as a scan; is it cut short?")
    colours = values[:, 3:] * (255.0 if values[:, 3:].max(initial=0.0) <= 1.0 else 1.0)
    return (
        values[:, :3],
        triangles if len(triangles) else None,
        None,
        np.clip(np.round(colours), 0, 255).astype(np.uint8) if values.shape[1] == 6 else None,
        None,
    )


def _read_npz(path: Path) -> _Arrays:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            found = {name: data[name] for name in data.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ScanError(f"{path}: cannot be read as a scan ({error})") from error

    def first(*names: str) -> np.ndarray | None:
        return next((found[name] for name in names if name in found), None)

    vertices = first("vertices", "points", "pts")
    if vertices is None or vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ScanError(f"{path}: lacks `vertices` (V, 3); it holds {', '.join(found) or 'nothing'}")
    faces, normals = first("faces"), first("normals")
    colours, labels = first("colours", "colors"), first("labels")
    for name, values in (("normals", normals), ("colours", colours)):
        if values is not None and values.shape != vertices.shape:
            raise ScanError(f"{path}: {name} are {values.shape} for vertices {vertices.shape}")
    if faces is not None and (
        faces.ndim != 2 or faces.shape[1] != 3 or faces.max(initial=0) >= len(vertices)
    ):
        raise ScanError(f"{path}: faces must be (F, 3) numbers of vertices, found {faces.shape}")
    if colours is not None and colours.dtype != np.uint8:
        colours = np.clip(np.round(colours * (255.0 if colours.max() <= 1.0 else 1.0)), 0, 255).astype(
            np.uint8
        )
    return (
        vertices.astype(float),
        None if faces is None or not len(faces) else faces.astype(np.int64),
        None if normals is None else normals.astype(float),
        colours,
        None if labels is None else _checked_labels(labels, len(vertices), path),
    )


def _normals_of_faces(vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "v 3"]:
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = np.stack(
        [
            sum(np.bincount(faces[:, k], across[:, axis], minlength=len(vertices)) for k in range(3))
            for axis in range(3)
        ],
        axis=1,
    )
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-30)


def estimated_normals(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """(N 3) unit normals of a cloud from each point's neighbours, made to agree with one another."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points)))
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
        cloud.orient_normals_consistent_tangent_plane(12)
    return np.asarray(cloud.normals).copy()


def _points_inwards(points: np.ndarray, normals: np.ndarray) -> bool:
    """Whether the outermost points in many directions have normals that point the other way."""
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    stride = max(1, len(points) // 20_000)
    outermost = (points[::stride] @ directions.T).argmax(axis=0)
    return float((normals[::stride][outermost] * directions).sum()) < 0.0
