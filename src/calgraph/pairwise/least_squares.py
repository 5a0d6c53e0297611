"""Batched small least squares on SE(3) in which unobservable directions keep their start values."""

import itertools
from collections.abc import Callable

import numpy as np

from calgraph.geometry import Array, se3


def gauss_newton(
    T: Array, residuals: Callable[[Array], tuple[Array, Array]], min_rms_slope: float, iterations: int = 12
) -> tuple[Array, Array]:
    """Minimizes K independent sums of squares over poses.

    Args:
        T: (K, 4, 4) start values.
        residuals: poses (K, 4, 4) to residuals (K, m) and their Jacobians (K, m, 6) for se3.retract; NaN for
            infeasible poses, to which no step is taken.
        min_rms_slope: change of the residuals' RMS per unit of a direction (m or rad) below which it keeps its
            start value.
        iterations: maximum number of steps.

    Returns:
        The poses (K, 4, 4) and their mean squared residuals (K,), infinite for infeasible start values.
    """
    r, J = residuals(T)
    cost = _mean_square(r)
    r, J = np.nan_to_num(r), np.nan_to_num(J)
    damping = np.full(len(T), 1e-4)
    for _ in range(iterations):
        H = np.einsum("kmi,kmj->kij", J, J) / r.shape[1]
        g = np.einsum("kmi,km->ki", J, r) / r.shape[1]
        values, vectors = np.linalg.eigh(H)
        along = np.einsum("kji,kj->ki", vectors, g)
        step = np.where(values > min_rms_slope**2, along / (values + damping[:, None]), 0.0)
        trial = se3.retract(T, -np.einsum("kij,kj->ki", vectors, step))
        r_trial, J_trial = residuals(trial)
        trial_cost = _mean_square(r_trial)
        better = trial_cost < cost
        damping = np.where(better, damping * 0.1, np.minimum(damping * 20, 1e3))
        gained = np.where(better, cost, 0.0) - np.where(better, trial_cost, 0.0)
        T = np.where(better[:, None, None], trial, T)
        r, J = np.where(better[:, None], r_trial, r), np.where(better[:, None, None], J_trial, J)
        converged = better & (gained <= 1e-9 * cost)
        cost = np.where(better, trial_cost, cost)
        if np.all(converged | (damping >= 1e3)):
            break
    return T, cost


def _mean_square(r: Array) -> Array:
    return np.asarray(np.where(np.isnan(r).any(axis=1), np.inf, np.mean(r**2, axis=1)))


def axis_aligned_rotations() -> Array:
    """The 24 rotations (24, 3, 3) that map axes to axes: start values for sensors of unknown mounting."""
    rotations = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0:
                rotations.append(R)
    return np.array(rotations)
