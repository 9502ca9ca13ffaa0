"""How far hulls stand off what they contain, over the body: taken off before cloth is measured.

A hull of 16 cameras is 2 to 3 mm larger than the person on average, one of 68 less than 1 mm, a scan not at
all. Taken for cloth, the difference makes bodies from scans too thin and bodies from few cameras too fat.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from fit.align import Alignment
from fit.solver import Fitter
from fit.thickness import smoothed_over_mesh
from hull.scan import Scan

#: So many frames, evenly spread, tell it: it is the rig's.
FRAMES = 12
N_NEAREST = 4
#: Rounds of smoothing over the mesh: slack is known place by place only roughly.
ROUNDS = 15


def hull_excess(
    fitter: Fitter, scans: Mapping[int, Scan], alignments: Sequence[Alignment]
) -> Float[np.ndarray, "v"] | None:
    """(V) m: mean over the frames at every vertex of the body; None where scans are no hulls."""
    known = [
        a
        for a in alignments
        if a.status != "failed" and a.frame_id in scans and scans[a.frame_id].excess_m is not None
    ]
    if not known:
        return None
    total = np.zeros(fitter.model.n_vertices)
    chosen = known[:: -(-len(known) // FRAMES)]
    for alignment in chosen:
        scan = scans[alignment.frame_id]
        assert scan.excess_m is not None
        nearest = cKDTree(scan.points).query(fitter.posed(alignment.state), k=N_NEAREST)[1]
        total += scan.excess_m[nearest].mean(axis=1)
    return smoothed_over_mesh(total / len(chosen), fitter.model.faces, ROUNDS)
