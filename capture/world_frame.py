"""A world to stand in: floor at z = 0, z up, metres.

Calibrations know only the cameras; where the floor is comes from a board that lay on it, from the feet of
somebody who walked on it (keypoints, or the lowest places that all silhouettes share), or, the direction
only, from the cameras, which most people mount upright. The scale comes from the board, or from the known
height of the person.

Reprojection cannot see a mirrored world: a board seen nearly flat on has two poses, and the wrong one hangs
the room upside down under its floor. Cameras under the floor and feet far from it are told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from capture.board import Board
from capture.errors import RecordingError
from capture.rig import Rig
from capture.shared_space import Masks, extent_along, lowest_place
from capture.world import closest_point

#: BODY_25's toes and heels, and its ankles (about 8 cm above the floor).
_SOLES = (19, 20, 21, 22, 23, 24)
_ANKLES = (11, 14)
_ANKLE_M = 0.08
_SOLE_M = 0.02  # toes' and heels' keypoints lie inside the foot

_UPRIGHT_RAD = 0.03  # beyond that most cameras are rolled: only their mean up direction tells something
_NEAR_UP_DEG = 20.0

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class Ground:
    """A rig moved to its floor. rig: metres, z up, floor at z = 0 (unless the notes say that its height is
    unknown); world_from_before (4 4): the rigid motion that did it, after scaling; scale: the factor before
    it; notes: sentences on how it was found; doubts: those that speak against it (mirrored, upside down, too
    few points).
    """

    rig: Rig
    world_from_before: Pose
    scale: float
    notes: tuple[str, ...]
    doubts: tuple[str, ...] = ()


def ground_from_cameras(rig: Rig) -> Ground:
    """z along the cameras' common up direction; origin where they look, since nothing tells how high the
    floor is.

    A camera mounted upright has a level x axis whichever way it looks: up is at right angles to all of them.
    """
    up = up_of_cameras(rig)
    centre, _ = closest_point(rig.centres, np.array([camera.forward for camera in rig]))
    moved = _moved(rig, frame_at(centre, up))
    doubts = _upside_down(moved.rig)
    note = "Up axis from the cameras, taken as upright; the origin lies where they look, not on the floor."
    return replace(moved, notes=(note,), doubts=doubts)


def up_of_cameras(rig: Rig) -> Float[np.ndarray, " 3"]:
    """Unit up direction (3): at right angles to the cameras' x axes, single rolled cameras counting little;
    or, where most are rolled, where their upper edges point on average.
    """
    right = np.array([camera.camera_from_world[0, :3] for camera in rig])
    mean = np.mean([camera.up for camera in rig], axis=0)
    up = mean / max(float(np.linalg.norm(mean)), 1e-9)
    if len(rig) < 3 or np.linalg.svd(right, compute_uv=False)[1] < 0.3:
        return up  # parallel x axes leave a turn about them open
    axis = up
    for _ in range(30):
        weight = 1 / np.maximum(np.abs(right @ axis), 0.005)
        axis = np.linalg.eigh((right * weight[:, None]).T @ right)[1][:, 0]
    if np.quantile(np.abs(right @ axis), 0.7) > _UPRIGHT_RAD:
        return up
    return axis if axis @ mean > 0 else -axis


def ground_from_board(
    rig: Rig, board: Board, world_from_board: Pose, *, mirrored_pose: Pose | None = None
) -> Ground:
    """The floor is the board's plane, the side that its print faces is up; origin and x axis are the board's.

    world_from_board (4 4) of the board as it lay on the floor, in the rig's world. mirrored_pose: the other
    pose that a single camera's view allows, if it allows one: taken where it agrees better with the cameras
    being upright.
    """
    notes = ["Floor from the board lying on it; x along its columns, z up."]
    doubts: list[str] = []
    pose = world_from_board
    if mirrored_pose is not None:
        up = up_of_cameras(rig)
        if -mirrored_pose[:3, 2] @ up > -pose[:3, 2] @ up:
            pose = mirrored_pose
        doubts.append(
            "The board on the floor was seen by one camera, nearly flat on: two poses fit it (mirrored "
            "ones). The one that "
            "suits upright cameras was taken; lay the board where two cameras see it to be sure."
        )
    up = -pose[:3, 2]
    along = pose[:3, 0]
    world_from_before = np.eye(4)
    world_from_before[:3, :3] = np.stack([along, np.cross(up, along), up])
    world_from_before[:3, 3] = -world_from_before[:3, :3] @ pose[:3, 3]
    moved = _moved(rig, world_from_before)
    below = [camera.name for camera in moved.rig if camera.centre[2] < 0]
    if below:
        doubts.append(
            f"Mirrored ground frame: {len(below)} of {len(rig)} cameras lie under the floor that the "
            "board gives "
            f"({', '.join(below[:6])}): its corners are counted in mirror image (flipped pictures), or "
            "it is not on the floor."
        )
    doubts += _upside_down(moved.rig)
    return replace(moved, notes=tuple(notes), doubts=tuple(doubts))


def ground_from_feet(
    rig: Rig,
    feet: Float[np.ndarray, "n 3"],
    *,
    up: Float[np.ndarray, " 3"] | None = None,
    above_m: float = 0.0,
) -> Ground:
    """The floor is the plane under the places (N 3, the rig's world, metres) where feet stood.

    above_m: how far above the floor such a place lies when the foot stands. Places on a line leave a tilt
    about it open; there, `up` holds (the cameras', if not given). Raises RecordingError for fewer than five
    places.
    """
    feet = feet[np.isfinite(feet).all(axis=1)]
    if len(feet) < 5:
        raise RecordingError(
            f"--floor feet: the feet were found in {len(feet)} frames only; take more frames, or "
            "--floor cameras"
        )
    up, level, spread_m = _floor_plane(feet, up_of_cameras(rig) if up is None else up)
    origin = np.median(feet, axis=0)
    origin = origin - up * (origin @ up - level + above_m)
    moved = _moved(rig, frame_at(origin, up))
    notes = [f"Floor from {len(feet)} places of feet."]
    doubts: list[str] = []
    if spread_m < 0.15:
        notes.append(
            "The feet hardly move about: the floor's tilt is that of the up axis as it was; walk about."
        )
    heights = feet @ moved.world_from_before[2, :3] + moved.world_from_before[2, 3]
    under = float((heights < above_m - 0.1).mean())
    if under > 0.2:
        doubts.append(
            f"{100 * under:.0f} % of the feet lie more than 10 cm under the floor: it fits them badly."
        )
    below = [camera.name for camera in moved.rig if camera.centre[2] < 0]
    if len(below) > len(rig) / 2:
        doubts.append(
            f"Mirrored world: {len(below)} of {len(rig)} cameras lie under the feet "
            f"({', '.join(below[:6])}); the "
            "calibration is mirrored or upside down. Calibrate again with a board that two cameras see "
            "at once."
        )
    doubts += _upside_down(moved.rig)
    return replace(moved, notes=tuple(notes), doubts=tuple(doubts))


def scaled_to_height(rig: Rig, measured: float, height_m: float) -> tuple[Rig, float]:
    """The rig in metres where its person is `measured` units tall and `height_m` metres in truth; and the
    factor.

    Raises RecordingError for a height that no person has.
    """
    if not 0.4 <= height_m <= 2.6:
        raise RecordingError(f"--height-m {height_m:g}: give the person's height in metres, for example 1.78")
    if not measured > 0:
        raise RecordingError("--height-m: the person's height could not be measured in any frame")
    factor = height_m / measured
    return rig.with_world_scaled(factor), factor


def settle_ground(
    rig: Rig,
    floor: str,
    *,
    joints: Sequence[Float[np.ndarray, "25 4"]] = (),
    masks: Sequence[Masks] = (),
    height_m: float | None = None,
    up: Float[np.ndarray, " 3"] | None = None,
) -> Ground:
    """Scale and floor of a rig from what a recording holds.

    rig: as filmed or pinholes, in any unit if `height_m` is given, else metres. floor: "keep", "cameras" or
    "feet". joints: triangulated keypoints by frame (`capture.keypoints.triangulate_keypoints`), in the rig's
    world; used for feet where given. masks: frames of undistorted silhouettes, one a camera: used for feet
    without joints, and for the height. up: the world's up direction as known so far; for feet it holds where
    it is within 20 degrees of the cameras'. Raises RecordingError where what was asked cannot be told.
    """
    if floor not in ("keep", "cameras", "feet"):
        raise RecordingError(f"--floor {floor}: unknown; choose keep, cameras or feet")
    scale = 1.0
    notes: list[str] = []
    of_cameras = up_of_cameras(rig)
    near = up is not None and float(up @ of_cameras) > np.cos(np.radians(_NEAR_UP_DEG))
    up = up if near and up is not None else of_cameras
    if height_m is not None:
        if not masks:
            raise RecordingError("--height-m: needs silhouettes of the person to measure")
        tall = [extent_along(rig, frame, up) for frame in masks]
        known = [span[1] - span[0] for span in tall if span is not None]
        # Who bends or sits is shorter: the tallest frames tell, less the odd one.
        measured = float(np.quantile(known, 0.9)) if known else 0.0
        rig, scale = scaled_to_height(rig, measured, height_m)
        notes.append(
            f"Scaled by {scale:.4f}: the person was {measured:.3f} units tall and is {height_m:g} m."
        )
    if floor == "keep":
        return Ground(rig, np.eye(4), scale, tuple(notes))
    if floor == "cameras":
        ground = ground_from_cameras(rig)
    elif len(joints):
        places, above_m = feet_of_joints(joints, up)
        ground = ground_from_feet(rig, places * scale, up=up, above_m=above_m)
    else:
        if not masks:
            raise RecordingError("--floor feet: needs keypoints or silhouettes")
        found = [lowest_place(rig, frame, up) for frame in masks]
        places = np.array([place for place in found if place is not None]).reshape(-1, 3)
        ground = ground_from_feet(rig, places, up=up)
    return replace(ground, scale=scale, notes=(*notes, *ground.notes))


def feet_of_joints(
    joints: Sequence[Float[np.ndarray, "25 4"]], up: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """The lower foot's lowest keypoint of every frame (N 3), and how far above the floor it stands, metres.

    Toes and heels where they are found, ankles otherwise.
    """
    stacked = np.array([frame[:, :3] for frame in joints])
    for indices, above_m in ((_SOLES, _SOLE_M), (_ANKLES, _ANKLE_M)):
        points = stacked[:, list(indices)]
        height = np.where(np.isfinite(points).all(axis=2), points @ up, np.inf)
        lowest = height.argmin(axis=1)
        found = np.isfinite(height.min(axis=1))
        if found.sum() >= min(5, len(joints)):
            return points[np.arange(len(points)), lowest][found], above_m
    return np.zeros((0, 3)), 0.0


def frame_at(origin: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]) -> Pose:
    """world_from_before (4 4): this origin, z along `up`, x the level direction nearest to before's x axis
    (or y)."""
    start = np.eye(3)[int(np.argmin(np.abs(up)))] if abs(up[0]) > 0.9 else np.array([1.0, 0, 0])
    along = start - up * (start @ up)
    along /= np.linalg.norm(along)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([along, np.cross(up, along), up])
    pose[:3, 3] = -pose[:3, :3] @ origin
    return pose


def _floor_plane(
    feet: Float[np.ndarray, "n 3"], up: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " 3"], float, float]:
    """Normal near `up`, level along it, and spread (m, standard deviation across the shorter way) of
    standing feet.

    Lifted feet lie above the plane: residuals above count less than those below. The tilt is held to the
    cameras' up direction (one degree) against the scatter of the feet (a centimetre at least).
    """
    x = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    x /= np.linalg.norm(x)
    y = np.cross(up, x)
    middle = np.median(feet, axis=0)
    a, b, h = (feet - middle) @ x, (feet - middle) @ y, (feet - middle) @ up
    weight = np.ones(len(feet))
    slope = np.zeros(3)
    scatter_m = 0.03
    for _ in range(30):
        design = np.column_stack([a, b, np.ones(len(feet))])
        matrix = design.T @ (design * weight[:, None]) / scatter_m**2
        matrix[:2, :2] += np.eye(2) / np.radians(1.0) ** 2
        slope = np.linalg.solve(matrix, design.T @ (weight * h) / scatter_m**2)
        off = h - design @ slope
        scatter_m = max(0.01, float(np.median(np.abs(off))))
        weight = 1 / np.maximum(np.where(off > 0, 3 * off, -off), 0.01)
        weight /= weight.max()
    normal = up - slope[0] * x - slope[1] * y
    normal /= np.linalg.norm(normal)
    level = float((middle + slope[2] * up) @ normal)
    spread = np.linalg.svd(np.column_stack([a, b]) - [a.mean(), b.mean()], compute_uv=False) / np.sqrt(
        len(feet)
    )
    return normal, level, float(spread[-1])


def _moved(rig: Rig, world_from_before: Pose) -> Ground:
    before_from_world = np.linalg.inv(world_from_before)
    cameras = []
    for camera in rig:
        projection = camera.projection
        cameras.append(
            replace(
                camera,
                camera_from_world=camera.camera_from_world @ before_from_world,
                projection=None if projection is None else projection @ before_from_world,
            )
        )
    return Ground(Rig(tuple(cameras)), world_from_before, 1.0, ())


def _upside_down(rig: Rig) -> tuple[str, ...]:
    tops = np.array([camera.up[2] for camera in rig])
    if np.mean(tops < -0.3) > 0.5:
        return (
            f"{int((tops < 0).sum())} of {len(rig)} cameras hang upside down over this floor: it is "
            "mirrored, or "
            "seen from below.",
        )
    return ()
