"""The terms of the single-frame objective, each a function citing its equation (paper section 4.1).

Normalisation (the paper leaves it open): sums over the N scan points are multiplied by V / N, so that a
weight means the same for any number of points and beside the coupling, which is a sum over mesh edges.
Distances in metres. Geman-McClure is used in its scaled form, rho(d) = sigma^2 d^2 / (sigma^2 + d^2), which
is d^2 near zero, so that the weights keep their meaning when sigma changes. Point terms return (energy,
weight) a point: `weight` is the factor of d^2 in iteratively re-weighted least squares.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_matrix

PerPoint = tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]


def geman_mcclure(distance: Float[np.ndarray, "n"], sigma_m: float) -> PerPoint:
    """rho of E_skin and E_fit: quadratic near zero, at most sigma^2."""
    ratio = sigma_m**2 / (sigma_m**2 + distance**2)
    return ratio * distance**2, ratio**2


def huber(distance: Float[np.ndarray, "n"], delta_m: float) -> PerPoint:
    """Quadratic up to delta (infinite: everywhere), linear beyond (written so that the quadratic part is
    d^2)."""
    size = np.abs(distance)
    if np.isinf(delta_m):
        return size**2, np.ones_like(size)
    energy = np.where(size <= delta_m, size**2, delta_m * (2.0 * size - delta_m))
    return energy, np.minimum(1.0, delta_m / np.maximum(size, 1e-30))


def skin_share(geodesic_m: Float[np.ndarray, "n"], edge_m: float, width_m: float) -> Float[np.ndarray, "n"]:
    """g of E_skin: logistic of the geodesic distance to the nearest cloth; one half at `edge_m`, 0 on
    cloth."""
    steps = np.clip((edge_m - geodesic_m) / width_m, -50.0, 50.0)
    return np.where(geodesic_m > 0.0, 1.0 / (1.0 + np.exp(steps)), 0.0)


def skin(
    signed_distance: Float[np.ndarray, "n"], sigma_m: float, g: Float[np.ndarray, "n"] | float = 1.0
) -> PerPoint:
    """E_skin: scan points labelled skin lie on the body, on either side, the less surely the nearer cloth
    is (g)."""
    energy, weight = geman_mcclure(signed_distance, sigma_m)
    return g * energy, g * weight


def cloth(
    signed_distance: Float[np.ndarray, "n"],
    outside_weight: float,
    outside_m: float,
    fit_weight: Float[np.ndarray, "n"] | float,
    sigma_m: float,
) -> PerPoint:
    """E_cloth = lambda_outside E_outside + lambda_fit E_fit; lambda_fit may differ from point to point."""
    out_energy, out_weight = outside(signed_distance, outside_m)
    fit_energy, fit_pull = fit(signed_distance, sigma_m)
    return (
        outside_weight * out_energy + fit_weight * fit_energy,
        outside_weight * out_weight + fit_weight * fit_pull,
    )


def outside(signed_distance: Float[np.ndarray, "n"], delta_m: float) -> PerPoint:
    """E_outside: cloth points inside the body (delta_i = 1, negative distance) push the surface inwards.

    Huber instead of the paper's square: one percent of points lost 20-60 mm inside the hull ruins a quadratic
    term.
    """
    energy, weight = huber(signed_distance, delta_m)
    inside = signed_distance < 0
    return np.where(inside, energy, 0.0), np.where(inside, weight, 0.0)


def fit(signed_distance: Float[np.ndarray, "n"], sigma_m: float) -> PerPoint:
    """E_fit: the body stays near the cloth, but wide clothes are let go."""
    return geman_mcclure(signed_distance, sigma_m)


def coupling(
    difference: Float[np.ndarray, "v 3"], laplacian: csr_matrix
) -> tuple[float, Float[np.ndarray, "v 3"]]:
    """E_cpl: edges of the template against the edges of its target; difference = T_Est - target.

    Returns the energy and half its gradient, L (T_Est - target).
    """
    half_gradient = laplacian @ difference
    return float((difference * half_gradient).sum()), half_gradient


def tether(difference: Float[np.ndarray, "v 3"]) -> tuple[float, Float[np.ndarray, "v 3"]]:
    """Keeps T_Est from drifting rigidly against the translation, which the coupling on edges cannot see."""
    return float((difference**2).sum()), difference


def gaussian_prior(
    value: Float[np.ndarray, "m"], mean: Float[np.ndarray, "m"], precision: Float[np.ndarray, "m m"]
) -> tuple[float, Float[np.ndarray, "m"]]:
    """E_prior: Mahalanobis distance (value - mean)^T Sigma^-1 (value - mean), and half its gradient."""
    half_gradient = precision @ (value - mean)
    return float((value - mean) @ half_gradient), half_gradient
