"""Tests of the fit of a network's joint solution: estimates at limits, unused beams, correlated residuals."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import NetworkModelSettings
from calgraph.geometry import Array
from calgraph.network.joint.beam_residuals import list_beam_residuals
from calgraph.network.joint.estimate import SolvedNetwork
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState
from calgraph.result.finding import Finding


def find_poor_fit(
    solved: SolvedNetwork, names: Sequence[str], background: Array, settings: NetworkModelSettings
) -> Iterator[Finding]:
    """The findings of all tests of the fit.

    Args:
        solved: the joint solution.
        names: of its scanners, the root first.
        background: (S,) noise of each scanner's static background, m.
        settings: limits of the tests.
    """
    yield from _find_noise_at_limit(solved, names, background, settings)
    yield from _find_model_error_at_limit(solved, names, settings)
    yield from _find_unused_beams(solved, names, settings)
    yield from _find_correlated_beams(solved, names, settings)


def _find_noise_at_limit(
    solved: SolvedNetwork, names: Sequence[str], background: Array, settings: NetworkModelSettings
) -> Iterator[Finding]:
    network = solved.problem
    limit = np.hypot(background, network.settings.range_noise.max_excess)
    if len(scanners := np.flatnonzero(network.range_sigma > settings.limit_share * limit)):
        ratio = float(np.max(network.range_sigma[scanners] / background[scanners]))
        yield Finding(
            f"the range noise of {_list_names(scanners, names)} at people is at its limit, {ratio:.0f} times that "
            "at walls: they are of another shape than target in rig.yaml states, or clocks differ",
            _make_weak(scanners, names),
            refutes=True,
        )


def _find_model_error_at_limit(
    solved: SolvedNetwork, names: Sequence[str], settings: NetworkModelSettings
) -> Iterator[Finding]:
    position, heading = np.sqrt(solved.problem.model_error_variance).tolist()
    limits = solved.problem.settings.model_error
    sizes = []
    if far := position > settings.limit_share * limits.max_position_sigma:
        sizes.append(f"{1000 * position:.0f} mm")
    if heading > settings.limit_share * limits.max_heading_sigma:
        sizes.append(f"{np.degrees(heading):.0f}°")
    if sizes:
        yield Finding(
            f"scanners disagree about people by {' and '.join(sizes)} in each scan, the limit of the model error: "
            "people are of another shape than target in rig.yaml states, or clocks, ranges or angles are wrong",
            tuple(names),
            refutes=far,
        )


def _find_unused_beams(
    solved: SolvedNetwork, names: Sequence[str], settings: NetworkModelSettings
) -> Iterator[Finding]:
    used, total = np.zeros((2, len(names)))
    for body in solved.problem.bodies:
        for scans in body.scans:
            used[scans.scanner] += np.count_nonzero(scans.weight)
            total[scans.scanner] += len(scans.weight)
    share = np.where(total > 0, used / np.maximum(total, 1), 1.0)
    if len(scanners := np.flatnonzero(share < settings.min_weighted_share)):
        yield Finding(
            f"only {share[scanners].min():.0%} of the beams of {_list_names(scanners, names)} at people agree "
            "with the joint solution: record people without loads, of the shape that target in rig.yaml states",
            _make_weak(scanners, names),
        )


def _find_correlated_beams(
    solved: SolvedNetwork, names: Sequence[str], settings: NetworkModelSettings
) -> Iterator[Finding]:
    correlation = correlate_adjacent_beams(solved)
    if len(scanners := np.flatnonzero(correlation > settings.max_beam_correlation)):
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
