"""Clothes for a synthetic person: meshes cut out of the body's surface, offset, and draped every frame.

A garment is a region of the body in the zero pose (everything above a hem, below a collar, up to a sleeve's
end), cut along its edges, refined and lifted off the skin. In every frame the lift is worked out anew from
the posed body:

- it varies over the garment, smoothly, and drifts as the pose changes, so that it touches in other places
  each time;
- cloth rests on what faces up and hangs off what faces down, presses in where the body moves towards it and
  trails behind (that is what a method that looks under clothes can live on);
- folds run across it, and loose garments bridge the hollows (armpit, crotch, behind the knee);
- it is nowhere nearer to the skin than `least_m`.

No physics: rules. The edges are closed by a rim down to the skin, so garment and body together are a solid
outside.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Integer, UInt8

from fit.body.skeleton import JOINT
from fit.surface import vertex_normals

RIM_DEPTH_M = 0.004
"""How far under the skin a closed edge ends (m)."""
LAYER_M = 0.003
"""Distance between two garments worn over each other (m)."""


@dataclass(frozen=True)
class Landmarks:
    """What a garment is measured by: the zero pose's joints (24 3), m, body frame."""

    joints: Float[np.ndarray, "24 3"]

    def __getitem__(self, name: str) -> Float[np.ndarray, " 3"]:
        return self.joints[JOINT[name]]

    def along_arm(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """0 at the shoulder joint, 1 at the wrist, of the arm on the point's side; below 0 in the trunk."""
        out = np.empty(len(points))
        for side, here in (("left", points[:, 0] >= 0), ("right", points[:, 0] < 0)):
            arm = self[f"{side}_wrist"] - self[f"{side}_shoulder"]
            out[here] = (points[here] - self[f"{side}_shoulder"]) @ arm / (arm @ arm)
        return out

    def along_leg(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """0 at the height of the hip joints, 1 at the knee, 2 at the ankle; negative above."""
        heights = [0.5 * (self[f"left_{j}"][1] + self[f"right_{j}"][1]) for j in ("ankle", "knee", "hip")]
        above = np.maximum(points[:, 1] - heights[2], 0.0) / (heights[2] - heights[1])
        return np.interp(points[:, 1], heights, [2.0, 1.0, 0.0]) - above

    @property
    def arm_m(self) -> float:
        """Shoulder to wrist (m)."""
        return float(np.linalg.norm(self["left_wrist"] - self["left_shoulder"]))


@dataclass(frozen=True)
class Cut:
    """A garment before it is worn.

    inside: metres inside the garment's edge for points of the zero pose (negative outside; only the sign and
    the slope near zero matter). least_m: nowhere thinner. ease_m: mean extra room where it is loosest.
    looseness: 0..1 of that room at points of the zero pose. bridge: how many smoothing steps of about a
    centimetre it spans hollows with. fold_m: height of folds. colours: cloth's two tones. stripes_m: their
    width, 0: none. lively: 1 cloth that hangs and drifts, 0 a thing that keeps its shape.
    """

    name: str
    inside: Callable[[Float[np.ndarray, "n 3"], Landmarks], Float[np.ndarray, " n"]]
    least_m: float
    ease_m: float
    looseness: Callable[[Float[np.ndarray, "n 3"], Landmarks], Float[np.ndarray, " n"]]
    bridge: int
    fold_m: float
    colours: tuple[tuple[int, int, int], tuple[int, int, int]]
    stripes_m: float = 0.0
    lively: float = 1.0


@dataclass(frozen=True)
class Garment:
    """A garment cut for one body: G outer vertices as mixtures of body vertices, and its random fields."""

    cut: Cut
    from_body: sp.csr_array
    """(G V): outer vertices on the skin = from_body @ body vertices."""
    faces: Integer[np.ndarray, "f 3"]
    """Outer faces, then the rim's; indices from G on are the rim's foot, `rim` repeated under the skin."""
    rim: Integer[np.ndarray, " r"]
    room_m: Float[np.ndarray, " G"]
    """Extra room at each vertex (m) when nothing moves."""
    waves: Float[np.ndarray, "G k 2"]
    """Sine and cosine of the k slow fields that make the room drift."""
    fold_phase: Float[np.ndarray, "G m"]
    colours: UInt8[np.ndarray, "G 3"]
    mean_of_neighbours: sp.csr_array
    """(G G): average over neighbours; along the edge only, for vertices on an edge."""
    drift: Float[np.ndarray, "k 2"]
    """Their amplitudes at the first moment."""


def cut_out(
    cut: Cut,
    template: Float[np.ndarray, "v 3"],
    faces: Integer[np.ndarray, "f 3"],
    landmarks: Landmarks,
    rng: np.random.Generator,
) -> Garment:
    """The garment cut out of a body in the zero pose (m), refined, its random fields drawn from `rng`."""
    from_body, patch = _refined(len(template), faces, cut.inside(template, landmarks) > -0.03)
    inside = cut.inside(from_body @ template, landmarks)
    onto, patch = _clipped(inside, patch)
    from_body = sp.csr_array(onto @ from_body)
    from_body, patch = _largest_pieces(from_body, patch)
    points = from_body @ template
    edge = _boundary(patch)
    rim = np.unique(edge)
    foot = np.full(len(points), -1)
    foot[rim] = len(points) + np.arange(len(rim))
    a, b = edge.T
    closing = np.concatenate([np.stack([b, a, foot[a]], 1), np.stack([b, foot[a], foot[b]], 1)])

    n_waves, n_folds = 6, 5
    directions = _directions(rng, n_waves) / rng.uniform(0.22, 0.5, (n_waves, 1))
    angle = 2 * np.pi * (points @ directions.T) + rng.uniform(0, 2 * np.pi, n_waves)
    field_1 = _smooth_field(points, rng, (0.15, 0.4))
    looseness = cut.looseness(points, landmarks)
    room = cut.ease_m * looseness * np.clip(1.0 + 0.35 * field_1, 0.25, 1.9)
    fold_axes = _directions(rng, n_folds) * [1.0, 0.55, 1.0] / rng.uniform(0.05, 0.14, (n_folds, 1))
    bend = np.stack([_smooth_field(points, rng, (0.12, 0.3)) for _ in range(n_folds)], 1)
    folds = 2 * np.pi * (points @ fold_axes.T) + 2.0 * bend
    return Garment(
        cut,
        from_body,
        np.concatenate([patch, closing]),
        rim,
        room,
        np.stack([np.sin(angle), np.cos(angle)], 2),
        folds,
        _cloth_colours(cut, points, cut.inside(points, landmarks), rng),
        _averaging(len(points), patch, edge),
        rng.standard_normal((n_waves, 2)),
    )


def drape(
    garment: Garment,
    posed: Float[np.ndarray, "v 3"],
    body_faces: Integer[np.ndarray, "f 3"],
    velocity: Float[np.ndarray, "v 3"],
    up: Float[np.ndarray, " 3"],
    moment: float,
    under: Float[np.ndarray, " v"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " v"]]:
    """Vertices (outer, then the rim's foot) on the posed body, and how high each body vertex is covered (m).

    velocity: metres a frame of the body's vertices (the cloth trails behind). up: unit, the posed body's
    frame. moment: what the slow drift and the folds follow, in radians; about one a second of vigorous
    movement. under: how high what is worn already stands over the skin: this garment goes over it.
    """
    cut = garment.cut
    skin = garment.from_body @ posed
    normals = _unit(garment.from_body @ vertex_normals(posed, body_faces))
    flat_normals = _unit(garment.mean_of_neighbours @ (garment.mean_of_neighbours @ normals))

    # Cloth lies on what faces up (0) and hangs off what faces down (1).
    hanging = 0.5 - 0.5 * (flat_normals @ up)
    # Where it is held off just now (1) and where it lies on (0): wanders over the garment as the person
    # moves.
    amplitudes = _turned(garment.drift, moment)
    drifting = np.einsum("nkc,kc->n", garment.waves, amplitudes) / np.sqrt(len(amplitudes))
    held_off = 0.5 + 0.5 * np.tanh(1.3 * drifting)
    trailing = np.tanh(-np.einsum("na,na->n", garment.from_body @ velocity, normals) / 0.05)
    share = (0.4 + 1.1 * hanging**1.5) * 2.2 * held_off**1.3 + 0.4 * trailing
    share = 1.0 + cut.lively * (np.maximum(share, 0.0) - 1.0)
    lift = garment.room_m * share
    most = 2.0 * cut.ease_m
    lift = most * np.tanh(lift / most)

    speed = 0.6 + 0.4 * np.arange(garment.fold_phase.shape[1]) / garment.fold_phase.shape[1]
    ridges = 1.0 - np.abs(np.sin(0.5 * (garment.fold_phase + moment * speed)))
    freedom = np.clip(lift / cut.ease_m, 0.0, 1.0)
    lift = lift + cut.fold_m * (0.25 + 0.75 * freedom) * (ridges.mean(1) - 0.36) * 2.0

    lift = cut.least_m + _softly_positive(lift, 0.002)
    below = garment.from_body @ under
    lift = np.maximum(lift, np.where(below > 0, below + LAYER_M, 0.0))
    outer = skin + lift[:, None] * flat_normals
    if cut.bridge:
        bridged = outer.copy()
        for _ in range(cut.bridge):
            bridged = bridged + 0.5 * (garment.mean_of_neighbours @ bridged - bridged)
        # Only outwards: where smoothing would cut into a bulge the cloth lies on the bulge.
        reach = np.einsum("na,na->n", bridged - skin, flat_normals)
        more = np.clip(reach - lift, 0.0, 0.05) * (0.5 + 0.5 * held_off)
        for _ in range(3):
            more = 0.5 * more + 0.5 * (garment.mean_of_neighbours @ more)
        outer = outer + more[:, None] * flat_normals
    outer = _kept_outside(outer, skin, normals, cut.least_m)
    foot = skin[garment.rim] - RIM_DEPTH_M * normals[garment.rim]
    height = np.einsum("na,na->n", outer - skin, flat_normals)
    return np.concatenate([outer, foot]), np.maximum(under, _highest(garment.from_body, height))


def _highest(from_body: sp.csr_array, height: Float[np.ndarray, " n"]) -> Float[np.ndarray, " v"]:
    """The largest height among the garment's vertices that a body vertex takes part in; 0 without any."""
    out = np.zeros(from_body.shape[1])
    rows = np.repeat(np.arange(from_body.shape[0]), np.diff(from_body.indptr))
    np.maximum.at(out, from_body.indices, height[rows])
    return out


# -- cutting -------------------------------------------------------------------------------------------------


def _refined(n_vertices: int, faces: np.ndarray, wanted: np.ndarray) -> tuple[sp.csr_array, np.ndarray]:
    """Faces with a wanted corner, split in four at their edges' middles: (mixing (N V), faces (M 3)).

    The body's triangles stay flat, so that what is lifted off them is outside of them; a centimetre between
    vertices is what folds need.
    """
    chosen = faces[wanted[faces].any(1)].astype(np.int64)
    corners = np.unique(chosen)
    index = np.full(n_vertices, -1)
    index[corners] = np.arange(len(corners))
    chosen = index[chosen]
    sides = np.concatenate([chosen[:, [0, 1]], chosen[:, [1, 2]], chosen[:, [2, 0]]])
    edges, edge_of = np.unique(np.sort(sides, 1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(3, len(chosen)).T + len(corners)
    n = len(corners)
    rows = np.concatenate([np.arange(n), n + np.repeat(np.arange(len(edges)), 2)])
    columns = np.concatenate([corners, corners[edges].ravel()])
    values = np.concatenate([np.ones(n), np.full(2 * len(edges), 0.5)])
    mixing = sp.csr_array((values, (rows, columns)), shape=(n + len(edges), n_vertices))
    a, b, c = chosen.T
    ab, bc, ca = edge_of.T
    split = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return mixing, split


def _clipped(inside: np.ndarray, faces: np.ndarray) -> tuple[sp.csr_array, np.ndarray]:
    """The part of a mesh where `inside` > 0: (mixing (M N), faces); cut edges get a vertex at the zero."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, edge_of = np.unique(np.sort(sides, 1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(3, len(faces)).T
    keep = inside > 0
    cut = np.flatnonzero(keep[edges[:, 0]] != keep[edges[:, 1]])
    value = inside[edges[cut]]
    # slivers would ruin the averages over neighbours
    t = np.clip(value[:, 0] / (value[:, 0] - value[:, 1]), 0.12, 0.88)
    corners = np.flatnonzero(keep)
    new_of_corner = np.full(len(inside), -1)
    new_of_corner[corners] = np.arange(len(corners))
    new_of_edge = np.full(len(edges), -1)
    new_of_edge[cut] = len(corners) + np.arange(len(cut))
    kept = keep[faces].sum(1)
    out = [new_of_corner[faces[kept == 3]]]
    for count in (1, 2):
        some, some_edges = faces[kept == count], edge_of[kept == count]
        # turn each face so that its odd corner out comes first
        first = (keep[some] if count == 1 else ~keep[some]).argmax(1)
        order = (first[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(some, order, 1).T
        ab, _, ca = new_of_edge[np.take_along_axis(some_edges, order, 1)].T
        if count == 1:
            out.append(np.stack([new_of_corner[a], ab, ca], 1))
        else:
            b, c = new_of_corner[b], new_of_corner[c]
            out += [np.stack([ab, b, c], 1), np.stack([ab, c, ca], 1)]
    rows = np.concatenate([np.arange(len(corners)), len(corners) + np.repeat(np.arange(len(cut)), 2)])
    columns = np.concatenate([corners, edges[cut].ravel()])
    values = np.concatenate([np.ones(len(corners)), np.stack([1 - t, t], 1).ravel()])
    mixing = sp.csr_array((values, (rows, columns)), shape=(len(corners) + len(cut), len(inside)))
    return mixing, np.concatenate(out)


def _largest_pieces(from_body: sp.csr_array, faces: np.ndarray) -> tuple[sp.csr_array, np.ndarray]:
    """Drop crumbs that a cut left over (pieces of less than a tenth of the largest), and unused vertices."""
    n = from_body.shape[0]
    links = sp.csr_array(
        (np.ones(2 * len(faces)), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())), shape=(n, n)
    )
    n_pieces, piece = sp.csgraph.connected_components(links, directed=False)
    size = np.bincount(piece[faces[:, 0]], minlength=n_pieces)
    faces = faces[size[piece[faces[:, 0]]] >= 0.1 * size.max()]
    used = np.unique(faces)
    index = np.full(n, -1)
    index[used] = np.arange(len(used))
    return sp.csr_array(from_body[used]), index[faces]


def _boundary(faces: np.ndarray) -> np.ndarray:
    """(E 2): the sides that only one face has, in that face's direction."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, where, count = np.unique(np.sort(sides, 1), axis=0, return_index=True, return_counts=True)
    return sides[where[count == 1]]


def _averaging(n: int, faces: np.ndarray, edge: np.ndarray) -> sp.csr_array:
    """(N N): the mean of a vertex's neighbours; on the garment's edge, of the two along the edge."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    on_edge = np.zeros(n, bool)
    on_edge[edge] = True
    sides = np.concatenate([sides, sides[:, ::-1]])
    sides = sides[~on_edge[sides[:, 0]]]
    sides = np.concatenate([sides, edge, edge[:, ::-1]])
    links = sp.csr_array((np.ones(len(sides)), (sides[:, 0], sides[:, 1])), shape=(n, n))
    links.data[:] = 1.0
    total = np.asarray(links.sum(1)).ravel()
    return sp.csr_array(sp.diags_array(1.0 / np.maximum(total, 1.0)) @ links)


# -- fields --------------------------------------------------------------------------------------------------


def _directions(rng: np.random.Generator, n: int) -> np.ndarray:
    return _unit(rng.standard_normal((n, 3)))


def _smooth_field(
    points: np.ndarray, rng: np.random.Generator, wavelengths_m: tuple[float, float]
) -> np.ndarray:
    """A random field of unit variance over space, from eight plane waves."""
    waves = _directions(rng, 8) / rng.uniform(*wavelengths_m, (8, 1))
    return np.sin(2 * np.pi * (points @ waves.T) + rng.uniform(0, 2 * np.pi, 8)).sum(1) / 2.0


def _turned(pairs: np.ndarray, angle: float) -> np.ndarray:
    """Each (sine, cosine) amplitude turned by an angle of its own pace: the drift in time."""
    pace = angle * (0.7 + 0.6 * np.arange(len(pairs)) / max(len(pairs) - 1, 1))
    sine, cosine = np.sin(pace), np.cos(pace)
    return np.stack([pairs[:, 0] * cosine - pairs[:, 1] * sine, pairs[:, 0] * sine + pairs[:, 1] * cosine], 1)


def _softly_positive(values: np.ndarray, width: float) -> np.ndarray:
    """max(values, 0) with its corner rounded over `width`: never negative."""
    return 0.5 * (values + np.sqrt(values * values + width * width))


def _kept_outside(outer: np.ndarray, skin: np.ndarray, normals: np.ndarray, least_m: float) -> np.ndarray:
    """Push back out what smoothing of directions brought nearer than `least_m` to its own piece of skin."""
    height = np.einsum("na,na->n", outer - skin, normals)
    return outer + np.maximum(least_m - height, 0.0)[:, None] * normals


def _cloth_colours(
    cut: Cut, points: np.ndarray, inside: np.ndarray, rng: np.random.Generator
) -> UInt8[np.ndarray, "n 3"]:
    """The two tones mixed by a smooth field (or in stripes), darker at the seams."""
    tone_a, tone_b = np.array(cut.colours, float)
    if cut.stripes_m:
        mix = (np.sin(2 * np.pi * points[:, 1] / cut.stripes_m) > 0.2).astype(float)
    else:
        mix = np.clip(0.5 + 0.35 * _smooth_field(points, rng, (0.04, 0.15)), 0, 1)
    colours = tone_a + mix[:, None] * (tone_b - tone_a)
    colours *= np.where(np.abs(inside - 0.012) < 0.006, 0.82, 1.0)[:, None]
    return np.clip(colours, 0, 255).astype(np.uint8)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
