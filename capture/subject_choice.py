"""Only the subject, when several people are in view: the part of a coarse hull that is followed through time.

What differs from the background in all cameras makes a coarse hull (`capture.subject_region`); each of its
parts may be the subject. A part speaks for itself by how many cameras see it, by how near it stands to the
point that the rig looks at, and by its size; over frames spread through the recording the path that scores
best and jumps least is the subject's (dynamic programming). In a frame between them the part nearest that
path is taken, so a frame's answer is the same in whatever order frames are made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from capture.rig import Rig
from capture.subject_region import RegionFinder

_FINDER_SIDE = 240  # px of the longer side: limbs are some pixels wide, and a frame costs little
_VOXEL_M = 0.05
_NEAR_CENTRE_M = 0.8
_NEAR_PATH_M = 0.5
_USUAL_VOXELS = 800  # of a person, hull widened; larger is not more of one
_JUMP_PRICE = 0.5  # of half a metre between two samples
_ASKED_SHARE = 0.03  # of the largest thing in view: smaller ones raise no question of who is meant
_WHOLE, _PART = 0.7, 0.05  # shares of a thing inside the subject's outline: kept whole, cut at the outline

Mask = UInt8[np.ndarray, "_h _w"]


@dataclass(frozen=True)
class SubjectChoice:
    """Who is meant. finder : of the coarse hull; frame_ids (T,), path (T 3) : where the subject is then, in
    voxels of the finder's grid; T may be 0: no hull in any sample."""

    finder: RegionFinder
    frame_ids: Int[np.ndarray, " t"]
    path: Float[np.ndarray, "t 3"]

    @staticmethod
    def build(rig: Rig, samples: Mapping[int, Sequence[Mask | None]]) -> SubjectChoice:
        """samples : frame -> one coarse mask a camera (non-zero where it differs; None: not known), of frames
        spread over the recording. rig : lens included, metres."""
        scale = min(1.0, _FINDER_SIDE / max(max(camera.size) for camera in rig))
        finder = RegionFinder.build(rig, scale)
        times, candidates, scores = [], [], []
        for frame_id in sorted(samples):
            labels = finder.parts(_scaled(finder, samples[frame_id]))
            if labels.max(initial=0) == 0:
                continue
            centres, score = _judged(finder, labels)
            times.append(frame_id)
            candidates.append(centres)
            scores.append(score)
        best = _best_path(candidates, scores)
        path = np.array([c[k] for c, k in zip(candidates, best, strict=True)]).reshape(-1, 3)
        return SubjectChoice(finder, np.array(times, dtype=np.int64), path)

    def kept(self, frame_id: int, coarse: Sequence[Mask | None]) -> list[Mask | None]:
        """Of each camera's coarse mask, what is the subject's (255); everything that is large enough, where
        there is no doubt or no hull."""
        parts = [None if mask is None else _Parts.of(mask) for mask in coarse]
        if all(part is None or part.n_large < 2 for part in parts):
            return [None if part is None else part.mask(part.large()) for part in parts]
        labels = self.finder.parts(_scaled(self.finder, coarse))
        if labels.max(initial=0) == 0:
            return [None if part is None else part.mask(part.large()) for part in parts]
        voxels = labels == self._chosen(frame_id, labels)
        result: list[Mask | None] = []
        for camera_idx, part in enumerate(parts):
            if part is None:
                result.append(None)
                continue
            outline = self.finder.outline(camera_idx, voxels).astype(np.uint8)
            height, width = part.labels.shape
            large = cv2.resize(outline, (width, height), interpolation=cv2.INTER_NEAREST)
            result.append(part.inside(large > 0))
        return result

    def _chosen(self, frame_id: int, labels: Int[np.ndarray, " v"]) -> int:
        centres, scores = _judged(self.finder, labels)
        if len(self.path):
            here = [np.interp(frame_id, self.frame_ids, self.path[:, axis]) for axis in range(3)]
            away_m = np.linalg.norm(centres - np.array(here), axis=1) * _VOXEL_M
            scores = scores + 2 * np.exp(-0.5 * (away_m / _NEAR_PATH_M) ** 2)
        return 1 + int(scores.argmax())


