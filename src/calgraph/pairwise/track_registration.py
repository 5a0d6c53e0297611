"""The pose between two scanners that fits everything they saw moving at the same time, near a first guess.

Two scanners see different sides of a person, with clocks that differ by some milliseconds. Both shift all of a
scanner's positions in the same way, towards the scanner and along the walk, so that they do not average out.
They are unknowns of the fit with a prior, and what the data leave open of them is part of the pose's covariance.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, se2
from calgraph.pairwise.synchronized_tracks import Meetings

GATE = 9.21
"""Squared Mahalanobis distance up to which two positions agree: χ² with two degrees of freedom, 99 %."""
# Standard deviation of what no covariance of a track knows (m), at first and at least.
_MISFIT = 0.15
_LEAST_MISFIT = 0.005
DEPTH = 0.03
"""Prior standard deviation of the distance from the centre that tracks show to the object's true one, m."""
# Prior standard deviation of the clocks' difference, s.
_CLOCK = 0.01
# What does not average out however long people walk: the sides and the gait that they show to either scanner, m.
_SYSTEMATIC = 0.008
# Squared Mahalanobis distance at which the Cauchy loss halves a pair's weight.
_CAUCHY = 6.0
# Fewer pairs than these fit many a pose.
_FEW = 4
# Gauss-Newton steps with associations made anew.
_STEPS = 6
# Residuals farther apart than so many steps are independent; nearer than so many ticks they are not, as people
# show another side every half second. A few seconds of residuals alone would understate that.
_LONGEST = 100
_SHORTEST = 5.0


@dataclass(frozen=True, eq=False)
class Agreement:
    """A pose with all that agrees with it."""

    T_a_b: Array
    """(3, 3)."""
    nuisance: Array
    """(3,) s that b's clock is ahead, and m that centres lie beyond those that a's and that b's tracks show."""
    pairs: NDArray[np.intp]
    """(P,) which of the meetings agree: each the other's nearest at its tick."""
    misfit: float
    """Standard deviation of the pairs' distances beyond what the tracks' covariances explain, m."""


def agree(
    T_a_b: Array, met: Meetings, *, depth: float = DEPTH, steps: int = _STEPS, misfit: float = _MISFIT
) -> Agreement | None:
    """Fits the pose to all simultaneous observations that agree with it, associated anew at every step.

    Args:
        T_a_b: (3, 3) first guess.
        met: all simultaneous observations.
        depth: distance (m) from the centres that tracks show to the objects' true ones, along the beam, standard
            deviation.
        steps: how often they are associated anew.
        misfit: distance (m) between what two scanners take for one object's centre, standard deviation.

    Returns:
        The agreement, or None if fewer than four observations agree with the first guess.
    """
    nuisance = np.zeros(3)
    for _ in range(steps):
        pairs, d2 = _associated(T_a_b, nuisance, met, misfit)
        if len(pairs) < _FEW:
            return None
        r, J, S = _linearized(T_a_b, nuisance, met, pairs)
        W = _inverse(S + misfit**2 * np.eye(2)) / (1 + d2 / _CAUCHY)[:, None, None]
        H, g = _normal_equations(r, J, W, nuisance, depth)
        step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        T_a_b = se2.retract(T_a_b, step[:3])
        nuisance = nuisance + step[3:]
        misfit = _misfit(r + J @ step, S)
    pairs, _ = _associated(T_a_b, nuisance, met, misfit)
    return Agreement(T_a_b, nuisance, pairs, misfit) if len(pairs) >= _FEW else None


def costs(T_a_b: Array, met: Meetings, misfit: float = _MISFIT) -> Array:
    """Truncated squared distances to the nearest, in units of the gate, mean over all that a saw: (K,) of poses.

    Covariances count by their mean over all directions, for speed.
    """
    x_a, y_a = met.x_a.T
    x_b, y_b = met.x_b.T
    scale = 1 / (GATE * (met.variance + misfit**2))
    out = np.empty(len(T_a_b))
    for k, T in enumerate(T_a_b):  # what one pose needs fits into the processor's cache
        x = T[0, 0] * x_b + T[0, 1] * y_b + (T[0, 2] - x_a)
        y = T[1, 0] * x_b + T[1, 1] * y_b + (T[1, 2] - y_a)
        d2 = (x * x + y * y) * scale
        out[k] = np.minimum(np.minimum.reduceat(d2, met.starts_a), 1).mean()
    return out


