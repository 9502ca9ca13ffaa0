"""What is odd about cameras by themselves, before any picture is looked at: a sentence each.

Wrong files show in few ways: a field of view or a principal point that no lens has, distances of thousands
(millimetres taken for metres), cameras all in one place or looking away from each other (poses the wrong way
round).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from capture.camera import Camera
from capture.rig import Rig
from capture.rig_formats import METRES_PER_UNIT
from capture.world import find_subject, poses_look_inverted

_LEAST_FIELD_DEG, _MOST_FIELD_DEG = 10.0, 120.0
_MOST_OFF_MIDDLE = 0.2  # of the picture's size
_NEAREST_M, _FARTHEST_M = 0.5, 15.0
_SCATTERED_UP, _COMMON_UP = 0.5, 0.7  # length of the mean up direction


def lens_doubts(rig: Rig) -> list[str]:
    """Sentences on fields of view and principal points that hardly any camera has."""
    doubts = []
    for camera in rig:
        across = field_of_view_deg(camera)
        if not _LEAST_FIELD_DEG <= across <= _MOST_FIELD_DEG:
            doubts.append(
                f"Camera {camera.name} has a field of view of {across:.3g} degrees: is its picture size "
                f"({camera.size[0]}x{camera.size[1]} px) the one it was calibrated with?"
            )
        middle = (np.array(camera.size) - 1) / 2
        off = np.abs(camera.intrinsics[:2, 2] - middle) / np.array(camera.size)
        if off.max() > _MOST_OFF_MIDDLE:
            u, v = camera.intrinsics[:2, 2]
            doubts.append(
                f"Camera {camera.name} has its principal point at ({u:.0f}, {v:.0f}) px, "
                f"{100 * off.max():.0f} % of the picture off its middle: is the picture cropped or resized?"
            )
    return doubts


def placement_doubts(rig: Rig, metres_per_unit: float) -> list[str]:
    """Sentences on where the cameras stand, world units times `metres_per_unit` being metres."""
    if len(rig) < 2:
        return []
    if poses_look_inverted(rig) or _upright_only_when_inverted(rig):
        return [
            "The poses look inverted (camera to world given where world to camera is due): the cameras stand "
            "round something only with every pose inverted; --invert-poses does that."
        ]
    doubts = []
    aim, _ = find_subject(rig, None)
    ahead = [float((aim - camera.centre) @ camera.forward) > 0 for camera in rig]
    away = [camera.name for camera, seen in zip(rig, ahead, strict=True) if not seen]
    if away:
        doubts.append(
            f"Cameras {', '.join(away)} look away from where the others aim: is their calibration inverted, "
            "or mirrored?"
        )
    distances = np.linalg.norm(rig.centres - aim, axis=1) * metres_per_unit
    median = float(np.median(distances))
    if not _NEAREST_M <= median <= _FARTHEST_M:
        doubts.append(
            f"The cameras stand {median:.4g} m from where they aim: check the unit (--units m, cm or mm)."
        )
    return doubts


def _upright_only_when_inverted(rig: Rig) -> bool:
    """Inverted, cameras round a point near the origin all look at one point from close by; but their
    pictures' up directions then point everywhere."""
    inverted = with_inverted_poses(rig)
    as_given, turned = (
        float(np.linalg.norm(np.mean([camera.up for camera in cameras], axis=0)))
        for cameras in (rig, inverted)
    )
    return len(rig) > 2 and as_given < _SCATTERED_UP and turned > _COMMON_UP


def guess_unit(rig: Rig) -> tuple[str | None, float]:
    """The one unit in which the cameras stand 0.5 to 15 m from where they aim, and that distance in world
    units; None where no unit or several do."""
    aim, _ = find_subject(rig, None)
    distance = float(np.median(np.linalg.norm(rig.centres - aim, axis=1)))
    fitting = [u for u, metres in METRES_PER_UNIT.items() if _NEAREST_M <= distance * metres <= _FARTHEST_M]
    return (fitting[0] if len(fitting) == 1 else None), distance


def with_inverted_poses(rig: Rig) -> Rig:
    """The rig that was meant where camera-to-world poses stand for world-to-camera ones."""
    return Rig(
        tuple(replace(c, camera_from_world=np.linalg.inv(c.camera_from_world), projection=None) for c in rig)
    )


def field_of_view_deg(camera: Camera) -> float:
    """The wider of the two fields of view, lens left out."""
    extent = np.array(camera.size) / np.diag(camera.intrinsics)[:2]
    return float(np.degrees(2 * np.arctan(extent.max() / 2)))
