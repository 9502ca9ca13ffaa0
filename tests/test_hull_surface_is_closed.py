"""Whatever the voxels, the surface is closed, oriented and the one of marching cubes on the dense volume."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.measure import marching_cubes

from hull.carve import Blocks, Grid
from hull.cleaning import compacted, face_pieces, is_closed, piece_volumes, vertex_normals
from hull.marching import binary_surface
from hull.ridges import split_faces


def _noise(fill: float, seed: int) -> Blocks:
    """Random voxels and random blocks of several sizes."""
    random = np.random.default_rng(seed)
    grid = Grid(np.zeros(3), 1.0, (24, 24, 24))
    voxels = np.stack(np.nonzero(random.random((24, 16, 20)) < fill))
    pairs = np.stack(np.nonzero(random.random((12, 12, 12)) < 0.02))
    # Blocks never overlap in a carve; drop the voxels that would.
    taken = {tuple(cell) for cell in pairs.T}
    keep = [tuple(cell // 2) not in taken for cell in voxels.T]
    return Blocks(grid, (voxels[:, keep], pairs))


@pytest.mark.parametrize("fill", [0.03, 0.2, 0.5, 0.8, 0.97])
def test_closed_and_oriented_for_any_voxels(fill: float) -> None:
    for seed in range(6):
        surface = binary_surface(_noise(fill, seed))
        assert is_closed(surface.faces, len(surface.inner))
        corners = 0.5 * (surface.inner + surface.outer)
        volume = piece_volumes(corners, surface.faces, np.zeros(len(surface.faces), dtype=int))[0]
        assert volume > 0
        assert (np.abs(surface.inner - surface.outer).sum(axis=1) == 1).all()


@pytest.mark.parametrize("fill", [0.02, 0.4, 0.9])
def test_the_triangles_are_those_of_marching_cubes_on_the_dense_volume(fill: float) -> None:
    """Also where bricks are full, and where the hull reaches the grid's end."""
    random = np.random.default_rng(1)
    grid = Grid(np.zeros(3), 1.0, (40, 40, 24))
    places = np.stack(np.unravel_index(random.permutation(3 * 5 * 5)[:30], (5, 5, 3)))
    taken = np.zeros((5, 5, 3), dtype=bool)
    taken[tuple(places)] = True
    voxels = np.stack(np.nonzero(random.random(grid.shape) < fill))
    voxels = voxels[:, ~taken[tuple(voxels // 8)]]
    nothing = np.zeros((3, 0), dtype=int)
    blocks = Blocks(grid, (voxels, nothing, nothing, places))
    found = binary_surface(blocks)
    low, high = np.full(3, -1), np.array(grid.shape) + 1
    vertices, faces, _, _ = marching_cubes(
        blocks.dense(low, high).astype(np.float32), 0.4, gradient_direction="ascent"
    )
    doubled = (
        np.round(2 * np.where(np.abs(vertices % 1) > 1e-3, np.floor(vertices) + 0.5, vertices)) + 2 * low
    )
    assert _triangles(found.inner + found.outer, found.faces) == _triangles(doubled.astype(int), faces)


def _triangles(vertices: np.ndarray, faces: np.ndarray) -> set:
    rows = vertices[faces]
    # A face may start at any of its corners.
    start = np.lexsort((rows[..., 2], rows[..., 1], rows[..., 0]), axis=1)[:, :1]
    turned = np.take_along_axis(rows, ((start + np.arange(3)) % 3)[..., None], axis=1)
    return {tuple(row) for row in turned.reshape(-1, 9).tolist()}


def test_dense_voxels_are_those_of_the_blocks() -> None:
    grid = Grid(np.zeros(3), 1.0, (16, 16, 16))
    blocks = Blocks(grid, (np.array([[1], [2], [3]]), np.array([[2], [2], [2]]), np.array([[2], [0], [1]])))
    first, end = blocks.span()
    assert first.tolist() == [1, 0, 2] or first.tolist() == [1, 0, 3]
    volume = blocks.dense(np.array([-1, -1, -1]), np.array([17, 17, 17]))
    assert volume.sum() == blocks.n_voxels == 1 + 8 + 64
    assert volume[2, 3, 4]
    assert volume[5:7, 5:7, 5:7].all()
    assert volume[9:13, 1:5, 5:9].all()
    assert blocks.dense(first, end).sum() == blocks.n_voxels


def test_splitting_edges_keeps_a_surface_closed_and_its_area() -> None:
    random = np.random.default_rng(0)
    for share in (0.1, 0.5, 1.0):
        surface = binary_surface(_noise(0.5, 1))
        vertices = 0.5 * (surface.inner + surface.outer)
        edges = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
        names, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
        number = np.full(len(names), -1)
        chosen = np.flatnonzero(random.random(len(names)) < share)
        number[chosen] = len(vertices) + np.arange(len(chosen))
        both = np.concatenate([vertices, vertices[names[chosen]].mean(axis=1)])
        faces = split_faces(surface.faces, number[which.ravel()].reshape(3, -1).T)
        assert is_closed(faces, len(both))
        assert _area(both, faces) == pytest.approx(_area(vertices, surface.faces), rel=1e-12)
        old = piece_volumes(vertices, surface.faces, np.zeros(len(surface.faces), dtype=int))
        new = piece_volumes(both, faces, np.zeros(len(faces), dtype=int))
        assert new == pytest.approx(old, rel=1e-9)


def test_is_closed_notices_holes_flips_and_double_edges() -> None:
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    assert is_closed(tetrahedron, 4)
    assert not is_closed(tetrahedron[:3], 4)
    assert not is_closed(np.vstack([tetrahedron[:3], tetrahedron[3, ::-1]]), 4)
    assert not is_closed(np.vstack([tetrahedron, tetrahedron]), 4)
    assert not is_closed(tetrahedron[:0], 4)


def test_pieces_volumes_and_normals_of_cubes() -> None:
    grid = Grid(np.zeros(3), 1.0, (20, 20, 20))
    blocks = Blocks(grid, (np.zeros((3, 0), dtype=int), np.array([[1, 6], [1, 1], [1, 1]])))
    surface = binary_surface(blocks)
    vertices = 0.5 * (surface.inner + surface.outer)
    label = face_pieces(surface.faces, len(vertices))
    assert label.max() == 1
    volumes = piece_volumes(vertices, surface.faces, label)
    assert volumes[0] == pytest.approx(volumes[1])
    assert 4 < volumes[0] < 8  # two voxels a side, corners and edges cut
    used, faces = compacted(surface.faces[label == 0], len(vertices))
    one = vertices[used]
    assert len(one) == len(vertices) // 2
    outward = one - one.mean(axis=0)
    normals = vertex_normals(one, faces)
    assert (np.einsum("vi,vi->v", outward, normals) > 0).all()


def _area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
