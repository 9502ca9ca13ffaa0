"""Hulls of the shared recordings of clothed people agree with every silhouette and hold the naked body."""

from __future__ import annotations

import numpy as np
import pytest

from capture.recording import open_recording
from hull.cleaning import is_closed
from hull.quality import share_outside, silhouette_agreement
from hull.visual_hull import build_hull
from tests.hull_subjects import PEOPLE

pytestmark = pytest.mark.skipif(
    not PEOPLE.is_dir(), reason="the shared recordings are not beside this repository"
)


@pytest.mark.parametrize("sequence", ["f11_bare", "f11_lunge", "m11_mill", "m12_lunge"])
def test_eight_millimetres(sequence: str) -> None:
    recording = open_recording(PEOPLE, sequence=sequence)
    with np.load(PEOPLE / "truth" / f"{sequence}.npz") as truth:
        bodies = truth["vertices"].astype(np.float64)
    frame_id = recording.frame_ids[6]
    images = recording.silhouettes(frame_id).images
    hull = build_hull(recording.rig, images)
    assert is_closed(hull.faces, len(hull.vertices))
    scores = silhouette_agreement(hull.vertices, hull.faces, recording.rig, images)
    assert scores.min() >= 0.99, f"{sequence} frame {frame_id}: worst agreement {scores.min():.4f}"
    body = bodies[recording.frame_ids.index(frame_id)]
    # A pixel is about 2.5 mm there; bare skin lies on the hull itself, so much of it is a little outside.
    out = share_outside(body, hull, tolerance_m=0.0025)
    assert out < 0.03, f"{sequence} frame {frame_id}: {out:.1%} of the body more than a pixel outside"
    assert hull.faults == ()
    assert hull.marks == ()
