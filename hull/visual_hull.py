"""One frame's visual hull: silhouettes in, a closed surface out.

The paper's scans for the INRIA recordings are such hulls (section 5.1); here they are made from the
silhouettes themselves: tables, box, adaptive carving, marching cubes, exact crossings, cleaning.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from capture.camera import Camera
from hull.bounds import Bounds, bounds_from_tables
from hull.carve import Grid, carve
from hull.cleaning import is_closed, keep_what_matters, vertex_normals
from hull.culling import Culling
from hull.diagnosis import refuse_inverted, why_empty
from hull.errors import EmptyHullError, HullError
from hull.faults import CameraFault, Carved, settle
from hull.marching import binary_surface
from hull.marks import elsewhere_mark, leaving_mark, one_subject
from hull.rays import RayScene
from hull.refine import refined
from hull.ridges import raise_ridges
from hull.soft import carve_soft, cross_softly
from hull.soft_tables import SoftTable, prepare_soft_tables, sure_mask
from hull.surface import cross_exactly
from hull.tables import SilhouetteTable, prepare_tables
from hull.thin_parts import FINE_ENOUGH_M, with_cameras, with_thin_parts
from hull.vertex_facts import vertex_facts
from hull.witnesses import WitnessRule, witness_rule

__all__ = ["Hull", "HullError", "HullOptions", "build_hull"]


@dataclass(frozen=True)
class HullOptions:
    """Everything that is a choice.

    Fields
    ------
    votes : so many cameras must see background before a place is given up. More than one makes the hull
        indifferent to single wrong silhouettes, and larger: by half a millimetre a vote with 68 cameras, by
        three with 16.
    soft : silhouettes are probabilities, 0 to 255 (128 is one half, not unknown); doubts are summed over the
        cameras before anything is cut.
    find_faults : cameras whose silhouette contradicts the others are named and kept from cutting the hull.
    refine : move the surface inwards to where it is smooth and all silhouettes still are as they were. Then
        it is no longer the largest shape that fits, but nearer to the person.
    """

    votes: int = 1
    soft: bool = False
    find_faults: bool = True
    refine: bool = False


@dataclass(frozen=True, eq=False)
class Hull:
    """A closed surface around everything the silhouettes allow.

    Fields
    ------
    vertices : (V 3), world metres.
    faces : (F 3), vertex indices; counter-clockwise seen from outside, every edge in two faces.
    normals : (V 3), unit, outward.
    n_witnesses : (V,), how many cameras give evidence at the vertex.
    n_bounding : (V,), how many cameras' outlines pass through the vertex, within a pixel: those that bound
        it.
    cut_by : (V,), place in the rig of the camera on whose cone the vertex lies; -1: on none, given up for
        want of witnesses.
    slack_m : (V,), metres that the surface could move inwards around the vertex without a silhouette
        noticing.
    is_phantom : (V,), true on parts that no silhouette needs.
    colours : (V 3) RGB from the pictures, or None.
    problems : one sentence each about what had to be left out or decided.
    faults : cameras whose silhouette contradicts the others, and what was done about each.
    marks : those of the problems that make the hull itself doubtful: a second subject, or one that leaves
        what the cameras see, or silhouettes that contradict one another.
    contradiction : share of the lines of sight through the silhouettes that miss the hull because cameras
        contradict one another and too few can be left out; above 0.01 the hull is not to be trusted.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    n_witnesses: Int[np.ndarray, " v"]
    n_bounding: Int[np.ndarray, " v"]
    cut_by: Int[np.ndarray, " v"]
    slack_m: Float[np.ndarray, " v"]
    is_phantom: Bool[np.ndarray, " v"]
    colours: UInt8[np.ndarray, "v 3"] | None = None
    problems: tuple[str, ...] = ()
    faults: tuple[CameraFault, ...] = ()
    marks: tuple[str, ...] = ()
    contradiction: float = 0.0

    @staticmethod
    def of_mesh(
        vertices: Float[np.ndarray, "v 3"],
        faces: Int[np.ndarray, "f 3"],
        normals: Float[np.ndarray, "v 3"] | None = None,
    ) -> Hull:
        """A closed surface from elsewhere, of which only the shape is known: no witnesses, no slack."""
        none = np.zeros(len(vertices), dtype=np.int64)
        return Hull(
            vertices=vertices,
            faces=faces,
            normals=vertex_normals(vertices, faces) if normals is None else normals,
            n_witnesses=none,
            n_bounding=none,
            cut_by=none - 1,
            slack_m=np.zeros(len(vertices)),
            is_phantom=np.zeros(len(vertices), dtype=bool),
        )

    @property
    def volume_m3(self) -> float:
        a, b, c = (self.vertices[self.faces[:, k]] - self.vertices.mean(axis=0) for k in range(3))
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


