"""What a format cannot hold, told the same way for all of them: refused where pixels would move, noted where
only other programs look away."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.errors import RecordingError
from capture.rig import Rig

# OpenCV's names in OpenCV's order.
_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def require_pinholes(rig: Rig, holder: str) -> None:
    """Raise RecordingError where a camera's lens distorts: `holder` (the format) has no place for it."""
    bent = [camera for camera in rig if camera.distortion.any()]
    if bent:
        raise RecordingError(
            f"no lens distortion fits into {holder}, but {_listed(bent)} of {len(rig)} have one; "
            "--undistorted writes the cameras of undistorted pictures; opencv, easymocap and colmap hold "
            "the lens"
        )


def require_terms(rig: Rig, n_terms: int, holder: str) -> None:
    """Raise RecordingError where a lens has terms beyond the first `n_terms` of OpenCV's."""
    bent = [camera for camera in rig if camera.distortion[n_terms:].any()]
    if bent:
        raise RecordingError(
            f"only the lens terms {' '.join(_TERMS[:n_terms])} fit into {holder}, but {_listed(bent)} of "
            f"{len(rig)} have more; --undistorted writes the cameras of undistorted pictures, opencv and "
            "colmap hold all"
        )


def require_no_skew(rig: Rig, holder: str) -> None:
    """Raise RecordingError where pixels are skewed: `holder` has no place for it."""
    skewed = [camera for camera in rig if _is_skewed(camera)]
    if skewed:
        raise RecordingError(
            f"no skew fits into {holder}, but {_listed(skewed)} of {len(rig)} have one "
            f"({skewed[0].intrinsics[0, 1]:.3g} px in {skewed[0].name}); "
            "inria, middlebury, qualisys and bodyhull hold it"
        )


def skew_notes(rig: Rig, holder: str, readers: str) -> list[str]:
    """A sentence where skewed pixels are written that the format's own programs look away from."""
    skewed = [camera for camera in rig if _is_skewed(camera)]
    if not skewed:
        return []
    largest = max(abs(camera.intrinsics[0, 1]) for camera in skewed)
    return [
        f"{holder}: {_listed(skewed)} have skewed pixels (up to {largest:.3g} px); the matrices hold "
        f"that, but {readers} ignores it."
    ]


def key_names(rig: Rig, allowed: str, holder: str) -> tuple[list[str], list[str]]:
    """The cameras' names with every character outside `allowed` and letters and digits replaced by "_", and
    notes.

    Raises RecordingError where two become the same.
    """
    names = [
        "".join(c if (c.isascii() and c.isalnum()) or c in allowed else "_" for c in n) for n in rig.names
    ]
    if len(set(names)) < len(names):
        raise RecordingError(
            f"{holder}: the camera names {', '.join(rig.names)} do not differ in its alphabet"
        )
    changed = [f"{old} to {new}" for old, new in zip(rig.names, names, strict=True) if old != new]
    return names, [f"{holder}: cameras renamed, {', '.join(changed)}."] if changed else []


def number_text(value: float) -> str:
    """The shortest decimal that reads back to the same double, never a bare integer."""
    return repr(float(value))


def row_text(values: Sequence[float] | np.ndarray) -> str:
    """Numbers with commas between, each at full precision."""
    return ", ".join(number_text(value) for value in values)


def read_text(path: Path) -> str:
    """A text file's content. Raises RecordingError where it cannot be read or is no text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise RecordingError(
            f"{path}: is not a text file (byte {error.start}); is it the right one?"
        ) from error


def _is_skewed(camera: Camera) -> bool:
    # Half the 1e-6 px that a conversion may lose: a matrix split into K, R and t leaves skews of 1e-12.
    skew = abs(float(camera.intrinsics[0, 1]))
    return skew * max(camera.size) / float(camera.intrinsics[1, 1]) > 5e-7


def _listed(cameras: Sequence[Camera]) -> str:
    names = [camera.name for camera in cameras]
    return (
        "cameras " * (len(names) > 1)
        + "camera " * (len(names) == 1)
        + ", ".join(names[:6])
        + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    )
