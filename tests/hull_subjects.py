"""Subjects for the tests of the hull, with silhouettes in closed form: balls, and figures made of balls."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.rig import Rig

PEOPLE = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "people"


@dataclass(frozen=True)
class Balls:
    """Centres (K 3) and radii (K,), metres."""

    centres: np.ndarray
    radii: np.ndarray

    def silhouette(self, camera: Camera) -> np.ndarray:
        """(h w) uint8: 255 where the ray through the pixel's centre meets a ball."""
        width, height = camera.size
        pixels = (
            np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
        )
        matrix = camera.projection_matrix
        rays = np.linalg.solve(matrix[:, :3], np.column_stack([pixels, np.ones(len(pixels))]).T).T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        hit = np.zeros(len(pixels), dtype=bool)
        for centre, radius in zip(self.centres, self.radii, strict=True):
            to_centre = centre - camera.centre
            along = rays @ to_centre
            hit |= (to_centre @ to_centre - along**2 <= radius**2) & (along > 0)
        return np.where(hit, 255, 0).astype(np.uint8).reshape(height, width)

    def silhouettes(self, rig: Rig) -> list[np.ndarray]:
        return [self.silhouette(camera) for camera in rig]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(N,) signed metres from the surface, positive outside; inside, of the nearest ball."""
        each = [np.linalg.norm(points - c, axis=1) - r for c, r in zip(self.centres, self.radii, strict=True)]
        return np.min(each, axis=0)


def ball(radius: float = 0.4, centre: tuple[float, float, float] = (0.05, -0.03, 1.1)) -> Balls:
    return Balls(np.array([centre]), np.array([radius]))


def figure() -> Balls:
    """A standing figure, 1.75 m: head, trunk, two arms held out, two legs."""

    def limb(start: tuple, end: tuple, radius_0: float, radius_1: float, n: int) -> list[tuple]:
        share = np.linspace(0, 1, n)[:, None]
        points = np.array(start) * (1 - share) + np.array(end) * share
        return [(*p, radius_0 * (1 - s) + radius_1 * s) for p, s in zip(points, share[:, 0], strict=True)]

    rows = [(0.0, 0.0, 1.63, 0.12)]
    rows += limb((0, 0, 1.5), (0, 0, 0.95), 0.13, 0.15, 8)
    for side in (-1, 1):
        rows += limb((0.17 * side, 0, 1.42), (0.6 * side, 0.1, 1.1), 0.055, 0.035, 14)
        rows += limb((0.1 * side, 0, 0.9), (0.18 * side, 0.05, 0.08), 0.09, 0.05, 16)
    table = np.array(rows)
    return Balls(table[:, :3], table[:, 3])


def is_vertex_manifold(faces: np.ndarray, n_vertices: int) -> bool:
    """True if the faces around each vertex of a closed surface form one fan: no two cones share a tip."""
    # Around a corner, each face leads from one edge to the next; as many turns as fans.
    corner, leaving = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    arriving = faces[:, [2, 0, 1]].ravel()
    forth = {(a, b): c for a, b, c in zip(corner.tolist(), leaving.tolist(), arriving.tolist(), strict=True)}
    degree = np.bincount(corner, minlength=n_vertices)
    first: dict[int, int] = dict(zip(corner.tolist(), leaving.tolist(), strict=True))
    for vertex, start in first.items():
        n, at = 1, forth[vertex, start]
        while at != start:
            at = forth[vertex, at]
            n += 1
        if n != degree[vertex]:
            return False
    return True
