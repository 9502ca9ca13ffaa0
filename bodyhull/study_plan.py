"""What a rig study varies: one thing at a time around a usual rig, so that each curve has one cause."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from bodyhull.config import Units, Up
from bodyhull.errors import UserError
from capture.rig import Rig
from capture.rig_choice import numbered, read_rig, resized, spread_subset, stood_round_origin
from render.synthetic import LAYOUTS

WAIST = np.array([0.0, 0.0, 1.0])
"""Where cameras of a calibration look, in the study's world (metres, z up)."""


@dataclass(frozen=True)
class Case:
    """One rig under test. width_px: of the pictures; the noises are standard deviations in pixels."""

    cameras: int
    width_px: int
    calibration_px: float = 0.0
    mask_px: float = 0.0

    @property
    def name(self) -> str:
        """A folder's name: 16-cameras_1024-px_0-calibration_0-mask."""
        return (
            f"{self.cameras}-cameras_{self.width_px}-px_{self.calibration_px:g}-calibration_"
            f"{self.mask_px:g}-mask"
        )


@dataclass(frozen=True)
class Factor:
    """One curve: its cases in the order of `values`, the numbers that change."""

    title: str
    unit: str
    values: tuple[float, ...]
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class StudyPlan:
    """Rigs to compare. calibration: a file with the cameras, or None for a layout. base: what is held while
    one thing changes.
    """

    base: Case
    cameras: tuple[int, ...]
    widths: tuple[int, ...]
    calibration_px: tuple[float, ...]
    mask_px: tuple[float, ...]
    layout: str = "dome"
    calibration: Path | None = None
    size: tuple[int, int] | None = None
    units: Units = "auto"
    up: Up = "auto"

    def factors(self) -> tuple[Factor, ...]:
        """The curves; a factor with a single value is none."""
        base = self.base
        cases = (
            tuple(replace(base, cameras=n) for n in sorted(set(self.cameras))),
            tuple(replace(base, width_px=n) for n in sorted(set(self.widths))),
            tuple(replace(base, calibration_px=v) for v in sorted(set(self.calibration_px))),
            tuple(replace(base, mask_px=v) for v in sorted(set(self.mask_px))),
        )
        titles = ("number of cameras", "picture width", "calibration noise", "mask noise")
        values = (self.cameras, self.widths, self.calibration_px, self.mask_px)
        return tuple(
            Factor(title, "px" if k else "cameras", tuple(float(v) for v in sorted(set(values[k]))), cases[k])
            for k, title in enumerate(titles)
            if len(cases[k]) > 1
        )

    def cases(self) -> tuple[Case, ...]:
        """Every rig once, the base first."""
        return tuple(
            dict.fromkeys([self.base, *(case for factor in self.factors() for case in factor.cases)])
        )

    def rig(self, case: Case) -> Rig:
        """The cameras of a case as they truly stand: metres, z up, the person at the origin."""
        if self.calibration is None:
            return LAYOUTS[self.layout](case.cameras, (case.width_px, case.width_px))
        return resized(numbered(spread_subset(self.all_cameras(), case.cameras, WAIST)), case.width_px)

    def all_cameras(self) -> Rig:
        """Every camera of the calibration, stood round the origin."""
        assert self.calibration is not None
        rig, unit = read_rig(self.calibration, self.size)
        return stood_round_origin(rig, unit, units=self.units, up=self.up)

    def as_dict(self) -> dict[str, object]:
        """JSON-ready."""
        return {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self).items()}


def plan_of(
    *,
    layout: str,
    calibration: Path | None,
    size: tuple[int, int] | None,
    units: Units,
    up: Up,
    cameras: tuple[int, ...],
    widths: tuple[int, ...],
    calibration_px: tuple[float, ...],
    mask_px: tuple[float, ...],
    base_cameras: int,
    base_width: int,
) -> StudyPlan:
    """The plan of what the user asked for. With a calibration its own number and width are the base and bound
    the rest. Raises UserError (or the calibration's own error).
    """
    base = Case(base_cameras, base_width)
    if calibration is not None:
        rig, _ = read_rig(calibration, size)
        base = Case(len(rig), rig[0].size[0])
        cameras = (*(n for n in cameras if n < len(rig)), len(rig))
        factors_of_width = [width / base_width for width in widths]
        widths = tuple(round(base.width_px * factor) for factor in factors_of_width)
    for option, values, least in (
        ("cameras", cameras, 2),
        ("widths", widths, 16),
        ("calibration-px", calibration_px, 0),
        ("mask-px", mask_px, 0),
    ):
        if not values or min(values) < least or not np.isfinite(values).all():
            raise UserError(f"--{option} {' '.join(map(str, values))}: give numbers of {least} or more")
    if base.cameras < 2 or base.width_px < 16:
        raise UserError(
            f"--base-cameras {base.cameras} --base-width {base.width_px}: at least 2 cameras and 16 pixels"
        )
    return StudyPlan(
        base,
        (*cameras, base.cameras),
        (*widths, base.width_px),
        (*calibration_px, 0.0),
        (*mask_px, 0.0),
        layout,
        calibration,
        size,
        units,
        up,
    )
