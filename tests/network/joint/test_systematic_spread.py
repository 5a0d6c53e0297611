"""The spread of systematic errors, estimated from differences between scanners."""

import numpy as np
import pytest

from calgraph.config.settings import NetworkEstimationSettings
from calgraph.geometry import Array
from calgraph.network.joint.body_batches import BodyBatches, KeptValues
from calgraph.network.joint.problem import NetworkProblem, NetworkState
from calgraph.network.joint.scanner_matrix import ScannerMatrix, ScannerOrder
from calgraph.network.joint.scanner_unknowns import (
    FIRST_SYSTEMATIC,
    RANGE_BIAS,
    SCANNER_UNKNOWNS,
    SYSTEMATIC_ERRORS,
)
from calgraph.network.joint.solver import NetworkEquations
from calgraph.network.joint.systematic_spread import estimate_systematic_sigma

COUNT, SIGMA = 8, 0.001
"""Scanners, and the standard deviation with which the data determine the difference of two range biases, m."""
PRIOR = np.zeros((COUNT, len(SYSTEMATIC_ERRORS)))
PRIOR[:, RANGE_BIAS] = 0.02


def estimate(bias: Array, current: Array, gain: float = 0.3) -> Array:
    """(S, E) for biases (S,) of which the data determine the differences only, in a problem with these priors.

    Poses depend on biases by the given gain.
    """
    size = SCANNER_UNKNOWNS * COUNT
    H, g = np.zeros((size, size)), np.zeros(size)
    scanners = SCANNER_UNKNOWNS * np.arange(COUNT)
    biases = scanners + FIRST_SYSTEMATIC + RANGE_BIAS
    difference = np.eye(COUNT) - 1 / COUNT
    H[np.ix_(biases, biases)] = difference / SIGMA**2
    poses = np.concatenate([scanners[1:] + axis for axis in range(3)])
    H[poses, poses] = 1e6
    # A pose moves with its scanner's bias: eliminating it leaves the information of the bias as it is.
    x, bias_of_x = scanners[1:], biases[1:]
    H[x, bias_of_x] = H[bias_of_x, x] = gain * 1e6
    H[bias_of_x, bias_of_x] += gain**2 * 1e6
    estimate = 0.5 * (bias - bias.mean())
    g[biases] = difference @ (estimate - bias) / SIGMA**2 + estimate / current[:, 0] ** 2
    H[biases, biases] += current[:, 0] ** -2
    state = NetworkState(np.tile(np.eye(3), (COUNT, 1, 1)), np.zeros(COUNT), np.zeros(PRIOR.shape), ())
    state.systematic[:, 0] = estimate
    unknowns = np.sort(np.concatenate([poses, biases]))
    settings = NetworkEstimationSettings()
    ones = np.ones(COUNT)
    network = NetworkProblem(COUNT, (), (), ones, np.ones(2), current, 0.0, 1.0, settings)
    matrix = ScannerMatrix.zeros(ScannerOrder.complete(COUNT, SCANNER_UNKNOWNS))
    matrix.add(np.arange(COUNT), H)
    estimated = np.isin(np.arange(size), unknowns)
    equations = NetworkEquations(
        0.0, network, state, BodyBatches.place(()), KeptValues(()), matrix, g, estimated, np.zeros(size)
    )
    return estimate_systematic_sigma(equations, PRIOR)


@pytest.fixture(autouse=True)
def have_no_common_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """All errors are of single scanners."""
    monkeypatch.setattr("calgraph.network.joint.scanner_unknowns.COMMON_ERROR_SHARE", 0.0)


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_the_spread_is_that_of_the_errors(share: float) -> None:
    rng = np.random.default_rng(5)
    found = [estimate(rng.normal(0, share * 0.02, COUNT), PRIOR)[0, 0] for _ in range(50)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(share * 0.02, rel=0.25)


def test_equal_errors_are_small() -> None:
    """A common bias of 2 cm is not observable; that scanners agree to 1 mm makes it improbable."""
    found = estimate(0.02 + np.random.default_rng(0).normal(0, SIGMA, COUNT), PRIOR)
    assert found[0, 0] < 0.002


def test_the_spread_does_not_depend_on_the_present_one() -> None:
    bias = np.random.default_rng(1).normal(0, 0.01, COUNT)
    np.testing.assert_allclose(estimate(bias, 0.1 * PRIOR), estimate(bias, PRIOR), rtol=1e-6)


def test_the_spread_does_not_depend_on_the_poses() -> None:
    bias = np.random.default_rng(1).normal(0, 0.01, COUNT)
    np.testing.assert_allclose(estimate(bias, PRIOR, 0.0), estimate(bias, PRIOR), rtol=1e-6)


def test_exact_errors_stay_exact() -> None:
    np.testing.assert_array_equal(estimate(np.zeros(COUNT), PRIOR)[:, 1:], 0.0)
