"""Flesh around a joint as an elastic lattice on rigid bones: where skin goes when the joint bends.

Cubes fill the skin near a joint; those near a bone (or deep in the trunk) follow it, the others want to keep
their shape and their volume, and what lies above and below a crease stays on its own side of it. Solved by
alternating a closed form for every cube and one prefactored linear system for all nodes (Bouaziz et al. 2014,
projective dynamics, without inertia). It is run when the body is built, on a few poses a joint, and tells
`correctives` what to reproduce. Metres, body frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from .dual_quaternions import blend_dual_quaternions

BONE_STIFFNESS = 100.0  # against 1 of a cube
CREASE_STIFFNESS = 1.5
VOLUME_SHARE = 0.85  # of a cube's wish: keep the volume in any shape; the rest: keep the shape
N_ROUNDS = 16
N_REMEMBERED = 5
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@dataclass(frozen=True)
class Bone:
    """A rod that flesh is fixed to: from, to (3) m, the joint that moves it, and how far it reaches: m, or as
    a share of the way from the rod to the skin, whichever is less.
    """

    start: Float[np.ndarray, "3"]
    end: Float[np.ndarray, "3"]
    joint: int
    reach_m: float = 0.03
    share: float = 0.45


@dataclass(frozen=True)
class Core:
    """The trunk's inside, deeper than `depth_m` and behind a plane (beyond it the limb begins): it follows
    these joints' bones, blended as in the skin nearby.
    """

    depth_m: float
    joints: tuple[int, ...]
    point: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class Crease:
    """A plane at rest through a joint: flesh stays on its side, while the plane turns half as far."""

    point: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    reach_m: float


def area_vectors(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """A third of the area (m2) around each vertex times its normal: the derivative of the volume."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a) / 6
    return np.stack(
        [np.bincount(faces.ravel(), np.repeat(across[:, k], 3), len(vertices)) for k in range(3)], 1
    )


