"""What holds a hull's surface where it is: whose outlines pass through it, and how much room it has.

A viewing ray that grazes the subject touches the true surface somewhere along its *viewing edge*, the stretch
on which it runs along the hull; nobody knows where. Around a vertex the surface can therefore move inwards by
as much as the nearest such ray can spare: remove a ball of radius s around the vertex, and a silhouette
notices as soon as one of its viewing edges lies wholly inside that ball. Where many cameras look, viewing
edges are short and the hull is as good as a scan; on a phantom they are long. (Viewing edges: Franco and
Boyer 2003.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from hull.culling import Culling
from hull.loops import mesh_loops
from hull.rays import RayScene
from hull.stack import TableStack
from hull.tables import NO_EVIDENCE, SilhouetteTable

# A ray along the surface itself would hit or miss it by rounding, so it is cast this far inside (pixels).
# What a picture shows is not known better than that anyway.
_NUDGE_PX = 0.5
# Slack is measured at no more vertices than this and spread to their neighbours: it changes slowly, and finer
# grids should not cost more rays.
MAX_MEASURED = 24_000
#: Excess over the product of a place's slack and the hull's median slack; more than the second is a phantom,
#: which alignments do not follow.
EXCESS_PER_M, LARGEST_EXCESS_M = 2.7, 0.008


@dataclass(frozen=True, eq=False)
class Outlines:
    """Which silhouettes' outlines pass through which points.

    Fields
    ------
    n_witnesses : (N,) cameras that give evidence at the point.
    n_bounding : (N,) cameras whose outline passes within about a pixel: the ones that bound the hull there.
    point_idx, table_idx : (P,) the pairs that `n_bounding` counts.
    """

    n_witnesses: Int[np.ndarray, " n"]
    n_bounding: Int[np.ndarray, " n"]
    point_idx: Int[np.ndarray, " p"]
    table_idx: Int[np.ndarray, " p"]


def outlines_at(points: Float[np.ndarray, "n 3"], culling: Culling) -> Outlines:
    """Ask every camera about every point (world metres, within the culling's grid)."""
    columns = np.ascontiguousarray(points.T)
    blocks, stack = culling.blocks_of(columns), culling.stack
    if stack is not None:
        return _outlines_compiled(stack, columns, blocks, *culling.outlined())
    n_witnesses = np.zeros(len(points), dtype=np.int64)
    point_idx, table_idx = [], []
    for k, table in enumerate(culling.tables):
        seen, unsure = culling.evidence(k, blocks)
        seen[unsure] = table.ask_points(columns.take(unsure, axis=1)) != NO_EVIDENCE
        n_witnesses += seen
        near = culling.may_be_outlined(k, blocks)
        on_it = near.take(table.on_outline(columns.take(near, axis=1)))
        point_idx.append(on_it)
        table_idx.append(np.full(len(on_it), k))
    at = np.concatenate(point_idx)
    return Outlines(n_witnesses, np.bincount(at, minlength=len(points)), at, np.concatenate(table_idx))


def _outlines_compiled(
    stack: TableStack,
    columns: Float[np.ndarray, "3 n"],
    blocks: Int[np.ndarray, " n"],
    n_seen: Int[np.ndarray, " b"],
    unsure: tuple[Int[np.ndarray, " b1"], Int[np.ndarray, " m"]],
) -> Outlines:
    n = len(blocks)
    n_witnesses, n_bounding = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    room = 2 * n + len(stack.tables)
    pairs: list[np.ndarray] = []
    first = 0
    while first < n or not pairs:
        pair = np.empty((2, room), dtype=np.int64)
        n_found, first = stack.loops.outlines(
            stack.numbers,
            stack.projections,
            columns,
            blocks,
            n_seen,
            *unsure,
            first,
            n_witnesses,
            n_bounding,
            *pair,
        )
        pairs.append(pair[:, :n_found])
    point_idx, table_idx = np.concatenate(pairs, axis=1)
    return Outlines(n_witnesses, n_bounding, point_idx, table_idx)


def slack_at(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    scene: RayScene,
    outlines: Outlines,
    tables: Sequence[SilhouetteTable],
) -> Float[np.ndarray, " v"]:
    """(V,) metres: the least, over the cameras that bound a vertex, of its distance to the farther end of
    the viewing edge through it; NaN where no camera bounds it or no ray could be followed.

    Seen from half a pixel inside, so even a round body has the slack of a chord that deep.
    """
    n = len(vertices)
    stride = max(-(-n // MAX_MEASURED), 1)
    chosen = np.flatnonzero(outlines.point_idx % stride == 0)
    at, camera = outlines.point_idx[chosen], outlines.table_idx[chosen]
    ways = vertices[at] - np.array([table.centre for table in tables])[camera]
    distance = np.linalg.norm(ways, axis=1, keepdims=True)
    ways /= distance
    # Straight into the hull as this camera sees it: across its ray.
    inwards = normals[at] - (normals[at] * ways).sum(axis=1, keepdims=True) * ways
    inwards /= -np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), 1e-9)
    pixel = distance / np.array([_focal_px(table) for table in tables])[camera, None]
    start = vertices[at] + _NUDGE_PX * pixel * inwards
    room = np.maximum(scene.first_hits(start, ways), scene.first_hits(start, -ways))
    slack = np.full(n, np.inf)
    np.minimum.at(slack, at, room)
    return np.where(np.isfinite(slack), slack, np.nan)


def expected_excess(slack_m: Float[np.ndarray, " v"]) -> Float[np.ndarray, " v"]:
    """(V,) metres: how far a hull may be expected to stand away from what it contains.

    Between two outlines that touch a round surface the hull stands off by the sagitta: slack times the angle
    between the cameras' tangents over eight. The angle is the same for the whole rig, and the median slack
    measures it. EXCESS_PER_M is from hulls of people, dressed and not, by 8 to 68 cameras: means of 4.8 to
    6.2 mm with 8, 2.2 to 2.8 with 16, 1.3 to 1.7 with 32, 0.7 to 1.0 with 68; a single place may differ by as
    much again. Pixels were 1 to 2 mm wide; with wider ones slack is never small, and too much is expected (1
    mm, with pixels of 4 mm).
    """
    return np.minimum(EXCESS_PER_M * float(np.median(slack_m)) * slack_m, LARGEST_EXCESS_M)


def spread_to_neighbours(
    values: Float[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"], n_rounds: int = 50
) -> Float[np.ndarray, " v"]:
    """(V,) with each NaN replaced by the mean of its neighbours, round by round; what nothing reaches: 0."""
    loops = mesh_loops()
    if loops is None:
        return spread_plainly(values, faces, n_rounds)
    values = values.copy()
    loops.spread_to_neighbours(values, faces, n_rounds)
    return np.nan_to_num(values, nan=0.0)


def spread_plainly(
    values: Float[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"], n_rounds: int
) -> Float[np.ndarray, " v"]:
    """`spread_to_neighbours`, not compiled."""
    values = values.copy()
    rows = faces
    for _ in range(n_rounds):
        missing = np.isnan(values)
        rows = rows[missing[rows].any(axis=1)]
        if not len(rows):
            break
        corners = values[rows]
        known = ~np.isnan(corners)
        total = np.where(known, corners, 0.0).sum(axis=1)
        sums = np.bincount(rows.ravel(), np.repeat(total, 3), minlength=len(values))
        weights = np.bincount(rows.ravel(), np.repeat(known.sum(axis=1), 3), minlength=len(values))
        reached = missing & (weights > 0)
        if not reached.any():
            break
        values[reached] = sums[reached] / weights[reached]
    return np.nan_to_num(values, nan=0.0)


def _focal_px(table: SilhouetteTable) -> float:
    """About the camera's focal length: what a metre at a metre's depth covers, px."""
    # The rows of P minus the picture's middle times its third row; only a scale is wanted, so the area will
    # do.
    turned = table.projection[:, :3]
    return float(np.sqrt(abs(np.linalg.det(turned)) / max(np.linalg.norm(turned[2]) ** 3, 1e-12)))