def build_hull(
    rig: Iterable[Camera],
    images: Sequence[np.ndarray | None],
    voxel_m: float = 0.008,
    bounds: Bounds | None = None,
    options: HullOptions = HullOptions(),
    near: Bounds | None = None,
) -> Hull:
    """The visual hull of one frame.

    rig : C pinhole cameras, metres (distortion is not looked at: silhouettes are undistorted).
    images : per camera (h w) uint8 (255 person, 0 background, 128 unknown) or None (no evidence); with
        `options.soft` probabilities.
    voxel_m : grid pitch. The surface is about four times as accurate; thinner parts than this may be lost.
    bounds : where to look; found from the silhouettes if None.
    options : everything else that is a choice.
    near : the box around the person a moment before: looked there first, which is quicker and finds the same.

    Raises HullError: fewer than two silhouettes, a silhouette of another size than its camera's, or an empty
    hull, naming the cameras at fault.
    """
    if not voxel_m > 0:
        raise HullError(f"voxel_m is {voxel_m}; it must be a positive length in metres, such as 0.008")
    cameras = tuple(rig)
    if options.votes < 1 or options.votes > max(1, sum(image is not None for image in images) - 2):
        raise HullError(
            f"votes is {options.votes}; choose 1 or a few more, 2 fewer than there are silhouettes at most"
        )
    if options.soft and options.votes > 1:
        raise HullError("votes and soft silhouettes exclude each other; with soft ones doubts are summed")

    refuse_inverted(cameras, images)
    soft = (
        {table.camera_idx: table for table in prepare_soft_tables(cameras, images)} if options.soft else None
    )
    if soft is not None:
        # Who contradicts whom is asked of what is nearly certain.
        images = [None if image is None else sure_mask(image) for image in images]

    def carve_with(tables: Sequence[SilhouetteTable], rule: WitnessRule, box: Bounds, finely: bool) -> Carved:
        chosen = None if soft is None else [soft[table.camera_idx] for table in tables]
        return _surface(tables, chosen, rule, box, voxel_m, options.votes, finely)

    finely = soft is None and voxel_m > FINE_ENOUGH_M

    faults: tuple[CameraFault, ...] = ()
    marks: tuple[str, ...] = ()
    contradiction = 0.0
    if options.find_faults:
        settled = settle(cameras, images, bounds, carve_with, options.votes, near, soft is None, finely)
        carved, faults, box = settled.carved, settled.faults, settled.bounds
        contradiction = settled.contradiction
        marks = (
            *settled.marks,
            *elsewhere_mark(carved.vertices, voxel_m, box, settled.tables, settled.n_lines, settled.missed),
        )
    else:
        tables = prepare_tables(cameras, images)
        box = bounds if bounds is not None else bounds_from_tables(tables, near)
        carved = carve_with(tables, witness_rule(tables, box.centre), box, finely)
    vertices, faces = carved.vertices, carved.faces
    normals = vertex_normals(vertices, faces)
    marks = (
        *carved.marks,
        *marks,
        *leaving_mark(vertices, normals, carved.cut_by, voxel_m, box, carved.culling.tables),
    )
    facts = vertex_facts(vertices, faces, normals, carved.cut_by, carved.culling, carved.scene)
    if options.refine:
        vertices = refined(vertices, faces, normals, facts.slack_m, carved.culling, carved.scene)
        normals = vertex_normals(vertices, faces)
    return Hull(
        vertices=vertices,
        faces=faces,
        normals=normals,
        **vars(facts),
        problems=(*carved.problems, *marks, *(fault.sentence() for fault in faults)),
        faults=faults,
        marks=marks,
        contradiction=contradiction,
    )


def _surface(
    tables: Sequence[SilhouetteTable],
    soft: Sequence[SoftTable] | None,
    rule: WitnessRule,
    bounds: Bounds,
    voxel_m: float,
    votes: int,
    finely: bool,
) -> Carved:
    """The closed surface of these tables' hull, or of their soft ones; `finely`: with thin parts and
    valleys. Raises EmptyHullError."""
    grid = grid_over(bounds, voxel_m)
    blocks = carve(tables, rule, grid, votes) if soft is None else carve_soft(soft, rule, grid)
    if not blocks.n_voxels:
        raise EmptyHullError(why_empty(tables, rule, bounds.low, bounds.high))
    surface = binary_surface(blocks)
    tables = tables if soft is None else soft
    culling, fine = Culling(tables, grid), grid
    if soft is not None:
        crossings = cross_softly(surface, grid, soft, culling)
    else:
        if finely:
            surface, fine = with_thin_parts(surface, grid, culling, rule, votes)
        crossings = cross_exactly(surface, fine, tables, culling, votes)
        if fine is not grid:
            crossings = with_cameras(crossings, surface, fine, culling, rule, votes)
    crossings, faces = raise_ridges(
        crossings,
        surface.faces,
        vertex_normals(crossings.vertices, surface.faces, n_rings=1),
        tables,
        fine.voxel_m * np.abs(surface.outer - surface.inner).sum(axis=1),
        culling,
        votes,
        finely,
    )
    kept, faces, problems = keep_what_matters(crossings.vertices, faces, tables)
    vertices, cut_by = crossings.vertices[kept], crossings.cut_by[kept]
    marks: tuple[str, ...] = ()
    if problems:
        # Only where there is more than one piece, that is.
        kept, faces, marks = one_subject(vertices, faces)
        vertices, cut_by = vertices[kept], cut_by[kept]
    assert is_closed(faces, len(vertices)), "the hull's surface is not closed"
    # One thread: frames are what runs in parallel.
    scene = RayScene(vertices, faces, n_threads=1)
    return Carved(vertices, faces, cut_by, problems + _touching(blocks.span(), grid), marks, culling, scene)


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


def _touching(span: tuple[np.ndarray, np.ndarray], grid: Grid) -> tuple[str, ...]:
    first, end = span
    if (first <= 0).any() or (end >= np.array(grid.shape)).any():
        return ("the hull reaches the end of the box it was carved in and is cut off there",)
    return ()
