"""Dense correspondence: the template's vertices carried onto any other person of the family.

Every vertex keeps its coordinates in the lofts, fingers and toes near it; another body decodes them with its
own tables, and a few Newton steps bring the result onto that body's skin.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix

from .implicit import Cone, ImplicitBody, Loft
from .remesh import SEAM_TOLERANCE_M

OFF_SEAM_M = 6e-4
SOFTNESS_M = 0.015  # how fast the say of a farther primitive fades
FARTHEST_M = 0.06
OFF_SKIN_M = 1e-3
MARGIN_M = 0.05  # a primitive shapes the vertices so near it on the template; on others it may be larger


def neighbour_mean(faces: Int[np.ndarray, "f 3"], n_vertices: int) -> csr_matrix:
    """The matrix that averages a quantity over every vertex's neighbours."""
    e = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([e, e[:, ::-1]])
    adjacency = coo_matrix((np.ones(len(both)), both.T), (n_vertices, n_vertices)).tocsr()
    adjacency.data[:] = 1
    return csr_matrix(adjacency.multiply(1 / np.asarray(adjacency.sum(1))))


class Carrier:
    """Moves the half template onto other bodies; `half` and `faces` belong to the body `source`."""

    def __init__(
        self, half: Float[np.ndarray, "h 3"], faces: Int[np.ndarray, "g 3"], source: ImplicitBody
    ) -> None:
        self.seam = half[:, 0] < SEAM_TOLERANCE_M
        self.n = len(half)
        self.ids = [i for i, p in enumerate(source.primitives) if isinstance(p, Loft | Cone) and p.carries]
        carriers = [p for p in source.primitives if isinstance(p, Loft | Cone) and p.carries]
        distance = np.stack([p.distance(half) for p in carriers])
        excess = distance - distance.min(0)
        weight = np.exp(-np.clip(excess / SOFTNESS_M, 0, 30)) * (excess < FARTHEST_M)
        weight /= weight.sum(0)
        self.index = [np.flatnonzero(w > 1e-4) for w in weight]
        self.weight = [w[ix, None] for w, ix in zip(weight, self.index, strict=True)]
        self.code = [p.encode(half[ix]) for p, ix in zip(carriers, self.index, strict=True)]
        # Which vertices each primitive shapes is the same in every body: decided once, on the template.
        self.reached = [
            index[p.distance(half[index]) < 0.03 + p.blend_m]
            for p, index in zip(source.primitives, source.reached(half), strict=True)
        ]
        self.smooth = neighbour_mean(faces, self.n)

    def _keep_sides(self, p: Float[np.ndarray, "h 3"]) -> None:
        p[:, 0] = np.where(self.seam, 0, np.maximum(p[:, 0], OFF_SEAM_M))

    def _to_skin(
        self,
        body: ImplicitBody,
        start: Float[np.ndarray, "n 3"],
        on_seam: Bool[np.ndarray, "n"],
        reached: list[Int[np.ndarray, "_"]],
        n_steps: int,
    ) -> Float[np.ndarray, "n 3"]:
        """The way from `start` to the skin by chord Newton: one gradient serves all steps."""
        p = start.copy()
        value = body(p, reached)
        gradient = np.empty_like(p)
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 5e-4
            gradient[:, axis] = (body(p + step, reached) - value) / 5e-4
        gradient[on_seam, 0] = 0
        gradient /= np.maximum((gradient * gradient).sum(1), 0.1)[:, None]
        for step_idx in range(n_steps):
            move = -value[:, None] * gradient
            length = np.sqrt((move * move).sum(1))[:, None]
            p += move * np.minimum(1, 0.02 / np.maximum(length, 1e-9))
            p[:, 0] = np.where(on_seam, 0, np.maximum(p[:, 0], OFF_SEAM_M))
            if step_idx < n_steps - 1:
                value = body(p, reached)
        return p - start

    def __call__(self, body: ImplicitBody) -> Float[np.ndarray, "h 3"]:
        """Half vertices on this body's skin, floor frame, metres."""
        decoded = np.zeros((self.n, 3))
        for i, index, code, weight in zip(self.ids, self.index, self.code, self.weight, strict=True):
            decoded[index] += body.primitives[i].decode(code) * weight  # type: ignore[attr-defined]
        self._keep_sides(decoded)
        # The midline ends at the crotch; below it there is no skin that Newton's steps could find.
        decoded[self.seam, 1] = np.maximum(decoded[self.seam, 1], body.crotch_y)

        correction = self._to_skin(body, decoded, self.seam, self.reached, 3)
        for _ in range(2):
            correction = 0.5 * correction + 0.5 * (self.smooth @ correction)
        correction[self.seam, 0] = 0
        placed = decoded + correction
        # Smoothing leaves some off the skin where it bends much (a large breast): those are brought back.
        off = np.flatnonzero(np.abs(body(placed, self.reached)) > OFF_SKIN_M)
        placed[off] += self._to_skin(body, placed[off], self.seam[off], body.reached(placed[off]), 2)
        self._keep_sides(placed)
        return placed
