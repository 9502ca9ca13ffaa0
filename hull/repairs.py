"""What would make a camera that fits nothing fit again: each known mistake undone in turn, and compared.

A mistake that is undone brings the camera's silhouettes inside the hull of the cameras that agree, in every
frame; anything else does not. The same for the whole rig, where it is the cameras among one another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from capture.camera import Camera
from capture.finding import FindingKind
from capture.projection_split import camera_from_projection
from hull.reference import (
    Fit,
    Moment,
    View,
    fit_of,
    fit_of_mask,
    mean_fit,
    moment_of,
    normalising_scale,
    rest_of,
)
from hull.trust import Trust, quick_agreement, trusted_cameras

UNIT_RATIOS = (0.001, 1000.0, 0.01, 100.0, 0.1, 10.0, 0.0254, 39.37, 0.3048, 3.281)
PICTURE_RATIOS = (2.0, 0.5, 4.0, 0.25, 1.5, 2 / 3, 3.0, 1 / 3)
# So many repairs of the whole rig are looked into, if all cameras agree no worse with them by this.
_N_LIKELY, _NO_WORSE = 3, 0.01
TURNS = ("left-right", "upside down", "by 180 degrees")


@dataclass(frozen=True)
class Repair:
    """One mistake undone. told : what it was. camera, turn : what undoes it. number: ratio, or the other
    camera's place."""

    kind: FindingKind
    told: str
    action: str
    change: Callable[[Camera], Camera] | None = None
    turn: str | None = None
    number: float | int | None = None


@dataclass(frozen=True)
class Repaired:
    """A repair and how the camera fits with it."""

    repair: Repair
    fit: Fit

    @property
    def score(self) -> float:
        """-1 to 1, larger is better."""
        return self.fit.iou - self.fit.surplus


def _inverted(camera: Camera) -> Camera:
    return replace(camera, camera_from_world=np.linalg.inv(camera.camera_from_world), projection=None)


def _mirrored_by(axis: int) -> Callable[[Camera], Camera]:
    signs = np.ones(4)
    signs[axis] = -1

    def change(camera: Camera) -> Camera:
        return camera_from_projection(camera.name, camera.size, camera.projection_matrix @ np.diag(signs))

    return change


def _placed(ratio: float) -> Callable[[Camera], Camera]:
    return lambda camera: camera.with_world_scaled(ratio)


def _enlarged(ratio: float) -> Callable[[Camera], Camera]:
    return lambda camera: camera.with_pixels_scaled(ratio, ratio)


def _part(ratio: float) -> str:
    names = {2.0: "half", 4.0: "a quarter of", 3.0: "a third of", 1.5: "two thirds of"}
    names |= {0.5: "twice", 0.25: "four times", 1 / 3: "three times", 2 / 3: "one and a half times"}
    return names[ratio]


INVERTED = Repair(
    FindingKind.INVERTED,
    "its pose is camera-to-world where world-to-camera is due",
    "invert its pose in the calibration file",
    _inverted,
)


def _size_repair(ratio: float) -> Repair:
    return Repair(
        FindingKind.PICTURE_SIZE,
        f"its intrinsics are for pictures of {_part(ratio)} the size",
        f"multiply its focal lengths and principal point by {ratio:.4g}, or use pictures of the calibrated "
        "size",
        _enlarged(ratio),
        number=ratio,
    )


def _turn_repair(turn: str) -> Repair:
    kind = FindingKind.MIRRORED
    what = {
        "left-right": "its pictures are mirrored left to right",
        "upside down": "its pictures are mirrored top to bottom (rows counted from the bottom?)",
        "by 180 degrees": "its pictures are turned by 180 degrees",
    }[turn]
    return Repair(kind, what, "flip its pictures back, or calibrate with the pictures as they are", turn=turn)


def camera_repairs() -> list[Repair]:
    """Every mistake that one camera alone can have, but for another moment or another camera's pictures."""
    units = [
        Repair(
            FindingKind.UNITS,
            f"its translation is in another unit than the others' ({1 / ratio:.4g} times as large)",
            f"multiply its translation by {ratio:.4g}",
            _placed(ratio),
            number=ratio,
        )
        for ratio in UNIT_RATIOS
    ]
    mirrored = [
        Repair(
            FindingKind.MIRRORED,
            f"its matrix is left-handed: the world's {'xyz'[axis]} axis is negated",
            f"negate column {axis + 1} of its matrix",
            _mirrored_by(axis),
        )
        for axis in range(3)
    ]
    sizes = [_size_repair(ratio) for ratio in PICTURE_RATIOS]
    return [INVERTED, *units, *sizes, *mirrored, *(_turn_repair(turn) for turn in TURNS)]


