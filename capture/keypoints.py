"""Keypoints detected in several cameras (BODY_25's points) -> one person's joints in the world.

Several people and wrong detections are usual: the person is chosen per camera by the silhouette and by
agreement between cameras, and every joint is triangulated by LO-RANSAC (pycolmap), so that one wrong view
does not bend it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float, UInt8

from capture.camera import Camera
from capture.formats.openpose import N_JOINTS
from capture.keypoint_files import read_keypoints
from capture.rig import Rig
from capture.silhouette_files import PERSON

__all__ = ["choose_person", "chosen_detections", "read_keypoints", "triangulate_keypoints"]

_LEAST_SCORE = 0.1
_LEAST_JOINTS = 6
_AGREEMENT_RAD = 0.035  # two degrees: a calibration one degree off and OpenPose's own noise pass
_LEAST_ANGLE_DEG = 3.0

People = Float[np.ndarray, "_p 25 3"]
Silhouette = UInt8[np.ndarray, "_h _w"]


def triangulate_keypoints(
    rig: Rig,
    per_camera: Sequence[People],
    silhouettes: Sequence[Silhouette | None] | None,
) -> Float[np.ndarray, "25 4"]:
    """The subject's joints (25 4): x y z in world units and a confidence in 0..1; NaN and 0 where not found.

    rig : the cameras as filmed, lens included (`Recording.calibration`), since the detections are pixels as
    filmed.
    silhouettes : undistorted ones, as `Recording.silhouettes` gives them, or None.
    The confidence is the mean score of the agreeing detections times their share among all detections of the
    joint.
    """
    planes, chosen = _choose(rig, per_camera, silhouettes)
    joints = np.full((N_JOINTS, 4), np.nan)
    joints[:, 3] = 0.0
    for joint_idx in range(N_JOINTS):
        views = [
            (camera, planes[camera_idx][person_idx, joint_idx])
            for camera_idx, (camera, person_idx) in enumerate(zip(rig, chosen, strict=True))
            if person_idx is not None and planes[camera_idx][person_idx, joint_idx, 2] >= _LEAST_SCORE
        ]
        found = _triangulate(views)
        if found is not None:
            joints[joint_idx] = found
    return joints


def chosen_detections(
    rig: Rig,
    per_camera: Sequence[People],
    silhouettes: Sequence[Silhouette | None] | None,
) -> Float[np.ndarray, "c 25 3"]:
    """The subject's detections in every camera (C 25 3): pixels of the camera's pinhole, and the score; 0
    where there is none, or one not to be used.

    Arguments as for `triangulate_keypoints`.
    """
    planes, chosen = _choose(rig, per_camera, silhouettes)
    found = np.zeros((len(rig), N_JOINTS, 3))
    for camera_idx, (camera, person_idx) in enumerate(zip(rig, chosen, strict=True)):
        if person_idx is None:
            continue
        person = planes[camera_idx][person_idx]
        homogeneous = np.column_stack([person[:, :2], np.ones(N_JOINTS)])
        used = person[:, 2] >= _LEAST_SCORE
        found[camera_idx, :, :2] = (homogeneous @ camera.intrinsics.T)[:, :2]
        found[camera_idx, :, 2] = np.where(used, person[:, 2], 0.0)
    return found


def _choose(
    rig: Rig, per_camera: Sequence[People], silhouettes: Sequence[Silhouette | None] | None
) -> tuple[list[People], list[int | None]]:
    """Detections on the plane z = 1, and which of each camera's people is the subject."""
    assert len(per_camera) == len(rig)
    planes = [_on_plane(camera, people) for camera, people in zip(rig, per_camera, strict=True)]
    if silhouettes is not None:
        planes = [
            _on_silhouette(camera, people, mask)
            for camera, people, mask in zip(rig, planes, silhouettes, strict=True)
        ]
    return planes, choose_person(rig, planes)


def choose_person(rig: Rig, planes: Sequence[People]) -> list[int | None]:
    """Which of each camera's people is the subject: the choice on which most cameras agree, closest; None:
    nobody.

    planes : for each camera (P 25 3), x y on the plane z = 1 and score. Every pair of people in two cameras
    is triangulated and looked for in the other cameras.
    """
    # Where no two cameras agree on anybody, nobody is the subject.
    best: tuple[float, list[int | None]] = (0.0, [None] * len(planes))
    for first, second in combinations(range(len(rig)), 2):
        for one in range(len(planes[first])):
            for other in range(len(planes[second])):
                views = ((rig[first], planes[first][one]), (rig[second], planes[second][other]))
                joints = _triangulate_pair(*views)
                score, choice = _agreement(rig, planes, joints)
                if score > best[0]:
                    best = (score, choice)
    return best[1]


def _agreement(
    rig: Rig, planes: Sequence[People], joints: Float[np.ndarray, "25 3"]
) -> tuple[float, list[int | None]]:
    """For each camera the person nearest to these joints if near enough, and how well all of them agree
    together."""
    score = 0.0
    choice: list[int | None] = []
    for camera, people in zip(rig, planes, strict=True):
        best: tuple[float, int | None] = (0.0, None)
        for person_idx, person in enumerate(people):
            error = _angles(camera, joints, person)
            usable = np.isfinite(error)
            if usable.sum() < _LEAST_JOINTS:
                continue
            quality = float(np.clip(1 - error[usable] / (2 * _AGREEMENT_RAD), 0, 1).sum()) / N_JOINTS
            if np.median(error[usable]) < _AGREEMENT_RAD and quality > best[0]:
                best = (quality, person_idx)
        score += best[0]
        choice.append(best[1])
    return score, choice


