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
    """Quadratic up to delta, linear beyond (written so that the quadratic part is d^2)."""
    size = np.abs(distance)
    energy = np.where(size <= delta_m, size**2, delta_m * (2.0 * size - delta_m))
    return energy, np.minimum(1.0, delta_m / np.maximum(size, 1e-30))


def skin(signed_distance: Float[np.ndarray, "n"], sigma_m: float) -> PerPoint:
    """E_skin: scan points labelled skin lie on the body, on either side (g(s) is applied by the caller)."""
    return geman_mcclure(signed_distance, sigma_m)


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
