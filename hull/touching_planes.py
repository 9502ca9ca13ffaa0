"""Where the planes through two cameras' centres touch their silhouettes.

Of all planes through two centres, those that touch the person touch both silhouettes, and the places where
they do are the two pictures of one point of the surface, a frontier point (Rieger, 1986; Cipolla, Astrom and
Giblin, ICCV 1995). A pair's planes are told apart by one number, the slope: the tangent of the angle around
the line between the centres, nought towards the person. The outermost planes touch the convex hulls, and are
paired without a doubt; the others touch where an outline bulges outwards, and are paired when the two
cameras' slopes are nearly the same and no third camera sees background at the point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import maximum_filter1d

from capture.rig_adjustment import RigPose
from hull.outlines import Outline, outline_of
from hull.tables import BACKGROUND

# A silhouette must lie so far from the line between the centres (cosine of the angle around it): a camera
# that looks along that line sees the person all around it, and no plane touches.
_LEAST_AHEAD = 0.35
# An outline bulges where the slope is the largest within this share of the person's size, by so many pixels.
_BULGE_SHARE, _BULGE_PX = 1 / 85, 0.5
# A third camera must see the point on the person or this near to it.
_NEAR_PX = 3.0


@dataclass(frozen=True, eq=False)
class Touches:
    """Planes that touch, one a row.

    cameras : (R 2) whose silhouettes.
    pixels : (R 2 2) where they touch.
    """

    cameras: Int[np.ndarray, "r 2"]
    pixels: Float[np.ndarray, "r 2 2"]

    @staticmethod
    def joined(parts: Sequence[Touches]) -> Touches:
        """All of them."""
        return Touches(
            np.concatenate([part.cameras for part in parts] or [np.zeros((0, 2), int)]),
            np.concatenate([part.pixels for part in parts] or [np.zeros((0, 2, 2))]),
        )

    def rays(self, pose: RigPose) -> Float[np.ndarray, "r 2 3"]:
        """(R 2 3) to where they touch, camera axes, z = 1."""
        homogeneous = np.concatenate([self.pixels, np.ones((*self.pixels.shape[:2], 1))], axis=2)
        return np.einsum("rsij,rsj->rsi", np.linalg.inv(pose.intrinsics)[self.cameras], homogeneous)

    @staticmethod
    def of_rays(pose: RigPose, cameras: Int[np.ndarray, "r 2"], rays: Float[np.ndarray, "r 2 3"]) -> Touches:
        """Inverse of `rays`."""
        return Touches(cameras, np.einsum("rsij,rsj->rsi", pose.intrinsics[cameras][:, :, :2], rays))


@dataclass(frozen=True, eq=False)
class Possible:
    """Where a camera may see the person, or within some pixels of it: `near` (h w), whose first pixel is
    `origin` (column, row); no pixel beyond it, in a picture of `size` (width, height)."""

    near: Bool[np.ndarray, "h w"]
    origin: tuple[int, int]
    size: tuple[int, int]

    @staticmethod
    def of(image: UInt8[np.ndarray, "h w"]) -> Possible:
        """From a silhouette (255 person, 0 background, 128 unknown)."""
        reach = int(_NEAR_PX)
        x, y, width, height = cv2.boundingRect(image)
        x_0, y_0 = max(x - reach, 0), max(y - reach, 0)
        part = (image[y_0 : y + height + reach, x_0 : x + width + reach] != BACKGROUND).astype(np.uint8)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        return Possible(cv2.dilate(part, disc) > 0, (x_0, y_0), (image.shape[1], image.shape[0]))

    def at(self, pixels: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Whether the person may be there; beyond the picture nobody can say, so yes."""
        # So far beyond any picture that it is an integer still.
        column, row = np.rint(np.clip(pixels, -1e6, 1e6)).astype(int).T
        outside = (column < 0) | (row < 0) | (column >= self.size[0]) | (row >= self.size[1])
        height, width = self.near.shape
        column, row = column - self.origin[0], row - self.origin[1]
        stored = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        there = self.near[row.clip(0, height - 1), column.clip(0, width - 1)] if self.near.size else stored
        return outside | (stored & there)


