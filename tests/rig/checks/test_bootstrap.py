"""Resampled captures: covariances that hold are called honest, and others are not."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

from bundle_scenes import bias_variances, scene
from calgraph.rig.bundle.bundle_solver import Bundle, linearize_bundle, minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.bootstrap import (
    BootstrapScatter,
    _confidence_factors,
    _difference_variances,
    _resample_bundle,
    bootstrap_poses,
)

BOARDS, ROUNDS, SEEDS, SWAY = 16, 20, 5, 0.001


def scatter(bundle: Bundle, seed: int, boards: int = BOARDS) -> dict[str, BootstrapScatter]:
    exact = scene(boards=boards)
    adjusted = SolvedBundle(bundle, minimize_bundle(bundle, exact.truth), np.arange(boards))
    return bootstrap_poses(adjusted, ROUNDS, np.random.default_rng(seed), lambda _: None)


def test_honest_covariances_are_called_honest() -> None:
    ratios, honest = [], 0
    for seed in range(SEEDS):
        found = scatter(scene(boards=BOARDS).measured(np.random.default_rng(seed), view_bias=SWAY), seed)
        ratios.append([s.ratio for s in found.values()])
        honest += all(s.verdict == "honest" for s in found.values())
    # All intervals of a recording hold with 95 %: of five, fewer than four do once in forty.
    assert honest >= SEEDS - 1
    # Twelve ratios of five recordings, each with half as many degrees of freedom as there are boards or more.
    assert abs(np.sqrt(np.mean(np.square(ratios))) - 1) < 0.2


def test_errors_larger_than_assumed_make_covariances_optimistic() -> None:
    bundle = scene(boards=BOARDS).measured(np.random.default_rng(0), view_bias=10 * SWAY)
    found = scatter(bundle, 0)
    assert {s.verdict for s in found.values()} == {"optimistic"}
    laser = found["laser"]
    assert laser.ratio[laser.worst] > 2


def test_measured_sway_keeps_covariances_of_correlated_errors_honest() -> None:
    exact = scene(boards=BOARDS)
    bundle = exact.measured(np.random.default_rng(0), view_bias=5 * SWAY)
    found = scatter(replace(bundle, bias_variance=bias_variances(3, 5 * SWAY)), 0)
    assert all(s.verdict != "optimistic" for s in found.values())


def test_errors_smaller_than_assumed_make_covariances_pessimistic() -> None:
    bundle = scene(boards=BOARDS).measured(np.random.default_rng(0), noise=0.1)
    found = scatter(bundle, 0)
    assert {s.verdict for s in found.values()} == {"pessimistic"}
    assert all(s.ratio[s.worst] < 0.5 for s in found.values())


def test_draws_that_happen_to_be_the_captures_themselves_say_nothing() -> None:
    found = scatter(scene(boards=3).measured(np.random.default_rng(0), view_bias=SWAY), 0, boards=3)
    assert len(found) == 2
    for s in found.values():
        assert ((s.ratio > 0) & (s.ratio < 1)).all()
        assert ((s.high / s.low > 10) & (s.high / s.low < 1e4)).all()


def test_covariance_of_a_sample_is_that_of_simulated_samples(rng: np.random.Generator) -> None:
    """One parameter, five captures of known information: the difference of two weighted means."""
    information = np.array([1.0, 2.0, 4.0, 3.0, 0.5])
    counts = np.array([2, 0, 1, 1, 1])
    measured = rng.normal(size=(200_000, 5)) / np.sqrt(information)
    whole = measured @ information / information.sum()
    sample = measured @ (counts * information) / (counts * information).sum()
    V = np.array([[1 / information.sum()]])
    _, expected = _difference_variances(
        information[:, None, None], np.linalg.inv(V), V, np.ones((1, 1, 1)), counts
    )
    np.testing.assert_allclose(np.var(sample - whole), expected[0, 0], rtol=0.02)


def test_confidence_factors_are_those_of_chi_squared_shared_among_all_axes() -> None:
    """Equal captures, many rounds: as many degrees of freedom as captures; each of two axes gets half of 5 %."""
    captures = 40
    information = np.tile(np.eye(2), (captures, 1, 1))
    low, high = _confidence_factors(np.eye(2)[None], information, 10**9, 0.95)
    bounds = scipy.stats.chi2.ppf([1 - 0.0125, 0.0125], captures)
    np.testing.assert_allclose(low[0], np.sqrt(captures / bounds[0]), rtol=1e-6)
    np.testing.assert_allclose(high[0], np.sqrt(captures / bounds[1]), rtol=1e-6)


def test_few_rounds_limit_the_degrees_of_freedom() -> None:
    """20 equal captures in 20 rounds: the reciprocals of both numbers add up to that of 10."""
    low, high = _confidence_factors(np.eye(1)[None], np.ones((20, 1, 1)), 20, 0.9)
    bounds = scipy.stats.chi2.ppf([0.95, 0.05], 10)
    np.testing.assert_allclose([low[0, 0], high[0, 0]], np.sqrt(10 / bounds), rtol=1e-9)


def test_a_sample_has_the_views_of_its_boards_as_often_as_they_are_drawn() -> None:
    """The laser detected the first and the third of four boards."""
    exact = scene(boards=4)
    lidar, camera, laser = exact.bundle.views
    bundle = exact.bundle.with_views((lidar, camera, laser.select(np.array([True, False, True, False]))))
    equations = linearize_bundle(bundle, exact.truth)
    sample, _, state = _resample_bundle(bundle, exact.truth, equations, np.array([3, 2, 2, 1]))
    assert [views.board.tolist() for views in sample.views] == [[0, 1, 2, 3], [0, 1, 2, 3], [1, 2]]
    np.testing.assert_array_equal(state.T_root_board, exact.truth.T_root_board[[3, 2, 2, 1]])


def test_stated_deviations_are_along_the_axes_of_the_sensor() -> None:
    """The optical axis of the camera is where the x axis of the root is."""
    exact = scene(boards=6)
    bundle = exact.measured(np.random.default_rng(0))
    solved = minimize_bundle(bundle, exact.truth)
    found = bootstrap_poses(
        SolvedBundle(bundle, solved, np.arange(6)), 1, np.random.default_rng(0), lambda _: None
    )
    to_camera = np.kron(np.eye(2), solved.state.T_root_sensor[1, :3, :3].T)
    covariance = to_camera @ pose_covariance(bundle, solved.state, solved.equations)[6:12, 6:12] @ to_camera.T
    np.testing.assert_allclose(found["camera"].stated, np.sqrt(np.diag(covariance)))


def test_a_difference_has_at_least_the_smallest_share_of_the_stated_variance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A share of a million divides ratios, which are about 1, by a thousand."""
    monkeypatch.setattr("calgraph.rig.checks.bootstrap._BOOTSTRAP_MIN_VARIANCE_SHARE", 1e6)
    exact = scene(boards=BOARDS)
    bundle = exact.measured(np.random.default_rng(0))
    solved = SolvedBundle(bundle, minimize_bundle(bundle, exact.truth), np.arange(BOARDS))
    found = bootstrap_poses(solved, ROUNDS, np.random.default_rng(0), lambda _: None)
    ratios = np.concatenate([one.ratio for one in found.values()])
    assert 0.3e-3 < ratios.min() < ratios.max() < 3e-3
