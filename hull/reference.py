"""The hull of some cameras as a reference for the others: carved coarsely, seen by any camera, compared.

A camera is right when its silhouette lies inside what the hull of the *rest* shows to it: that hull holds the
whole person. What sticks out is a contradiction (`surplus`); what the hull shows beyond the silhouette
(`missing`) may just be room that few cameras leave.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from capture.camera import Camera
from capture.rig import Rig
from capture.world import find_subject, subject_extent
from hull.bounds import Bounds
from hull.carve import carve
from hull.coverage import Coverage
from hull.culling import Culling
from hull.errors import HullError
from hull.marching import binary_surface
from hull.surface import cross_exactly
from hull.tables import PERSON, UNKNOWN, SilhouetteTable, prepare_table
from hull.visual_hull import grid_over
from hull.witnesses import witness_rule

VOXEL_M = 0.02
# Nobody reaches further than this from the middle of the silhouettes, metres.
_REACH_M = 1.35
_SPREAD_DEG = 30.0
_PERSON_M, _USUAL_M = (0.8, 2.5), 1.7
# In a large rig cameras are left out by so many groups, not one by one: one more or less changes little.
N_PARTS, _PARTED_FROM = 12, 24
# A strip along the outline, so many pixels wide, sticks out for many small reasons.
_RIM_PX = 2
_RIM = np.ones((2 * _RIM_PX + 1, 2 * _RIM_PX + 1), np.uint8)


def turned(mask: UInt8[np.ndarray, "h w"], way: str) -> UInt8[np.ndarray, "h w"]:
    """The mask flipped "left-right" or "upside down", or turned "by 180 degrees"."""
    steps = {"left-right": (1, -1), "upside down": (-1, 1), "by 180 degrees": (-1, -1)}[way]
    return np.ascontiguousarray(mask[:: steps[0], :: steps[1]])


@dataclass(frozen=True, eq=False)
class View:
    """One camera's mask in one frame, ready to be compared. core: the person without a rim."""

    mask: UInt8[np.ndarray, "h w"]
    person: Bool[np.ndarray, "h w"]
    core: Bool[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"] | None
    n_person: int
    n_core: int

    @staticmethod
    def of(mask: UInt8[np.ndarray, "h w"]) -> View:
        """255 person, 0 background, 128 unknown."""
        person = mask == PERSON
        # The picture's end is no outline.
        core = cv2.erode(person.astype(np.uint8), _RIM, borderType=cv2.BORDER_REPLICATE) > 0
        unknown = mask == UNKNOWN
        known = ~unknown if unknown.any() else None
        return View(mask, person, core, known, int(person.sum()), int(core.sum()))

    def turned(self, way: str) -> View:
        """The picture as `turned` leaves it."""
        return View.of(turned(self.mask, way))


@dataclass(frozen=True)
class Fit:
    """How a silhouette fits what a hull shows: intersection over union; missing, of the hull's area; surplus,
    of the silhouette's area without its rim."""

    iou: float
    missing: float
    surplus: float


NO_FIT = Fit(0.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame: every camera's view (None: no evidence), and what was prepared of them for carving."""

    k: int
    cameras: tuple[Camera, ...]
    views: tuple[View | None, ...]
    tables: tuple[SilhouetteTable | None, ...]
    bounds: Bounds
    _kept: dict[tuple[tuple[int, ...], int], Coverage | None] = field(default_factory=dict)
    _shown: dict[tuple[tuple[int, ...], int], Bool[np.ndarray, "_h _w"] | None] = field(default_factory=dict)

    def hull(self, members: Iterable[int], votes: int = 1) -> Coverage | None:
        """The hull of these cameras; None where nothing is left, or fewer than two of them have evidence."""
        key = (tuple(members), votes)
        if key not in self._kept:
            while len(self._kept) >= N_PARTS + 2:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = self._carved(*key)
        return self._kept[key]

    def rest_mask(self, members: Sequence[int], i: int) -> Bool[np.ndarray, "_h _w"] | None:
        """What the hull of the members without camera i (see `rest_of`) shows to it; None: no hull, or part
        of it behind the camera."""
        key = (tuple(members), i)
        if key not in self._shown:
            hull = self.hull(rest_of(members, i))
            self._shown[key] = None if hull is None else hull.mask(self.cameras[i])
        return self._shown[key]

    def _carved(self, members: tuple[int, ...], votes: int) -> Coverage | None:
        tables = [table for i in members if (table := self.tables[i]) is not None]
        if len(tables) < 2:
            return None
        try:
            # Two that see a place are enough here: what nobody contradicts must not be missing.
            rule = replace(witness_rule(tables, self.bounds.centre), n_min=2)
            rule = replace(rule, spread_rad=min(rule.spread_rad, np.deg2rad(_SPREAD_DEG)))
            grid = grid_over(self.bounds, VOXEL_M)
            blocks = carve(tables, rule, grid, votes)
            if not blocks.n_voxels:
                return None
            surface = binary_surface(blocks)
            if votes > 1:
                # Half a cell is exact enough for who is right at all.
                between = 0.5 * (surface.inner + surface.outer) + 0.5
                return Coverage(grid.low + between * grid.voxel_m, surface.faces)
            crossings = cross_exactly(surface, grid, tables, Culling(tables, grid), votes)
        except HullError:
            return None
        return Coverage(crossings.vertices, surface.faces)

    def fits(self, hull: Coverage | None, members: Iterable[int]) -> dict[int, Fit]:
        """How these cameras' silhouettes fit the hull; those without a silhouette are left out."""
        return {
            i: fit_of(hull, self.cameras[i], view) for i in members if (view := self.views[i]) is not None
        }


def moment_of(
    k: int, cameras: Sequence[Camera], masks: Sequence[UInt8[np.ndarray, "_h _w"] | None]
) -> Moment | None:
    """Prepare a frame; None where fewer than two cameras show somebody. `k` is kept."""
    views = tuple(None if mask is None else View.of(mask) for mask in masks)
    views = tuple(view if view is not None and view.n_person else None for view in views)
    if sum(view is not None for view in views) < 2:
        return None
    tables = tuple(
        None if view is None else prepare_table(camera, view.mask, i)
        for i, (camera, view) in enumerate(zip(cameras, views, strict=True))
    )
    # A person's surroundings where the lines through the silhouettes' middles come closest.
    middle, _ = find_subject(Rig(tuple(cameras)), [None if view is None else view.mask for view in views])
    return Moment(k, tuple(cameras), views, tables, Bounds(middle - _REACH_M, middle + _REACH_M))


def normalising_scale(cameras: Sequence[Camera], masks: Sequence[UInt8[np.ndarray, "_h _w"] | None]) -> float:
    """What the world must be multiplied by for the subject to be as large as a person; 1 where it is."""
    rig = Rig(tuple(cameras))
    extent = subject_extent(rig, masks, find_subject(rig, masks)[0])
    if extent is None or _PERSON_M[0] < extent < _PERSON_M[1] or not np.isfinite(extent) or extent <= 0:
        return 1.0
    return _USUAL_M / extent


def fit_of(hull: Coverage | None, camera: Camera, view: View) -> Fit:
    """How a silhouette fits what the hull shows to the camera; nothing fits where there is no hull."""
    covered = None if hull is None else hull.mask(camera)
    return NO_FIT if covered is None else fit_of_mask(covered, view)


def fit_of_mask(covered: Bool[np.ndarray, "h w"], view: View) -> Fit:
    """The same for what the hull shows as a mask of the picture's size."""
    shown = np.count_nonzero(covered if view.known is None else covered & view.known)
    both = np.count_nonzero(covered & view.person)
    union = shown + view.n_person - both
    if not union:
        return NO_FIT
    surplus = 1 - np.count_nonzero(covered & view.core) / view.n_core if view.n_core else 0.0
    return Fit(both / union, 1 - both / shown if shown else 1.0, surplus)


def rest_of(members: Sequence[int], i: int) -> list[int]:
    """The members without camera i, and in a large rig without every twelfth other."""
    if i in members and len(members) >= _PARTED_FROM:
        part = list(members).index(i) % N_PARTS
        return [j for k, j in enumerate(members) if k % N_PARTS != part]
    return [j for j in members if j != i]


def mean_fit(fits: Sequence[Fit]) -> Fit:
    """The mean over frames; `NO_FIT` of none."""
    if not fits:
        return NO_FIT
    table: Float[np.ndarray, "n 3"] = np.array([(f.iou, f.missing, f.surplus) for f in fits])
    iou, missing, surplus = table.mean(axis=0)
    return Fit(float(iou), float(missing), float(surplus))
