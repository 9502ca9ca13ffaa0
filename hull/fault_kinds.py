"""What is wrong with a camera's silhouette, seen against a hull that was made without it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from capture.camera import Camera
from hull.rays import RayScene
from hull.tables import PERSON, UNKNOWN, SilhouetteTable

# Differences thinner than this many pixels are seams, as calibration and pixels leave them everywhere.
_SEAM_PX = 7
# A part is missing, and nothing else wrong, when what the rest adds or lacks stays below these shares.
_REST_FITS, _MOST_MISSING = 0.05, 0.6
# Around a missing part this many pixels, or this share of the person's extent, are unknown too.
_MARGIN_PX, _MARGIN_SHARE = 8, 0.01


class FaultKind(StrEnum):
    """What is wrong; the value is how it is told."""

    EMPTY = "its silhouette is empty"
    FULL = "its silhouette covers the whole picture"
    INVERTED = "its silhouette is inverted (person and background swapped)"
    PART_MISSING = "a part of the person is missing in its silhouette"
    MOVED = "its silhouette is moved"
    OTHER = "its silhouette does not fit (another frame or another camera?)"
    TOO_MUCH = "it shows person where other cameras see background"
    CONTRADICTS = "its silhouette contradicts the others"


class FaultAction(StrEnum):
    """What was done about it."""

    LEFT_OUT = "left out"
    REGION_UNKNOWN = "that region counts as unknown"
    KEPT = "kept"


@dataclass(frozen=True)
class CameraFault:
    """One camera against the others in one frame.

    Fields
    ------
    camera_idx, name : the camera.
    missing : what it lacks, as a share of the person's area in its picture (as the other cameras tell it);
        for CONTRADICTS the share of the other cameras' lines of sight that it forbids.
    surplus : what it shows and the others do not, as a share of the same area; of its own lines of sight for
        TOO_MUCH.
    moved_px : (right, down) for MOVED.
    """

    camera_idx: int
    name: str
    kind: FaultKind
    action: FaultAction
    missing: float = 0.0
    surplus: float = 0.0
    moved_px: tuple[float, float] | None = None

    def done(self, action: FaultAction) -> CameraFault:
        """The same fault with another remedy."""
        return replace(self, action=action)

    def sentence(self) -> str:
        """For the user, without the frame."""
        how = ""
        if self.moved_px is not None:
            how = f" by about {self.moved_px[0]:.0f} px to the right and {self.moved_px[1]:.0f} px down"
        shares = [
            f"{word} {share:.0%}"
            for word, share in (("lacks", self.missing), ("adds", self.surplus))
            if share >= 0.005
        ]
        told = f" ({', '.join(shares)})" if shares else ""
        if self.kind is FaultKind.CONTRADICTS:
            told = f" (it forbids {self.missing:.1%} of their lines of sight)"
        if self.kind is FaultKind.TOO_MUCH:
            told = f" ({self.surplus:.0%} of its lines of sight)"
        done = {
            FaultAction.LEFT_OUT: "; it is left out of this frame",
            FaultAction.REGION_UNKNOWN: "; that region counts as unknown",
            FaultAction.KEPT: "; it cuts nothing by that"
            if self.kind is FaultKind.TOO_MUCH or self.kind is FaultKind.FULL
            else "; too few cameras are left to do without it",
        }[self.action]
        return f"camera {self.name}: {self.kind.value}{how}{told}{done}"

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "camera": self.name,
            "kind": self.kind.name.lower(),
            "action": self.action.name.lower(),
            "missing": round(self.missing, 4),
            "surplus": round(self.surplus, 4),
            "moved_px": None if self.moved_px is None else [round(v, 1) for v in self.moved_px],
        }


def classified(
    camera: Camera, camera_idx: int, image: UInt8[np.ndarray, "h w"], scene: RayScene
) -> tuple[CameraFault, UInt8[np.ndarray, "h w"] | None]:
    """The fault (told as left out), and the silhouette with the missing region unknown, if the rest fits.

    `scene` : a hull made without this camera.
    """
    known, person = image != UNKNOWN, image > UNKNOWN
    covered = scene.mask(camera)
    area = max(int((covered & known).sum()), 1)
    lacking = _thick(covered & known & ~person)
    adding = _thick(person & known & ~covered)
    missing, surplus = float(lacking.sum()) / area, float(adding.sum()) / area

    def fault(kind: FaultKind, moved: tuple[float, float] | None = None) -> CameraFault:
        return CameraFault(camera_idx, camera.name, kind, FaultAction.LEFT_OUT, missing, surplus, moved)

    if not person.any():
        return fault(FaultKind.EMPTY), None
    if (person | ~known).mean() > 0.99:
        return fault(FaultKind.FULL), None
    if _overlap(covered & known, known & ~person) > 0.7 > 0.3 > _overlap(covered & known, person):
        return fault(FaultKind.INVERTED), None
    moved = _moved(covered & known, person)
    if moved is not None:
        return fault(FaultKind.MOVED, moved), None
    if surplus < _REST_FITS and 0 < missing < _MOST_MISSING:
        mended = _mended(image, lacking)
        fits = _thick(covered & (mended < UNKNOWN)).sum() < _REST_FITS * area
        return fault(FaultKind.PART_MISSING), mended if fits else None
    return fault(FaultKind.OTHER), None


def kept_against(table: SilhouetteTable, share: float) -> CameraFault:
    """A camera that contradicts the others where none can be spared. `share`: of the lines it forbids."""
    return CameraFault(table.camera_idx, table.name, FaultKind.CONTRADICTS, FaultAction.KEPT, missing=share)


def shows_too_much(
    table: SilhouetteTable, image: UInt8[np.ndarray, "h w"] | None, share: float
) -> CameraFault:
    """A camera whose surplus two others refuse; it removes nothing. `share`: of its lines of sight."""
    full = image is not None and (image == PERSON).mean() > 0.99
    kind = FaultKind.FULL if full else FaultKind.TOO_MUCH
    return CameraFault(table.camera_idx, table.name, kind, FaultAction.KEPT, surplus=share)


def _mended(image: UInt8[np.ndarray, "h w"], lacking: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    rows, columns = np.flatnonzero(lacking.any(axis=1)), np.flatnonzero(lacking.any(axis=0))
    extent = max(np.ptp(rows), np.ptp(columns)) if len(rows) else 0
    margin = int(max(_MARGIN_PX, _MARGIN_SHARE * max(image.shape), 0.05 * extent))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    region = cv2.dilate(lacking.astype(np.uint8), disc) > 0
    return np.where(region, np.uint8(UNKNOWN), image)


def _moved(covered: Bool[np.ndarray, "h w"], person: Bool[np.ndarray, "h w"]) -> tuple[float, float] | None:
    """By how much `person` is moved against `covered`, px (right, down), if that is all there is to it."""
    either = covered | person
    rows, columns = np.flatnonzero(either.any(axis=1)), np.flatnonzero(either.any(axis=0))
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    expected: Float[np.ndarray, "h w"] = np.pad(covered[box], 16).astype(np.float32)
    found: Float[np.ndarray, "h w"] = np.pad(person[box], 16).astype(np.float32)
    (right, down), _ = cv2.phaseCorrelate(expected, found)
    if max(abs(right), abs(down)) < 2.0:
        return None
    back = np.array([[1, 0, -right], [0, 1, -down]], dtype=np.float64)
    moved = cv2.warpAffine(found, back, found.shape[::-1]) > 0.5
    before, after = _overlap(expected > 0.5, found > 0.5), _overlap(expected > 0.5, moved)
    if after > 0.85 and 1 - after < 0.6 * (1 - before):
        return float(right), float(down)
    return None


def _overlap(one: Bool[np.ndarray, "h w"], other: Bool[np.ndarray, "h w"]) -> float:
    return float((one & other).sum()) / max(int((one | other).sum()), 1)


def _thick(region: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The parts of a region that are more than a seam."""
    kernel = np.ones((_SEAM_PX, _SEAM_PX), np.uint8)
    return cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