def _angles(
    camera: Camera, joints: Float[np.ndarray, "25 3"], person: Float[np.ndarray, "25 3"]
) -> Float[np.ndarray, " 25"]:
    """Angle (rad) between each joint and its detection as seen from the camera; NaN where one of them is
    missing."""
    pose = camera.camera_from_world
    seen = joints @ pose[:3, :3].T + pose[:3, 3]
    ray = np.column_stack([person[:, :2], np.ones(N_JOINTS)])
    sine = np.linalg.norm(np.cross(seen, ray), axis=1)
    angle = np.arctan2(sine, (seen * ray).sum(axis=1))
    return np.where(person[:, 2] >= _LEAST_SCORE, angle, np.nan)


def _triangulate_pair(
    one: tuple[Camera, Float[np.ndarray, "25 3"]], other: tuple[Camera, Float[np.ndarray, "25 3"]]
) -> Float[np.ndarray, "25 3"]:
    """Midpoints of the closest approach of two cameras' rays (25 3); NaN where a detection is missing."""
    (camera, person), (second, other_person) = one, other
    directions = []
    for view, detections in ((camera, person), (second, other_person)):
        ray = np.column_stack([detections[:, :2], np.ones(N_JOINTS)]) @ view.camera_from_world[:3, :3]
        directions.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    first, last = directions
    between = second.centre - camera.centre
    cosine = (first * last).sum(axis=1)
    scale = 1 - np.minimum(cosine**2, 1 - 1e-9)
    along_first = (first @ between - cosine * (last @ between)) / scale
    along_last = (cosine * (first @ between) - last @ between) / scale
    middle = (camera.centre + along_first[:, None] * first + second.centre + along_last[:, None] * last) / 2
    seen = (person[:, 2] >= _LEAST_SCORE) & (other_person[:, 2] >= _LEAST_SCORE)
    return np.where((seen & (along_first > 0) & (along_last > 0))[:, None], middle, np.nan)


def _triangulate(views: Sequence[tuple[Camera, Float[np.ndarray, " 3"]]]) -> Float[np.ndarray, " 4"] | None:
    """One joint from its detections on the plane z = 1 (x y score): x y z and confidence; None where views
    disagree."""
    if len(views) < 2:
        return None
    options = pycolmap.EstimateTriangulationOptions()
    options.min_tri_angle = np.radians(_LEAST_ANGLE_DEG)
    options.residual_type = pycolmap.TriangulationResidualType.ANGULAR_ERROR
    options.ransac.max_error = _AGREEMENT_RAD
    options.ransac.random_seed = 0
    # A camera with focal length 1 and principal point 0: the detections are on the plane z = 1 already.
    ideal = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[1.0, 1.0, 0.0, 0.0])
    found = pycolmap.estimate_triangulation(
        np.array([detection[:2] for _, detection in views]),
        [pycolmap.Rigid3d(camera.camera_from_world[:3]) for camera, _ in views],
        [ideal] * len(views),
        options,
    )
    if found is None:
        return None
    agreeing = np.asarray(found["inliers"], dtype=bool)
    scores = np.array([detection[2] for _, detection in views])
    return np.append(np.asarray(found["xyz"]), scores[agreeing].mean() * agreeing.mean())


def _on_plane(camera: Camera, people: People) -> People:
    """Pixels as filmed to the plane z = 1; scores clipped to 0..1, and 0 for what is missing (OpenPose
    writes 0, 0)."""
    if len(people) == 0:
        return people
    pixels = camera.undistort(people[..., :2].reshape(-1, 2))
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    plane = np.linalg.solve(camera.intrinsics, homogeneous.T).T[:, :2]
    missing = (people[..., 0] <= 0) & (people[..., 1] <= 0)
    score = np.where(missing, 0.0, np.clip(people[..., 2], 0, 1))
    return np.concatenate([plane.reshape(*people.shape[:2], 2), score[..., None]], axis=2)


def _on_silhouette(camera: Camera, people: People, mask: Silhouette | None) -> People:
    """Only the people of whom at least half the joints lie on (or within 1 % beside) the silhouette, if
    there are any."""
    if mask is None or len(people) == 0:
        return people
    reach = 2 * max(1, round(max(mask.shape) / 100)) + 1
    near = cv2.dilate((mask == PERSON).astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    homogeneous = np.concatenate([people[..., :2], np.ones((*people.shape[:2], 1))], axis=2)
    pixels = np.rint(homogeneous @ camera.intrinsics.T)[..., :2].astype(int)
    height, width = mask.shape
    inside = (pixels >= 0).all(axis=2) & (pixels[..., 0] < width) & (pixels[..., 1] < height)
    column, row = pixels[..., 0].clip(0, width - 1), pixels[..., 1].clip(0, height - 1)
    seen = people[..., 2] >= _LEAST_SCORE
    share = (inside & near[row, column] & seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    # Joints off the silhouette are wrong whoever they belong to.
    kept = people[share >= 0.5].copy()
    kept[..., 2] *= (inside & near[row, column])[share >= 0.5]
    return kept
