"""Isotropic remeshing of the half body to a size field: split, collapse, flip, relax, project.

After Botsch & Kobbelt, A Remeshing Approach to Multiresolution Modeling (SGP 2004), with a seam: vertices in
the plane x = 0 stay there, so that mirroring gives an exactly symmetric whole. Positions are rounded to a
micrometre each pass, so that the decisions do not hang on the last bits of a linear algebra library.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

SEAM_TOLERANCE_M = 1e-9
OFF_SEAM_M = 8e-4  # vertices that are not on the seam keep at least this distance from it

Point = tuple[float, float, float]
Triangle = tuple[int, int, int]


def cross_of(p: Point, q: Point, r: Point) -> Point:
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    wx, wy, wz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    return uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx


def dot(a: Point, b: Point) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def midpoint(p: Point, q: Point) -> Point:
    return (p[0] + q[0]) / 2, (p[1] + q[1]) / 2, (p[2] + q[2]) / 2


def gap(p: Point, q: Point) -> float:
    return ((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2) ** 0.5


def shape_quality(p: Point, q: Point, r: Point) -> float:
    """1 for an equilateral triangle, 0 for a degenerate one."""
    n = cross_of(p, q, r)
    squares = gap(p, q) ** 2 + gap(q, r) ** 2 + gap(r, p) ** 2
    return 3.4641 * dot(n, n) ** 0.5 / (squares + 1e-30)


class Remesher:
    """A half mesh under change. `wanted(points)`: the edge length asked for; `project`: back to the skin."""

    def __init__(
        self,
        vertices: Float[np.ndarray, "v 3"],
        faces: Int[np.ndarray, "f 3"],
        wanted: Callable[[np.ndarray], np.ndarray],
        project: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ) -> None:
        self.wanted, self.project = wanted, project
        self.load(vertices, faces)

    def load(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        self.points: list[Point] = [tuple(p) for p in vertices.tolist()]
        self.triangles: dict[int, Triangle] = {i: tuple(t) for i, t in enumerate(faces.tolist())}
        self.next_id = len(faces)
        self.around: list[set[int]] = [set() for _ in self.points]
        for i, t in self.triangles.items():
            for a in t:
                self.around[a].add(i)
        self.seam = [p[0] < SEAM_TOLERANCE_M for p in self.points]
        self.size: list[float] = np.round(self.wanted(np.asarray(self.points)), 9).tolist()

    def arrays(self) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
        used = sorted({a for t in self.triangles.values() for a in t})
        new = {a: i for i, a in enumerate(used)}
        vertices = np.array([self.points[a] for a in used])
        return vertices, np.array([[new[a] for a in t] for t in self.triangles.values()])

    def edges(self) -> set[tuple[int, int]]:
        pairs = ((t[k], t[k - 1]) for t in self.triangles.values() for k in range(3))
        return {(a, b) if a < b else (b, a) for a, b in pairs}

    def relative_length(self, edge: tuple[int, int]) -> float:
        a, b = edge
        return gap(self.points[a], self.points[b]) / (0.5 * (self.size[a] + self.size[b]))

    def n_mirrored(self) -> int:
        """Vertices of the whole body after mirroring and welding."""
        used = [a for a, faces in enumerate(self.around) if faces]
        return 2 * len(used) - sum(self.seam[a] for a in used)

    def _remove(self, i: int) -> None:
        for a in self.triangles.pop(i):
            self.around[a].discard(i)

    def _insert(self, t: Triangle) -> None:
        self.triangles[self.next_id] = t
        for a in t:
            self.around[a].add(self.next_id)
        self.next_id += 1

    def _ring(self, a: int) -> set[int]:
        return {b for i in self.around[a] for b in self.triangles[i]} - {a}

    def split(self, a: int, b: int) -> None:
        m = len(self.points)
        shared = sorted(self.around[a] & self.around[b])
        self.points.append(midpoint(self.points[a], self.points[b]))
        self.size.append(0.5 * (self.size[a] + self.size[b]))
        self.around.append(set())
        self.seam.append(len(shared) == 1)
        for i in shared:
            t = self.triangles[i]
            self._remove(i)
            for old in (b, a):
                x, y, z = (m if v == old else v for v in t)
                self._insert((x, y, z))

    def collapse(self, a: int, b: int) -> bool:
        """Merge b into a; False where the link condition or the geometry forbids it."""
        shared = self.around[a] & self.around[b]
        if self.seam[a] != self.seam[b]:
            if self.seam[b]:
                a, b = b, a
            position = self.points[a]
        else:
            if self.seam[a] and len(shared) != 1:
                return False
            position = midpoint(self.points[a], self.points[b])
        ring_a, ring_b = self._ring(a), self._ring(b)
        if len(ring_a & ring_b) != len(shared) or (len(shared) == 2 and len(ring_a | ring_b) - 2 < 4):
            return False
        for c in ring_b - {a}:
            if gap(self.points[c], position) > 1.35 * 0.5 * (self.size[c] + self.size[a]):
                return False
        for x in (a, b):
            for i in self.around[x] - shared:
                t = self.triangles[i]
                before = cross_of(*[self.points[y] for y in t])
                after = cross_of(*[position if y == x else self.points[y] for y in t])
                if dot(before, after) <= 0.3 * (dot(before, before) * dot(after, after)) ** 0.5:
                    return False
        for i in sorted(shared):
            self._remove(i)
        for i in sorted(self.around[b]):
            t = self.triangles[i]
            self._remove(i)
            x1, x2, x3 = (a if y == b else y for y in t)
            self._insert((x1, x2, x3))
        self.points[a] = position
        return True

    def split_pass(self, limit: float) -> None:
        for edge in sorted(self.edges(), key=lambda e: (-self.relative_length(e), e)):
            a, b = edge
            if self.relative_length(edge) > limit and self.around[a] & self.around[b]:
                self.split(a, b)

    def collapse_pass(self, limit: float) -> None:
        for relative, a, b in sorted((self.relative_length(e), *e) for e in self.edges()):
            if relative > limit:
                break
            if self.around[a] & self.around[b] and self.relative_length((a, b)) < limit:
                self.collapse(a, b)

    def flip_pass(self) -> None:
        """Flip edges where that evens out valences (6, on the seam 4) or betters the worst triangle."""
        for a, b in sorted(self.edges()):
            shared = self.around[a] & self.around[b]
            if len(shared) != 2:
                continue
            i, j = sorted(shared)
            t = self.triangles[i]
            if t[(t.index(a) + 1) % 3] != b:
                i, j = j, i
                t = self.triangles[i]
            c = next(x for x in t if x != a and x != b)
            d = next(x for x in self.triangles[j] if x != a and x != b)
            if c == d or self.around[c] & self.around[d]:
                continue
            valence = [len(self.around[x]) + self.seam[x] for x in (a, b, c, d)]
            target = [4 if self.seam[x] else 6 for x in (a, b, c, d)]
            change = (-1, -1, 1, 1)
            before = sum((v - g) ** 2 for v, g in zip(valence, target, strict=True))
            after = sum((v + e - g) ** 2 for v, g, e in zip(valence, target, change, strict=True))
            old = [tuple(self.points[x] for x in tri) for tri in ((a, b, c), (b, a, d))]
            new = [tuple(self.points[x] for x in tri) for tri in ((a, d, c), (d, b, c))]
            quality_old = min(shape_quality(*tri) for tri in old)
            quality_new = min(shape_quality(*tri) for tri in new)
            evener = after < before and quality_new > 0.55 * quality_old
            if not (evener or (after <= before + 2 and quality_new > 1.15 * quality_old)):
                continue
            n_old, n_new = [cross_of(*tri) for tri in old], [cross_of(*tri) for tri in new]
            facing = [dot(n_old[0], n) + dot(n_old[1], n) for n in n_new]
            size = (dot(n_new[0], n_new[0]) * dot(n_new[1], n_new[1])) ** 0.5
            if min(facing) <= 0 or dot(*n_new) <= 0.5 * size + 1e-30:
                continue
            self._remove(i)
            self._remove(j)
            self._insert((a, d, c))
            self._insert((d, b, c))

    def relax(self, times: int, amount: float = 0.6) -> None:
        """Move vertices along the surface to the mean of their triangles (areas in wanted units), and
        project.
        """
        v, f = self.arrays()
        self.load(v, f)
        for _ in range(times):
            seam = v[:, 0] < SEAM_TOLERANCE_M
            n = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
            area = 0.5 * np.linalg.norm(n, axis=1) / self.wanted(v)[f].mean(1) ** 2
            centre = v[f].mean(1)
            pull, total, normal = np.zeros_like(v), np.zeros(len(v)), np.zeros_like(v)
            for k in range(3):
                np.add.at(pull, f[:, k], centre * area[:, None])
                np.add.at(total, f[:, k], area)
                np.add.at(normal, f[:, k], n)
            step = pull / total[:, None] - v
            if seam.any():
                step[seam] = self._seam_step(v, f, seam)
                normal[seam, 0] = 0
            normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
            step -= (step * normal).sum(1, keepdims=True) * normal
            step[seam, 0] = 0
            v = v + amount * step
            v[seam, 0] = 0
            v[~seam, 0] = np.maximum(v[~seam, 0], OFF_SEAM_M)
            v = np.round(self.project(v, seam), 6)
        self.load(v, f)

    @staticmethod
    def _seam_step(
        v: Float[np.ndarray, "v 3"], f: Int[np.ndarray, "f 3"], seam: np.ndarray
    ) -> Float[np.ndarray, "s 3"]:
        """Along the seam towards the middle of the two seam neighbours."""
        e = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
        e = e[seam[e].all(1)]
        _, inverse, count = np.unique(np.sort(e, 1), axis=0, return_inverse=True, return_counts=True)
        e = e[count[inverse.ravel()] == 1]  # an edge of one face only: the boundary
        total, n = np.zeros_like(v), np.zeros(len(v))
        for a, b in ((0, 1), (1, 0)):
            np.add.at(total, e[:, a], v[e[:, b]])
            np.add.at(n, e[:, a], 1)
        return (total[seam] / n[seam, None] - v[seam]) * 0.7
