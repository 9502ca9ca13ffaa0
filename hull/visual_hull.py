"""One frame's visual hull: silhouettes in, a closed surface out.

The paper's scans for the INRIA recordings are such hulls (section 5.1); here they are made from the
silhouettes themselves: tables, box, adaptive carving, marching cubes, exact crossings, cleaning.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Camera
from hull.bounds import Bounds, bounds_from_tables
from hull.carve import Grid, carve
from hull.cleaning import is_closed, keep_what_matters, vertex_normals
from hull.culling import Culling
from hull.diagnosis import why_empty
from hull.errors import HullError
from hull.ridges import raise_ridges
from hull.surface import binary_surface, cross_exactly
from hull.tables import NO_EVIDENCE, prepare_tables
from hull.witnesses import witness_rule

__all__ = ["Hull", "HullError", "build_hull"]


@dataclass(frozen=True, eq=False)
class Hull:
    """A closed surface around everything the silhouettes allow.

    Fields
    ------
    vertices : (V 3), world metres.
    faces : (F 3), vertex indices; counter-clockwise seen from outside, every edge in two faces.
    normals : (V 3), unit, outward.
    n_witnesses : (V,), how many cameras give evidence at the vertex.
    problems : one sentence each about what had to be left out or decided.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    n_witnesses: Int[np.ndarray, " v"]
    problems: tuple[str, ...] = ()

    @property
    def volume_m3(self) -> float:
        a, b, c = (self.vertices[self.faces[:, k]] - self.vertices.mean(axis=0) for k in range(3))
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


def build_hull(
    rig: Iterable[Camera],
    images: Sequence[np.ndarray | None],
    voxel_m: float = 0.008,
    bounds: Bounds | None = None,
) -> Hull:
    """The visual hull of one frame.

    rig : C pinhole cameras, metres (distortion is not looked at: silhouettes are undistorted).
    images : per camera (h w) uint8 (255 person, 0 background, 128 unknown) or None (no evidence).
    voxel_m : grid pitch. The surface is about four times as accurate; thinner parts than this may be lost.
    bounds : where to look; found from the silhouettes if None.

    Raises HullError: fewer than two silhouettes, a silhouette of another size than its camera's, or an empty
    hull, naming the cameras at fault.
    """
    if not voxel_m > 0:
        raise HullError(f"voxel_m is {voxel_m}; it must be a positive length in metres, such as 0.008")
    tables = prepare_tables(rig, images)
    if bounds is None:
        bounds = bounds_from_tables(tables)
    grid = grid_over(bounds, voxel_m)
    rule = witness_rule(tables, bounds.centre)
    blocks = carve(tables, rule, grid)
    if not blocks.n_voxels:
        raise HullError(why_empty(tables, rule, bounds.low, bounds.high))
    surface = binary_surface(blocks)
    culling = Culling(tables, grid)
    crossings = cross_exactly(surface, grid, tables, culling)
    crossings, faces = raise_ridges(
        crossings,
        surface.faces,
        vertex_normals(crossings.vertices, surface.faces),
        tables,
        voxel_m,
        culling,
    )
    vertices, faces, problems = keep_what_matters(crossings.vertices, faces, tables)
    assert is_closed(faces, len(vertices)), "the hull's surface is not closed"
    return Hull(
        vertices=vertices,
        faces=faces,
        normals=vertex_normals(vertices, faces),
        n_witnesses=_n_witnesses(culling, vertices),
        problems=problems + _touching(blocks.span(), grid),
    )


def grid_over(bounds: Bounds, voxel_m: float) -> Grid:
    """The grid that covers the box, on whole multiples of `voxel_m`: all frames share grid points."""
    first = np.floor(bounds.low / voxel_m)
    end = np.ceil(bounds.high / voxel_m)
    nx, ny, nz = (int(n) for n in end - first)
    if nx * ny * nz > 2**40:
        raise HullError(
            f"the box of {np.round(bounds.size_m, 1).tolist()} m at {voxel_m * 1000:g} mm has "
            f"{nx} x {ny} x {nz} voxels; are the cameras in metres? Give a larger voxel or smaller bounds"
        )
    return Grid(first * voxel_m, voxel_m, (nx, ny, nz))


def _n_witnesses(culling: Culling, vertices: Float[np.ndarray, "v 3"]) -> Int[np.ndarray, " v"]:
    count = np.zeros(len(vertices), dtype=np.int64)
    blocks = culling.blocks_of(vertices.T)
    for table_idx, table in enumerate(culling.tables):
        seen, unsure = culling.evidence(table_idx, blocks)
        seen[unsure] = table.ask_points(vertices[unsure].T) != NO_EVIDENCE
        count += seen
    return count


def _touching(span: tuple[np.ndarray, np.ndarray], grid: Grid) -> tuple[str, ...]:
    first, end = span
    if (first <= 0).any() or (end >= np.array(grid.shape)).any():
        return ("the hull reaches the end of the box it was carved in and is cut off there",)
    return ()
