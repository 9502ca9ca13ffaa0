"""Smooth variation along the normal: what neither a tape nor a named component says about a person.

A Gaussian process on the mean body: normal displacement with a standard deviation that differs by place (soft
regions vary more than shins) and a covariance that falls with the eigenvalues of the surface's Laplacian. Its
Karhunen-Loeve expansion gives independent components, the strongest first; what the measured and named
components can do already is taken out beforehand.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import eigsh

from fit.surface import vertex_areas, vertex_normals

N_MODES = 360
"""Laplacian modes behind the process, even and odd ones together: half waves down to about 5 cm."""
ASYMMETRY = 0.4
"""Standard deviation of what differs left from right, against what does not."""
HOLD = 1e4  # stiffness of held vertices: a bump dies off within about 1 / sqrt(HOLD) = 1 cm
WAVELENGTH_M = 0.16
"""Variance falls by four where waves are this short."""
SPREAD_M = 0.0050
"""RMS over the body of all normal displacement, at the amplitude one."""


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


def parity_basis(partner: Int[np.ndarray, "v"]) -> list[csc_matrix]:
    """Matrices that extend values on the left half to even and to odd functions of the whole body."""
    n = len(partner)
    everyone = np.arange(n)
    out = []
    for sign, base in ((1.0, everyone <= partner), (-1.0, everyone < partner)):
        own = np.flatnonzero(base)
        column = np.full(n, -1)
        column[own] = np.arange(len(own))
        entry = np.where(base, 1.0, sign)
        source = column[np.where(base, everyone, partner)]
        known = source >= 0  # an odd function is zero on the seam
        out.append(csc_matrix((entry[known], (everyone[known], source[known])), (n, len(own))))
    return out


def laplacian_modes(
    v: Float[np.ndarray, "v 3"],
    f: Int[np.ndarray, "f 3"],
    held: Float[np.ndarray, "v"],
    extend: csc_matrix,
    n_modes: int,
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "v m"]]:
    """Lowest eigenvalues (1/m2) and mass-orthonormal modes of one parity; `held` vertices (1) stay put."""
    area = vertex_areas(v, f)
    stiff = cotangent_laplacian(v, f) + diags(area * held * HOLD)
    mass = csc_matrix(diags(area))
    start = np.random.default_rng(0).standard_normal(extend.shape[1])  # eigsh's own is not reproducible
    values, modes = eigsh(extend.T @ stiff @ extend, n_modes, extend.T @ mass @ extend, sigma=-1.0, v0=start)
    return values, extend @ modes


def smooth_components(
    v: Float[np.ndarray, "v 3"],
    f: Int[np.ndarray, "f 3"],
    amplitude: Float[np.ndarray, "v"],
    held: Float[np.ndarray, "v"],
    partner: Int[np.ndarray, "v"],
    known: Float[np.ndarray, "v 3 k"],
    n_components: int,
) -> Float[np.ndarray, "v 3 b"]:
    """Displacements (m) at one standard deviation, by falling variance.

    `amplitude` (about 1) scales the standard deviation by place, `held` in [0, 1] says where nothing moves,
    `known` are the components that exist already: their normal parts are projected out. Every component is
    even or odd under the left-right mirror.
    """
    area = vertex_areas(v, f)
    normals = vertex_normals(v, f)
    root_mass = np.sqrt(area)[:, None]
    taken = np.linalg.qr(root_mass * np.einsum("va,vak->vk", normals, known))[0]
    fields, variances = [], []
    shares = (1.0, ASYMMETRY)
    total = 0.0
    spectra = []
    for extend, share in zip(parity_basis(partner), shares, strict=True):
        values, modes = laplacian_modes(v, f, held, extend, N_MODES // 2)
        power = share**2 / (1 + np.maximum(values, 0) * (WAVELENGTH_M / (2 * np.pi)) ** 2) ** 2
        spectra.append((power, modes))
        total += power.sum()
    scale = SPREAD_M**2 * area.sum() / total
    for power, modes in spectra:
        weighted = root_mass * amplitude[:, None] * modes * np.sqrt(scale * power)
        weighted -= taken @ (taken.T @ weighted)
        left, singular, _ = np.linalg.svd(weighted, full_matrices=False)
        fields.append(left / root_mass * singular)
        variances.append(singular**2)
    order = np.argsort(-np.concatenate(variances), kind="stable")[:n_components]
    bumps = np.concatenate(fields, 1)[:, order]
    # Outwards at the strongest left vertex: a sign that does not hang on the solver.
    is_left = np.arange(len(v)) <= partner
    strongest = np.abs(bumps * is_left[:, None]).argmax(0)
    bumps *= np.sign(bumps[strongest, np.arange(len(order))])
    return normals[:, :, None] * bumps[:, None, :]
