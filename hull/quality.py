"""How well a surface explains the silhouettes, which cameras disagree, and what lies outside a hull."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer

from capture.camera import Camera
from hull.bounds import Bounds, bounds_from_tables
from hull.carve import carve
from hull.cleaning import face_pieces, piece_volumes
from hull.coverage import Coverage, NotClosedError
from hull.diagnosis import why_empty
from hull.errors import HullError
from hull.marching import binary_surface
from hull.rays import RayScene
from hull.surface import cross_exactly
from hull.tables import BORDER_PX, UNKNOWN, prepare_tables
from hull.visual_hull import Hull, grid_over
from hull.witnesses import witness_rule

# A camera is suspicious when it lacks or adds more than this share, and this many times more than the typical
# camera.
_SUSPICIOUS_SHARE = 0.03
_SUSPICIOUS_FACTOR = 4.0


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


@dataclass(frozen=True)
class CameraDisagreement:
    """One camera against what the others agree on, as shares of that shape's area in its picture.

    Fields
    ------
    missing : covered by the shape that (almost) all cameras agree on, but background in this silhouette.
    surplus : person in this silhouette, but not covered by that shape.
    suspicious : either is large, and much larger than in the rig's typical camera.
    """

    name: str
    missing: float
    surplus: float
    suspicious: bool


def camera_disagreements(
    rig: Iterable[Camera],
    images: Sequence[np.ndarray | None],
    voxel_m: float = 0.02,
    bounds: Bounds | None = None,
) -> tuple[CameraDisagreement, ...]:
    """Which silhouettes do not fit the others. One entry per camera that gave one, in the rig's order.

    The measure is the hull in which two cameras are needed to carve: a silhouette that lacks a part cannot
    cut it, so the part shows up as missing there; agreement with the ordinary hull would blame all the
    others. Four silhouettes at least are needed for that; with fewer the ordinary hull is used.
    """
    cameras = tuple(rig)
    tables = prepare_tables(cameras, images)
    box = bounds_from_tables(tables) if bounds is None else bounds
    rule = witness_rule(tables, box.centre)
    votes = 2 if len(tables) >= 4 else 1
    grid = grid_over(box, voxel_m)
    blocks = carve(tables, rule, grid, votes=votes)
    if not blocks.n_voxels:
        raise HullError(why_empty(tables, rule, box.low, box.high))
    surface = binary_surface(blocks)
    # Exits are those of every camera alike, so the vertices stay in the middle where two votes are needed.
    middle = 0.5 * (grid.centres(surface.inner.T) + grid.centres(surface.outer.T)).T
    vertices = cross_exactly(surface, grid, tables).vertices if votes == 1 else middle
    # With a vote to spare there are more phantoms; the person is the largest piece.
    label = face_pieces(surface.faces, len(vertices))
    largest = int(np.argmax(piece_volumes(vertices, surface.faces, label)))
    scene = RayScene(vertices, surface.faces[label == largest])
    shares = []
    for table in tables:
        camera, image = cameras[table.camera_idx], images[table.camera_idx]
        assert image is not None
        covered, known, person = scene.mask(camera), image != UNKNOWN, image > UNKNOWN
        area = max(int((covered & known).sum()), 1)
        # The two-vote shape is a little wider than each silhouette anyway: only what is deeper than that
        # counts.
        lacking = _core(covered & known & ~person)
        extra = _core(person & known & ~covered)
        shares.append((lacking / area, extra / area))
    missing, surplus = np.array(shares).T
    limits = [max(_SUSPICIOUS_SHARE, _SUSPICIOUS_FACTOR * float(np.median(v))) for v in (missing, surplus)]
    return tuple(
        CameraDisagreement(table.name, float(m), float(s), bool(m > limits[0] or s > limits[1]))
        for table, m, s in zip(tables, missing, surplus, strict=True)
    )


def suspicious_cameras(scores: Float[np.ndarray, " c"], names: Sequence[str]) -> tuple[str, ...]:
    """Names of the cameras whose agreement (C,) is much worse than the rest's; NaN entries pass."""
    shortfall = 1.0 - scores
    limit = (
        max(_SUSPICIOUS_SHARE, _SUSPICIOUS_FACTOR * float(np.nanmedian(shortfall))) if len(scores) else 0.0
    )
    return tuple(name for name, lack in zip(names, shortfall, strict=True) if lack > limit)


def signed_distance(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Integer[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """(N,) metres from a closed surface, negative inside it, to about a micrometre."""
    return RayScene(vertices, faces).signed_distance(points)


def share_outside(points: Float[np.ndarray, "n 3"], hull: Hull, tolerance_m: float = 0.0) -> float:
    """The share of points that lie more than `tolerance_m` outside the hull."""
    return float((signed_distance(points, hull.vertices, hull.faces) > tolerance_m).mean())


def _core(region: Bool[np.ndarray, "h w"]) -> int:
    """Pixels of the parts of a region that are thicker than a seam (nine pixels), at their full size."""
    opened = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
    return int(opened.sum())


def _check_size(camera: Camera, image: np.ndarray) -> None:
    width, height = camera.size
    if image.shape != (height, width):
        raise HullError(
            f"camera {camera.name}: its silhouette is {image.shape}, expected ({height}, {width})"
        )