@dataclass(frozen=True, eq=False)
class OutlineFrame:
    """One frame: for each camera of the rig its outline, and where it may see the person; None where there is
    no evidence."""

    outlines: tuple[Outline | None, ...]
    possible: tuple[Possible | None, ...]

    @staticmethod
    def of(images: Sequence[UInt8[np.ndarray, "_h _w"] | None]) -> OutlineFrame:
        """From silhouettes (255 person, 0 background, 128 unknown), one a camera."""
        outlines = [None if image is None else outline_of(image) for image in images]
        possible = [
            None if image is None or outline is None else Possible.of(image)
            for image, outline in zip(images, outlines, strict=True)
        ]
        return OutlineFrame(tuple(outlines), tuple(possible))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of cameras (P 2) and their frames around the baseline: forward and sideways (P 3), world."""

    cameras: Int[np.ndarray, "p 2"]
    forward: Float[np.ndarray, "p 3"]
    sideways: Float[np.ndarray, "p 3"]
    px_of_slope: Float[np.ndarray, " p"]

    def of_camera(self, camera_idx: int) -> Int[np.ndarray, " q"]:
        return np.flatnonzero((self.cameras == camera_idx).any(axis=1))


def outer_touches(frame: OutlineFrame, pose: RigPose, use: Bool[np.ndarray, " c"]) -> Touches:
    """The outermost touching planes of all pairs of the cameras in use, two a pair where there are any."""
    rays = _rays(frame, pose, use, corners_only=True)
    pairs = _pairs(pose, rays)
    n_pairs = len(pairs.cameras)
    usable = np.ones((2, n_pairs), bool)
    found = np.zeros((2, n_pairs, 2, 3))
    for camera_idx, (in_camera, in_world, sure) in rays.items():
        which = pairs.of_camera(camera_idx)
        side = (pairs.cameras[which, 1] == camera_idx).astype(int)
        slope, ahead = _slopes(in_world, pairs, which)
        for k, index in enumerate((slope.argmin(axis=1), slope.argmax(axis=1))):
            usable[k, which] &= ahead & sure[index]
            found[k, which, side] = in_camera[index]
    return Touches.joined(
        [Touches.of_rays(pose, pairs.cameras[usable[k]], found[k][usable[k]]) for k in (0, 1)]
    )


def inner_touches(
    frame: OutlineFrame, pose: RigPose, use: Bool[np.ndarray, " c"], reach_px: float
) -> Touches:
    """Touching planes wherever outlines bulge, of pairs whose slopes differ by less than `reach_px`."""
    rays = _rays(frame, pose, use, corners_only=False)
    pairs = _pairs(pose, rays)
    # For every pair and side of the person, each camera's places: slopes and rays.
    places: dict[tuple[int, bool], list[tuple[np.ndarray, np.ndarray]]] = {}
    for camera_idx in rays:
        for key, place in _bulges(frame, pose, pairs, camera_idx).items():
            places.setdefault(key, []).append(place)
    cameras, found = [], []
    for (pair_idx, _), of_both in places.items():
        if len(of_both) < 2:
            continue
        # The first camera of a pair was visited first, as cameras are in order.
        (slope, ray), (other_slope, other_ray) = of_both
        apart = np.abs(slope[:, None] - other_slope) * pairs.px_of_slope[pair_idx]
        nearest = apart.argmin(axis=1)
        mutual = apart.argmin(axis=0)[nearest] == np.arange(len(slope))
        mutual &= apart[np.arange(len(slope)), nearest] < reach_px
        found.append(np.stack([ray[mutual], other_ray[nearest[mutual]]], axis=1))
        cameras.append(np.repeat(pairs.cameras[pair_idx][None], mutual.sum(), axis=0))
    touches = Touches.joined([Touches.of_rays(pose, c, r) for c, r in zip(cameras, found, strict=True)])
    seen = _seen_by_all(touches, frame, pose, use)
    return Touches(touches.cameras[seen], touches.pixels[seen])


def _rays(
    frame: OutlineFrame, pose: RigPose, use: Bool[np.ndarray, " c"], corners_only: bool
) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each camera with an outline: rays in its own axes (N 3), in the world's (N 3), and whether sure."""
    result = {}
    for camera_idx, outline in enumerate(frame.outlines):
        if outline is None or not use[camera_idx]:
            continue
        pixels, sure = np.concatenate(outline.loops), np.concatenate(outline.sure)
        if corners_only:
            pixels, sure = pixels[outline.corners], sure[outline.corners]
        in_camera = _on_plane(pose, camera_idx, pixels)
        result[camera_idx] = (in_camera, in_camera @ pose.rotations[camera_idx], sure)
    return result


