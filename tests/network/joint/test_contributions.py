"""Parts of the normal equations of a network by body and time."""

import numpy as np
import pytest

from calgraph.network.joint.body_equations import predict_beams
from calgraph.network.joint.contributions import Contributions, split_contributions
from calgraph.network.joint.scan_equations import TUKEY_LIMIT, TukeyLoss
from calgraph.network.joint.solver import NetworkEquations, linearize_network
from leg_scenes import build_network
from network_scenes import eliminate_densely
from solved_networks import SECONDS, solve_two_walks

pytestmark = pytest.mark.slow

SHRINKAGE = TukeyLoss(TUKEY_LIMIT).score_to_information ** 0.5


def split(solved: NetworkEquations, interval: float) -> Contributions:
    """The parts over all scanners."""
    return split_contributions(solved, interval).select(np.arange(3))


@pytest.fixture(scope="module")
def parts() -> Contributions:
    return split(solve_two_walks(np.random.default_rng(0)), 5.0)


def test_parts_and_priors_add_up_to_the_information_of_the_whole() -> None:
    solved = solve_two_walks(np.random.default_rng(0))
    parts = split(solved, 3.0)
    H = eliminate_densely(solved)
    np.testing.assert_allclose(
        parts.sum_information(np.ones(len(parts.body))) + SHRINKAGE * parts.prior, H, rtol=1e-9, atol=1e-3
    )


def test_gradients_of_all_parts_and_priors_add_up_to_zero_at_the_solution(parts: Contributions) -> None:
    total = parts.sum_gradient(np.ones(len(parts.body)))
    step = parts.covariance @ total / np.sqrt(np.diag(parts.covariance))
    np.testing.assert_allclose(step, 0, atol=0.1)


def test_gradients_scatter_as_their_information_lets_expect() -> None:
    # The mean over 10 recordings, with about 20 parts of 8 unknowns each, has a standard deviation of 4 %; what
    # the unknowns take up is less than the share of one of 48 parts.
    ratios = []
    for seed in range(10):
        parts = split(solve_two_walks(np.random.default_rng(seed)), 1.0)
        C = parts.covariance
        expected = np.trace(C @ parts.sum_information(np.ones(len(parts.body))))
        of_parts = zip(parts.columns, parts.gradient, strict=True)
        ratios.append(sum(b @ C[np.ix_(columns, columns)] @ b for columns, b in of_parts) / expected)
    assert np.mean(ratios) == pytest.approx(1, abs=0.12)


def test_parts_are_of_their_body_and_time(parts: Contributions) -> None:
    np.testing.assert_array_equal(np.unique(parts.body), [0, 1])
    for body in (0, 1):
        times = parts.time[parts.body == body]
        np.testing.assert_allclose(np.diff(times), 5.0)
        assert 0 < times[0] < 5
        assert SECONDS - 5 < times[-1] < SECONDS + 5


def test_unknowns_are_named_by_scanner_and_kind(parts: Contributions) -> None:
    # The root's pose and clock are known, and all systematic errors zero.
    np.testing.assert_array_equal(parts.scanner, np.repeat([1, 2], 4))
    assert parts.is_placement.all()


def test_a_leg_is_one_part() -> None:
    problem, state = build_network()
    solved = linearize_network(problem, state)
    parts = split(solved, 1.0)
    np.testing.assert_array_equal(parts.body, [0, 1])
    H = eliminate_densely(solved)
    information = parts.sum_information(np.ones(len(parts.body)))
    np.testing.assert_allclose(information + SHRINKAGE * parts.prior, H, rtol=1e-9, atol=1e-3)


def test_beams_without_noise_have_no_residuals_at_the_true_state_of_legs() -> None:
    network, state = build_network()
    beams = [
        one
        for body, path in zip(network.bodies, state.paths, strict=True)
        for one in predict_beams(network, state, body, path)
    ]
    assert [one.scans.scanner for one in beams] == [0, 1, 2, 0, 1, 2]
    for one in beams:
        np.testing.assert_allclose(one.residual, 0, atol=1e-6)
        assert len(one.scan) == len(one.sigma) == len(one.residual)


def test_groups_of_scanners_have_the_parts_of_their_unknowns() -> None:
    contributions = split_contributions(solve_two_walks(np.random.default_rng(0)), 5.0)
    whole = contributions.select(np.arange(3))
    groups = [contributions.select(group) for group in contributions.group_scanners(2)]
    assert sorted(s for group in groups for s in np.unique(group.scanner).tolist()) == [1, 2]
    for group in groups:
        rows = np.flatnonzero(np.isin(whole.unknowns, group.unknowns))
        of_group, of_whole = (one.sum_information(np.ones(len(one.body))) for one in (group, whole))
        np.testing.assert_allclose(of_group, of_whole[np.ix_(rows, rows)])
        np.testing.assert_allclose(group.prior, whole.prior[np.ix_(rows, rows)])
