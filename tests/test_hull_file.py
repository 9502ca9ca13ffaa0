"""A hull in files: what is saved comes back, and files that do not belong together are refused."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from capture.layouts import dome_layout
from hull.fault_kinds import CameraFault, FaultAction, FaultKind
from hull.hull_file import facts_file, load_hull, save_hull
from hull.mesh_file import MeshFileError, save_mesh
from hull.visual_hull import Hull, build_hull
from tests.hull_subjects import ball


@pytest.fixture(scope="module")
def hull() -> Hull:
    rig = dome_layout(6, (96, 96))
    made = build_hull(rig, ball().silhouettes(rig), 0.05)
    colours = np.random.default_rng(0).integers(0, 256, made.vertices.shape).astype(np.uint8)
    faults = (
        CameraFault(2, "cam2", FaultKind.MOVED, FaultAction.LEFT_OUT, 0.1, 0.2, (10.0, -0.5)),
        CameraFault(4, "cam4", FaultKind.PART_MISSING, FaultAction.REGION_UNKNOWN, 1 / 3),
    )
    return replace(made, colours=colours, problems=("one", "two, ünïcode"), faults=faults, marks=("one",))


def test_what_is_saved_comes_back(hull: Hull, tmp_path: Path) -> None:
    save_hull(tmp_path / "000007.ply", hull)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000007.npz", "000007.ply"]
    back = load_hull(tmp_path / "000007.ply")
    for field in fields(Hull):
        wanted, found = getattr(hull, field.name), getattr(back, field.name)
        if field.name == "slack_m":
            wanted = wanted.astype(np.float32)
        assert np.array_equal(found, wanted), field.name
        if isinstance(wanted, np.ndarray):
            assert found.dtype == getattr(hull, field.name).dtype, field.name
    save_hull(tmp_path / "000008.ply", replace(hull, colours=None))
    assert load_hull(tmp_path / "000008.ply").colours is None


def test_a_missing_damaged_or_foreign_half_is_refused(hull: Hull, tmp_path: Path) -> None:
    path = tmp_path / "000000.ply"
    save_hull(path, hull)
    whole = facts_file(path).read_bytes()
    for damage in (whole[: len(whole) // 2], b"", b"PK\x03\x04" + bytes(200)):
        facts_file(path).write_bytes(damage)
        with pytest.raises(MeshFileError, match=r"000000\.npz is damaged .*; carve the frame again"):
            load_hull(path)
    facts_file(path).unlink()
    with pytest.raises(
        MeshFileError, match=r"000000\.ply lacks 000000\.npz beside it; carve the frame again"
    ):
        load_hull(path)
    facts_file(path).write_bytes(whole)
    save_mesh(path, hull.vertices + 1e-6, hull.faces, normals=hull.normals)
    with pytest.raises(MeshFileError, match=r"000000\.npz belongs to another mesh than 000000\.ply"):
        load_hull(path)
    save_mesh(path, hull.vertices, hull.faces)
    with pytest.raises(MeshFileError, match=r"000000\.ply holds no normals"):
        load_hull(path)
