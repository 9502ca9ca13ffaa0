"""Relief on the skin: forms too fine or too gentle for a union of solids.

A relief is a primitive whose `distance` is added to what is there already: -1 mm raises the skin by one
millimetre.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .implicit import VectorLike

REACH_SIGMAS = 3.5  # beyond it a form counts as zero


@dataclass(frozen=True)
class Bump:
    """A Gaussian hill (height_m > 0) or hollow. sigma_m: along x, y, z."""

    centre: VectorLike
    sigma_m: VectorLike
    height_m: float


@dataclass(frozen=True)
class Ridge:
    """A Gaussian ridge (or groove, height_m < 0) along a polyline, metres.

    depth: how much a distance along z counts; small for lines drawn on the face, whose z need not be exact.
    """

    line: VectorLike
    sigma_m: float
    height_m: float
    depth: float = 1.0


@dataclass(frozen=True)
class Opening:
    """An almond sunk into the skin, between two arcs through its corners in the x-y plane, metres.

    rise_m, drop_m: how far the upper and the lower arc leave the line between the corners.
    edge_m: how far inwards the full depth is reached.
    """

    corners: VectorLike  # (2 3)
    rise_m: float
    drop_m: float
    depth_m: float
    edge_m: float


def _to_polyline(
    points: Float[np.ndarray, "n 3"], line: Float[np.ndarray, "k 3"], depth: float
) -> Float[np.ndarray, "n"]:
    """Squared distance, z counted `depth` times."""
    metric = np.array([1.0, 1.0, depth])
    p, corner = points * metric, line * metric
    best = np.full(len(p), np.inf)
    for a, b in itertools.pairwise(corner):
        q, e = p - a, b - a
        h = np.clip(q @ e / (e @ e), 0, 1)
        d = q - h[:, None] * e
        best = np.minimum(best, (d * d).sum(1))
    return best


class Relief:
    """Many bumps, ridges and openings as one primitive."""

    carries = False
    displaces = True
    blend_m = 0.0

    def __init__(self, forms: Sequence[Bump | Ridge | Opening]) -> None:
        bumps = [form for form in forms if isinstance(form, Bump)]
        self.ridges = [form for form in forms if isinstance(form, Ridge)]
        self.openings = [form for form in forms if isinstance(form, Opening)]
        self.centre_of_bump = np.array([b.centre for b in bumps], dtype=np.float64).reshape(-1, 3)
        self.sigma = np.array([b.sigma_m for b in bumps], dtype=np.float64).reshape(-1, 3)
        self.height = np.array([b.height_m for b in bumps], dtype=np.float64)
        lines = [np.asarray(r.line, dtype=np.float64) for r in self.ridges]
        self.lines = lines
        corners = [np.asarray(o.corners, dtype=np.float64) for o in self.openings]
        reach = self.sigma * REACH_SIGMAS
        margins = [r.sigma_m * REACH_SIGMAS for r in self.ridges]
        rims = [o.rise_m + o.drop_m + o.edge_m for o in self.openings]
        self.low = np.concatenate(
            [self.centre_of_bump - reach]
            + [line - margin for line, margin in zip(lines, margins, strict=True)]
            + [corner - rim for corner, rim in zip(corners, rims, strict=True)]
        ).min(0)
        self.high = np.concatenate(
            [self.centre_of_bump + reach]
            + [line + margin for line, margin in zip(lines, margins, strict=True)]
            + [corner + rim for corner, rim in zip(corners, rims, strict=True)]
        ).max(0)

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Metres to add to the distance so far."""
        raised = np.zeros(len(points))
        for centre, sigma, height in zip(self.centre_of_bump, self.sigma, self.height, strict=True):
            q = (points - centre) / sigma
            raised += height * np.exp(-0.5 * (q * q).sum(1))
        for ridge, line in zip(self.ridges, self.lines, strict=True):
            raised += ridge.height_m * np.exp(
                -0.5 * _to_polyline(points, line, ridge.depth) / ridge.sigma_m**2
            )
        for opening in self.openings:
            raised -= opening.depth_m * _inside(opening, points)
        return -raised


def arcs_of(opening: Opening, n: int = 9) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """The upper and the lower arc of the outline, z along the straight line between the corners."""
    a, b = np.asarray(opening.corners, dtype=np.float64)
    span = b - a
    half = 0.5 * float(np.linalg.norm(span[:2]))
    across = np.array([-span[1], span[0], 0.0]) / (2 * half)
    u = np.linspace(-1, 1, n)
    arcs = []
    for sign, rise in ((1.0, opening.rise_m), (-1.0, opening.drop_m)):
        radius = (half * half + rise * rise) / (2 * rise)
        height = np.sqrt(np.maximum(radius**2 - (half * u) ** 2, 0)) - (radius - rise)
        arcs.append(a + np.outer(0.5 * (u + 1), span) + sign * np.outer(height, across))
    return arcs[0], arcs[1]


def _inside(opening: Opening, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """0 on the almond's outline and outside it, 1 from edge_m inwards."""
    a, b = np.asarray(opening.corners, dtype=np.float64)
    middle, half = 0.5 * (a + b), 0.5 * float(np.linalg.norm((b - a)[:2]))
    along = (b - a)[:2] / (2 * half)
    across = np.array([-along[1], along[0]])
    q = points - middle
    u, v = q[:, :2] @ along, q[:, :2] @ across
    outside = np.full(len(points), -np.inf)
    for sign, rise in ((1.0, opening.rise_m), (-1.0, opening.drop_m)):
        radius = (half * half + rise * rise) / (2 * rise)
        outside = np.maximum(outside, np.hypot(u, v - sign * (rise - radius)) - radius)
    x = np.clip(-outside / opening.edge_m, 0, 1) * (np.abs(q[:, 2]) < 0.04)
    return x * x * (3 - 2 * x)