def _associated(T_a_b: Array, nuisance: Array, met: Meetings, misfit: float) -> tuple[NDArray[np.intp], Array]:
    """The meetings (P,) of mutual nearest neighbours within the gate, and their squared Mahalanobis distances."""
    apart = _differences(T_a_b, nuisance, met)
    rough = np.sum(apart**2, axis=1) / (met.variance + misfit**2)
    # The exact covariance matters for the gate alone; who is nearest is clear without it.
    near = np.flatnonzero(rough < 4 * GATE)
    if not len(near):
        return near, np.zeros(0)
    near = near[met.mutual(near, rough[near])]
    r, _, S = _linearized(T_a_b, nuisance, met, near)
    d2 = _squared(r, _inverse(S + misfit**2 * np.eye(2)))
    return near[d2 < GATE], d2[d2 < GATE]


def _linearized(T: Array, nuisance: Array, met: Meetings, pairs: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Differences (P, 2) of positions in a's frame, Jacobians (P, 2, 6) by pose, clock, depths, covariances."""
    R = T[:2, :2]
    turned = met.x_b[pairs] @ R.T
    J = np.zeros((len(pairs), 2, 6))
    J[:, 0, 0] = J[:, 1, 1] = 1
    J[:, 0, 2], J[:, 1, 2] = -turned[:, 1], turned[:, 0]
    J[:, :, 3], J[:, :, 4], J[:, :, 5] = met.v_b[pairs] @ R.T, -met.sight_a[pairs], met.sight_b[pairs] @ R.T
    S = met.a.covariances[met.row_a[pairs]] + R @ met.b.covariances[met.row_b[pairs]] @ R.T
    return _differences(T, nuisance, met, pairs), J, S


def _differences(T: Array, nuisance: Array, met: Meetings, pairs: NDArray[np.intp] | slice = slice(None)) -> Array:
    """(P, 2) from what a saw to what b saw, in a's frame, clocks and depths put right."""
    late, behind_a, behind_b = nuisance
    seen_by_a = met.x_a[pairs] + behind_a * met.sight_a[pairs]
    seen_by_b = met.x_b[pairs] + late * met.v_b[pairs] + behind_b * met.sight_b[pairs]
    return np.asarray(se2.apply(T, seen_by_b) - seen_by_a)


def _normal_equations(r: Array, J: Array, W: Array, nuisance: Array, depth: float) -> tuple[Array, Array]:
    prior = np.array([0, 0, 0, _CLOCK**-2, depth**-2, depth**-2])
    J, WJ = J.reshape(-1, 6), (W @ J).reshape(-1, 6)
    H = J.T @ WJ + np.diag(prior)
    g = WJ.T @ r.ravel() + prior * np.concatenate([np.zeros(3), nuisance])
    # A hair of damping: observations of somebody who stands still say nothing of the angle.
    return H + 1e-6 * np.eye(6), g


def _misfit(r: Array, S: Array) -> float:
    """The standard deviation (m) that the residuals have beyond their covariances, by their median."""
    scatter = float(np.median(np.sum(r**2, axis=1))) / 1.386  # the median of χ² with two degrees of freedom
    explained = float(np.mean(np.trace(S, axis1=1, axis2=2))) / 2
    return float(np.clip(np.sqrt(max(scatter - explained, 0.0)), _LEAST_MISFIT, _MISFIT))


def information(fit: Agreement, met: Meetings, depth: float = DEPTH) -> Array:
    """(3, 3) inverse covariance of the pose's error in the fixed axes of a, with clock and depths unknown.

    Smoothed positions err for seconds in the same direction: their number counts divided by the time over
    which residuals stay correlated, in ticks.
    """
    pairs = fit.pairs
    r, J, S = _linearized(fit.T_a_b, fit.nuisance, met, pairs)
    W = _inverse(S + fit.misfit**2 * np.eye(2))
    d2 = _squared(r, W)
    whitened = np.einsum("pij,pj->pi", np.swapaxes(np.linalg.cholesky(W), 1, 2), r)
    walks = met.a.walk[met.row_a[pairs]] * (met.b.walk.max() + 1) + met.b.walk[met.row_b[pairs]]
    ticks = met.a.tick[met.row_a[pairs]]
    together = max(correlation_time(whitened, walks, ticks), _SHORTEST)
    independent = max(2 * len(pairs) / together - 6, 1.0)
    scatter = max(float(np.sum(d2)) / together / independent, 0.1)
    H, _ = _normal_equations(r, J, W / (scatter * together), fit.nuisance, depth)
    random = np.linalg.inv(H)[:3, :3]
    return np.asarray(np.linalg.inv(random + _systematic(fit.T_a_b, met.x_a[pairs])), dtype=np.float64)


def _systematic(T_a_b: Array, x_a: Array) -> Array:
    """(3, 3) covariance of the pose for what all positions (P, 2) err alike, and differently at their two ends."""
    center = x_a.mean(axis=0)
    extent = np.sqrt(np.mean(np.sum((x_a - center) ** 2, axis=1)))
    return rigid_spread(T_a_b, center, _SYSTEMATIC, _SYSTEMATIC / max(float(extent), 0.1))


def rigid_spread(T_a_b: Array, center: Array, shift: float, turn: float) -> Array:
    """(3, 3) covariance of a pose shifted (m) along either axis and turned (rad) about a center (2,) of a."""
    lever = center - T_a_b[:2, 2]
    G = np.eye(3)
    G[:2, 2] = lever[1], -lever[0]
    return np.asarray(G @ np.diag(np.array([shift, shift, turn]) ** 2) @ G.T)


def correlation_time(r: Array, series: NDArray[np.intp], ticks: NDArray[np.intp]) -> float:
    """How many successive residuals count as one independent: the integrated autocorrelation, >= 1.

    Args:
        r: (P, k) residuals of mean 0.
        series: (P,) which of them belong together.
        ticks: (P,) their times, in steps.

    Source: Geyer, "Practical Markov chain Monte Carlo", 1992: the sum ends where pairs of terms fall below 0.
    """
    order = np.lexsort((ticks, series))
    r, key = r[order], series[order] * (int(ticks.max()) + 2 * _LONGEST) + ticks[order] - int(ticks.min())
    power = float(np.sum(r**2)) / max(len(r), 1)
    total, previous = 1.0, 0.0
    step = int(np.min(np.diff(np.unique(ticks)), initial=_LONGEST))
    for lag in range(1, _LONGEST):
        found = np.searchsorted(key, key + lag * step)
        pairs = np.flatnonzero(key[np.minimum(found, len(key) - 1)] == key + lag * step)
        if len(pairs) < 0.1 * len(r):
            break
        term = float(np.sum(r[pairs] * r[found[pairs]])) / len(pairs) / max(power, 1e-12)
        if lag % 2 == 0 and term + previous <= 0:
            break
        total += 2 * term
        previous = term
    return max(total, 1.0)


def _squared(r: Array, W: Array) -> Array:
    x, y = r.T
    return np.asarray(W[:, 0, 0] * x * x + 2 * W[:, 0, 1] * x * y + W[:, 1, 1] * y * y)


def _inverse(S: Array) -> Array:
    """Inverses of symmetric (P, 2, 2), five times as fast as by a general decomposition."""
    W = np.empty_like(S)
    W[:, 0, 0], W[:, 1, 1] = S[:, 1, 1], S[:, 0, 0]
    W[:, 0, 1] = W[:, 1, 0] = -S[:, 0, 1]
    return np.asarray(W / (S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2)[:, None, None])
