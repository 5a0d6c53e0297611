"""Tests of a network's joint solution by parts of its data: halves, groups of people, intervals, pairs alone.

A model error that is the same in all parts shows in none of these tests but the last; it shows in the fit.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.special import chdtrc

from calgraph.geometry import Array, se2
from calgraph.network.joint.contributions import Contributions, NetworkContributions
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.result.finding import Finding
from calgraph.solver.squared_distances import compute_squared_distances

# Information (1/m², 1/rad², 1/s²) that keeps stated differences from growing where the data hardly determine them:
# standard deviations of 1 m, 1 rad and 1 s.
_DIFFERENCE_RIDGE = 1.0


# Probability with which each of the tests of halves, groups of bodies, scatter and averaging rejects a right
# recording. On 96 simulated ones, halves have p < 0.01 in none, and groups in two.
FALSE_ALARM_PROBABILITY = 1e-3


def find_inconsistent_parts(
    parts: Contributions, names: Sequence[str], variance_factor: float, groups: int = 1
) -> Iterator[Finding]:
    """Halves of the recording, or groups of people, that give other poses.

    Args:
        parts: of the joint solution.
        names: of its scanners, the root first.
        variance_factor: observed over expected variance of the parts, at least 1.
        groups: number of groups of scanners that are tested.
    """
    halves: Mapping[str, NDArray[np.bool_]] = {
        "the first and the second half of the recording": _split_by_time(parts),
        "two groups of people, each over the whole recording,": _split_by_body(parts),
    }
    for description, first in halves.items():
        yield from _test_halves(
            parts, first, description, names, variance_factor, FALSE_ALARM_PROBABILITY / groups
        )


def _split_by_time(parts: Contributions) -> NDArray[np.bool_]:
    """(C,) the parts of the first half of the information."""
    order = np.argsort(parts.time, kind="stable")
    share = np.cumsum(parts.amount[order])
    first = np.empty(len(order), dtype=np.bool_)
    first[order] = share <= share[-1] / 2
    return first


def _split_by_body(parts: Contributions) -> NDArray[np.bool_]:
    """(C,) the parts of one of two groups of bodies with about the same information."""
    information = np.bincount(parts.body, parts.amount)
    total, in_first = np.zeros(2), np.zeros(len(information), dtype=np.bool_)
    for body in np.argsort(-information, kind="stable"):
        group = int(total[1] < total[0])
        total[group] += information[body]
        in_first[body] = group == 0
    return np.asarray(in_first[parts.body])


# Minimum variance, relative to that of the components it is along, of a direction in which parts, or averaged and
# joint poses, are compared: below it the difference is that of the linearization. One of two halves without data
# of a scanner leaves such directions, in which squared distances would be any number.
_MIN_RELATIVE_VARIANCE = 1e-3


def _test_halves(
    parts: Contributions,
    first: NDArray[np.bool_],
    description: str,
    names: Sequence[str],
    variance_factor: float,
    false_alarm_probability: float,
) -> Iterator[Finding]:
    """Score tests of a difference of poses and clocks between two halves: of each scanner alone, and of all.

    Everything else is the same in both halves, so that small differences show. Source: Rao, "Large sample tests of
    statistical hypotheses concerning several parameters", 1948.
    """
    if first.all() or not first.any():
        return
    score, information, scale = parts.test_difference(first)
    normalized = score / np.sqrt(variance_factor)

    def test(unknowns: NDArray[np.intp]) -> float:
        covariance = information[np.ix_(unknowns, unknowns)]
        return compute_p_value(normalized[unknowns], covariance, _MIN_RELATIVE_VARIANCE, scale[unknowns])

    scanners = np.unique(parts.scanner[parts.scanner > 0]).tolist()
    columns = [np.flatnonzero(parts.is_placement & (parts.scanner == s)) for s in scanners]
    p_each = len(scanners) * np.array([test(unknowns) for unknowns in columns])
    if (p := min(test(np.concatenate(columns)), float(p_each.min()))) >= false_alarm_probability:
        return
    worst = int(np.argmin(p_each))
    of_worst = information[np.ix_(columns[worst], columns[worst])]
    difference = np.linalg.solve(of_worst + _DIFFERENCE_RIDGE * np.eye(len(of_worst)), -score[columns[worst]])
    mm, degrees = 1000 * np.hypot(difference[0], difference[1]), np.degrees(abs(difference[2]))
    wrong = tuple(names[scanners[k]] for k in np.flatnonzero(p_each < false_alarm_probability))
    yield Finding(
        f"{description} give poses of {names[scanners[worst]]} that differ by {mm:.1f} mm and {degrees:.2f}°, "
        f"more than noise explains (p = {p:.0e}): it moved, its clock drifts, or people are not as modelled; "
        "fix the scanners, set their clocks, and record again",
        wrong or tuple(names),
    )


@dataclass(frozen=True)
class Scatter:
    """How far the contributions of parts scatter."""

    ratio: float
    """Observed over expected variance."""
    p: float
    """Probability of a larger ratio."""


def measure_scatter(parts: NetworkContributions) -> Scatter:
    """Compares the scatter of the gradients of parts with their information (White, 1982).

    The sum of ``b C b`` over the parts, with the covariance C of the solution, has the mean ``Σ tr(C A)`` and the
    variance ``2 Σ tr(C A C A)``, and about the distribution of a multiple of χ² (Satterthwaite, 1946).
    """
    mean = square = observed = 0.0
    for c, (columns, b) in enumerate(zip(parts.columns, parts.gradient, strict=True)):
        C, A = parts.inverse.select(columns), parts.expand_information(c)
        CA = C @ A
        mean += float(np.trace(CA))
        square += float(np.sum(CA * CA.T))
        observed += float(b @ C @ b)
    freedom, ratio = mean**2 / square, observed / mean
    return Scatter(ratio, float(chdtrc(freedom, freedom * ratio)))


def find_disagreement(
    joint: NetworkSolution, T_root_averaged: Array, averaged_covariance: Array, names: Sequence[str]
) -> Iterator[Finding]:
    """Whether the joint solution is farther from the averaged pairs than their covariance allows.

    The joint solution is the more precise one by far, so that the covariance of the difference is at most that of
    averaging (Hausman, "Specification tests in econometrics", 1978).

    Args:
        joint: the joint solution.
        T_root_averaged: (S, 3, 3) averaged poses.
        averaged_covariance: (3S, 3S) of these, zero for the root.
        names: of the scanners, the root first.
    """
    difference = se2.difference(joint.T_root_scanner, T_root_averaged)
    p = compute_p_value(difference[1:].ravel(), averaged_covariance[3:, 3:], _MIN_RELATIVE_VARIANCE)
    if p < FALSE_ALARM_PROBABILITY:
        distance = np.hypot(difference[:, 0], difference[:, 1])
        farthest = int(np.argmax(distance))
        yield Finding(
            f"the joint solution is up to {1000 * distance[farthest]:.0f} mm ({names[farthest]}) from averaged "
            f"pairs, more than their covariance allows (p = {p:.0e}): one of the two is wrong; check the axes of "
            "target in rig.yaml, that clocks agree, and ranges against a tape",
            tuple(names),
        )


# Relative error of the factor: 0.05 % of a standard deviation.
_EXCESS_TOLERANCE = 1e-3


def measure_excess(difference: Array, covariance: Array, other: Array) -> float:
    """Factor, at least 1, of a covariance with which chi-square of the difference to an independent estimate is n.

    One factor for all components. Estimates of one recording have errors in common: for them it is rather too
    small. Source: Paule and Mandel, "Consensus values and weighting factors", 1982.

    Args:
        difference: (n,) of the two estimates.
        covariance: (n, n) that is multiplied.
        other: (n, n) of the other estimate.
    """
    # Axes along which both covariances are diagonal, the first being 1; rounding may leave the other below zero.
    variances, axes = eigh(other, covariance)
    variances, squares = np.maximum(variances, 0.0), (axes.T @ difference) ** 2

    def exceed(factor: float) -> float:
        return float(np.sum(squares / (factor + variances))) - len(difference)

    if exceed(1.0) <= 0:
        return 1.0
    # With an exact other estimate; a little more, so that rounding leaves a root below.
    most = 1.01 * float(squares.sum()) / len(difference)
    return float(brentq(exceed, 1.0, most, rtol=_EXCESS_TOLERANCE))


def compute_p_value(
    error: Array, covariance: Array, min_relative_variance: float, scale: Array | None = None
) -> float:
    """Probability of a larger squared Mahalanobis distance, along directions whose variance is not zero.

    Args:
        error: (n,).
        covariance: (n, n).
        min_relative_variance: below which a variance is zero, in squares of the scale.
        scale: (n,) standard deviations; those of the covariance if left out.
    """
    if scale is not None:
        # Unknowns without any information have a scale of zero.
        informed = np.flatnonzero(scale > 0)
        if not len(informed):
            return 1.0
        error, covariance, scale = error[informed], covariance[np.ix_(informed, informed)], scale[informed]
    return float(chdtrc(*compute_squared_distances(error, covariance, min_relative_variance, scale)[::-1]))
