"""Marching cubes over the few voxels near a surface, in bricks of eight voxels a side.

A grid over a person at 4 mm holds ten million voxels, of which one in fifty lies at the surface. The carve
knows which: bricks that are full or empty are one number each, only the mixed ones hold voxels. Memory and
time go with the surface. The cases of the 256 cubes are those of skimage's marching cubes (Lewiner et al.
2003), asked once a process, so the triangles are those of `skimage.measure.marching_cubes` on dense voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Int, UInt8

from hull.carve import Blocks
from hull.loops import mesh_loops

# Voxels a brick's side is 2**BRICK_LEVEL.
BRICK_LEVEL = 3
_SIDE = 1 << BRICK_LEVEL
_N_VOXELS = _SIDE**3
# A level below one half makes marching cubes join voxels that touch at an edge, always alike: with exactly
# one half the tables' ties are broken at random and edges with four faces appear.
_LEVEL = 0.4
_EMPTY, _FULL = 0, 1
_OFFSETS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
_STRIDE = np.array([(_SIDE + 1) ** 2, _SIDE + 1, 1])


@dataclass(frozen=True, eq=False)
class GridSurface:
    """A closed surface on the grid: each vertex is the edge between an inside and an outside voxel.

    Fields
    ------
    inner, outer : (V 3) the two neighbouring voxels.
    faces : (F 3) vertex indices, outward.
    """

    inner: Int[np.ndarray, "v 3"]
    outer: Int[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def binary_surface(blocks: Blocks) -> GridSurface:
    """The surface between inside and outside voxels: closed, every edge with two faces."""
    rows, voxels = _bricks(blocks)
    places = _bricks_with_surface(rows)
    # One brick more on the far sides, since each brick's cubes reach a voxel into its neighbours.
    number = np.full(np.array(rows.shape) + 1, -1, dtype=np.int32)
    number[tuple(places)] = np.arange(places.shape[1], dtype=np.int32)
    padded = _with_neighbours(rows, voxels, places)
    neighbours = np.stack([number[tuple(places + offset[:, None])] for offset in _OFFSETS], axis=1)
    loops = mesh_loops()
    if loops is None:
        inner, outer, faces = surface_plainly(padded, places, neighbours, *_cases())
        return GridSurface(inner.T, outer.T, faces)
    n_faces, edges = _cases()
    first = np.empty(len(padded), dtype=np.int64)
    within = np.empty((len(padded), 3, _SIDE, _SIDE, _SIDE), dtype=np.int16)
    cases = np.empty((len(padded), _SIDE, _SIDE, _SIDE), dtype=np.uint8)
    n_all, n_all_faces = loops.number_vertices(padded, n_faces, first, within, cases)
    inner, outer = np.empty((3, n_all), dtype=np.int64), np.empty((3, n_all), dtype=np.int64)
    faces = np.empty((n_all_faces, 3), dtype=np.int64)
    loops.brick_surface(padded, places, neighbours, n_faces, edges, first, within, cases, inner, outer, faces)
    return GridSurface(inner.T, outer.T, faces)


def surface_plainly(
    padded: Bool[np.ndarray, "m s1 s1 s1"],
    places: Int[np.ndarray, "3 m"],
    neighbours: Int[np.ndarray, "m 8"],
    n_faces: Int[np.ndarray, "256"],
    case_edges: UInt8[np.ndarray, "256 most 3"],
) -> tuple[Int[np.ndarray, "3 v"], Int[np.ndarray, "3 v"], Int[np.ndarray, "f 3"]]:
    """Inner and outer voxels of the vertices (3 V), and the faces. `neighbours`: the bricks that begin at
    each corner of a brick."""
    low = padded[:, :-1, :-1, :-1]

    # Vertices: which neighbours along each axis differ, numbered brick by brick.
    differ = np.stack(
        [low != padded[:, 1:, :-1, :-1], low != padded[:, :-1, 1:, :-1], low != padded[:, :-1, :-1, 1:]],
        axis=1,
    ).reshape(len(padded), -1)
    n_in_brick = np.count_nonzero(differ, axis=1)
    n_before = np.cumsum(n_in_brick) - n_in_brick
    at = np.flatnonzero(differ)
    brick = np.repeat(np.arange(len(padded)), n_in_brick)
    within = np.zeros(differ.size, dtype=np.int16)
    within[at] = np.arange(len(at)) - n_before.take(brick)
    local = at - brick * differ.shape[1]
    axis, voxel = local >> (3 * BRICK_LEVEL), local & (_N_VOXELS - 1)
    near = (_SIDE * (places - 1)).take(brick, axis=1) + _COORDINATES_OF_VOXEL.take(voxel, axis=1)
    near_is_inner = np.ascontiguousarray(low).reshape(-1).take(brick * _N_VOXELS + voxel)
    step = np.eye(3, dtype=near.dtype).take(axis, axis=1)
    inner, outer = near + step * ~near_is_inner, near + step * near_is_inner

    # Faces: the case of every cube of eight voxels, and its edges' vertices, which may be a neighbour's.
    case = np.zeros(low.shape, dtype=np.uint8)
    for bit, (x, y, z) in enumerate(_OFFSETS):
        corner = padded[:, x : x + _SIDE, y : y + _SIDE, z : z + _SIDE]
        case |= corner.view(np.uint8) << np.uint8(bit)
    cubes = np.flatnonzero(n_faces.take(case.reshape(-1)))
    of_cube = case.reshape(-1).take(cubes)
    count = n_faces.take(of_cube)
    first = np.cumsum(count) - count
    repeated = np.repeat(np.arange(len(cubes)), count)
    nth = np.arange(len(repeated)) - first.take(repeated)
    edges = case_edges[of_cube.take(repeated), nth]
    in_brick, cube = cubes >> (3 * BRICK_LEVEL), cubes & (_N_VOXELS - 1)
    place = _PLACE_OF_VOXEL.take(cube).take(repeated)[:, None] + _EDGE_PLACE.take(edges)
    owner = neighbours.reshape(-1).take((8 * in_brick).take(repeated)[:, None] + _CARRY.take(place))
    name = owner * np.intp(3 * _N_VOXELS)
    name += _EDGE_AXIS.take(edges) * _N_VOXELS
    name += _WRAPPED.take(place)
    faces = n_before.take(owner) + within.take(name)
    return inner, outer, faces


def _bricks(blocks: Blocks) -> tuple[Int[np.ndarray, "x y z"], Bool[np.ndarray, "n s s s"]]:
    """For each brick of the grid, one empty brick around it, the row of its voxels; and the rows.

    Rows 0 and 1 are the empty and the full brick.
    """
    shape = -(-np.array(blocks.grid.shape) // _SIDE) + 2
    rows = np.full(shape, _EMPTY, dtype=np.int32)
    mixed = []
    for level, cells in enumerate(blocks.cells):
        if level < BRICK_LEVEL:
            mixed.append((cells >> (BRICK_LEVEL - level)) + 1)
        else:
            span = np.arange(1 << (level - BRICK_LEVEL))
            i, j, k = np.meshgrid(span, span, span, indexing="ij")
            cubes = (cells << (level - BRICK_LEVEL)) + 1
            rows[
                cubes[0][:, None] + i.ravel(), cubes[1][:, None] + j.ravel(), cubes[2][:, None] + k.ravel()
            ] = _FULL
    for bricks in mixed:
        rows[tuple(bricks)] = -1
    part = np.nonzero(rows < 0)
    rows[part] = 2 + np.arange(len(part[0]), dtype=np.int32)
    voxels = np.zeros((2 + len(part[0]), _SIDE, _SIDE, _SIDE), dtype=bool)
    voxels[_FULL] = True
    for level, bricks in enumerate(mixed):
        n, side = _SIDE >> level, 1 << level
        i, j, k = blocks.cells[level] & (n - 1)
        view = voxels.reshape(len(voxels), n, side, n, side, n, side)
        view[rows[tuple(bricks)], i, :, j, :, k, :] = True
    return rows, voxels


def _bricks_with_surface(rows: Int[np.ndarray, "x y z"]) -> Int[np.ndarray, "3 n"]:
    """The bricks that may have surface between their voxels or towards their upper neighbours'."""
    kind = np.minimum(rows, 2)
    lowest, highest = kind, kind
    for axis in range(3):
        here = [slice(None)] * 3
        here[axis] = slice(0, -1)
        next_one = [slice(None)] * 3
        next_one[axis] = slice(1, None)
        lowest = np.minimum(lowest[tuple(here)], lowest[tuple(next_one)])
        highest = np.maximum(highest[tuple(here)], highest[tuple(next_one)])
    return np.stack(np.nonzero((lowest != highest) | (highest == 2)))


