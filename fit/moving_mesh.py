"""Closest points on a mesh that moves but keeps its faces: the body, step after step.

A complete binary tree over the triangles is made once, from the mesh at rest, where parts that may touch
later are well apart; for every new position of the vertices only its boxes are fitted anew. `guess` hands
over the triangles that were found one step ago, so that most of the tree is never opened. The answers are
those of `closest.closest_points` (in double precision throughout); the loops are in `compiled`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fit.closest import ClosestPoints

TRIANGLES_A_LEAF = 2


@dataclass(frozen=True)
class MovingMesh:
    """faces (F 3); order (F): the triangles as the leaves hold them, place (F) the inverse; first (L + 1):
    where each leaf's begin."""

    faces: Int[np.ndarray, "f 3"]
    order: Int[np.ndarray, "f"]
    place: Int[np.ndarray, "f"]
    first: Int[np.ndarray, "_"]

    @staticmethod
    def of(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> MovingMesh:
        """The tree of this mesh: halved at the median along the longest side, again and again."""
        faces = np.ascontiguousarray(faces, dtype=np.int64)
        centres = vertices[faces].mean(1)
        n_levels = max(0, int(np.ceil(np.log2(len(faces) / TRIANGLES_A_LEAF))))
        order = np.arange(len(faces))
        for level in range(n_levels):
            first = np.linspace(0, len(faces), 2**level + 1).astype(np.int64)
            sorted_centres = centres[order]
            side = np.maximum.reduceat(sorted_centres, first[:-1]) - np.minimum.reduceat(
                sorted_centres, first[:-1]
            )
            node = np.repeat(np.arange(2**level), np.diff(first))
            along = sorted_centres[np.arange(len(faces)), side.argmax(1)[node]]
            order = order[np.lexsort((along, node))]
        first = np.linspace(0, len(faces), 2**n_levels + 1).astype(np.int64)
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        return MovingMesh(faces, order, place, first)

    def closest(
        self,
        vertices: Float[np.ndarray, "v 3"],
        points: Float[np.ndarray, "n 3"],
        guess: Int[np.ndarray, "n"] | None = None,
    ) -> ClosestPoints:
        """Closest points as `Container.closest` defines them; guess: for every point a triangle that may be
        near (a wrong one costs time, nothing else)."""
        from fit import compiled

        vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        points = np.ascontiguousarray(points, dtype=np.float64)
        n = len(points)
        corners = np.empty((len(self.faces), 9))
        compiled.pack_triangles(vertices, self.faces, self.order, corners)
        boxes = np.empty((2 * len(self.first) - 3, 6))
        compiled.fit_boxes(corners, self.first, boxes)
        guess = np.full(n, -1, dtype=np.int64) if guess is None else guess
        triangle, barycentric = np.empty(n, dtype=np.int64), np.empty((n, 3))
        compiled.find_closest(
            points, corners, self.first, boxes, self.order, self.place, guess, triangle, barycentric
        )
        normals = np.zeros((len(vertices), 3))
        compiled.sum_face_normals(vertices, self.faces, normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        foot, normal, direction = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
        distance = np.empty(n)
        compiled.measure(
            points, vertices, self.faces, normals, triangle, barycentric, foot, normal, distance, direction
        )
        return ClosestPoints(triangle, barycentric, foot, normal, distance, direction)