def distance_to_rod(
    points: Float[np.ndarray, "n 3"], start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    """Distance to a segment."""
    along = end - start
    t = np.clip((points - start) @ along / max(along @ along, 1e-12), 0, 1)
    return np.linalg.norm(points - start - t[:, None] * along, axis=1)


class Flesh:
    """The lattice of one region of skin; `posed` moves it with the bones."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "v 3"],
        normals: Float[np.ndarray, "v 3"],
        weights: Float[np.ndarray, "v j"],
        region: Bool[np.ndarray, "v"],
        bones: tuple[Bone, ...],
        spacing_m: float,
        centre: Float[np.ndarray, "3"],
        radius_m: float,
        *,
        core: Core | None = None,
        crease: Crease | None = None,
        left_half: bool = False,
    ) -> None:
        """`region`: the skin of interest; near the radius around the centre its flesh only follows.
        left_half: nothing of it beyond x = 0, where it stays with the core.
        """
        self.region = np.flatnonzero(region)
        skin = vertices[self.region]
        low = np.floor(skin.min(0) / spacing_m).astype(int) - 1
        if left_half:
            low[0] = max(low[0], 0)
        size = np.floor(skin.max(0) / spacing_m).astype(int) + 2 - low
        grid = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), -1).reshape(-1, 3) + low
        tree = cKDTree(vertices)
        centres = (grid + 0.5) * spacing_m
        _, nearest = tree.query(centres)
        inside = ((centres - vertices[nearest]) * normals[nearest]).sum(1) < 0
        cells = grid[inside & region[nearest]]
        home = np.floor(skin / spacing_m).astype(int)
        if left_half:
            home[:, 0] = np.maximum(home[:, 0], 0)
        cells = np.unique(np.concatenate([cells, home]), axis=0)
        nodes, corner = np.unique((cells[:, None] + CORNERS).reshape(-1, 3), axis=0, return_inverse=True)
        self.rest = nodes * spacing_m
        self.cells = corner.reshape(-1, 8)
        self.n = len(nodes)

        key = {tuple(c): i for i, c in enumerate(cells.tolist())}
        cell_of = np.array([key[tuple(c)] for c in home.tolist()])
        local = skin / spacing_m - home
        weight = np.prod(np.where(CORNERS[None] == 1, local[:, None], 1 - local[:, None]), -1)
        rows = np.repeat(np.arange(len(skin)), 8)
        self.interpolate = csr_matrix(
            (weight.ravel(), (rows, self.cells[cell_of].ravel())), shape=(len(skin), self.n)
        )

        depth, nearest = tree.query(self.rest)
        buried = ((self.rest - vertices[nearest]) * normals[nearest]).sum(1) < 0
        self.follows = np.full(self.n, -1)
        margin = np.full(self.n, np.inf)
        for b in bones:
            d = distance_to_rod(self.rest, b.start, b.end)
            held = (d < b.reach_m) & (d < b.share * (d + depth)) & buried & (d < margin)
            self.follows[held] = b.joint
            margin[held] = d[held]
        _, few = tree.query(self.rest, k=6)
        self.weights = weights[few].mean(1)  # where the lattice starts from
        rod = np.min([distance_to_rod(skin, b.start, b.end) for b in bones], axis=0)
        self.softness = np.clip((rod - 0.01) / 0.05, 0, 1)  # of the skin: how thick the flesh under it is
        self.core = np.zeros(0, dtype=int)
        if core is not None:
            deep = buried & (depth > core.depth_m) & ((self.rest - core.point) @ core.normal < 0)
            seam = left_half & (nodes[:, 0] == 0) & (self.weights[:, list(core.joints)].sum(1) > 0.5)
            self.core = np.flatnonzero((deep | seam) & (self.follows < 0))
            of_core = self.weights[self.core][:, list(core.joints)]
            of_core[:, 0] += 1e-6
            self.core_weights = np.zeros((len(self.core), weights.shape[1]))
            self.core_weights[:, list(core.joints)] = of_core / of_core.sum(1, keepdims=True)
        away = np.linalg.norm(self.rest - centre, axis=1) / radius_m
        self.rim = BONE_STIFFNESS * np.clip((away - 0.75) / 0.25, 0, 1) ** 2
        fixed = self.rim.copy()
        fixed[self.follows >= 0] += BONE_STIFFNESS
        fixed[self.core] += BONE_STIFFNESS
        self.crease = crease
        self.side = np.zeros(self.n)
        kept = np.zeros(self.n)
        if crease is not None:
            height = (self.rest - crease.point) @ crease.normal
            self.side = np.where(np.abs(height) > spacing_m, np.sign(height), 0)
            distance = np.linalg.norm(self.rest - crease.point, axis=1) / crease.reach_m
            kept = CREASE_STIFFNESS * np.clip(2 - 2 * distance, 0, 1)
        self.fixed, self.kept = fixed, kept
        n_cells = len(self.cells)
        at = np.repeat(np.arange(n_cells), 8)
        gather = coo_matrix((np.ones(8 * n_cells), (at, self.cells.ravel())), (n_cells, self.n)).tocsr()
        # The sum over a cube's corners of |x - mean - goal|2: identity less the mean.
        laplacian = diags(np.asarray(gather.sum(0)).ravel()) - gather.T @ gather / 8
        self.solve = splu((laplacian + diags(fixed + kept + 1e-6)).tocsc()).solve
        self.gather = gather.T.tocsr()
        self.scatter = csr_matrix(
            (np.ones(8 * n_cells), (self.cells.ravel(), np.arange(8 * n_cells))), (self.n, 8 * n_cells)
        )
        self.corners = (CORNERS - 0.5) * spacing_m
        self.spacing = spacing_m

    def posed(
        self,
        bones: Float[np.ndarray, "j 4 4"],
        half_turn: Float[np.ndarray, "4 4"],
    ) -> Float[np.ndarray, "r 3"]:
        """Skin of the region, settled on these bones; half_turn moves the crease's plane."""
        start = blend_dual_quaternions(self.rest, self.weights, bones)
        wanted = np.zeros_like(self.rest)
        held = self.follows >= 0
        wanted[held] = move(bones[self.follows[held]], self.rest[held])
        if len(self.core):
            blended = np.einsum("nj,jab->nab", self.core_weights, bones)
            wanted[self.core] = move(blended, self.rest[self.core])
        pulled = (self.fixed - self.rim)[:, None] * wanted + (self.rim + 1e-6)[:, None] * start
        x, ahead = start, _Ahead()
        if self.crease is not None:
            normal = half_turn[:3, :3] @ self.crease.normal
            point = half_turn[:3, :3] @ self.crease.point + half_turn[:3, 3]
        for _ in range(N_ROUNDS):
            corners = x[self.cells]
            centred = corners - corners.mean(1, keepdims=True)
            stretch = np.einsum("cia,ib->cab", centred, self.corners) / (2 * self.spacing**2)
            u, s, vt = np.linalg.svd(stretch)
            flip = np.sign(np.linalg.det(u @ vt))
            s[:, 2] *= flip
            u[:, :, 2] *= flip[:, None]
            s = np.clip(s, 0.25, 3.0)
            even = s / np.cbrt(s.prod(1))[:, None]
            goal = np.einsum("cab,cb,cbd->cad", u, VOLUME_SHARE * even + 1 - VOLUME_SHARE, vt)
            rhs = self.scatter @ np.einsum("cab,ib->cia", goal, self.corners).reshape(-1, 3) + pulled
            if self.crease is not None:
                height = self.side * ((x - point) @ normal)
                kept = x - np.minimum(height, 0)[:, None] * self.side[:, None] * normal
                rhs += self.kept[:, None] * kept
            x = ahead(x, self.solve(rhs))
        return self.interpolate @ x

    def free_of_crease(
        self, skin: Float[np.ndarray, "r 3"], half_turn: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "r"]:
        """0 for posed skin of the region on the crease's plane, 1 where it is well clear of it."""
        if self.crease is None:
            return np.ones(len(skin))
        normal = half_turn[:3, :3] @ self.crease.normal
        point = half_turn[:3, :3] @ self.crease.point + half_turn[:3, 3]
        inner = (self.interpolate @ self.rest - self.crease.point) @ self.crease.normal
        clear = np.sign(inner) * ((skin - point) @ normal)
        return np.clip(clear / (0.12 * self.crease.reach_m), 0, 1)


class _Ahead:
    """Anderson acceleration of x <- g(x) over the last few steps (Peng et al. 2018)."""

    def __init__(self) -> None:
        self.steps: list[np.ndarray] = []
        self.images: list[np.ndarray] = []

    def __call__(
        self, x: Float[np.ndarray, "n 3"], image: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        self.steps = [*self.steps, (image - x).ravel()][-N_REMEMBERED - 1 :]
        self.images = [*self.images, image.ravel()][-N_REMEMBERED - 1 :]
        if len(self.steps) < 2:
            return image
        by_step, by_image = np.diff(np.array(self.steps), axis=0), np.diff(np.array(self.images), axis=0)
        gram = by_step @ by_step.T
        gram += 1e-6 * np.trace(gram) * np.eye(len(gram))
        share = np.linalg.solve(gram, by_step @ self.steps[-1])
        return (self.images[-1] - share @ by_image).reshape(x.shape)


def move(
    transforms: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Each point by its own transform."""
    return np.einsum("nab,nb->na", transforms[:, :3, :3], points) + transforms[:, :3, 3]
