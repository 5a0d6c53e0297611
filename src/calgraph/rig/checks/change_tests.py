"""Tests of changes in the course of the captures: of their halves against each other, and of drifts.

Errors that change in the course of a recording, or that no parameter describes, give halves poses that differ by
more than their covariances. Errors that both halves share do not show.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from calgraph.config.settings import DiagnosticsSettings
from calgraph.geometry import Array
from calgraph.result.finding import Finding
from calgraph.rig.bundle.board_information import gradient_by_board, information_by_board
from calgraph.rig.bundle.bundle_solver import pose_jacobian
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.drift_tests import find_drifts, measure_drifts

# Poses of halves whose differences have a smaller share of the largest eigenvalue of their covariance are equal.
_RANK_TOLERANCE = 1e-12


def find_changes(solved: SolvedBundle, settings: DiagnosticsSettings) -> Iterator[Finding]:
    """Sensors whose poses drift, or differ between halves of the captures, by more than their covariances allow.

    Halves are the first and the second half in time, and captures of even and odd number. Their solutions are
    one Gauss-Newton step from that of all captures, with its noise, view bias and robust weights. Both have the
    prior of information P; with covariances A and B of the halves, their difference has ``A + B - A P B - B P A``.

    Args:
        solved: the solution of all captures.
        settings: of drifts, and the false-alarm probability of one sensor and one pair of halves.
    """
    bundle, minimized = solved.bundle, solved.minimized
    confidence = 1 - settings.verdict.false_alarm_probability
    H, g, _ = minimized.equations.eliminate_boards()
    by_board = information_by_board(bundle, minimized.equations), gradient_by_board(bundle, minimized.equations)
    prior = H - by_board[0].sum(axis=0), g - by_board[1].sum(axis=0)
    order = np.unique(solved.captures, return_inverse=True)[1]
    count = int(order.max(initial=-1)) + 1
    axes = pose_jacobian(bundle, minimized.state).reshape(len(bundle.sensors), 6, -1)
    named: set[str] = set()
    drifts = measure_drifts(solved)
    for drift in find_drifts(drifts):
        named.update(drift.sensors)
        yield drift
    halves: Mapping[str, NDArray[np.bool_]] = {
        "the first and the second half of the captures": order < count / 2,
        "captures of even and odd number": order % 2 == 0,
    }
    for description, first in halves.items():
        difference, covariance = _compare_halves(prior, by_board, first)
        for name, J in zip(bundle.sensors, axes, strict=True):
            if name in named or not J.any():
                continue
            off, C = J @ difference, drifts.serial_correlation * J @ covariance @ J.T
            squared, freedom = _squared_distance(off, C)
            # The variances of view biases have about as many degrees of freedom as there are captures.
            if squared > freedom * fdtri(freedom, count, confidence):
                named.add(name)
                mm, degrees = 1000 * np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))
                yield Finding(
                    f"{description} give poses of {name} that differ by {mm:.1f} mm and {degrees:.2f}°, "
                    f"{np.sqrt(squared / freedom):.1f} times what noise explains: something changed while "
                    "recording; fix sensors, lenses and board, hold the board still, and record again",
                    (name,),
                )


def _compare_halves(
    prior: tuple[Array, Array], by_board: tuple[Array, Array], first: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Difference (G,) of the solutions of two halves of the boards (C,), and its covariance (G, G).

    Args:
        prior: information (G, G) and gradient (G,) of priors, which both have.
        by_board: information (C, G, G) and gradient (C, G) of each board.
        first: (C,) whether a board is in the first half.
    """
    covariances, steps = [], []
    for half in (first, ~first):
        covariance = np.linalg.inv(prior[0] + by_board[0][half].sum(axis=0))
        covariances.append(covariance)
        steps.append(-covariance @ (prior[1] + by_board[1][half].sum(axis=0)))
    A, B = covariances
    shared = A @ prior[0] @ B
    return steps[1] - steps[0], A + B - shared - shared.T


def _squared_distance(error: Array, covariance: Array) -> tuple[float, int]:
    """Squared Mahalanobis distance and its degrees of freedom."""
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    regular = values > _RANK_TOLERANCE * values[-1]
    along = vectors.T @ (error / scale)
    return float(np.sum(along[regular] ** 2 / values[regular])), int(regular.sum())
