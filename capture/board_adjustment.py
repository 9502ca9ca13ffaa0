"""One bundle adjustment over the whole rig, through pycolmap: the board is the world.

A board that moves before cameras that stand is the same as a rig that moves before a board that lies: the
corners are fixed points, the rig's pose is another one each moment, and what is wanted are the cameras'
poses in the rig and their intrinsics. Scale and gauge come from the board. Pixels move by half on the way in
and out, as COLMAP counts from the corner of the first pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float

from capture.board import Board
from capture.board_intrinsics import Intrinsics
from capture.board_start import Pose, RigPose
from capture.board_view import BoardView

_LOSS_PX = 1.0
_FUNCTION_TOLERANCE = 1e-6  # pycolmap's own is nought: a hundred iterations that gain nothing


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Intrinsics and poses after the adjustment. Fields as in `RigPose`; lone_poses: camera_from_board of
    the views that no other camera shares, in the order of `Sightings.alone`, by camera; converged:
    pycolmap's word for it.
    """

    intrinsics: tuple[Intrinsics | None, ...]
    camera_from_rig: Mapping[int, Pose]
    rig_from_board: Mapping[int, Pose]
    converged: bool


def adjust(
    rig: RigPose,
    board: Board,
    intrinsics: Sequence[Intrinsics | None],
    lone: Mapping[int, Sequence[tuple[BoardView, Pose]]] | None = None,
    *,
    fixed_intrinsics: bool = False,
    fixed_principal_points: bool = False,
    n_threads: int = -1,
) -> Adjusted:
    """Intrinsics, camera poses and board poses that fit all corners best, wrong corners counting little.

    lone: views that only one camera has, with a first camera_from_board each: they help its intrinsics.
    """
    model, images = _reconstruction(rig, board, intrinsics, lone or {})
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_points3D = False
    options.refine_focal_length = options.refine_extra_params = not fixed_intrinsics
    options.refine_principal_point = not fixed_intrinsics and not fixed_principal_points
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_PX
    solver = options.ceres.solver_options
    solver.function_tolerance = _FUNCTION_TOLERANCE
    solver.num_threads = n_threads
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in images:
        config.add_image(image_id)
    for point_id in model.points3D:
        config.add_constant_point(point_id)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return _read_back(rig, intrinsics, model, str(summary.termination_type))


def _rigid(pose: Pose) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(np.ascontiguousarray(pose[:3]))


def _matrix(pose: pycolmap.Rigid3d | None) -> Pose:
    assert pose is not None
    out = np.eye(4)
    out[:3] = pose.matrix()
    return out


def _reconstruction(
    rig: RigPose,
    board: Board,
    intrinsics: Sequence[Intrinsics | None],
    lone: Mapping[int, Sequence[tuple[BoardView, Pose]]],
) -> tuple[pycolmap.Reconstruction, list[int]]:
    model = pycolmap.Reconstruction()
    layout = pycolmap.Rig(rig_id=1)
    reference = rig.members[0]
    to_reference = np.linalg.inv(rig.camera_from_rig[reference])
    for c in rig.members:
        model.add_camera(_camera(c, rig.sightings.sizes[c], intrinsics[c]))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, c + 1)
        if c == reference:
            layout.add_ref_sensor(sensor)
        else:
            layout.add_sensor(sensor, _rigid(rig.camera_from_rig[c] @ to_reference))
    model.add_rig(layout)
    # Points: the board's corners, seen by nobody yet; their numbers are the corners' plus one.
    for corner in board.corners:
        model.add_point3D(corner, pycolmap.Track())
    images: list[int] = []
    frame_id = 0

    def add_frame(pose: Pose, views: Mapping[int, BoardView]) -> None:
        nonlocal frame_id
        frame_id += 1
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
        frame.rig_from_world = _rigid(pose)
        ids = {}
        for c in views:
            ids[c] = len(images) + 1
            images.append(ids[c])
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, c + 1)
            frame.add_data_id(pycolmap.data_t(sensor, ids[c]))
        model.add_frame(frame)
        for c, view in views.items():
            image = pycolmap.Image(
                name=f"{frame_id:06d}_{c:03d}", keypoints=view.pixels + 0.5, camera_id=c + 1, image_id=ids[c]
            )
            image.frame_id = frame_id
            model.add_image(image)
            for k, corner in enumerate(view.ids):
                model.add_observation(int(corner) + 1, pycolmap.TrackElement(ids[c], k))
        model.register_frame(frame_id)

    for moment, pose in rig.rig_from_board.items():
        views = {c: rig.sightings.views[c][moment] for c in rig.members if moment in rig.sightings.views[c]}
        if views:
            add_frame(rig.camera_from_rig[reference] @ pose, views)
    for c, seen in lone.items():
        for view, camera_from_board in seen:
            rig_from_camera = np.linalg.inv(rig.camera_from_rig[c] @ to_reference)
            add_frame(rig_from_camera @ camera_from_board, {c: view})
    return model, images


def _camera(camera_idx: int, size: tuple[int, int], known: Intrinsics | None) -> pycolmap.Camera:
    assert known is not None
    k, d = known.matrix, known.distortion
    parameters = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *d]
    name = "OPENCV" if len(d) == 4 else "FULL_OPENCV"
    return pycolmap.Camera(
        camera_id=camera_idx + 1, model=name, width=size[0], height=size[1], params=parameters
    )


def _read_back(
    rig: RigPose, intrinsics: Sequence[Intrinsics | None], model: pycolmap.Reconstruction, ended: str
) -> Adjusted:
    layout = model.rig(1)
    reference = rig.members[0]
    placed: dict[int, Pose] = {reference: np.eye(4)}
    found = list(intrinsics)
    for c in rig.members:
        if c != reference:
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, c + 1)
            placed[c] = _matrix(layout.sensor_from_rig(sensor))
        p = np.array(model.camera(c + 1).params)
        matrix = np.array([[p[0], 0, p[2] - 0.5], [0, p[1], p[3] - 0.5], [0, 0, 1]])
        before = intrinsics[c]
        assert before is not None
        found[c] = replace(before, matrix=matrix, distortion=p[4:])
    boards = {
        moment: _matrix(model.frame(k + 1).rig_from_world) for k, moment in enumerate(_placed_moments(rig))
    }
    return Adjusted(tuple(found), placed, boards, "CONVERGENCE" in ended and "NO_CONVERGENCE" not in ended)


def _placed_moments(rig: RigPose) -> list[int]:
    return [
        moment
        for moment in rig.rig_from_board
        if any(moment in rig.sightings.views[camera_idx] for camera_idx in rig.members)
    ]


def residuals_px(
    view: BoardView, board: Board, known: Intrinsics, camera_from_board: Pose
) -> Float[np.ndarray, "n 2"]:
    """Seen minus expected corners (N 2), px."""
    expected, _ = cv2.projectPoints(
        board.corners[view.ids],
        cv2.Rodrigues(camera_from_board[:3, :3])[0],
        camera_from_board[:3, 3],
        known.matrix,
        known.distortion,
    )
    return view.pixels - expected.reshape(-1, 2)
