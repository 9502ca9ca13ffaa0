"""What the files leave open about the world: its unit, its up axis, and whether the calibration is mirrored
or inverted.

All read off the silhouettes: the subject stands where the rays through their middles come closest, must be
in front of every camera, and is as tall as a person.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from capture.camera import Camera
from capture.errors import RecordingError
from capture.ray_agreement import coarse_evidence, covered_shares
from capture.rig import Rig
from capture.silhouette_files import PERSON

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}
UP_AXES = dict(zip(("x", "y", "z", "-x", "-y", "-z"), [*np.eye(3), *-np.eye(3)], strict=True))
_PERSON_M = 1.7

_MIRRORED, _N_ASKED = 0.75, 12
_SURE_OF_UP_DEG = 20.0  # rigs that look down from a dome tilt their mean by less

Masks = Sequence[UInt8[np.ndarray, "_h _w"] | None]


@dataclass(frozen=True)
class World:
    """The world frame's unit and up axis. up (3,): unit vector. notes: how they were found, and doubts;
    settled: those of the notes that give no reason for doubt.
    """

    unit: str
    metres_per_unit: float
    up: Float[np.ndarray, " 3"]
    notes: tuple[str, ...]
    settled: tuple[str, ...] = ()


def settle_world(
    rig: Rig,
    masks: Masks | None,
    *,
    declared_unit: str | None,
    units: str = "auto",
    up: str = "auto",
    where: str = "calibration",
) -> World:
    """Unit and up axis of a rig in file units, after checking that its cameras look at the subject.

    `masks`: one frame's undistorted silhouettes, or None (videos, before segmentation): then the point that
    the cameras' optical axes pass closest stands for the subject, and the unit must be declared by the
    format or by the user. Raises RecordingError where the calibration is mirrored or inverted, or where unit
    or up axis cannot be told.
    """
    doubts: list[str] = []
    settled: list[str] = []
    subject, miss = find_subject(rig, masks)
    _check_facing(rig, masks, subject, where)
    distance = float(np.median(np.linalg.norm(rig.centres - subject, axis=1)))
    if masks is not None and miss > 0.08 * distance:
        doubts.append(
            "The rays through the silhouettes' middles miss each other by "
            f"{100 * miss / distance:.0f} % of the distance: does the calibration belong to these folders?"
        )
    unit = _settle_unit(rig, masks, subject, declared_unit, units, where, doubts, settled)
    axis = _settle_up(rig, up, doubts, settled)
    return World(unit, METRES_PER_UNIT[unit], axis, (*doubts, *settled), tuple(settled))


def find_subject(rig: Rig, masks: Masks | None) -> tuple[Float[np.ndarray, " 3"], float]:
    """The point (3,) closest to the rays through the silhouettes' middles, and the median distance to them.

    World units. Works with lines, not half lines, so it does not depend on the matrices' signs. Cameras
    without a silhouette are left out; without masks (or with fewer than two) the optical axes are used.
    """
    origins, directions = [], []
    given = enumerate(masks or ())
    seen = [camera_idx for camera_idx, mask in given if mask is not None and (mask == PERSON).any()]
    use_axes = len(seen) < 2
    for camera_idx in range(len(rig)) if use_axes else seen:
        camera = rig[camera_idx].pinhole()
        if use_axes:
            origin, direction = camera.centre, camera.forward
        else:
            assert masks is not None
            mask = masks[camera_idx]
            assert mask is not None
            origin, ray = camera.rays(_middle(mask)[None])
            direction = ray[0]
        origins.append(origin)
        directions.append(direction)
    return closest_point(np.array(origins), np.array(directions))


def closest_point(
    origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " 3"], float]:
    """The point (3,) with the least sum of distances to lines (N 3, N 3 unit), and the median distance to
    them."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    weight = np.ones(len(origins))
    point = np.zeros(3)
    offset = np.einsum("nij,nj->ni", across, origins)
    smallest = 1e-6 * max(float(np.abs(origins).max()), 1e-12)
    # Reweighted towards distances instead of their squares: one wrong camera must not decide.
    for _ in range(20):
        matrix = (weight[:, None, None] * across).sum(axis=0)
        point = np.linalg.lstsq(matrix, (weight[:, None] * offset).sum(axis=0))[0]
        distance = np.linalg.norm(np.einsum("nij,nj->ni", across, point - origins), axis=1)
        weight = 1 / np.maximum(distance, smallest)
    return point, float(np.median(distance))


