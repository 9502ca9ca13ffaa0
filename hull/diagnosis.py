"""Why a hull came out empty, in a sentence that names the cameras.

Leaving each camera out in turn: if the others agree on something, that camera is the one to look at.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8

from capture.camera import Camera
from hull.carve import Grid, carve
from hull.errors import HullError
from hull.tables import BORDER_PX, INSIDE, NO_EVIDENCE, OUTSIDE, UNKNOWN, SilhouetteTable
from hull.witnesses import WitnessRule

_N_ACROSS = 128
# A silhouette is inverted, or full, when this share of its picture's edge is person; so many may be.
_EDGE_SHARE, _MOST_INVERTED = 0.9, 0.25
_MOST_NAMES = 8


def why_empty(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    low: Float[np.ndarray, " 3"],
    high: Float[np.ndarray, " 3"],
) -> str:
    """The sentence for the user. `low`, `high`: the box that was searched, world metres."""
    blank = [table.name for table in tables if not (table.squares[0] & INSIDE).any()]
    unclear = [table.name for table in tables if (table.squares[0] == NO_EVIDENCE).all()]
    blank = [name for name in blank if name not in unclear]
    if blank:
        return (
            f"the silhouettes of {_listed(blank)} show nobody, so nothing is left; "
            "leave them out (None) or redo them"
        )
    spared = volumes_without_each(tables, rule, low, high)
    culprit = int(np.argmax(spared))
    if spared[culprit] > 0:
        others = np.delete(spared, culprit)
        alone = others.max(initial=0.0) < 0.5 * spared[culprit]
        rest = f"what the other {len(tables) - 1} cameras agree on ({spared[culprit] * 1000:.0f} L)"
        if alone:
            return (
                f"camera {tables[culprit].name} leaves nothing of {rest}; "
                "look at its silhouette and its calibration, or leave it out"
            )
        several = [tables[i].name for i in np.argsort(-spared, kind="stable")[:3] if spared[i] > 0]
        return (
            f"the silhouettes have no space in common; leaving out one of {_listed(several)} would leave some"
        )
    return (
        f"the silhouettes of the {len(tables)} cameras have no space in common, even without any single one "
        "of them; do the calibration and the pictures belong together "
        "(units, picture size, order of the cameras)?"
    )


def refuse_inverted(cameras: Sequence[Camera], images: Sequence[UInt8[np.ndarray, "_h _w"] | None]) -> None:
    """Raise HullError where more than a quarter of the silhouettes show person all along the picture's edge.

    Nobody stands so; carving would fill all of space.
    """
    present = [
        (camera.name, image) for camera, image in zip(cameras, images, strict=False) if image is not None
    ]
    wrong = [name for name, image in present if _edge_is_person(image)]
    if len(wrong) > _MOST_INVERTED * len(present):
        raise HullError(
            f"the silhouettes of {len(wrong)} of {len(present)} cameras show person all along the picture's "
            f"edge ({_listed(wrong[:_MOST_NAMES])}{', ...' * (len(wrong) > _MOST_NAMES)}); are they "
            "inverted? The person is white (255), the background black (0)"
        )


def _edge_is_person(image: UInt8[np.ndarray, "h w"]) -> bool:
    inner = image[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    edge = np.concatenate([inner[0], inner[-1], inner[:, 0], inner[:, -1]]) if inner.size else inner.ravel()
    known = edge[edge != UNKNOWN]
    return bool(len(known)) and bool((known > UNKNOWN).mean() > _EDGE_SHARE)


def volumes_without_each(
    tables: Sequence[SilhouetteTable],
    rule: WitnessRule,
    low: Float[np.ndarray, " 3"],
    high: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " c"]:
    """(C,) volume, cubic metres, of the hull that is left when each camera is left out; coarse.

    One carve with two votes holds everything that any single camera empties; its voxels are then asked once
    more.
    """
    extent = high - low
    voxel_m = float(extent.max()) / _N_ACROSS
    nx, ny, nz = (max(int(np.ceil(e / voxel_m)), 1) for e in extent)
    blocks = carve(tables, rule, Grid(low, voxel_m, (nx, ny, nz)), votes=2)
    if not blocks.n_voxels:
        return np.zeros(len(tables))
    first, end = blocks.span()
    cells = np.stack(np.nonzero(blocks.dense(first, end))) + first[:, None]
    answers = answers_of_all(tables, blocks.grid.centres(cells))
    refused = answers == OUTSIDE
    by_one_only = refused.sum(axis=0) == 1
    by_none = (~refused.any(axis=0)).sum()
    return (by_none + (refused & by_one_only).sum(axis=1)) * voxel_m**3


def answers_of_all(
    tables: Sequence[SilhouetteTable], points: Float[np.ndarray, "3 n"]
) -> UInt8[np.ndarray, "c n"]:
    """(C N) every camera's answer for every point (3 N): the definition that carving reproduces."""
    return np.stack([table.ask_points(points) for table in tables])


def inside_by_definition(
    tables: Sequence[SilhouetteTable], rule: WitnessRule, points: Float[np.ndarray, "3 n"], votes: int = 1
) -> Bool[np.ndarray, " n"]:
    """(N,) the hull's definition at points (3 N), without any shortcut; slow."""
    answers = answers_of_all(tables, points)
    sets = np.zeros((len(rule.full()), points.shape[1]), dtype=np.uint64)
    for camera in range(len(tables)):
        sets[camera // 64] |= (answers[camera] == INSIDE).astype(np.uint64) << np.uint64(camera % 64)
    return ((answers == OUTSIDE).sum(axis=0) < votes) & rule.enough(sets)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"camera {name}" for name in names)
