"""How well a surface explains the silhouettes, and what lies outside a hull."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Integer

from capture.camera import Camera
from hull.coverage import Coverage, NotClosedError
from hull.errors import HullError
from hull.rays import RayScene
from hull.tables import BORDER_PX, UNKNOWN
from hull.visual_hull import Hull


def projected_mask(
    vertices: Float[np.ndarray, "v 3"], faces: Integer[np.ndarray, "f 3"], camera: Camera
) -> Bool[np.ndarray, "h w"]:
    """Which pixels' centres the mesh covers, seen through the camera's pinhole: (h w)."""
    return _projection(vertices, faces)(camera)


def _projection(
    vertices: Float[np.ndarray, "v 3"], faces: Integer[np.ndarray, "f 3"]
) -> Callable[[Camera], Bool[np.ndarray, "h w"]]:
    """`projected_mask` for several cameras: by the contour if the mesh is closed, else a ray a pixel."""
    try:
        coverage = Coverage(vertices, faces)
    except NotClosedError:
        return RayScene(vertices, faces).mask

    def mask(camera: Camera) -> Bool[np.ndarray, "h w"]:
        covered = coverage.mask(camera)
        return RayScene(vertices, faces).mask(camera) if covered is None else covered

    return mask


def silhouette_agreement(
    vertices: Float[np.ndarray, "v 3"],
    faces: Integer[np.ndarray, "f 3"],
    rig: Iterable[Camera],
    images: Sequence[np.ndarray | None],
) -> Float[np.ndarray, " c"]:
    """Intersection over union, per camera, of the mesh's projection and the silhouette; NaN: no evidence.

    Pixels of value 128 count nowhere. A camera whose silhouette and projection are both empty gets NaN too.
    """
    cameras = tuple(rig)
    if len(cameras) != len(images):
        raise HullError(
            f"{len(cameras)} cameras but {len(images)} silhouettes; give one (or None) per camera, in order"
        )
    mask = _projection(vertices, faces)
    scores = np.full(len(cameras), np.nan)
    for camera_idx, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        if image is None:
            continue
        _check_size(camera, image)
        covered, person = mask(camera), image > UNKNOWN
        # What is person is known; numpy counts flags many times faster than it sums them.
        both = np.count_nonzero(covered & person)
        union = np.count_nonzero(covered & (image != UNKNOWN)) + np.count_nonzero(person) - both
        if union:
            scores[camera_idx] = both / union
    return scores


def contour_distance(
    vertices: Float[np.ndarray, "v 3"],
    faces: Integer[np.ndarray, "f 3"],
    rig: Iterable[Camera],
    images: Sequence[np.ndarray | None],
) -> Float[np.ndarray, " c"]:
    """How far, per camera, the mesh's outline and the silhouette's are apart, in pixels; NaN: no evidence.

    The mean distance from one to the nearest point of the other, averaged over both directions; outlines run
    between a covered pixel's centre and one that is not. Places at unknown pixels or in the picture's border
    count nowhere. The picture's diagonal where one of the two is missing altogether.
    """
    cameras = tuple(rig)
    if len(cameras) != len(images):
        raise HullError(
            f"{len(cameras)} cameras but {len(images)} silhouettes; give one (or None) per camera, in order"
        )
    mask = _projection(vertices, faces)
    distances = np.full(len(cameras), np.nan)
    for camera_idx, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        if image is None:
            continue
        _check_size(camera, image)
        known = image != UNKNOWN
        known[:BORDER_PX] = known[-BORDER_PX:] = False
        known[:, :BORDER_PX] = known[:, -BORDER_PX:] = False
        distances[camera_idx] = mask_distance(mask(camera), image > UNKNOWN, known)
    return distances


def mask_distance(
    one: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> float:
    """Mean distance, px, between the outlines of two masks, both ways, where `known`; NaN without any.

    An outline may end where knowledge does, so the edge of the unknown is as near as the other outline.
    """
    from scipy.spatial import cKDTree

    outlines = [_outline(mask, known) for mask in (one, other)]
    if not len(outlines[0]) and not len(outlines[1]):
        return float("nan")
    if not len(outlines[0]) or not len(outlines[1]):
        return float(np.hypot(*one.shape))
    edge = _outline(known, np.ones_like(known))
    trees = [cKDTree(np.concatenate([outline, edge])) for outline in outlines]
    ways = [tree.query(outline)[0].mean() for tree, outline in zip(trees[::-1], outlines, strict=True)]
    return float(np.mean(ways))


def _outline(mask: Bool[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    """(row, column) of the points half way between neighbouring known pixels of which one is in the mask."""
    across = (mask[:, 1:] != mask[:, :-1]) & known[:, 1:] & known[:, :-1]
    along = (mask[1:] != mask[:-1]) & known[1:] & known[:-1]
    half_right, half_down = np.array([0.0, 0.5]), np.array([0.5, 0.0])
    return np.concatenate([np.argwhere(across) + half_right, np.argwhere(along) + half_down])


def signed_distance(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Integer[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """(N,) metres from a closed surface, negative inside it, to about a micrometre."""
    return RayScene(vertices, faces).signed_distance(points)


def share_outside(points: Float[np.ndarray, "n 3"], hull: Hull, tolerance_m: float = 0.0) -> float:
    """The share of points that lie more than `tolerance_m` outside the hull."""
    return float((signed_distance(points, hull.vertices, hull.faces) > tolerance_m).mean())


def _check_size(camera: Camera, image: np.ndarray) -> None:
    width, height = camera.size
    if image.shape != (height, width):
        raise HullError(
            f"camera {camera.name}: its silhouette is {image.shape}, expected ({height}, {width})"
        )