def _middle(mask: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, " 2"]:
    """Centroid (u, v) of the person's pixels."""
    person = mask == PERSON
    n_pixels = person.sum()
    return np.array(
        [
            (person.sum(axis=0) * np.arange(mask.shape[1])).sum() / n_pixels,
            (person.sum(axis=1) * np.arange(mask.shape[0])).sum() / n_pixels,
        ]
    )


def _check_facing(rig: Rig, masks: Masks | None, subject: Float[np.ndarray, " 3"], where: str) -> None:
    """Raise where cameras have the subject behind them: mirrored matrices, or poses given the wrong way
    round."""
    # A mirrored rig agrees with its silhouettes but for the sign of the depths, an inverted one does not.
    if poses_look_inverted(rig, masks) and _agreement(rig, masks, subject) < _MIRRORED:
        raise RecordingError(
            f"{where}: the poses look inverted (camera-to-world given where world-to-camera is due): "
            "the cameras see the subject from around it only with every pose inverted; invert them"
        )
    behind = _behind(rig, subject)
    if not behind:
        return
    names = ", ".join(behind)
    if len(behind) == len(rig) and any(camera.projection is not None for camera in rig):
        raise RecordingError(
            f"{where}: mirrored calibration: with the sign fixed so that the subject is in front, "
            f"cameras {names} are left-handed. Negate one world axis (one of columns 1 to 3 of each matrix), "
            "or, where rows count from the bottom, replace row 2 by (height - 1) x row 3 - row 2"
        )
    kind = (
        "mirrored or inverted"
        if any(camera.projection is not None for camera in rig)
        else "inverted or misaimed"
    )
    raise RecordingError(
        f"{where}: {len(behind)} of {len(rig)} cameras have the subject behind them ({names}): "
        f"their calibration is {kind}; calibrate them again or leave them out"
    )


def _agreement(rig: Rig, masks: Masks | None, subject: Float[np.ndarray, " 3"]) -> float:
    """Mean share of the silhouettes that the others' hull covers; 0 without silhouettes."""
    extent = None if masks is None else subject_extent(rig, masks, subject)
    if masks is None or extent is None:
        return 0.0
    evidence = coarse_evidence(masks, _N_ASKED)
    return float(covered_shares(rig, evidence, subject, extent).mean())


def poses_look_inverted(rig: Rig, masks: Masks | None = None) -> bool:
    """True where the cameras stand round a subject only with every pose inverted."""
    if _is_plausible(rig, *find_subject(rig, masks)):
        return False
    inverted = Rig(tuple(_inverted(camera) for camera in rig))
    return _is_plausible(inverted, *find_subject(inverted, masks))


def _is_plausible(rig: Rig, subject: Float[np.ndarray, " 3"], miss: float) -> bool:
    """Cameras around a subject: it is in front of all, their rays meet, and they do not stand in one
    place."""
    distance = float(np.median(np.linalg.norm(rig.centres - subject, axis=1)))
    spread = float(np.linalg.norm(rig.centres - rig.centres.mean(axis=0), axis=1).max())
    return not _behind(rig, subject) and miss < 0.08 * distance and (spread > 0.3 * distance or len(rig) < 2)


def _behind(rig: Rig, subject: Float[np.ndarray, " 3"]) -> list[str]:
    return [camera.name for camera in rig if camera.pinhole().project(subject[None])[1][0] <= 0]


def _inverted(camera: Camera) -> Camera:
    return Camera(
        camera.name, camera.size, camera.intrinsics, np.linalg.inv(camera.camera_from_world), np.zeros(0)
    )


