"""Implicit-surface primitives of the body's generator, and their smooth union.

Lofted tubes, ellipsoids and rounded cones. Each gives a pseudo-distance (metres, negative inside, exact along
the local radius). Lofts and cones that carry skin also give `encode` and `decode`, a pair of maps between
space and coordinates relative to the primitive: that pair takes a vertex from one body to the same place on
another.
"""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d

PROFILE_SAMPLES = 192  # of a loft's section table along its axis
TINY = 1e-9

VectorLike = np.ndarray | Sequence[Any]


def unit(vector: VectorLike) -> Float[np.ndarray, "3"]:
    v = np.asarray(vector, dtype=np.float64)
    return v / np.linalg.norm(v)


def cross(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """numpy's own takes forty times as long on one pair of vectors, and a person has a hundred."""
    x, y, z = a.tolist()
    u, v, w = b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def monotone_samples(
    t: Float[np.ndarray, "r"], table: Float[np.ndarray, "r k"], at: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n k"]:
    """Every column interpolated by cubics that never overshoot (Fritsch & Butland 1984), `t` increasing."""
    step = np.diff(t)[:, None]
    rise = np.diff(table, axis=0) / step
    before, after = rise[:-1], rise[1:]
    near, far = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    same_sign = before * after > 0
    inner = np.where(same_sign, before * after, 0) / np.where(same_sign, near * after + far * before, 1)
    slope = np.concatenate([rise[:1], inner * (near + far), rise[-1:]])
    i = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    h = step[i]
    x = (at - t[i])[:, None] / h
    y = 1 - x
    ends = y * y * (1 + 2 * x) * table[i] + x * x * (1 + 2 * y) * table[i + 1]
    return ends + h * x * y * (y * slope[i] - x * slope[i + 1])


@runtime_checkable
class Primitive(Protocol):
    carries: bool  # whether template vertices ride on it
    displaces: bool  # whether its distance is added to what is there, instead of joined with it
    blend_m: float  # radius of the smooth union with what is there already
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]: ...


class Loft:
    """A tube along a straight axis with superelliptic sections that differ by quadrant.

    `rows`: (station, centre1, centre2, radius1+, radius1-, radius2+, radius2-, exponent2+, exponent2-), one
    per table row; `along_m`: the axial position of each row. The station is an anatomical number, equal in
    all bodies (a leg: 0 hip, 1 knee, 2 ankle). Sections between rows are interpolated monotonically, then
    blurred.
    """

    carries = True
    displaces = False

    def __init__(
        self,
        origin: VectorLike,
        axis: VectorLike,
        first: VectorLike,
        second: VectorLike,
        rows: VectorLike,
        along_m: VectorLike,
        blend_m: float,
        caps_m: tuple[float, float],
        blur: float = 0.025,
    ) -> None:
        self.origin = np.asarray(origin, dtype=np.float64)
        a = unit(axis)
        e1 = np.asarray(first, dtype=np.float64)
        e1 = unit(e1 - np.dot(e1, a) * a)
        e2 = cross(a, e1)
        e2 = e2 * np.sign(np.dot(e2, second))
        self.frame = np.stack([e1, e2, a])
        table, t = np.asarray(rows, dtype=np.float64), np.asarray(along_m, dtype=np.float64)
        self.start, self.end = t[0], t[-1]
        self.blend_m, self.caps_m = blend_m, caps_m
        self.profile = monotone_samples(t, table, np.linspace(t[0], t[-1], PROFILE_SAMPLES))
        self.profile[:, 1:] = gaussian_filter1d(
            self.profile[:, 1:], blur * PROFILE_SAMPLES, axis=0, mode="nearest"
        )
        radius = self.profile[:, 3:7].max() + np.abs(self.profile[:, 1:3]).max()
        ends = self.origin + np.outer([t[0] - caps_m[0], t[-1] + caps_m[1]], a)
        self.low, self.high = ends.min(0) - radius, ends.max(0) + radius

    def _rows_at(self, sample: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 9"]:
        x = np.clip(sample, 0, PROFILE_SAMPLES - 1.000001)
        i = x.astype(np.int64)
        f = (x - i)[:, None]
        return self.profile[i] * (1 - f) + self.profile[i + 1] * f

    def _section(self, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, ...]:
        local = (points - self.origin) @ self.frame.T
        t = local[:, 2]
        row = self._rows_at((t - self.start) / (self.end - self.start) * (PROFILE_SAMPLES - 1))
        u, v = local[:, 0] - row[:, 1], local[:, 1] - row[:, 2]
        radius_u = np.where(u > 0, row[:, 3], row[:, 4])
        radius_v = np.where(v > 0, row[:, 5], row[:, 6])
        exponent = np.where(v > 0, row[:, 7], row[:, 8])
        beyond = np.maximum(t - self.end, 0) - np.maximum(self.start - t, 0)
        cap = np.where(t > self.end, self.caps_m[1], self.caps_m[0])
        return row, u, v, radius_u, radius_v, exponent, beyond, cap

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        _, u, v, radius_u, radius_v, exponent, beyond, cap = self._section(points)
        power = (np.abs(u / radius_u) + TINY) ** exponent + (np.abs(v / radius_v) + TINY) ** exponent
        gauge = np.sqrt(power ** (2.0 / exponent) + (beyond / cap) ** 2)
        rho = np.sqrt(u * u + v * v + beyond * beyond)
        return np.maximum(rho - rho / gauge, -0.2)

    def encode(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
        """(station, u / radius, v / radius, overshoot / cap) of points in space."""
        row, u, v, radius_u, radius_v, _, beyond, cap = self._section(points)
        return np.stack([row[:, 0], u / radius_u, v / radius_v, beyond / cap], 1)

    def decode(self, code: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3"]:
        """The points in space at these coordinates of this body's tube."""
        station = self.profile[:, 0]
        row = self._rows_at(np.interp(code[:, 0], station, np.arange(PROFILE_SAMPLES, dtype=np.float64)))
        t = self.start + (self.end - self.start) * np.interp(
            code[:, 0], station, np.linspace(0, 1, PROFILE_SAMPLES)
        )
        u = row[:, 1] + code[:, 1] * np.where(code[:, 1] > 0, row[:, 3], row[:, 4])
        v = row[:, 2] + code[:, 2] * np.where(code[:, 2] > 0, row[:, 5], row[:, 6])
        t = t + code[:, 3] * np.where(code[:, 3] > 0, self.caps_m[1], self.caps_m[0])
        return self.origin + np.stack([u, v, t], 1) @ self.frame


class Ellipsoid:
    carries = False
    displaces = False

    def __init__(
        self, centre: VectorLike, radii: VectorLike, blend_m: float, axes: np.ndarray | None = None
    ) -> None:
        self.centre, self.radii = np.asarray(centre, dtype=np.float64), np.asarray(radii, dtype=np.float64)
        self.blend_m = blend_m
        self.axes = np.eye(3) if axes is None else axes
        reach = self.radii.max()
        self.low, self.high = self.centre - reach, self.centre + reach

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        q = (points - self.centre) @ self.axes.T
        rho = np.sqrt((q * q).sum(1)) + TINY
        return rho - rho / (np.sqrt(((q / self.radii) ** 2).sum(1)) + TINY)


class Cone:
    """A rounded cone from a (radius_a) to b (radius_b)."""

    displaces = False

    def __init__(
        self,
        a: VectorLike,
        b: VectorLike,
        radius_a: float,
        radius_b: float,
        blend_m: float,
        carries: bool = False,
    ) -> None:
        self.a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        self.radius_a, self.radius_b, self.blend_m, self.carries = radius_a, radius_b, blend_m, carries
        reach = max(radius_a, radius_b)
        self.low, self.high = np.minimum(self.a, b) - reach, np.maximum(self.a, b) + reach
        self.length = float(np.linalg.norm(b - self.a))
        axis = (b - self.a) / self.length
        # A helper direction that is never parallel to the axis; odd digits keep equal bodies' frames equal.
        helper = [0.03, 1.0, 0.02] if abs(axis[1]) < 0.9 else [1.0, 0.02, 0.03]
        e1 = unit(cross(axis, np.array(helper)))
        self.frame = np.stack([e1, cross(axis, e1), axis])

    def _local(self, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q = (points - self.a) @ self.frame.T
        h = np.clip(q[:, 2] / self.length, 0, 1)
        return q, h, self.radius_a + (self.radius_b - self.radius_a) * h

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        q, h, radius = self._local(points)
        w = q[:, 2] - h * self.length
        return np.sqrt(q[:, 0] ** 2 + q[:, 1] ** 2 + w * w) - radius

    def encode(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
        q, h, radius = self._local(points)
        return np.stack([h, q[:, 0] / radius, q[:, 1] / radius, (q[:, 2] - h * self.length) / radius], 1)

    def decode(self, code: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3"]:
        radius = self.radius_a + (self.radius_b - self.radius_a) * code[:, 0]
        q = np.stack(
            [code[:, 1] * radius, code[:, 2] * radius, code[:, 0] * self.length + code[:, 3] * radius], 1
        )
        return self.a + q @ self.frame


class Sheet:
    """The upright half-plane x = 0 below `top_y`, `half_m` thick to either side: cut, it parts the thighs."""

    carries = False
    displaces = False

    def __init__(self, top_y: float, half_m: float, blend_m: float) -> None:
        self.top_y, self.half_m, self.blend_m = top_y, half_m, blend_m
        self.low, self.high = np.array([-half_m, 0.15, -0.4]), np.array([half_m, top_y + half_m, 0.4])

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        above = np.maximum(points[:, 1] - (self.top_y - self.half_m), 0)
        return np.sqrt(points[:, 0] ** 2 + above**2) - self.half_m


def smooth_minimum(
    a: Float[np.ndarray, "..."], b: Float[np.ndarray, "..."], radius: float
) -> Float[np.ndarray, "..."]:
    """Quadratic smooth minimum: differs from min(a, b) only where |a - b| < radius, by at most radius / 4."""
    h = np.maximum(radius - np.abs(a - b), 0) / radius
    return np.minimum(a, b) - h * h * radius * 0.25


class ImplicitBody:
    """An ordered smooth union (and subtraction) of primitives: zero on the skin of the left half, x >= 0."""

    FAR_M = 0.10  # value where no primitive reaches
    REACH_M = 0.05  # beyond its box and blend radius a primitive is not asked

    def __init__(self) -> None:
        self.primitives: list[Primitive] = []
        self.is_cut: list[bool] = []
        self.crotch_y = -np.inf  # where the skin's midline ends below

    def add(self, primitive: Primitive) -> None:
        self.primitives.append(primitive)
        self.is_cut.append(False)

    def cut(self, primitive: Ellipsoid | Sheet) -> None:
        self.primitives.append(primitive)
        self.is_cut.append(True)

    @staticmethod
    def join(
        so_far: Float[np.ndarray, "..."],
        distance: Float[np.ndarray, "..."],
        primitive: Primitive,
        is_cut: bool,
    ) -> Float[np.ndarray, "..."]:
        if primitive.displaces:
            return so_far + distance
        if is_cut:
            return -smooth_minimum(-so_far, distance, primitive.blend_m)
        return smooth_minimum(so_far, distance, primitive.blend_m)

    def reached(self, points: Float[np.ndarray, "n 3"]) -> list[Int[np.ndarray, "_"]]:
        """Per primitive, the indices of the points that it can touch."""
        margin = self.REACH_M + np.array([[p.blend_m] for p in self.primitives])
        low = np.stack([p.low for p in self.primitives]) - margin
        high = np.stack([p.high for p in self.primitives]) + margin
        x, y, z = np.ascontiguousarray(points.T)
        out = []
        for (x0, y0, z0), (x1, y1, z1) in zip(low.tolist(), high.tolist(), strict=True):
            out.append(np.flatnonzero((x > x0) & (x < x1) & (y > y0) & (y < y1) & (z > z0) & (z < z1)))
        return out

    def __call__(
        self, points: Float[np.ndarray, "n 3"], reached: list[Int[np.ndarray, "_"]] | None = None
    ) -> Float[np.ndarray, "n"]:
        value = np.full(len(points), self.FAR_M)
        reached = self.reached(points) if reached is None else reached
        for primitive, is_cut, index in zip(self.primitives, self.is_cut, reached, strict=True):
            if len(index):
                value[index] = self.join(value[index], primitive.distance(points[index]), primitive, is_cut)
        return value

    def gradient(
        self, points: Float[np.ndarray, "n 3"], reached: list[Int[np.ndarray, "_"]], step_m: float = 4e-4
    ) -> Float[np.ndarray, "n 3"]:
        """By central differences."""
        g = np.empty_like(points)
        for axis in range(3):
            e = np.zeros(3)
            e[axis] = step_m
            g[:, axis] = (self(points + e, reached) - self(points - e, reached)) / (2 * step_m)
        return g

    def project(
        self, points: Float[np.ndarray, "n 3"], on_seam: np.ndarray, steps: int = 3
    ) -> Float[np.ndarray, "n 3"]:
        """Newton steps (2 cm at most each) onto the skin; points `on_seam` stay in the plane x = 0."""
        p = points.copy()
        for _ in range(steps):
            reached = self.reached(p)
            g = self.gradient(p, reached)
            g[on_seam, 0] = 0
            slope2 = np.maximum((g * g).sum(1), 0.05)
            step = -(self(p, reached) / slope2)[:, None] * g
            length = np.sqrt((step * step).sum(1))[:, None]
            p += step * np.minimum(1, 0.02 / np.maximum(length, TINY))
            p[:, 0] = np.where(on_seam, 0, np.maximum(p[:, 0], 0))
        return p
