"""Mesh files: what is written is what is read, to the last bit in PLY; whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hull.mesh_file import MeshFileError, load_colours, load_mesh, load_normals, save_mesh


def _mesh(n: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(0)
    vertices = random.normal(size=(n, 3)) * np.pi
    faces = np.array([random.permutation(n)[:3] for _ in range(100)])
    normals = random.normal(size=(n, 3))
    return vertices, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_ply_keeps_every_bit(tmp_path: Path) -> None:
    vertices, faces, normals = _mesh()
    colours = np.random.default_rng(1).integers(0, 256, size=(60, 3)).astype(np.uint8)
    path = tmp_path / "000012.ply"
    save_mesh(path, vertices, faces, normals, colours)
    read_vertices, read_faces = load_mesh(path)
    assert np.array_equal(read_vertices, vertices)
    assert np.array_equal(read_faces, faces)
    read_normals, read_colours = load_normals(path), load_colours(path)
    assert read_normals is not None
    assert read_colours is not None
    assert np.array_equal(read_normals, normals)
    assert np.array_equal(read_colours, colours)
    assert path.read_bytes()[:200].count(b"property double") >= 3


def test_ply_without_extras(tmp_path: Path) -> None:
    vertices, faces, _ = _mesh()
    save_mesh(tmp_path / "a.ply", vertices, faces.astype(np.uint32))
    assert load_normals(tmp_path / "a.ply") is None
    assert load_colours(tmp_path / "a.ply") is None


@pytest.mark.parametrize("ending", [".obj", ".off"])
def test_text_formats_keep_micrometres(tmp_path: Path, ending: str) -> None:
    vertices, faces, _ = _mesh()
    # Other programs' readers may number vertices anew, so each one is used.
    faces = np.concatenate([faces, np.arange(60).reshape(-1, 3)])
    path = tmp_path / f"mesh{ending}"
    save_mesh(path, vertices, faces)
    read_vertices, read_faces = load_mesh(path)
    assert read_vertices[read_faces] == pytest.approx(vertices[faces], abs=1e-5)


def test_writing_again_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    vertices, faces, _ = _mesh()
    path = tmp_path / "mesh.ply"
    save_mesh(path, vertices, faces)
    save_mesh(path, 2 * vertices, faces)
    assert np.array_equal(load_mesh(path)[0], 2 * vertices)
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import open3d as o3d

    vertices, faces, _ = _mesh()
    path = tmp_path / "mesh.ply"
    save_mesh(path, vertices, faces)
    monkeypatch.setattr(o3d.io, "write_triangle_mesh", lambda *a, **k: False)
    with pytest.raises(MeshFileError, match=r"cannot write .*mesh\.ply: is the disk full, or the mesh empty"):
        save_mesh(path, 2 * vertices, faces)
    assert np.array_equal(load_mesh(path)[0], vertices)
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]


def test_errors_say_what_is_wrong(tmp_path: Path) -> None:
    vertices, faces, _ = _mesh()
    with pytest.raises(MeshFileError, match=r"mesh\.xyz: meshes are \.ply, \.obj, \.off files, not \.xyz"):
        save_mesh(tmp_path / "mesh.xyz", vertices, faces)
    with pytest.raises(MeshFileError, match="there is no folder"):
        save_mesh(tmp_path / "nowhere" / "mesh.ply", vertices, faces)
    with pytest.raises(MeshFileError, match="there is no mesh file"):
        load_mesh(tmp_path / "mesh.ply")
    save_mesh(tmp_path / "mesh.ply", vertices, faces)
    whole = (tmp_path / "mesh.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:60])
    with pytest.raises(MeshFileError, match=r"cut\.ply ends before the data that its header announces"):
        load_mesh(tmp_path / "cut.ply")


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95, 0.999])
def test_a_ply_cut_short_is_refused(tmp_path: Path, share: float) -> None:
    vertices, faces, _ = _mesh()
    save_mesh(tmp_path / "mesh.ply", vertices, faces)
    whole = (tmp_path / "mesh.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(MeshFileError, match="is it cut short"):
        load_mesh(tmp_path / "cut.ply")
