"""Errors that successive captures have in common: how much they increase the variances of sums over captures.

Source: Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent
covariance matrix", Econometrica 1987.
"""

from collections.abc import Callable

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.rig.bundle.bundle_solver import Bundle, MinimizedBundle
from calgraph.rig.bundle.covariances import gradient_by_board

# Captures until correlations are taken to end, by Bartlett's weights: twice the cube root of the usual 30 to 60
# captures is 6 to 8, and more would leave few independent sums.
LAGS = 6
# Random orders of the captures, all of which have less correlation than that of time if it is significant: a
# false-alarm probability of 1 %, which costs 20 to 50 % of variance.
_PERMUTATIONS = 99


def measure_serial_correlation(bundle: Bundle, solution: MinimizedBundle, order: Index) -> float:
    """The factor by which serial correlation increases the variances of poses; 1 where it is not significant.

    What each board adds to the poses has a long-run variance, with lags weighted as by Bartlett, after removal of
    a linear trend. It is the mean over all directions in the space of poses, whitened by the covariance of the
    solution, so that it does not depend on the root and on units. Its ratio to that of random orders of the boards
    is the factor if it is larger than in all of them.

    Args:
        bundle: the observations.
        solution: its solution.
        order: (C,) of the boards in time.
    """
    if len(order) < 2 * LAGS or not bundle.body_count:
        return 1.0
    poses = 6 * bundle.body_count
    H, _, _ = solution.equations.eliminate_boards()
    covariance = np.linalg.inv(H)[:, :poses]
    steps = gradient_by_board(bundle, solution.equations) @ covariance
    steps = np.linalg.solve(np.linalg.cholesky(covariance[:poses]), steps.T).T
    variance, random_orders = _compare_orders(steps[np.argsort(order, kind="stable")], _mean_long_run_variance)
    return variance / float(np.median(random_orders)) if variance > max(random_orders) else 1.0


def measure_score_correlation(scores: Array) -> float:
    """The factor by which serial correlation of views increases the variance of sums of their scores, at least 1.

    The long-run covariance of the scores has one largest eigenvalue for the views in order of time, and others for
    random orders, whose median is what independent views have.

    Args:
        scores: (V, m) of views in order of time.
    """
    variance, random_orders = _compare_orders(scores, _largest_long_run_variance)
    return max(1.0, variance / float(np.median(random_orders)))


def _compare_orders(series: Array, variance: Callable[[Array], float]) -> tuple[float, list[float]]:
    """A long-run variance of a series (C, m) in order of time, and those in random orders."""
    rng = np.random.default_rng(0)
    return variance(series), [variance(rng.permutation(series)) for _ in range(_PERMUTATIONS)]


def _largest_long_run_variance(series: Array) -> float:
    """The largest eigenvalue of the long-run covariance of a series (V, m)."""
    covariance = series.T @ series
    for k in range(1, min(LAGS, len(series))):
        product = series[k:].T @ series[:-k]
        covariance += (1 - k / LAGS) * (product + product.T)
    return float(np.linalg.eigvalsh(covariance)[-1])


def _mean_long_run_variance(steps: Array) -> float:
    """Of a series (C, n) without its linear trend, over its variance; both are sums over columns."""
    trend = np.stack([np.ones(len(steps)), np.linspace(-1, 1, len(steps))], axis=1)
    left = steps - trend @ np.linalg.lstsq(trend, steps, rcond=None)[0]
    products = [np.sum(left[k:] * left[: len(left) - k]) for k in range(LAGS)]
    return float(1 + sum(2 * (1 - k / LAGS) * products[k] for k in range(1, LAGS)) / products[0])
