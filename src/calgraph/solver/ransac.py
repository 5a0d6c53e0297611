"""The sample-and-score loop, with the score of MSAC.

Sources: Fischler and Bolles, "Random sample consensus", CACM 1981 (sampling, count of inliers, stopping rule);
Torr and Zisserman, "MLESAC", CVIU 2000 (the truncated-residual score called MSAC there); Chum, Matas, Kittler,
"Locally optimized RANSAC", DAGM 2003 (the fit to the inliers of each best model); Chum and Matas, "Matching with
PROSAC", CVPR 2005 (samples of the data with the best scores first, here half of them).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

Indices = NDArray[np.intp]

# Samples solved and scored in one call, after which the confidence is tested: enough that the time of a call does
# not matter.
_BATCH = 100
# Up to this number of data for each of a sample, samples are drawn by shuffling: it is faster then.
_MAX_SHUFFLED = 20
# Limit on fits of one model to its inliers; they stay the same after two to four.
_MAX_LOCAL_FITS = 10


@dataclass(frozen=True, eq=False)
class RansacResult:
    """The best model found and its inliers."""

    model: Array
    """One model, with the shape that ``solve`` gives for one sample."""
    inliers: NDArray[np.bool_]
    """(N,) at most one datum of each group: the best one, if it is within the threshold."""
    cost: float
    """Sum over groups of the truncated squared residuals, in units of the squared threshold."""
    samples: int
    """Number of samples drawn."""

    @property
    def inlier_count(self) -> int:
        """Number of groups with an inlier."""
        return int(self.inliers.sum())


def find_consensus(
    groups: Indices,
    sample_size: int,
    solve: Callable[[Indices], Array],
    squared_residuals: Callable[[Array], Array],
    threshold2: float,
    *,
    rng: np.random.Generator,
    confidence: float,
    max_samples: int,
    fit: Callable[[Array, NDArray[np.bool_]], Array] | None = None,
) -> RansacResult | None:
    """Finds the model with the lowest robust cost by random sampling.

    Data come in groups of mutually exclusive alternatives, such as candidate detections of one capture: a sample
    takes at most one of a group, and a group's residual is that of its best member. Every second sample takes the
    first of each group, the others any. Data without alternatives are groups of one, ``groups = arange(N)``.

    Args:
        groups: (N,) group of each datum, any non-negative integers; the most probable datum of a group first.
        sample_size: number of data in a minimal sample.
        solve: indices (K, sample_size) of K samples to K models (K, ...). A sample without solution gets NaN.
        squared_residuals: models (K, ...) to (K, N) squared residuals; NaN counts as infinite.
        threshold2: squared residual up to which a datum is an inlier, in the same units.
        rng: source of the samples.
        confidence: stop once an all-inlier sample has been drawn with this probability.
        max_samples: stop after this many samples.
        fit: local optimization: one model and its inliers (N,) to the model that fits these best. Samples without
            outliers may still give poor models, because the data have noise.

    Returns:
        The best model, or None if there are fewer groups than ``sample_size`` or no sample has a solution.
    """
    groups = np.asarray(groups)
    order = np.argsort(groups, kind="stable")
    _, starts, sizes = np.unique(groups[order], return_index=True, return_counts=True)
    if len(starts) < sample_size:
        return None

    def best_of_groups(models: Array) -> tuple[Array, Array]:
        r2 = squared_residuals(models)[:, order] / threshold2
        r2 = np.where(np.isnan(r2), np.inf, r2)
        return np.minimum.reduceat(r2, starts, axis=1), r2[:, starts]

    def cost_of(best: Array) -> Array:
        return np.asarray(np.minimum(best, 1.0).sum(axis=1))

    def select_inliers(model: Array) -> NDArray[np.bool_]:
        return select_best_of_groups(squared_residuals(model[None])[0] / threshold2, groups)

    def optimize_locally(model: Array, cost: float) -> tuple[Array, float]:
        for _ in range(_MAX_LOCAL_FITS):
            fitted = fit(model, select_inliers(model)) if fit else model
            fitted_cost = float(cost_of(best_of_groups(fitted[None])[0])[0])
            if not fitted_cost < cost:
                break
            model, cost = fitted, fitted_cost
        return model, cost

    best: Array | None = None
    best_cost, sample_count = np.inf, 0
    # Of few data, all samples have been drawn before long.
    distinct = math.comb(len(starts), sample_size) * float(sizes.max()) ** sample_size
    required = _required_samples(0.5 / distinct, confidence)
    while sample_count < min(required, max_samples):
        chosen = _draw_samples(len(starts), sample_size, min(_BATCH, max_samples - sample_count), rng)
        members = (rng.random(chosen.shape) * sizes[chosen]).astype(np.intp)
        members[sample_count % 2 :: 2] = 0
        models = solve(order[starts[chosen] + members])
        sample_count += len(chosen)
        models = models[np.isfinite(models.reshape(len(models), -1)).all(axis=1)]
        if not len(models):
            continue
        costs = cost_of(best_of_groups(models)[0])
        winner = int(np.argmin(costs))
        if costs[winner] < best_cost:
            best, best_cost = optimize_locally(models[winner], float(costs[winner]))
            (of_group,), (of_first,) = best_of_groups(best[None])
            inlier_share, first_share = np.mean((of_group <= 1.0) / sizes), np.mean(of_first <= 1.0)
            # If most of the first data are outliers, the same few samples of the others are drawn again and again.
            first_probability = first_share**sample_size if first_share > 0.5 else 0.0
            if sizes.max() == 1:
                first_probability = inlier_share**sample_size
            probability = float(inlier_share**sample_size + first_probability) / 2
            required = min(required, _required_samples(probability, confidence))
    if best is None:
        return None
    return RansacResult(best, select_inliers(best), best_cost, sample_count)


def _required_samples(inlier_probability: float, confidence: float) -> float:
    """Number of samples after which one without outliers has been drawn with the given probability.

    Args:
        inlier_probability: of a sample without outliers: the share of inliers to the power of the sample size, in
            the mean of both ways to sample.
        confidence: required probability.
    """
    return float(np.log1p(-confidence) / np.log1p(-np.clip(inlier_probability, 1e-300, 1 - 1e-12)))


def _draw_samples(n: int, size: int, count: int, rng: np.random.Generator) -> Indices:
    """Draws ``count`` samples of ``size`` distinct numbers below ``n``: (count, size)."""
    if n <= _MAX_SHUFFLED * size:
        return np.argsort(rng.random((count, n)), axis=1)[:, :size]
    # With many data a repeated number is rare: redrawing the few rows that have one is faster than shuffling all.
    rows = rng.integers(n, size=(count, size))
    while True:
        ordered = np.sort(rows, axis=1)
        repeated = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
        if not repeated.any():
            return rows
        rows[repeated] = rng.integers(n, size=(int(repeated.sum()), size))


def select_best_of_groups(r2: Array, groups: Indices) -> NDArray[np.bool_]:
    """Marks the best member of each group if it is within the threshold.

    Args:
        r2: (N,) squared residuals in units of the squared threshold; NaN counts as infinite.
        groups: (N,).

    Returns:
        (N,) with at most one True in each group.
    """
    r2 = np.where(np.isnan(r2), np.inf, r2)
    by_residual = np.argsort(r2, kind="stable")
    _, first = np.unique(groups[by_residual], return_index=True)
    inliers = np.zeros(len(r2), dtype=bool)
    inliers[by_residual[first]] = True
    return inliers & (r2 <= 1.0)
