"""Rigs to plan with: a calibration on its own, stood round a subject, and the best-spread few of its cameras.

A rig study films a synthetic person with cameras that exist (or are planned) elsewhere; there are no pictures
yet, so what a recording's silhouettes tell about the world is read off the cameras alone.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.errors import RecordingError
from capture.rig import Rig
from capture.rig_formats import detect_format, read_rig_of
from capture.world import find_subject, settle_world

# The cameras' axes meet at about the height of a person's waist.
_AIM_HEIGHT_M = 1.0


def read_rig(path: Path, size: tuple[int, int] | None = None) -> tuple[Rig, str | None]:
    """Every camera of a calibration as a pinhole, and its unit ("m", "mm"; None: the format does not say).

    `path`: any format of `capture.rig_formats`; one without picture sizes (a folder of camNN.txt) needs
    `size` (width, height) px. Raises RecordingError for what cannot be read.
    """
    foreign = read_rig_of(path)
    without = [camera.name for camera in foreign.cameras if camera.size is None]
    if without and size is None:
        what = "matrices do" if detect_format(path) == "inria" else "this calibration does"
        raise RecordingError(
            f"{path}: {what} not say how large the pictures are; give --size, for example 2048x2048"
        )
    return foreign.rig(size).pinholes(), foreign.unit


def stood_round_origin(rig: Rig, declared_unit: str | None, *, units: str = "auto", up: str = "auto") -> Rig:
    """The rig in metres with z up and the origin on the floor where its cameras aim.

    Unit and up axis as `capture.world.settle_world` finds them without silhouettes. The floor is taken to lie
    a metre under the point that the optical axes pass closest. Raises RecordingError.
    """
    world = settle_world(rig, None, declared_unit=declared_unit, units=units, up=up)
    metric = rig.with_world_scaled(world.metres_per_unit)
    aim, _ = find_subject(metric, None)
    upright_from_world = np.eye(4)
    upright_from_world[:3, :3] = _rotation_to_z(world.up)
    upright_from_world[:3, 3] = [0, 0, _AIM_HEIGHT_M] - upright_from_world[:3, :3] @ aim
    world_from_upright = np.linalg.inv(upright_from_world)
    return Rig(tuple(_seen_from(camera, world_from_upright) for camera in metric))


def spread_subset(rig: Rig, n_cameras: int, target: Float[np.ndarray, " 3"]) -> Rig:
    """`n_cameras` of the rig's cameras whose directions from `target` (3,) lie far apart, in the rig's order.

    Greedy: the first camera, then always the one farthest (by angle) from all that are chosen. Raises
    RecordingError where the rig has fewer.
    """
    if not 1 <= n_cameras <= len(rig):
        raise RecordingError(f"{n_cameras} cameras asked for; the rig has {len(rig)}")
    directions = rig.centres - target
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < n_cameras:
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return Rig(tuple(rig[k] for k in sorted(chosen)))


def numbered(rig: Rig) -> Rig:
    """The same cameras called cam-000, cam-001 and so on, as a recording's folders are."""
    return Rig(tuple(replace(camera, name=f"cam-{k:03d}") for k, camera in enumerate(rig)))


def resized(rig: Rig, width_px: int) -> Rig:
    """The same views in pictures `width_px` wide; heights follow."""
    return Rig(tuple(_resized(camera, width_px) for camera in rig))


def _resized(camera: Camera, width_px: int) -> Camera:
    scale = width_px / camera.size[0]
    size = (width_px, max(round(camera.size[1] * scale), 1))
    return camera.with_pixels_scaled(scale, size[1] / camera.size[1], size)


def _seen_from(camera: Camera, world_from_upright: Float[np.ndarray, "4 4"]) -> Camera:
    given = None if camera.projection is None else camera.projection @ world_from_upright
    return replace(camera, camera_from_world=camera.camera_from_world @ world_from_upright, projection=given)


def _rotation_to_z(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation (3 3) that takes the unit vector `up` to +z."""
    aside = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(aside, up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
