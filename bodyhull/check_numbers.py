"""The numbers of a check: of every camera, and of the rig as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.camera import Camera
from capture.frame_facts import FrameFacts
from capture.preflight import Opened
from capture.rig import Rig
from hull.errors import HullError
from hull.preflight import Examination
from hull.reference import Moment
from hull.visual_hull import HullOptions, build_hull

_VOXEL_M = 0.015


@dataclass(frozen=True)
class CameraNumbers:
    """What is known of one camera. None: cannot be told.

    size : px. field_of_view_deg : across and down. distance_m, height_m : from the person's middle, and of
    the camera above the floor (the lowest point of the hull). residual_px : see `hull.residual`. agreement,
    missing, surplus : with the hull of the other cameras. offset_frames : see `hull.time_offsets`.
    area : mean share of the picture that is person; area_low, area_high: least and most. shown, cropped :
    shares of the frames with a person, and of those in which the person touches the picture's border.
    """

    name: str
    size: tuple[int, int]
    field_of_view_deg: tuple[float, float]
    distance_m: float | None
    height_m: float | None
    residual_px: float | None
    agreement: float | None
    missing: float | None
    surplus: float | None
    offset_frames: float | None
    area: float
    area_low: float
    area_high: float
    shown: float
    cropped: float


@dataclass(frozen=True)
class RigNumbers:
    """Of the hull in the middle frame, by the cameras that agree. None: there was none.

    unit, metres_per_unit : of the calibration, as far as told. up : world axis, (3,) or None. floor_m : the
    hull's lowest coordinate along it; camera heights are above that.
    """

    n_cameras: int
    n_frames: int
    n_frames_read: int
    unit: str
    metres_per_unit: float
    up: tuple[float, ...] | None
    person_height_m: float | None
    volume_l: float | None
    witnesses: float | None
    floor_m: float | None
    lowest_camera_m: float | None
    highest_camera_m: float | None
    agreeing: tuple[str, ...]


def rig_numbers(
    opened: Opened,
    facts: FrameFacts,
    found: Examination,
    rig: Rig,
    moments: Sequence[Moment],
    unit: str,
    per_unit: float,
    axis: np.ndarray | None,
) -> RigNumbers:
    height = volume = witnesses = floor = lowest = highest = None
    if moments and len(found.members) >= 2:
        middle = moments[len(moments) // 2]
        images = [
            view.mask if view is not None and i in found.members else None
            for i, view in enumerate(middle.views)
        ]
        try:
            hull = build_hull(rig, images, _VOXEL_M, options=HullOptions(find_faults=False))
        except HullError:
            hull = None
        if hull is not None:
            volume = 1000 * hull.volume_m3
            witnesses = float(hull.n_witnesses.mean())
            if axis is not None:
                along = hull.vertices @ axis
                floor = float(along.min())
                height = float(along.max()) - floor
                above = rig.centres[list(found.members)] @ axis - floor
                lowest, highest = float(above.min()), float(above.max())
    return RigNumbers(
        len(rig),
        len(opened.recording.frame_ids),
        len(facts.frame_ids),
        unit,
        per_unit,
        None if axis is None else tuple(float(v) for v in axis),
        height,
        volume,
        witnesses,
        floor,
        lowest,
        highest,
        tuple(rig.names[i] for i in found.members),
    )


def camera_numbers(
    facts: FrameFacts,
    found: Examination,
    rig: Rig,
    outside: dict[int, float],
    moments: Sequence[Moment],
    axis: np.ndarray | None,
    numbers: RigNumbers,
) -> list[CameraNumbers]:
    centre = np.median([moment.bounds.centre for moment in moments], axis=0) if moments else None
    floor = numbers.floor_m
    made = []
    for i, camera in enumerate(rig):
        fit, offset = found.fits.get(i), found.offsets.get(i)
        shown = facts.present[i]
        area = facts.area[i][shown]
        offset_frames = None
        if offset is not None and offset.frames is not None:
            offset_frames = offset.frames * facts.usual_step
        made.append(
            CameraNumbers(
                camera.name,
                camera.size,
                field_of_view_deg(camera),
                None if centre is None else float(np.linalg.norm(camera.centre - centre)),
                None if floor is None or axis is None else float(camera.centre @ axis) - floor,
                outside.get(i),
                None if fit is None else fit.iou,
                None if fit is None else fit.missing,
                None if fit is None else fit.surplus,
                offset_frames,
                float(area.mean()) if len(area) else 0.0,
                float(area.min()) if len(area) else 0.0,
                float(area.max()) if len(area) else 0.0,
                float(shown.mean()),
                float(facts.border[i][shown].mean()) if shown.any() else 0.0,
            )
        )
    return made


def field_of_view_deg(camera: Camera) -> tuple[float, float]:
    """(across, down) degrees between the picture's edges."""
    width, height = camera.size
    K = camera.intrinsics
    across = np.arctan((K[0, 2] + 0.5) / K[0, 0]) + np.arctan((width - 0.5 - K[0, 2]) / K[0, 0])
    down = np.arctan((K[1, 2] + 0.5) / K[1, 1]) + np.arctan((height - 0.5 - K[1, 2]) / K[1, 1])
    return float(np.degrees(across)), float(np.degrees(down))
