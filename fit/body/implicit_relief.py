"""Relief on the skin: forms too fine or too gentle for a union of solids.

A relief is a primitive whose `distance` is added to what is there already: -1 mm raises the skin by one
millimetre.
"""

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


class Relief:
    """Many bumps, ridges and openings as one primitive.

    All squared distances are quadratic forms of the point, so that one matrix product serves all bumps and
    one all segments of all ridges.
    """

    carries = False
    displaces = True
    blend_m = 0.0

    def __init__(self, forms: Sequence[Bump | Ridge | Opening]) -> None:
        self.bumps = [form for form in forms if isinstance(form, Bump)]
        self.ridges = [form for form in forms if isinstance(form, Ridge)]
        self.openings = [form for form in forms if isinstance(form, Opening)]
        boxes = [_box_of(form) for form in forms]
        self.low = np.min([low for low, _ in boxes], axis=0)
        self.high = np.max([high for _, high in boxes], axis=0)
        self.origin = 0.5 * (self.low + self.high)
        centres = np.array([b.centre for b in self.bumps]).reshape(-1, 3) - self.origin
        sigmas = np.array([b.sigma_m for b in self.bumps]).reshape(-1, 3)
        self.bump_form = _quadratic(centres, sigmas**-2)
        self.bump_height = np.array([b.height_m for b in self.bumps])
        self._prepare_segments()

    def _prepare_segments(self) -> None:
        start: list[np.ndarray] = []
        edge: list[np.ndarray] = []
        metric: list[np.ndarray] = []
        first: list[int] = []
        for ridge in self.ridges:
            line = np.asarray(ridge.line, dtype=np.float64) - self.origin
            first.append(len(start))
            start += list(line[:-1])
            edge += list(np.diff(line, axis=0))
            metric += [np.array([1.0, 1.0, ridge.depth**2])] * (len(line) - 1)
        self.first_segment = np.array(first, dtype=np.int64)
        if not self.ridges:
            return
        a, e, w = np.array(start), np.array(edge), np.array(metric)
        self.from_start = _quadratic(a, w)
        self.along = np.concatenate([(w * e).T, -(w * e * a).sum(1)[None]])  # of (x, y, z, 1)
        self.edge2 = (w * e * e).sum(1)
        self.ridge_height = np.array([r.height_m for r in self.ridges])
        self.ridge_sigma = np.array([r.sigma_m for r in self.ridges])

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Metres to add to the distance so far."""
        p = points - self.origin
        terms = np.concatenate([p * p, p, np.ones((len(p), 1))], 1)
        raised = np.exp(-0.5 * (terms @ self.bump_form)) @ self.bump_height
        if self.ridges:
            along = terms[:, 3:] @ self.along
            h = np.clip(along / self.edge2, 0, 1)
            away2 = terms @ self.from_start - h * (2 * along - h * self.edge2)
            nearest2 = np.minimum.reduceat(away2, self.first_segment, axis=1)
            raised += np.exp(-0.5 * nearest2 / self.ridge_sigma**2) @ self.ridge_height
        for opening in self.openings:
            raised -= opening.depth_m * _inside(opening, points)
        return -raised


def _quadratic(
    centre: Float[np.ndarray, "k 3"], factor: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "7 k"]:
    """The coefficients that make sum(factor (p - centre)^2) of (x2, y2, z2, x, y, z, 1)."""
    return np.concatenate([factor.T, (-2 * factor * centre).T, (factor * centre**2).sum(1)[None]])


def _box_of(form: Bump | Ridge | Opening) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Corners of the box beyond which the form counts as zero."""
    if isinstance(form, Bump):
        at, reach = np.array([form.centre]), np.asarray(form.sigma_m) * REACH_SIGMAS
    elif isinstance(form, Ridge):
        at, reach = np.asarray(form.line), np.full(3, form.sigma_m * REACH_SIGMAS)
    else:
        at, reach = np.asarray(form.corners), np.full(3, form.rise_m + form.drop_m)
    return at.min(0) - reach, at.max(0) + reach


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
