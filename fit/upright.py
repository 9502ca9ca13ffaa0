"""Unit and up axis of scans, which their files leave open.

The unit follows from the size of a person. For the axis the body itself is asked: it is fitted coarsely with
every likely axis as up, both ways round, and the one in which it fits best is up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from capture.world import METRES_PER_UNIT, UP_AXES
from fit.coarse import CoarseScan, refine
from fit.frames import recording_from_body
from fit.initialise import KEPT, N_HEADINGS, PoseFinder

PERSON_M = 1.7
#: A person standing, crouching or with the arms spread, m.
EXTENT_LIMITS_M = (0.6, 3.0)
#: Axes along which the scan is at least this long, relative to its longest, may be up.
LIKELY = 0.45
#: Coarse distances that differ by less than this factor do not settle the axis.
CLEAR = 1.15
TRIED_POINTS = 1500


@dataclass(frozen=True)
class ScanWorld:
    """unit, metres_per_unit, up: name of the axis; notes: how they were found; settled: those that leave no
    doubt."""

    unit: str
    metres_per_unit: float
    up: str
    notes: tuple[str, ...] = ()
    settled: tuple[str, ...] = ()


def settle_unit(points: Sequence[Float[np.ndarray, "_n 3"]], units: str = "auto") -> tuple[str, str]:
    """Unit of some scans in their files' units, and a sentence that says why.

    Raises ValueError where no unit, or not the one given, makes a person of them.
    """
    extent = float(np.median([np.ptp(p, axis=0).max() for p in points]))
    likely = min(
        METRES_PER_UNIT, key=lambda name: abs(np.log(max(extent, 1e-12) * METRES_PER_UNIT[name] / PERSON_M))
    )
    unit = likely if units == "auto" else units
    tall = extent * METRES_PER_UNIT[unit]
    if not EXTENT_LIMITS_M[0] < tall < EXTENT_LIMITS_M[1]:
        if units == "auto":
            raise ValueError(
                f"the scans are {extent:.3g} units long, which is no person in m, cm or mm; scale "
                f"them, or give --units"
            )
        raise ValueError(
            f"--units {units}: the scans are then {tall:.3g} m long, which is no person ({likely} would be)"
        )
    return unit, f"Unit of the scans: {unit} (the person then spans {tall:.2f} m)."


def find_up(
    finder: PoseFinder, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> dict[str, float]:
    """Likely up axes of one scan (metres), best first, with the coarse distance that the body keeps there,
    m."""
    extent = np.ptp(points, axis=0)
    scores: dict[str, float] = {}
    betas = np.zeros(finder.n_model_betas)
    for name, axis in UP_AXES.items():
        if extent[np.abs(axis).argmax()] < LIKELY * extent.max():
            continue
        rotation = recording_from_body(axis)[:3, :3]
        scan = CoarseScan.of(points @ rotation, normals @ rotation, TRIED_POINTS)
        tried = [
            refine(finder.body, scan, finder.prior, finder.facing(scan, heading, betas), (0.3,), 6)
            for heading in 2.0 * np.pi * np.arange(N_HEADINGS) / N_HEADINGS
        ]
        for sigma in (0.15, 0.08):
            tried = sorted(tried, key=lambda at: at.score)[:KEPT]
            tried = [refine(finder.body, scan, finder.prior, at, (sigma,), 6) for at in tried]
        scores[name] = min(at.score for at in tried)
    return dict(sorted(scores.items(), key=lambda item: item[1]))


def settle_world(
    finder: PoseFinder,
    scans: Sequence[tuple[Float[np.ndarray, "_n 3"], Float[np.ndarray, "_n 3"]]],
    units: str = "auto",
    up: str = "auto",
) -> ScanWorld:
    """Unit and up axis of some frames' (points, normals) in file units.

    The frame that is longest for its width settles the axis: the stretched person is told most easily. Raises
    ValueError as `settle_unit`.
    """
    unit, why = settle_unit([p for p, _ in scans], units)
    factor = METRES_PER_UNIT[unit]
    if up != "auto":
        return ScanWorld(unit, factor, up, (why,), (why,))
    sizes = [np.sort(np.ptp(p, axis=0)) for p, _ in scans]
    chosen = int(np.argmax([size[2] / max(size[1], 1e-12) for size in sizes]))
    scores = find_up(finder, factor * scans[chosen][0], scans[chosen][1])
    names = list(scores)
    note = f"Up axis: {names[0]} (a body stands in the scan to {1e3 * scores[names[0]]:.0f} mm"
    if len(names) > 1:
        note += f", along {names[1]} to {1e3 * scores[names[1]]:.0f} mm"
    note += ")."
    if len(names) > 1 and scores[names[1]] < CLEAR * scores[names[0]]:
        return ScanWorld(unit, factor, names[0], (f"{note[:-1]}; if it is not, give --up.", why), (why,))
    return ScanWorld(unit, factor, names[0], (note, why), (note, why))
