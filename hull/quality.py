"""How well a surface explains the silhouettes, which cameras disagree, and what lies outside a hull.

The mesh is projected exactly: one ray through the centre of every pixel that could show it (filling projected polygons
would widen it by up to a pixel).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from capture.camera import Camera
from hull.bounds import Bounds, bounds_from_tables
from hull.carve import carve
from hull.diagnosis import why_empty
from hull.errors import HullError
from hull.surface import binary_surface, cross_exactly
from hull.tables import UNKNOWN, prepare_tables
from hull.visual_hull import Hull, grid_over
from hull.witnesses import witness_rule

# A camera is suspicious when it lacks or adds more than this share, and this many times more than the typical camera.
_SUSPICIOUS_SHARE = 0.03
_SUSPICIOUS_FACTOR = 4.0


def projected_mask(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], camera: Camera
) -> Bool[np.ndarray, "h w"]:
    """Which pixels' centres the mesh covers, seen through the camera's pinhole: (h w)."""
    return _Projector(vertices, faces).mask(camera)


def silhouette_agreement(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    rig: Iterable[Camera],
    images: Sequence[np.ndarray | None],
) -> Float[np.ndarray, " c"]:
    """Intersection over union, per camera, of the mesh's projection with the silhouette; NaN without evidence.

    Pixels of value 128 count nowhere. A camera whose silhouette and projection are both empty gets NaN too.
    """
    cameras = tuple(rig)
    if len(cameras) != len(images):
        raise HullError(f"{len(cameras)} cameras but {len(images)} silhouettes; give one (or None) per camera, in order")
    projector = _Projector(vertices, faces)
    scores = np.full(len(cameras), np.nan)
    for camera_idx, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        if image is None:
            continue
        _check_size(camera, image)
        covered = projector.mask(camera)
        known = image != UNKNOWN
        person = image > UNKNOWN
        union = int(((covered | person) & known).sum())
        if union:
            scores[camera_idx] = int((covered & person & known).sum()) / union
    return scores


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

    The measure is the hull in which two cameras are needed to carve (reference, section 6d): a silhouette that lacks a
    part cannot cut it, so the part shows up as missing there; agreement with the ordinary hull would blame all the
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
        raise HullError(why_empty(tables, rule, box))
    surface = binary_surface(blocks)
    # Exits are those of every camera alike, so the vertices stay in the middle where two votes are needed.
    vertices = (
        cross_exactly(surface, grid, tables) if votes == 1 else grid.centres(0.5 * (surface.inner + surface.outer).T).T
    )
    projector = _Projector(vertices, surface.faces)
    shares = []
    for table in tables:
        camera, image = cameras[table.camera_idx], images[table.camera_idx]
        assert image is not None
        covered, known, person = projector.mask(camera), image != UNKNOWN, image > UNKNOWN
        area = max(int((covered & known).sum()), 1)
        # The two-vote shape is a little wider than each silhouette anyway: only what is deeper than that counts.
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
    """Names of the cameras whose agreement (C,) is much worse than the rest's; NaN entries are passed over."""
    shortfall = 1.0 - scores
    limit = max(_SUSPICIOUS_SHARE, _SUSPICIOUS_FACTOR * float(np.nanmedian(shortfall))) if len(scores) else 0.0
    return tuple(name for name, lack in zip(names, shortfall, strict=True) if lack > limit)


def signed_distance(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """(N,) metres from a closed surface, negative inside it. About a micrometre of rounding at a person's size."""
    import open3d as o3d

    projector = _Projector(vertices, faces)
    query = o3d.core.Tensor((points - projector.middle).astype(np.float32))
    distance = projector.scene.compute_distance(query).numpy().astype(np.float64)
    # Three rays vote, because one that grazes an edge may miscount.
    inside = projector.scene.compute_occupancy(query, nsamples=3).numpy() > 0.5
    return np.where(inside, -distance, distance)


def share_outside(points: Float[np.ndarray, "n 3"], hull: Hull, tolerance_m: float = 0.0) -> float:
    """The share of points that lie more than `tolerance_m` outside the hull."""
    return float((signed_distance(points, hull.vertices, hull.faces) > tolerance_m).mean())


class _Projector:
    """A mesh ready for rays, in coordinates about its own middle (rays are single precision)."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        import open3d as o3d

        self.vertices = np.asarray(vertices, dtype=np.float64)
        self.middle = 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))
        self.scene: Any = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(
            o3d.core.Tensor((self.vertices - self.middle).astype(np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
        )

    def mask(self, camera: Camera) -> UInt8[np.ndarray, "h w"]:
        import open3d as o3d

        width, height = camera.size
        covered = np.zeros((height, width), dtype=bool)
        p = np.asarray(camera.projection_matrix, dtype=np.float64)
        u, v, depth = p[:, :3] @ self.vertices.T + p[:, 3:]
        if (depth > 0).all():
            u, v = u / depth, v / depth
            x_0, x_1 = max(int(np.floor(u.min())), 0), min(int(np.ceil(u.max())), width - 1)
            y_0, y_1 = max(int(np.floor(v.min())), 0), min(int(np.ceil(v.max())), height - 1)
        else:
            # Partly behind the camera: its projection has no box.
            x_0, x_1, y_0, y_1 = 0, width - 1, 0, height - 1
        if x_1 < x_0 or y_1 < y_0:
            return covered
        inverse = np.linalg.inv(p[:, :3])
        origin = -inverse @ p[:, 3] - self.middle
        columns, rows = np.meshgrid(np.arange(x_0, x_1 + 1.0), np.arange(y_0, y_1 + 1.0))
        ways = columns[..., None] * inverse[:, 0] + rows[..., None] * inverse[:, 1] + inverse[:, 2]
        rays = np.empty((*ways.shape[:2], 6), dtype=np.float32)
        rays[..., :3] = origin
        rays[..., 3:] = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
        hit = self.scene.test_occlusions(o3d.core.Tensor(rays)).numpy()
        covered[y_0 : y_1 + 1, x_0 : x_1 + 1] = hit
        return covered


def _core(region: Bool[np.ndarray, "h w"]) -> int:
    """Pixels of the parts of a region that are thicker than a seam (nine pixels), at their full size."""
    opened = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
    return int(opened.sum())


def _check_size(camera: Camera, image: np.ndarray) -> None:
    width, height = camera.size
    if image.shape != (height, width):
        raise HullError(f"camera {camera.name}: its silhouette is {image.shape}, expected ({height}, {width})")