def repaired(
    moments: Sequence[Moment], members: Sequence[int], i: int, repairs: Sequence[Repair]
) -> list[Repaired]:
    """How camera i fits the hull of the other members with each repair, best first."""
    others = rest_of(members, i)
    fits: list[list[Fit]] = [[] for _ in repairs]
    for moment in moments:
        view = moment.views[i]
        if view is None:
            continue
        hull = moment.hull(others)
        plain = None if hull is None else hull.mask(moment.cameras[i])
        for found, repair in zip(fits, repairs, strict=True):
            if repair.change is not None:
                try:
                    camera = repair.change(moment.cameras[i])
                except (ValueError, np.linalg.LinAlgError):
                    continue
                found.append(fit_of(hull, camera, view))
            elif plain is not None and repair.turn is not None:
                found.append(fit_of_mask(plain, view.turned(repair.turn)))
    done = [Repaired(repair, mean_fit(found)) for repair, found in zip(repairs, fits, strict=True) if found]
    return sorted(done, key=lambda each: -each.score)


def fits_with_pictures_of(
    moments: Sequence[Moment], members: Sequence[int], i: int, candidates: Sequence[int]
) -> dict[int, Fit]:
    """How the silhouettes of each candidate camera fit where camera i stands."""
    found: dict[int, list[Fit]] = {j: [] for j in candidates}
    for moment in moments:
        covered = moment.rest_mask(members, i)
        if covered is None:
            continue
        for j in candidates:
            view = moment.views[j]
            if view is not None and view.mask.shape == covered.shape:
                found[j].append(fit_of_mask(covered, view))
    return {j: mean_fit(fits) for j, fits in found.items() if fits}


def whole_rig_repairs() -> list[Repair]:
    """Every mistake that a whole rig can share and that its own silhouettes tell."""
    inverted = replace(
        INVERTED,
        told="all poses are camera-to-world where world-to-camera is due",
        action="invert every pose in the calibration file",
    )
    sizes = [
        Repair(
            FindingKind.PICTURE_SIZE,
            f"all intrinsics are for pictures of {_part(ratio)} the size",
            f"multiply all focal lengths and principal points by {ratio:.4g}, or use pictures of the "
            "calibrated size",
            _enlarged(ratio),
            number=ratio,
        )
        for ratio in PICTURE_RATIOS
    ]
    world = Repair(
        FindingKind.MIRRORED,
        "the world is mirrored: every camera is left-handed, with the person behind it",
        "negate one world axis (one of columns 1 to 3 of every matrix)",
        _mirrored_by(0),  # whichever axis: a mirrored world turned about is a mirrored world
    )
    turns = [
        replace(
            _turn_repair(turn),
            told=_turn_repair(turn).told.replace("its pictures", "all pictures"),
            action="flip them back, or mirror the calibration's world",
        )
        for turn in TURNS
    ]
    return [inverted, *sizes, world, *turns]


def rig_with(moments: Sequence[Moment], repair: Repair) -> list[Moment]:
    """The same frames with the repair done to every camera."""
    found: list[Moment] = []
    scale = None
    for moment in moments:
        views: Sequence[View | None] = moment.views
        if repair.turn is not None:
            views = [None if view is None else view.turned(repair.turn) for view in views]
        try:
            cameras = [
                camera if repair.change is None else repair.change(camera) for camera in moment.cameras
            ]
        except (ValueError, np.linalg.LinAlgError):
            continue
        masks = [None if view is None else view.mask for view in views]
        # Another focal length, another distance: the world's size changes with the repair.
        scale = normalising_scale(cameras, masks) if scale is None else scale
        made = moment_of(moment.k, [camera.with_world_scaled(scale) for camera in cameras], masks)
        if made is not None:
            found.append(made)
    return found


def likely_for_rig(
    moments: Sequence[Moment], asked: Sequence[int], plain: float
) -> list[tuple[float, Repair]]:
    """The few repairs of the whole rig with which all cameras agree best, and no worse than `plain`.

    In a symmetrical rig with few cameras they are nearly as good as each other by that.
    """
    few = moments[:: max(len(moments) // 2, 1)]
    tried = [(quick_agreement(rig_with(few, repair), asked), repair) for repair in whole_rig_repairs()]
    tried = [each for each in tried if each[0] > plain - _NO_WORSE]
    return sorted(tried, key=lambda each: -each[0])[:_N_LIKELY]


def best_for_rig(
    moments: Sequence[Moment], asked: Sequence[int], likely: Sequence[tuple[float, Repair]], now: float
) -> tuple[Repair, list[Moment], Trust] | None:
    """The one of the likely repairs that explains clearly more than `now` (a `Trust.score`); None: none."""
    best = None
    for _, repair in likely:
        made = rig_with(moments, repair)
        trust = trusted_cameras(made, asked, at_least=max(now, 0.0 if best is None else best[2].score))
        if best is None or trust.score > best[2].score:
            best = repair, made, trust
    if best is None or 1 - best[2].score > 0.6 * (1 - now) or best[2].score < now + 0.02:
        return None
    return best