@dataclass(frozen=True)
class _Parts:
    """The connected things of a coarse mask. areas (n,): the first is the background's, set to 0."""

    labels: Int[np.ndarray, "_h _w"]
    areas: Int[np.ndarray, " n"]

    @staticmethod
    def of(mask: Mask) -> _Parts:
        _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
        areas = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
        areas[0] = 0
        return _Parts(labels, areas)

    def large(self) -> Bool[np.ndarray, " n"]:
        return (self.areas > 0) & (self.areas >= 0.01 * self.areas.max())

    @property
    def n_large(self) -> int:
        return int((self.areas > _ASKED_SHARE * max(1, self.areas.max())).sum())

    def mask(self, chosen: Bool[np.ndarray, " n"]) -> Mask:
        return np.where(chosen, 255, 0).astype(np.uint8)[self.labels]

    def inside(self, outline: Bool[np.ndarray, "_h _w"]) -> Mask:
        """What lies in the outline: whole things, or the part of those that reach far beyond it."""
        within = np.bincount(self.labels[outline], minlength=len(self.areas))
        share = within / np.maximum(self.areas, 1)
        share[0] = 0
        whole, cut = self.mask(share >= _WHOLE), self.mask((share >= _PART) & (share < _WHOLE))
        result = np.where(outline, np.maximum(whole, cut), whole)
        again = _Parts.of(result.astype(np.uint8))
        return again.mask(again.large())


def largest_parts(mask: Mask) -> Mask:
    """Without cameras to ask: the largest thing in view, and others of a tenth of it."""
    x, y, width, height = cv2.boundingRect(mask)
    result = np.zeros_like(mask)
    if width:
        box = (slice(y, y + height), slice(x, x + width))
        parts = _Parts.of(mask[box])
        result[box] = parts.mask((parts.areas > 0) & (parts.areas >= 0.1 * parts.areas.max()))
    return result


def _scaled(finder: RegionFinder, coarse: Sequence[Mask | None]) -> list[Mask | None]:
    out: list[Mask | None] = []
    for mask, size in zip(coarse, finder.sizes, strict=True):
        if mask is None:
            out.append(None)
        else:
            small = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
            out.append(cv2.threshold(small, 80, 255, cv2.THRESH_BINARY)[1].astype(np.uint8))
    return out


def _judged(
    finder: RegionFinder, labels: Int[np.ndarray, " v"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Each part's centre (voxels) and how much speaks for it."""
    n_parts = int(labels.max())
    counts = np.bincount(labels, minlength=n_parts + 1)[1:]
    index = np.stack(np.unravel_index(np.arange(len(labels)), finder.shape), axis=1)
    centres = (
        np.stack(
            [np.bincount(labels, weights=index[:, axis], minlength=n_parts + 1)[1:] for axis in range(3)],
            axis=1,
        )
        / np.maximum(counts, 1)[:, None]
    )
    n_views = sum(np.bincount(labels[visible], minlength=n_parts + 1)[1:] for visible in finder.visible)
    agreement = n_views / np.maximum(counts, 1) / len(finder.visible)
    off_m = np.linalg.norm((centres - np.array(finder.shape) / 2)[:, :2], axis=1) * _VOXEL_M
    score = agreement + np.exp(-0.5 * (off_m / _NEAR_CENTRE_M) ** 2) + np.minimum(counts / _USUAL_VOXELS, 1)
    return centres, score


def _best_path(
    candidates: list[Float[np.ndarray, "_n 3"]], scores: list[Float[np.ndarray, " _n"]]
) -> list[int]:
    """One candidate a sample: the greatest sum of scores less the price of jumps."""
    if not candidates:
        return []
    total, origins = scores[0], []
    for before, here, score in zip(candidates, candidates[1:], scores[1:], strict=False):
        jump_m = np.linalg.norm(here[:, None] - before[None], axis=2) * _VOXEL_M
        value = total[None] - _JUMP_PRICE * np.minimum(jump_m / 0.5, 4)
        origins.append(value.argmax(axis=1))
        total = score + value.max(axis=1)
    path = [int(total.argmax())]
    for origin in reversed(origins):
        path.append(int(origin[path[-1]]))
    return path[::-1]
