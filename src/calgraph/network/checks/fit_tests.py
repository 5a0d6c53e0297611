"""Tests of the fit of a network's joint solution: estimates at limits, unused beams, correlated residuals."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array
from calgraph.network.joint.beam_residuals import list_beam_residuals
from calgraph.network.joint.estimate import SolvedNetwork
from calgraph.network.joint.model_error import MAX_HEADING_SIGMA, MAX_POSITION_SIGMA
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.network.joint.range_noise import MAX_EXCESS
from calgraph.result.finding import Finding


def find_poor_fit(solved: SolvedNetwork, names: Sequence[str], background: Array) -> Iterator[Finding]:
    """The findings of all tests of the fit.

    Args:
        solved: the joint solution.
        names: of its scanners, the root first.
        background: (S,) noise of each scanner's static background, m.
    """
    yield from _find_noise_at_limit(solved, names, background)
    yield from _find_model_error_at_limit(solved, names)
    yield from _find_unused_beams(solved, names)
    yield from _find_correlated_beams(solved, names)


# A range noise or model error of more than this share of its limit counts as at the limit: an estimate that is
# cut off there. Valid models reach 0.3 of them, also with swinging arms.
_LIMIT_SHARE = 0.95


def _find_noise_at_limit(solved: SolvedNetwork, names: Sequence[str], background: Array) -> Iterator[Finding]:
    network = solved.problem
    limit = np.hypot(background, MAX_EXCESS)
    if len(scanners := np.flatnonzero(network.range_sigma > _LIMIT_SHARE * limit)):
        ratio = float(np.max(network.range_sigma[scanners] / background[scanners]))
        yield Finding(
            f"the range noise of {_list_names(scanners, names)} at people is at its limit, {ratio:.0f} times that "
            "at walls: they are of another shape than target in rig.yaml states, or clocks differ",
            _make_weak(scanners, names),
            refutes=True,
        )


def _find_model_error_at_limit(solved: SolvedNetwork, names: Sequence[str]) -> Iterator[Finding]:
    position, heading = np.sqrt(solved.problem.model_error_variance).tolist()
    pass
    sizes = []
    if far := position > _LIMIT_SHARE * MAX_POSITION_SIGMA:
        sizes.append(f"{1000 * position:.0f} mm")
    if heading > _LIMIT_SHARE * MAX_HEADING_SIGMA:
        sizes.append(f"{np.degrees(heading):.0f}°")
    if sizes:
        yield Finding(
            f"scanners disagree about people by {' and '.join(sizes)} in each scan, the limit of the model error: "
            "people are of another shape than target in rig.yaml states, or clocks, ranges or angles are wrong",
            tuple(names),
            refutes=far,
        )


# Minimum share of a scanner's beams on bodies that have a weight: robust estimates hold up to about half of
# outliers. 0.89 to 0.95 in simulation, 0.63 and more where arms swing by 0.15 m; 0.4 to 0.56 where ellipses are
# fitted to two people's legs.
_MIN_WEIGHTED_SHARE = 0.6


def _find_unused_beams(solved: SolvedNetwork, names: Sequence[str]) -> Iterator[Finding]:
    used, total = np.zeros((2, len(names)))
    for body in solved.problem.bodies:
        for scans in body.scans:
            used[scans.scanner] += np.count_nonzero(scans.weight)
            total[scans.scanner] += len(scans.weight)
    share = np.where(total > 0, used / np.maximum(total, 1), 1.0)
    if len(scanners := np.flatnonzero(share < _MIN_WEIGHTED_SHARE)):
        yield Finding(
            f"only {share[scanners].min():.0%} of the beams of {_list_names(scanners, names)} at people agree "
            "with the joint solution: record people without loads, of the shape that target in rig.yaml states",
            _make_weak(scanners, names),
        )


# Maximum correlation of the residuals of a scanner's adjacent beams on a body: a body of another shape has
# residuals of one sign along its outline. In simulation it is below 0.02, below 0.1 where arms swing, and 0.5 to
# 0.9 where ellipses are fitted to legs or a clock is wrong. On a real recording of legs it is 0.7, although poses
# are right to a centimetre, so that it does not refute the model.
_MAX_BEAM_CORRELATION = 0.2


def _find_correlated_beams(solved: SolvedNetwork, names: Sequence[str]) -> Iterator[Finding]:
    correlation = correlate_adjacent_beams(solved)
    if len(scanners := np.flatnonzero(correlation > _MAX_BEAM_CORRELATION)):
        largest = float(correlation[scanners].max())
        yield Finding(
            f"residuals of adjacent beams of {_list_names(scanners, names)} at people have a correlation of "
            f"{largest:.2f}: people are of another shape than target in rig.yaml states, or clocks, ranges or "
            "angles are wrong",
            _make_weak(scanners, names),
        )


def correlate_adjacent_beams(solved: SolvedNetwork) -> Array:
    """(S,) correlation of the weighted residuals of each scanner's adjacent beams on a body; 0 without beams."""
    products, squares = np.zeros((2, solved.problem.count))
    for of_body in solved.equations.batches.map(_multiply_adjacent, solved.problem, solved.state):
        for scanner, product, square in of_body:
            products[scanner] += product
            squares[scanner] += square
    return np.asarray(products / np.maximum(squares, np.finfo(float).tiny))


def _multiply_adjacent(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> list[tuple[int, float, float]]:
    """Each scanner of a body, with the weighted sums of products and of mean squares of adjacent residuals."""
    sums = []
    for beams in list_beam_residuals(network, state, body, path):
        weights = beams.scans.weight
        weight = np.sqrt(weights[:-1] * weights[1:]) * (beams.scan[:-1] == beams.scan[1:])
        first, second = beams.residual[:-1], beams.residual[1:]
        product, square = weight @ (first * second), weight @ (first**2 + second**2) / 2
        sums.append((beams.scans.scanner, float(product), float(square)))
    return sums


def _make_weak(scanners: NDArray[np.integer[Any]], names: Sequence[str]) -> tuple[str, ...]:
    """Names of those whose poses are weak if these scanners are wrong: all, where the root is among them."""
    return tuple(names) if 0 in scanners else tuple(names[s] for s in scanners)


def _list_names(scanners: NDArray[np.integer[Any]], names: Sequence[str]) -> str:
    return ", ".join(names[s] for s in scanners)
