"""The sample-and-score loop, with the scores of RANSAC and MSAC.

Sources: Fischler and Bolles, "Random sample consensus", CACM 1981 (sampling, count of inliers, stopping rule);
Torr and Zisserman, "MLESAC", CVIU 2000 (the truncated-residual score called MSAC there). There is no local
optimization (Chum, Matas, Kittler, DAGM 2003): callers refine the model on its inliers with their covariances.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

Indices = NDArray[np.intp]
Score = Literal["ransac", "msac"]

# Samples solved in one call: enough that the time of a call does not matter.
_BATCH = 100
# Up to this number of data for each of a sample, samples are drawn by shuffling: it is faster then.
_MAX_SHUFFLED = 20


@dataclass(frozen=True, eq=False)
class RansacResult:
    """The best model found and its inliers."""

    model: Array
    """One model, of whatever shape ``solve`` gives for one sample."""
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
    score: Score = "msac",
    confidence: float,
    max_samples: int,
    batch: int = _BATCH,
) -> RansacResult | None:
    """Finds the model with the lowest robust cost by random sampling.

    Data come in groups of mutually exclusive alternatives (candidate detections of one capture, say): a sample
    takes at most one of a group, and a group's residual is that of its best member. Data without alternatives
    are groups of one, ``groups = arange(N)``.

    Args:
        groups: (N,) group of each datum, any non-negative integers.
        sample_size: number of data in a minimal sample.
        solve: indices (K, sample_size) of K samples to K models (K, ...). A sample without solution gets NaN.
        squared_residuals: models (K, ...) to (K, N) squared residuals; NaN counts as infinite.
        threshold2: squared residual up to which a datum is an inlier, in the same units.
        rng: source of the samples.
        score: ``msac`` sums truncated squared residuals, ``ransac`` counts outliers.
        confidence: stop once an all-inlier sample has been drawn with this probability.
        max_samples: stop after this many samples.
        batch: samples solved and scored in one call, after which the confidence is tested.

    Returns:
        The best model, or None if there are fewer groups than ``sample_size`` or no sample has a solution.
    """
    groups = np.asarray(groups)
    order = np.argsort(groups, kind="stable")
    _, starts, sizes = np.unique(groups[order], return_index=True, return_counts=True)
    if len(starts) < sample_size:
        return None

    def score_models(models: Array) -> tuple[Array, NDArray[np.bool_]]:
        r2 = squared_residuals(models)[:, order] / threshold2
        best_in_group = np.minimum.reduceat(np.where(np.isnan(r2), np.inf, r2), starts, axis=1)
        truncated = np.minimum(best_in_group, 1.0) if score == "msac" else 1.0 * (best_in_group > 1.0)
        return truncated.sum(axis=1), best_in_group <= 1.0

    best: Array | None = None
    best_cost, sample_count, required = np.inf, 0, float(max_samples)
    while sample_count < min(required, max_samples):
        chosen = _draw_samples(len(starts), sample_size, min(batch, max_samples - sample_count), rng)
        members = starts[chosen] + (rng.random(chosen.shape) * sizes[chosen]).astype(np.intp)
        models = solve(order[members])
        sample_count += len(chosen)
        models = models[np.isfinite(models.reshape(len(models), -1)).all(axis=1)]
        if not len(models):
            continue
        costs, is_inlier = score_models(models)
        winner = int(np.argmin(costs))
        if costs[winner] < best_cost:
            best, best_cost = models[winner], float(costs[winner])
            inlier_probability = float(np.mean(is_inlier[winner] / sizes)) ** sample_size
            required = _required_samples(inlier_probability, confidence)
    if best is None:
        return None
    inliers = select_best_of_groups(squared_residuals(best[None])[0] / threshold2, groups)
    return RansacResult(best, inliers, best_cost, sample_count)


def _required_samples(inlier_probability: float, confidence: float) -> float:
    """Number of samples after which one without outliers has been drawn with the given probability.

    Args:
        inlier_probability: of a sample without outliers: the share of inliers to the power of the sample size.
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