def _settle_unit(
    rig: Rig,
    masks: Masks | None,
    subject: Float[np.ndarray, " 3"],
    declared: str | None,
    units: str,
    where: str,
    doubts: list[str],
    settled: list[str],
) -> str:
    if units != "auto" and units not in METRES_PER_UNIT:
        raise RecordingError(f"--units {units}: unknown; choose auto, m, cm or mm")
    size = None if masks is None else subject_extent(rig, masks, subject)
    if units == "auto" and declared is None:
        if size is None:
            raise RecordingError(f"{where}: no silhouette to tell the unit from; give --units m, cm or mm")
        unit = min(METRES_PER_UNIT, key=lambda name: abs(np.log(size * METRES_PER_UNIT[name] / _PERSON_M)))
        tall = size * METRES_PER_UNIT[unit]
        if not 0.6 < tall < 3.5:
            raise RecordingError(
                f"{where}: the subject is {size:.3g} units tall, which is no person in m, cm or mm; "
                "check the calibration or give --units"
            )
        settled.append(f"Unit of the calibration: {unit} (the subject then spans {tall:.2f} m).")
        return unit
    unit = declared if units == "auto" and declared is not None else units
    if size is not None and not 0.6 < size * METRES_PER_UNIT[unit] < 3.5:
        span = size * METRES_PER_UNIT[unit]
        doubts.append(f"With the unit {unit} the subject spans {span:.3g} m, which is no person.")
    distance = float(np.median(np.linalg.norm(rig.centres - subject, axis=1))) * METRES_PER_UNIT[unit]
    if not 0.3 < distance < 60:
        doubts.append(
            f"With the unit {unit} the cameras stand {distance:.3g} m from the subject: check the unit."
        )
    if declared is not None and unit != declared:
        settled.append(f"Unit {unit} as asked; the calibration's format says {declared}.")
    return unit


def subject_extent(rig: Rig, masks: Masks, subject: Float[np.ndarray, " 3"]) -> float | None:
    """The subject's longer side in world units: median over cameras of silhouette pixels times depth over
    focal length.

    Silhouettes cut by the picture's border are left out while whole ones exist. None without any silhouette.
    """
    whole: list[float] = []
    cut: list[float] = []
    for camera, mask in zip(rig, masks, strict=True):
        if mask is None:
            continue
        person = mask == PERSON
        columns, rows = np.flatnonzero(person.any(axis=0)), np.flatnonzero(person.any(axis=1))
        if columns.size == 0:
            continue
        depth = abs(float(camera.pinhole().project(subject[None])[1][0]))
        spans = [
            (columns[-1] - columns[0] + 1) / camera.intrinsics[0, 0],
            (rows[-1] - rows[0] + 1) / camera.intrinsics[1, 1],
        ]
        height, width = mask.shape
        inside = columns[0] > 0 and rows[0] > 0 and columns[-1] < width - 1 and rows[-1] < height - 1
        (whole if inside else cut).append(depth * max(spans))
    return float(np.median(whole or cut)) if whole or cut else None


def _settle_up(rig: Rig, up: str, doubts: list[str], settled: list[str]) -> Float[np.ndarray, " 3"]:
    if up != "auto":
        if up not in UP_AXES:
            raise RecordingError(f"--up {up}: unknown; choose auto or one of {', '.join(UP_AXES)}")
        return UP_AXES[up].copy()
    mean = np.mean([camera.up for camera in rig], axis=0)
    length = float(np.linalg.norm(mean))
    name = max(UP_AXES, key=lambda axis: float(UP_AXES[axis] @ mean))
    cosine = float(UP_AXES[name] @ mean) / max(length, 1e-12)
    if length < 0.25 or cosine < 0.75:
        raise RecordingError(
            f"the cameras agree on no up axis (their mean up direction is {np.round(mean, 2).tolist()}); "
            "say which one it is with --up x|y|z|-x|-y|-z"
        )
    off_deg = np.degrees(np.arccos(min(cosine, 1.0)))
    note = f"Up axis: {name} (the cameras' mean up direction is {off_deg:.0f} degrees off it)."
    (settled if off_deg < _SURE_OF_UP_DEG else doubts).append(note)
    return UP_AXES[name].copy()
