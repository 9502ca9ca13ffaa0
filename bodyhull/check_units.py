"""In which unit a calibration is: what its format or the user says, against the size of the person."""

from __future__ import annotations

import numpy as np

from capture.finding import Finding, FindingKind
from capture.frame_facts import FrameFacts
from capture.preflight import Opened
from capture.rig import Rig
from capture.world import METRES_PER_UNIT, find_subject, subject_extent
from hull.preflight import Examination

_PERSON_M = (0.6, 3.5)


def metric_rig(
    opened: Opened, facts: FrameFacts, found: Examination
) -> tuple[Rig, float, str, list[Finding]]:
    """The rig in metres with its own mistake as a whole undone, metres a unit of it, the unit's name, and
    what is to be said of it."""
    rig = opened.recording.rig
    small = facts.rig
    if found.rig_repair is not None and found.rig_repair.change is not None:
        rig = Rig(tuple(found.rig_repair.change(camera) for camera in rig))
        small = Rig(tuple(found.rig_repair.change(camera) for camera in small))
    extents = []
    for moment in found.moments:
        masks = [
            None if view is None or (found.members and i not in found.members) else view.mask
            for i, view in enumerate(moment.views)
        ]
        extent = subject_extent(small, masks, find_subject(small, masks)[0])
        if extent is not None and np.isfinite(extent) and extent > 0:
            extents.append(extent)
    unit = opened.declared or "m"
    if not extents:
        return rig, opened.recording.metres_per_unit, unit, []
    extent = float(np.median(extents))
    nearest = min(METRES_PER_UNIT, key=lambda name: abs(np.log(extent * METRES_PER_UNIT[name] / 1.7)))
    fits = _PERSON_M[0] < extent * METRES_PER_UNIT[nearest] < _PERSON_M[1]
    names = rig.names
    if opened.declared is None:
        if fits and nearest == "m":
            return rig, 1.0, "m", []
        if fits:
            factor = METRES_PER_UNIT[nearest]
            finding = Finding(
                FindingKind.UNITS,
                names,
                f"the calibration does not say its unit, which is {nearest} by the person's size "
                f"({extent * factor:.2f} m)",
                f"say so with --units {nearest} if that is right (it is what `run` assumes)",
                whole_rig=True,
                numbers={"unit": nearest, "ratio": factor},
            )
            return rig.with_world_scaled(factor), factor, nearest, [finding]
        finding = Finding(
            FindingKind.UNITS,
            names,
            f"the person is {extent:.3g} units tall, which is no person in m, cm or mm",
            f"multiply all translations by about {1.7 / extent:.3g}, or calibrate again",
            whole_rig=True,
            numbers={"ratio": 1.7 / extent},
        )
        return rig.with_world_scaled(1.7 / extent), 1.7 / extent, "unknown", [finding]
    if _PERSON_M[0] < extent < _PERSON_M[1]:
        return rig, opened.recording.metres_per_unit, unit, []
    # The extent is in metres if the declared unit is right.
    own = extent / METRES_PER_UNIT[unit]
    better = min(METRES_PER_UNIT, key=lambda name: abs(np.log(own * METRES_PER_UNIT[name] / 1.7)))
    right = _PERSON_M[0] < own * METRES_PER_UNIT[better] < _PERSON_M[1]
    finding = Finding(
        FindingKind.UNITS,
        names,
        f"with the unit {unit}, which {'was asked for' if opened.asked else 'its format means'}, the person "
        f"is {extent:.3g} m tall" + (f"; its numbers are {better}" if right else ""),
        f"give --units {better}, or convert the calibration"
        if right
        else f"multiply all translations by about {1.7 / extent:.3g}, or calibrate again",
        whole_rig=True,
        numbers={"unit": better if right else None, "ratio": 1.7 / extent},
    )
    factor = METRES_PER_UNIT[better] / METRES_PER_UNIT[unit] if right else 1.7 / extent
    return (
        rig.with_world_scaled(factor),
        opened.recording.metres_per_unit * factor,
        better if right else "unknown",
        [finding],
    )