def _with_neighbours(
    rows: Int[np.ndarray, "x y z"], voxels: Bool[np.ndarray, "n s s s"], places: Int[np.ndarray, "3 m"]
) -> Bool[np.ndarray, "m s1 s1 s1"]:
    """The bricks' voxels, and one layer of those of their upper neighbours."""
    padded = np.empty((places.shape[1], _SIDE + 1, _SIDE + 1, _SIDE + 1), dtype=bool)
    for offset in _OFFSETS:
        of = rows[tuple(places + offset[:, None])]
        source = tuple(slice(0, 1) if o else slice(None) for o in offset)
        target = tuple(slice(_SIDE, None) if o else slice(0, _SIDE) for o in offset)
        padded[(slice(None), *target)] = voxels[(slice(None), *source)][of]
    return padded


@lru_cache(maxsize=1)
def _cases() -> tuple[Int[np.ndarray, "256"], UInt8[np.ndarray, "256 most 3"]]:
    """For each set of inside corners (bits in the order of `_OFFSETS`): the number of faces, and the edges of
    the cube that their corners lie on, outward."""
    from skimage.measure import marching_cubes

    faces_of: list[np.ndarray] = [np.zeros((0, 3), dtype=np.uint8)]
    for case in range(1, 255):
        corners = ((case >> np.arange(8)) & 1).reshape(2, 2, 2).astype(np.float32)
        vertices, faces, _, _ = marching_cubes(corners, _LEVEL, gradient_direction="ascent")
        between = np.abs(vertices - np.round(vertices)) > 1e-3
        assert (between.sum(axis=1) == 1).all(), "marching cubes put a vertex off the cube's edges"
        near = np.where(between, 0, np.round(vertices)).astype(int)
        edge = np.argmax(between, axis=1) * 8 + near @ (4, 2, 1)
        faces_of.append(edge.astype(np.uint8)[faces])
    faces_of.append(faces_of[0])
    count = np.array([len(faces) for faces in faces_of])
    table = np.zeros((256, count.max(), 3), dtype=np.uint8)
    for case, faces in enumerate(faces_of):
        table[case, : len(faces)] = faces
    return count, table


# An edge's number is its axis times 8 plus its lower corner; places are counted in bricks with a layer more.
_EDGE_AXIS = np.repeat(np.arange(3), 8)
_EDGE_PLACE = np.tile(_OFFSETS @ _STRIDE, 3)
_COORDINATES_OF_VOXEL = np.stack(np.unravel_index(np.arange(_N_VOXELS), (_SIDE,) * 3))
_PLACE_OF_VOXEL = _STRIDE @ _COORDINATES_OF_VOXEL
_COORDINATES = np.stack(np.unravel_index(np.arange((_SIDE + 1) ** 3), (_SIDE + 1,) * 3))
_CARRY = (_COORDINATES == _SIDE).T @ np.array([4, 2, 1])
_WRAPPED = (_COORDINATES % _SIDE).T @ np.array([_SIDE**2, _SIDE, 1])
