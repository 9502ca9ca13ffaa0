"""The shape space: principal components of drawn people, then smooth bumps along the normal.

Anthropometric components: area-weighted PCA (Loper et al., SMPL, section 3), scaled so that a coefficient of
one is one standard deviation. Displacement components: low eigenmodes of the mesh's Laplacian along the
normal of the mean body, for what no tape has measured; they fade to nothing towards hands, feet and face.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import eigsh

from .anatomy import make_person
from .anthropometry import draw_people, measure
from .correspondence import Carrier
from .skeleton import JOINT

N_ANTHROPOMETRIC = 16
N_DISPLACEMENT = 48
DISPLACEMENT_SD_M = 0.0045
"""RMS over the body of the smoothest displacement component at one standard deviation."""
ASYMMETRY = 0.4
"""Standard deviation of components that differ left from right, against those that do not."""
HOLD = 1e4  # stiffness of held vertices: a bump dies off within about 1 / sqrt(HOLD) = 1 cm


@dataclass(frozen=True)
class People:
    """Drawn people on the half template, all shifted so that their surface centroids agree (metres)."""

    halves: Float[np.ndarray, "n h 3"]
    joints: Float[np.ndarray, "n 24 3"]
    stature: Float[np.ndarray, "n"]
    bmi: Float[np.ndarray, "n"]


def vertex_areas(v: Float[np.ndarray, "v 3"], f: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v"]:
    """A third of every incident triangle (m2)."""
    area = np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1) / 6
    return np.bincount(f.ravel(), np.repeat(area, 3), len(v))


def vertex_normals(v: Float[np.ndarray, "v 3"], f: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Area-weighted unit normals, outwards for this package's face orientation."""
    n = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    total = np.stack([np.bincount(f.ravel(), np.repeat(n[:, k], 3), len(v)) for k in range(3)], 1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def gather_people(
    carrier: Carrier,
    half_area: Float[np.ndarray, "h"],
    n: int,
    seed: int,
    sex: float | None,
    progress: Callable[[], object],
) -> People:
    """Build n drawn people. Aligned at the centroid of the skin: aligned at the pelvis, leg length would move
    every vertex and take a component for itself. The mean pelvis joint becomes the origin.
    """
    weight = half_area / half_area.sum()
    sexes, scores = draw_people(n, seed, sex)
    halves, joints = np.empty((n, carrier.n, 3)), np.empty((n, 24, 3))
    stature, bmi = np.empty(n), np.empty(n)
    for i in range(n):
        person = measure(float(sexes[i]), scores[i])
        body, joints[i] = make_person(person)
        halves[i] = carrier(body)
        centroid = np.array([0, weight @ halves[i, :, 1], weight @ halves[i, :, 2]])  # x = 0 after mirroring
        halves[i] -= centroid
        joints[i] -= centroid
        stature[i], bmi[i] = person.stature, person.bmi
        progress()
    origin = joints[:, JOINT["pelvis"]].mean(0)
    return People(halves - origin, joints - origin, stature, bmi)


def principal_components(
    people: People, half_area: Float[np.ndarray, "h"], n_components: int
) -> tuple[Float[np.ndarray, "h 3"], Float[np.ndarray, "h 3 b"], Float[np.ndarray, "b"]]:
    """Mean, components at one standard deviation, and the share of variance of each.

    Area-weighted, or the fine hands would rule. The sign of a component is that of taller, else of heavier.
    """
    n = len(people.halves)
    mean = people.halves.mean(0)
    centred = people.halves - mean
    weighted = (centred * np.sqrt(half_area / half_area.sum())[None, :, None]).reshape(n, -1)
    variance, vectors = np.linalg.eigh(weighted @ weighted.T)
    variance, vectors = variance[::-1], vectors[:, ::-1][:, :n_components]
    for b in range(n_components):
        by_stature = np.corrcoef(vectors[:, b], people.stature)[0, 1]
        by_bmi = np.corrcoef(vectors[:, b], people.bmi)[0, 1]
        if (by_stature if abs(by_stature) > 0.5 else by_bmi) < 0:
            vectors[:, b] *= -1
    components = np.einsum("nb,nvc->vcb", vectors, centred) / np.sqrt(n - 1)
    return mean, components, variance[:n_components] / variance.sum()


def cotangent_laplacian(v: Float[np.ndarray, "v 3"], f: Int[np.ndarray, "f 3"]) -> csc_matrix:
    """Symmetric positive semi-definite stiffness matrix of linear elements (Pinkall & Polthier 1993)."""
    n = len(v)
    total = csc_matrix((n, n))
    for k in range(3):
        i, j, o = f[:, k], f[:, (k + 1) % 3], f[:, (k + 2) % 3]
        a, b = v[i] - v[o], v[j] - v[o]
        cot = (a * b).sum(1) / np.maximum(np.linalg.norm(np.cross(a, b), axis=1), 1e-12)
        half = 0.5 * np.maximum(cot, 1e-3)  # obtuse angles would make negative couplings
        total = total + coo_matrix((half, (i, j)), (n, n)) + coo_matrix((half, (j, i)), (n, n))
    return csc_matrix(diags(np.asarray(total.sum(1)).ravel()) - total)


def displacement_components(
    v: Float[np.ndarray, "v 3"],
    f: Int[np.ndarray, "f 3"],
    held: Float[np.ndarray, "v"],
    partner: Int[np.ndarray, "v"],
    n_components: int,
) -> Float[np.ndarray, "v 3 b"]:
    """Smooth bumps along the normal at one standard deviation, most extended first.

    `held` in [0, 1] says how much a vertex must stay (1: hands, feet, face). Modes solve (L + c held M) x =
    lambda M x; the standard deviation falls with the eigenvalue from DISPLACEMENT_SD_M, so that fine detail
    stays small. Modes are symmetrised: each is even or odd under the left-right mirror.
    """
    area = vertex_areas(v, f)
    mass = csc_matrix(diags(area))
    stiff = cotangent_laplacian(v, f) + diags(area * held * HOLD)
    # The mirror commutes with the operator: even and odd modes are solved for apart, so that none is a
    # mixture.
    everyone = np.arange(len(v))
    is_left = everyone <= partner
    by_sign: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for sign, base in ((1.0, is_left), (-1.0, everyone < partner)):
        own = np.flatnonzero(base)
        column = np.full(len(v), -1)
        column[own] = np.arange(len(own))
        entry = np.where(base, 1.0, sign)
        source = column[np.where(base, everyone, partner)]
        known = source >= 0  # an odd mode is zero on the seam
        extend = csc_matrix((entry[known], (everyone[known], source[known])), (len(v), len(own)))
        start = np.random.default_rng(0).standard_normal(len(own))  # eigsh's own start is not reproducible
        found, modes = eigsh(
            extend.T @ stiff @ extend, n_components, extend.T @ mass @ extend, sigma=-1.0, v0=start
        )
        by_sign.append((found, extend @ modes, np.full(n_components, 1.0 if sign > 0 else ASYMMETRY)))
    values, vectors, spread = (np.concatenate(columns, -1) for columns in zip(*by_sign, strict=True))
    order = np.argsort(values, kind="stable")[:n_components]
    values, vectors, spread = values[order], vectors[:, order], spread[order]
    rms = np.sqrt((area[:, None] * vectors**2).sum(0) / area.sum())
    # Outwards at the mode's strongest left vertex: a sign that does not hang on the eigensolver.
    strongest = np.abs(vectors * is_left[:, None]).argmax(0)
    sign_of = np.sign(vectors[strongest, np.arange(len(order))])
    sd = DISPLACEMENT_SD_M * spread / (1 + values / values[len(order) // 2])
    bumps = vectors * (sign_of * sd / rms)
    return vertex_normals(v, f)[:, :, None] * bumps[:, None, :]
