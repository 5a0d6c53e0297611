"""Robust linear least squares of samples whose errors are the same within groups."""

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

_ROUNDS = 10
"""Weights change by less than a percent after five."""


def solve_with_grouped_errors(A: Array, differences: Array, groups: NDArray[np.int64]) -> tuple[Array, Array]:
    """Solution (U,) and its standard deviations (U,): Huber's weights, and a sandwich covariance of groups.

    Args:
        A: (M, K, U) derivatives of M samples of K values.
        differences: (M, K).
        groups: (M,) of samples, numbered from 0.
    """
    weights = np.ones(len(A))
    ridge = 1e-9 * len(A) * np.eye(A.shape[2])
    for _ in range(_ROUNDS):
        normal = np.einsum("nik,n,nil->kl", A, weights, A) + ridge
        solution = np.linalg.solve(normal, np.einsum("nik,n,ni->k", A, weights, differences))
        residuals = differences - A @ solution
        lengths = np.hypot(*residuals.T)
        weights = 1 / np.maximum(1.0, lengths / max(2 * float(np.median(lengths)), 1e-6))
    scores = np.zeros((int(groups.max()) + 1, A.shape[2]))
    np.add.at(scores, groups, np.einsum("nik,n,ni->nk", A, weights, residuals))
    inverse = np.linalg.inv(normal)
    return solution, np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse))
