"""Scans in files: every format gives the same points, clouds get outward normals, labels and errors are
told."""

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from hull.errors import ScanError
from hull.mesh_file import MeshFileError, save_mesh
from hull.scan_files import fingerprint_of, list_scans, read_scan


def ball(n_rings: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A long ball: vertices, outward faces."""
    mesh = o3d.geometry.TriangleMesh.create_sphere(0.5, n_rings)
    return np.asarray(mesh.vertices) * [0.4, 0.3, 1.7], np.asarray(mesh.triangles).astype(np.int64)


def outwardness(points: np.ndarray, normals: np.ndarray) -> float:
    """Share of normals that leave the ball."""
    return float(((points / [0.16, 0.09, 2.89] * normals).sum(1) > 0).mean())


@pytest.mark.parametrize("ending", [".ply", ".obj", ".off", ".npz"])
def test_every_format_gives_the_same_surface(ending: str, tmp_path: Path) -> None:
    vertices, faces = ball()
    path = tmp_path / f"walk.000012{ending}"
    if ending == ".npz":
        np.savez(path, vertices=vertices, faces=faces)
    else:
        save_mesh(path, vertices, faces)
    scan = read_scan(path)
    assert list(list_scans(tmp_path)) == [12]
    assert scan.faces is not None and np.abs(scan.vertices - vertices).max() < 1e-5
    points = scan.sampled(500).points
    assert np.abs(np.linalg.norm(points / [0.2, 0.15, 0.85], axis=1) - 1.0).max() < 0.02
    assert np.array_equal(points, scan.sampled(500).points), "the same seed gives the same points"
    assert outwardness(scan.vertices, scan.normals) == 1.0


def test_inward_faces_are_turned(tmp_path: Path) -> None:
    vertices, faces = ball()
    save_mesh(tmp_path / "a0.ply", vertices, faces[:, ::-1])
    scan = read_scan(tmp_path / "a0.ply")
    assert outwardness(scan.vertices, scan.normals) == 1.0
    assert outwardness(scan.sampled(300).points, scan.sampled(300).normals) == 1.0


@pytest.mark.parametrize("ending", [".ply", ".npz"])
def test_a_point_cloud_gets_outward_normals_and_even_weights(ending: str, tmp_path: Path) -> None:
    vertices, _ = ball(50)
    points = vertices[np.unique(np.round(vertices, 6), axis=0, return_index=True)[1]]
    path = tmp_path / f"c7{ending}"
    if ending == ".npz":
        np.savez(path, points=points)
    else:
        o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    scan = read_scan(path)
    assert scan.faces is None and outwardness(scan.vertices, scan.normals) > 0.98
    sampled = scan.sampled(1000)
    assert len(sampled.points) == 1000 and sampled.weight.mean() == pytest.approx(1.0)
    # The poles of the ball are crowded: each point there stands for less area.
    pole = np.abs(sampled.points[:, 2]) > 0.84
    assert sampled.weight[pole].mean() < 0.7 * sampled.weight[~pole].mean()


@pytest.mark.parametrize("ending", [".npy", ".txt", ".npz"])
def test_labels_beside_the_scan_or_in_a_folder(ending: str, tmp_path: Path) -> None:
    vertices, faces = ball()
    save_mesh(tmp_path / "a3.ply", vertices, faces)
    assert read_scan(tmp_path / "a3.ply").is_skin is None
    top = vertices[:, 2] > 0
    elsewhere = tmp_path / "labels"
    elsewhere.mkdir()
    before = fingerprint_of([tmp_path / "a3.ply"])
    for file, folder in ((elsewhere / f"a3{ending}", elsewhere), (tmp_path / f"a3.labels{ending}", None)):
        if ending == ".txt":
            np.savetxt(file, top.astype(int), fmt="%d")
        elif ending == ".npy":
            np.save(file, top)
        else:
            np.savez(file, labels=top.astype(np.uint8))
        scan = read_scan(tmp_path / "a3.ply", folder)
        assert scan.is_skin is not None and np.array_equal(scan.is_skin, top)
        sampled = scan.sampled(400)
        clear = np.abs(sampled.points[:, 2]) > 0.1
        assert np.array_equal(sampled.is_skin[clear], sampled.points[clear, 2] > 0)
    assert fingerprint_of([tmp_path / "a3.ply"]) != before, "labels are part of the input"


def test_errors_name_the_file_and_what_to_do(tmp_path: Path) -> None:
    vertices, faces = ball()
    with pytest.raises(ScanError, match="there is no such folder of scans"):
        list_scans(tmp_path / "nowhere")
    with pytest.raises(ScanError, match="holds no scans; put one"):
        list_scans(tmp_path)
    save_mesh(tmp_path / "a.ply", vertices, faces)
    with pytest.raises(ScanError, match=r"its name holds no frame number; call it a\.000000\.ply"):
        list_scans(tmp_path)
    (tmp_path / "a.ply").rename(tmp_path / "a_001.ply")
    np.savez(tmp_path / "b1.npz", vertices=vertices)
    with pytest.raises(ScanError, match=r"frame 1 is there twice, a_001\.ply and b1\.npz"):
        list_scans(tmp_path)
    np.savez(tmp_path / "b1.npz", faces=faces)
    with pytest.raises(ScanError, match="lacks `vertices`"):
        read_scan(tmp_path / "b1.npz")
    np.savez(tmp_path / "b1.npz", vertices=vertices[:50])
    with pytest.raises(ScanError, match="100 points or more"):
        read_scan(tmp_path / "b1.npz")
    np.save(tmp_path / "a_001.labels.npy", np.zeros(7))
    with pytest.raises(ScanError, match=rf"holds 7 labels for {len(vertices)} vertices"):
        read_scan(tmp_path / "a_001.ply")
    np.save(tmp_path / "a_001.labels.npy", np.full(len(vertices), 3))
    with pytest.raises(ScanError, match="labels are 1 for skin and 0 for cloth; found"):
        read_scan(tmp_path / "a_001.ply")
    content = (tmp_path / "a_001.ply").read_bytes()
    (tmp_path / "a_001.ply").write_bytes(content[: len(content) // 2])
    with pytest.raises(MeshFileError, match="cut short"):
        read_scan(tmp_path / "a_001.ply")