def _on_plane(pose: RigPose, camera_idx: int, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    return np.linalg.solve(pose.intrinsics[camera_idx], homogeneous.T).T


def _pairs(pose: RigPose, rays: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> _Pairs:
    cameras = np.array(list(combinations(rays, 2)), dtype=int).reshape(-1, 2)
    middles = np.zeros((len(pose.centres), 3))
    for camera_idx, (_, in_world, _) in rays.items():
        middles[camera_idx] = in_world.mean(axis=0)
    present = list(rays)
    if len(present) < 2:
        nothing = np.zeros((0, 3))
        return _Pairs(cameras, nothing, nothing, np.zeros(0))
    subject = meeting_of_lines(pose.centres[present], middles[present])
    baseline = pose.centres[cameras[:, 1]] - pose.centres[cameras[:, 0]]
    baseline /= np.maximum(np.linalg.norm(baseline, axis=1, keepdims=True), 1e-9)
    towards = subject - pose.centres[cameras]
    across = towards - np.einsum("psi,pi->ps", towards, baseline)[..., None] * baseline[:, None]
    away = np.linalg.norm(across, axis=2)
    focal = pose.intrinsics[cameras][..., 0, 0]
    px_of_slope = (focal * away / np.linalg.norm(towards, axis=2)).min(axis=1)
    forward = across[:, 0] / np.maximum(away[:, :1], 1e-9)
    return _Pairs(cameras, forward, np.cross(baseline, forward), px_of_slope)


def meeting_of_lines(
    origins: Float[np.ndarray, "k 3"], directions: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, " 3"]:
    """The point (3,) closest to lines, by least squares."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    return np.linalg.lstsq(across.sum(axis=0), np.einsum("cij,cj->i", across, origins), rcond=None)[0]


def _slopes(
    in_world: Float[np.ndarray, "n 3"], pairs: _Pairs, which: Int[np.ndarray, " q"]
) -> tuple[Float[np.ndarray, "q n"], Bool[np.ndarray, " q"]]:
    """Slopes (Q N) of rays around the baselines of some pairs, and for which pairs they mean something."""
    ahead = pairs.forward[which] @ in_world.T
    beside = pairs.sideways[which] @ in_world.T
    usable = (ahead > _LEAST_AHEAD * np.hypot(ahead, beside)).all(axis=1)
    return beside / np.where(ahead > 0, ahead, 1.0), usable


def _bulges(
    frame: OutlineFrame, pose: RigPose, pairs: _Pairs, camera_idx: int
) -> dict[tuple[int, bool], tuple[np.ndarray, np.ndarray]]:
    """Where one camera's outline bulges towards larger slopes (True) or smaller ones: by pair and side,
    slopes (M,) and rays (M 3)."""
    outline = frame.outlines[camera_idx]
    assert outline is not None
    which = pairs.of_camera(camera_idx)
    # All loops must lie ahead, not only this one.
    every = _on_plane(pose, camera_idx, np.concatenate(outline.loops)[outline.corners])
    which = which[_slopes(every @ pose.rotations[camera_idx], pairs, which)[1]]
    reach = max(round(outline.size_px * _BULGE_SHARE), 4)
    found: dict[tuple[int, bool], tuple[np.ndarray, np.ndarray]] = {}
    for pixels, sure in zip(outline.loops, outline.sure, strict=True):
        if len(pixels) < 2 * reach + 2:
            continue
        along = np.roll(pixels, -1, axis=0) - np.roll(pixels, 1, axis=0)
        # The person is on the right of the walk as the picture is seen (y down).
        inwards = pixels + np.column_stack([-along[:, 1], along[:, 0]])
        rays = _on_plane(pose, camera_idx, pixels)
        slope, _ = _slopes(rays @ pose.rotations[camera_idx], pairs, which)
        within = _on_plane(pose, camera_idx, inwards) @ pose.rotations[camera_idx]
        least = (_BULGE_PX / pairs.px_of_slope[which])[:, None]
        for upwards, height in ((True, slope), (False, -slope)):
            top = height == maximum_filter1d(height, 2 * reach + 1, axis=1, mode="wrap")
            for shift in (reach, -reach):
                top &= height - np.roll(height, shift, axis=1) > least
            row, at = np.nonzero(top & sure)
            pair = which[row]
            behind = (within[at] * pairs.sideways[pair]).sum(axis=1) / (within[at] * pairs.forward[pair]).sum(
                axis=1
            )
            outwards = (behind < slope[row, at]) == upwards
            row, at, pair = row[outwards], at[outwards], pair[outwards]
            for each in np.unique(pair):
                of_pair = pair == each
                place = (slope[row[of_pair], at[of_pair]], rays[at[of_pair]])
                key = (int(each), upwards)
                if key in found:
                    place = tuple(np.concatenate(both) for both in zip(found[key], place, strict=True))  # type: ignore[assignment]
                found[key] = place
    return found


def _seen_by_all(
    touches: Touches, frame: OutlineFrame, pose: RigPose, use: Bool[np.ndarray, " c"]
) -> Bool[np.ndarray, " r"]:
    """Which touching rays (R,) meet in front of both cameras where no camera in use sees background."""
    first, second = touches.cameras.T
    unit = []
    rays = touches.rays(pose)
    for side, cameras in ((0, first), (1, second)):
        ray = np.einsum("rij,ri->rj", pose.rotations[cameras], rays[:, side])
        unit.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    baseline = pose.centres[second] - pose.centres[first]
    cosine = (unit[0] * unit[1]).sum(axis=1)
    scale = 1 - np.minimum(cosine**2, 1 - 1e-9)
    along, beyond = (baseline * unit[0]).sum(axis=1), (baseline * unit[1]).sum(axis=1)
    depth = ((along - cosine * beyond) / scale, (cosine * along - beyond) / scale)
    points = 0.5 * (
        pose.centres[first] + depth[0][:, None] * unit[0] + pose.centres[second] + depth[1][:, None] * unit[1]
    )
    seen = (depth[0] > 0) & (depth[1] > 0)
    for camera_idx, possible in enumerate(frame.possible):
        if possible is None or not use[camera_idx]:
            continue
        there = (points - pose.centres[camera_idx]) @ pose.rotations[camera_idx].T
        in_front = there[:, 2] > 0
        pixels = (there @ pose.intrinsics[camera_idx].T)[:, :2]
        seen &= ~in_front | possible.at(pixels / np.where(in_front, there[:, 2], 1.0)[:, None])
    return seen
