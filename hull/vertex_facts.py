"""What every vertex of a hull carries beside its place: who bounds it, how much room it has, whether it is
needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from hull.culling import Culling
from hull.phantoms import find_phantoms
from hull.rays import RayScene
from hull.slack import outlines_at, slack_at, spread_to_neighbours


@dataclass(frozen=True, eq=False)
class VertexFacts:
    """The fields of a `Hull` that tell how much to trust it; see there."""

    n_witnesses: Int[np.ndarray, " v"]
    n_bounding: Int[np.ndarray, " v"]
    cut_by: Int[np.ndarray, " v"]
    slack_m: Float[np.ndarray, " v"]
    is_phantom: Bool[np.ndarray, " v"]


def vertex_facts(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    cut_by: Int[np.ndarray, " v"],
    culling: Culling,
    scene: RayScene,
) -> VertexFacts:
    """The facts of a finished hull (closed, outward normals, metres). `cut_by` (V,): table or -1.

    `scene`: of the same vertices and faces.
    """
    tables = culling.tables
    camera_idx = np.array([table.camera_idx for table in tables] + [-1])
    outlines = outlines_at(vertices, culling)
    slack_m = spread_to_neighbours(slack_at(vertices, normals, scene, outlines, tables), faces)
    return VertexFacts(
        n_witnesses=outlines.n_witnesses,
        n_bounding=outlines.n_bounding,
        cut_by=camera_idx[cut_by],
        slack_m=slack_m,
        is_phantom=find_phantoms(vertices, faces, normals, slack_m, scene, tables),
    )
