"""Skin told from cloth by colour: a colour model grown from places that are usually bare, then a smooth
labelling of the surface.

Mixtures of Gaussians of skin and of everything else, over lightness (which light and shade change, so it
counts half) and the two opponent colours of CIE Lab, are fitted in turns with the labels, as interactive
picture segmentation does; a minimum cut gives the labels that agree with both and change seldom between
neighbours of one colour.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

_LIGHTNESS = 0.5
#: Added to every colour (standard deviation, Lab), so that one even colour is no singular Gaussian.
_BLUR = 2.0
_N_SKIN, _N_OTHER = 2, 5
_ROUNDS = 3
#: Lab of any person's skin: a hue between red and yellow, neither grey nor black.
_HUE_DEG, _LEAST_CHROMA, _LEAST_LIGHTNESS = (10.0, 85.0), 6.0, 12.0
#: Seeds whose colours differ by more than this (Lab, without lightness) are not both skin.
_SAME_SKIN = 18.0
#: Cost of an edge between labels, and the difference of colours at which it is a tenth cheaper each time.
_EDGE_COST, _EDGE_COLOUR = 4.0, 8.0
_LARGEST_COST = 8.0
#: Mahalanobis distances: a seed within the first is skin; what lies beyond the second is something else for
#: sure.
_SURE, _ELSE = 2.5, 3.5
_FEWEST = 30


def lab(colours: UInt8[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """CIE Lab of RGB values: L from 0 to 100, a and b around 0."""
    flat = np.ascontiguousarray(colours.reshape(-1, 1, 3), dtype=np.float32) / 255.0
    return np.asarray(cv2.cvtColor(flat, cv2.COLOR_RGB2LAB), dtype=float).reshape(colours.shape)


def is_skin_tone(tone: Float[np.ndarray, "3"]) -> bool:
    """Whether a Lab colour may be a person's skin, of any complexion."""
    hue = float(np.degrees(np.arctan2(tone[2], tone[1])))
    chroma = float(np.hypot(tone[1], tone[2]))
    return _HUE_DEG[0] < hue < _HUE_DEG[1] and chroma > _LEAST_CHROMA and bool(tone[0] > _LEAST_LIGHTNESS)


def skin_by_colour(
    colours: UInt8[np.ndarray, "t v 3"],
    seeds: Sequence[Bool[np.ndarray, " v"]],
    edges: Int[np.ndarray, "e 2"],
) -> Bool[np.ndarray, "t v"] | None:
    """(T V) true where a surface of V vertices is bare in T frames; None where no seed shows skin.

    seeds : groups of vertices that are usually bare, the surest first; a group of another colour than the
    first
        that looks like skin (gloves, a mask) is left out. edges : pairs of neighbours.
    """
    values = lab(colours)
    bare = np.zeros(colours.shape[1], dtype=bool)
    first: np.ndarray | None = None
    for group in seeds:
        if group.sum() < 3:
            continue
        tone = np.median(values[:, group].reshape(-1, 3), axis=0)
        if is_skin_tone(tone) and (first is None or np.linalg.norm((tone - first)[1:]) < _SAME_SKIN):
            first = tone if first is None else first
            bare |= group
    if first is None:
        return None
    random = np.random.default_rng(0)
    places = values * [_LIGHTNESS, 1.0, 1.0]
    blurred = (places + random.normal(0.0, _BLUR, places.shape)).astype(np.float64)
    of_seeds = blurred[:, bare].reshape(-1, 3)
    # Hair, brows or a cuff among the seeds: what is far from their middle does not count.
    for _ in range(3):
        distance = _mahalanobis(blurred, of_seeds)
        of_seeds = blurred[:, bare][distance[:, bare] < _SURE]
    labels = distance < _SURE + 0.5
    other = distance > _ELSE
    costs_of_edges = _edge_costs(places, edges)
    for _ in range(_ROUNDS):
        if labels.sum() < _FEWEST or other.sum() < _FEWEST:
            break
        score = _log_likelihood(blurred, blurred[labels], _N_SKIN) - _log_likelihood(
            blurred, blurred[other], _N_OTHER
        )
        score = np.clip(score, -_LARGEST_COST, _LARGEST_COST)
        score = 0.5 * (score + score.mean(axis=0))  # clothes stay where they are, or nearly
        labels = np.stack([_least_cut(s, edges, c) for s, c in zip(score, costs_of_edges, strict=True)])
        other = ~labels
    if labels.sum() < _FEWEST:
        return None
    return labels


def _mahalanobis(values: np.ndarray, sample: np.ndarray) -> np.ndarray:
    middle = np.median(sample, axis=0)
    inverse = np.linalg.inv(np.cov(sample.T) + np.eye(3))
    gap = values - middle
    return np.sqrt(np.einsum("...i,ij,...j->...", gap, inverse, gap))


def _log_likelihood(values: np.ndarray, sample: np.ndarray, n_clusters: int) -> np.ndarray:
    """Log density of every value under a mixture fitted to the sample."""
    model = cv2.ml.EM.create()
    model.setClustersNumber(n_clusters)
    model.setTermCriteria((cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-3))
    cv2.setRNGSeed(1)
    model.trainEM(sample[np.linspace(0, len(sample) - 1, min(len(sample), 8000)).astype(int)])
    means, weights = model.getMeans(), model.getWeights().ravel()
    parts = []
    for mean, weight, covariance in zip(means, weights, model.getCovs(), strict=True):
        spread = covariance + np.eye(3)
        gap = values - mean
        squared = np.einsum("...i,ij,...j->...", gap, np.linalg.inv(spread), gap)
        parts.append(np.log(max(weight, 1e-12)) - 0.5 * (squared + np.linalg.slogdet(2 * np.pi * spread)[1]))
    # A little of everything everywhere: a colour that neither model knows says nothing.
    return np.logaddexp(np.logaddexp.reduce(parts, axis=0), np.log(1e-6))


def _edge_costs(places: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(T E) cost of a border between neighbours, low where the colour changes."""
    change = np.linalg.norm(places[:, edges[:, 0]] - places[:, edges[:, 1]], axis=2)
    return _EDGE_COST * np.exp(-0.5 * (change / _EDGE_COLOUR) ** 2)


def _least_cut(score: np.ndarray, edges: np.ndarray, edge_cost: np.ndarray) -> Bool[np.ndarray, " v"]:
    """The labelling (V,) of least cost: -score where true, 0 where false, and the edges between labels."""
    n = len(score)
    source, sink, units = n, n + 1, 1000.0
    gain, loss = np.round(units * np.maximum(score, 0)), np.round(units * np.maximum(-score, 0))
    between = np.round(units * edge_cost)
    every = np.arange(n)
    rows = np.concatenate([np.full(n, source), every, edges[:, 0], edges[:, 1]])
    columns = np.concatenate([every, np.full(n, sink), edges[:, 1], edges[:, 0]])
    capacity = np.concatenate([gain, loss, between, between]).astype(np.int32)
    graph = coo_matrix((capacity, (rows, columns)), shape=(n + 2, n + 2)).tocsr()
    graph.sum_duplicates()
    graph.eliminate_zeros()
    left = graph - maximum_flow(graph, source, sink).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = breadth_first_order(left, source, return_predecessors=False)
    out = np.zeros(n + 2, dtype=bool)
    out[reached] = True
    return out[:n]
