"""What a check of a recording finds: a kind, the cameras, what was seen, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class FindingKind(StrEnum):
    """The kinds of trouble that a check tells apart; the value is how it is told."""

    UNITS = "units"
    INVERTED = "inverted extrinsics"
    SWAPPED = "swapped cameras"
    PICTURE_SIZE = "half-size calibration"
    UNSYNCHRONISED = "unsynchronised camera"
    MIRRORED = "mirrored"
    STALE = "stale frames"
    DEAD = "dead camera"
    CALIBRATION = "calibration off"
    SILHOUETTES = "wrong silhouettes"
    UNREADABLE = "inconsistent recording"


@dataclass(frozen=True)
class Finding:
    """One line of the verdict.

    cameras : names; those of the whole rig where `whole_rig`.
    text : what was seen, with numbers. action : what to do, an imperative.
    numbers : what the text tells, for programs (JSON-ready).
    """

    kind: FindingKind
    cameras: tuple[str, ...]
    text: str
    action: str
    whole_rig: bool = False
    numbers: dict[str, Any] = field(default_factory=dict)

    def sentence(self) -> str:
        """The line for the user."""
        plural = "s" if len(self.cameras) > 1 else ""
        who = "the whole rig" if self.whole_rig else f"camera{plural} {', '.join(self.cameras)}"
        return f"{self.kind.value}: {who}: {self.text}; {self.action}"

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {
            "kind": self.kind.name.lower(),
            "label": self.kind.value,
            "cameras": list(self.cameras),
            "whole_rig": self.whole_rig,
            "text": self.text,
            "action": self.action,
            **self.numbers,
        }
