"""Estimated noise, view bias and outlier views, over many seeds; intervals hold with 99 % and more."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2

from bundle_scenes import Scene, remeasured, scene
from calgraph.config.settings import VarianceComponentSettings
from calgraph.estimation.rig.bundle_solver import Bundle, MinimizedBundle, minimize_bundle
from calgraph.estimation.rig.covariances import pose_covariance, view_covariance_factors
from calgraph.estimation.rig.normal_equations import consistency_statistic
from calgraph.estimation.rig.observations import BoardViews, RangeObservations, relative_poses
from calgraph.estimation.rig.variance_components import (
    _shrink_noise_scale,
    find_outlier_views,
    update_variance_components,
)
from calgraph.geometry import se3

SEEDS = 20


def settled(exact: Scene, bundle: Bundle, rounds: int = 4) -> tuple[Bundle, MinimizedBundle]:
    """The bundle after rounds of solving and estimating noise and view bias."""
    solution = minimize_bundle(bundle, exact.truth)
    for _ in range(rounds):
        factors = view_covariance_factors(bundle, solution.equations)
        bundle = update_variance_components(bundle, solution, factors)
        solution = minimize_bundle(bundle, solution.state, iterations=3)
    return bundle, solution


def contradicting(bundle: Bundle, solution: MinimizedBundle) -> list[NDArray[np.bool_]]:
    return find_outlier_views(bundle, solution.equations, view_covariance_factors(bundle, solution.equations))


@pytest.mark.parametrize("noise", [0.1, 0.5, 1.0, 2.0])
def test_wrongly_stated_noise_is_estimated(noise: float) -> None:
    exact = scene(boards=6)
    found = []
    for seed in range(SEEDS):
        bundle = exact.measured(np.random.default_rng(seed), noise)
        solution = minimize_bundle(bundle, exact.truth)
        for _ in range(3):
            bundle = update_variance_components(
                bundle, solution, view_covariance_factors(bundle, solution.equations)
            )
            solution = minimize_bundle(bundle, solution.state, iterations=3)
        found.append([views.noise_scale for views in bundle.views])
    # Corners have 6 x 24 - 6 x 6 degrees of freedom; the stated noise counts as three more.
    freedom = np.array([6 * 108 - 18, 108, len(exact.bundle.views[2].start) * 50])
    spread = noise / np.sqrt(2 * freedom * SEEDS)
    pull = 3 / freedom * abs(np.log(noise)) * noise
    assert np.all(np.abs(np.mean(found, axis=0) - noise) < 3 * spread + pull)


@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_noise_is_estimated_from_the_scatter_among_views(noise: float) -> None:
    exact = scene(("lidar", "camera", "laser"), boards=15)
    found = []
    for seed in range(SEEDS):
        measured = exact.measured(np.random.default_rng(seed), noise)
        # Two beams on a board always fit it.
        bundle = replace(measured, views=(*measured.views[:2], with_two_beams(measured.views[2])))
        found.append(settled(exact, bundle, rounds=6)[0].views[2].noise_scale)
    freedom = 2 * 15 - 6
    spread = noise / np.sqrt(2 * freedom * SEEDS)
    pull = 3 / freedom * abs(np.log(noise)) * noise
    # The true view bias is 0, and estimates are not negative: in every other run, they take from the noise.
    taken = np.std(found) / np.sqrt(2 * np.pi)
    assert abs(np.mean(found) - noise) < 3 * spread + pull + taken


def with_two_beams(views: BoardViews) -> BoardViews:
    """The views with the first and the last beam of each."""
    assert isinstance(views, RangeObservations)
    ends = np.stack([views.start, np.append(views.start[1:], len(views.ranges)) - 1], axis=-1).ravel()
    return replace(
        views,
        start=2 * np.arange(len(views.start)),
        directions=views.directions[ends],
        ranges=views.ranges[ends],
        sigma=views.sigma[ends],
    )


def test_noise_is_attributed_to_its_sensor() -> None:
    exact = scene(boards=6)
    loud = exact.measured(np.random.default_rng(0), 3.0)
    quiet = exact.measured(np.random.default_rng(1), 1.0)
    bundle, _ = settled(exact, replace(quiet, views=(quiet.views[0], loud.views[1], quiet.views[2])))
    scales = [views.noise_scale for views in bundle.views]
    assert scales == pytest.approx([1, 3, 1], rel=0.25)


@pytest.mark.parametrize("view_bias", [0.003, 0.01])
def test_view_bias_is_estimated_without_bias(view_bias: float) -> None:
    exact = scene(("lidar", "camera", "laser", "camera"), boards=15)
    variances = np.array(
        [
            settled(exact, exact.measured(np.random.default_rng(seed), view_bias=view_bias))[0].bias_variance
            for seed in range(SEEDS)
        ]
    )
    # Each sensor's variance over the true one: its mean over seeds against their own scatter.
    relative_size = variances / view_bias**2
    standard_error = relative_size.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    assert np.all(np.abs(relative_size.mean(axis=0) - 1) < 3.5 * standard_error + 0.02)


def test_without_view_bias_its_estimate_is_small() -> None:
    exact = scene(boards=15)
    biases = np.sqrt([
        settled(exact, exact.measured(np.random.default_rng(seed)))[0].bias_variance for seed in range(SEEDS)
    ])  # fmt: skip
    # Larger by chance for some; still a small part of the noise.
    assert np.median(biases) < 5e-4
    assert biases.max() < 2.5e-3


def test_with_view_bias_errors_are_consistent_with_the_covariance() -> None:
    exact = scene(boards=20)
    nees = []
    for seed in range(2 * SEEDS):
        bundle, solution = settled(exact, exact.measured(np.random.default_rng(seed), view_bias=0.005))
        spread = pose_covariance(bundle, solution.state, solution.equations)[6:, 6:]
        error = se3.difference(solution.state.T_root_sensor, exact.truth.T_root_sensor)[1:].ravel()
        nees.append(error @ np.linalg.solve(spread, error))
    low, high = chi2.ppf([0.005, 0.995], 12 * len(nees)) / (12 * len(nees))
    # Sway measured from twenty views of a sensor is itself uncertain, which Student's t would make wider.
    assert low < np.mean(nees) / 12 < high * 1.2


def moved_views(exact: Scene, bundle: Bundle, sensor: int, wrong: list[int], rng: np.random.Generator) -> Bundle:
    """The bundle with outlier views of one sensor, 5 cm and 3 degrees off."""
    off = np.zeros((len(exact.truth.T_root_board), 6))
    off[wrong] = 0.05 * rng.choice([-1, 1], (len(wrong), 6))
    T = relative_poses(exact.truth.T_root_sensor[sensor], exact.truth.T_root_board)
    views = list(bundle.views)
    views[sensor] = remeasured(exact.bundle.views[sensor], se3.retract(T, off), rng, 1.0)
    return replace(bundle, views=tuple(views), bias_variance=np.full(len(views), 0.003**2))


def named(exact: Scene, bundle: Bundle, rounds: int = 3) -> list[tuple[int, int]]:
    """Sensors and boards of the outlier views, rejected round by round."""
    found = []
    for _ in range(rounds):
        wrong = contradicting(bundle, minimize_bundle(bundle, exact.truth))
        found += [(s, int(board)) for s, bad in enumerate(wrong) for board in bundle.views[s].board[bad]]
        left = tuple(views.select(~bad) for views, bad in zip(bundle.views, wrong, strict=True))
        bundle = replace(bundle, views=left)
    return found


@pytest.mark.parametrize("sensor", [0, 1])
def test_outlier_views_are_found(sensor: int) -> None:
    # Three sensors measure the board's plane, so that an outlier of one is identified.
    exact = scene(("lidar", "camera", "lidar2", "laser"), boards=15)
    right, others = 0, 0
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        found = named(exact, moved_views(exact, exact.measured(rng), sensor, [2, 7, 11], rng))
        right += len({(sensor, board) for board in (2, 7, 11)} & set(found))
        others += len(found)
    assert right >= 0.98 * 3 * SEEDS
    assert others - right <= 0.1 * right


def test_inlier_views_are_kept() -> None:
    exact = scene(boards=20)
    wrong = 0
    for seed in range(SEEDS):
        bundle, solution = settled(exact, exact.measured(np.random.default_rng(seed)))
        wrong += sum(int(bad.sum()) for bad in contradicting(bundle, solution))
    # One in 100,000 by chance, of 1,200.
    assert wrong <= 1


@pytest.mark.parametrize(("probability", "rejected"), [(2e-5, False), (0.5e-5, True)])
def test_an_outlier_is_as_unlikely_as_stated(probability: float, rejected: bool) -> None:
    """A view is displaced until a correct one would be as far away with this probability."""
    exact = scene(("lidar", "camera", "lidar2", "laser"), boards=10)
    T = relative_poses(exact.truth.T_root_sensor[1], exact.truth.T_root_board)

    def displaced(size: float) -> tuple[Bundle, MinimizedBundle]:
        off = np.zeros((10, 6))
        off[3] = size
        views = list(exact.bundle.views)
        views[1] = remeasured(views[1], se3.retract(T, off), np.random.default_rng(0), 0.0)
        bundle = replace(exact.bundle, views=tuple(views))
        return bundle, minimize_bundle(bundle, exact.truth)

    def statistic(size: float) -> tuple[float, int]:
        bundle, solution = displaced(size)
        at, F = solution.equations.views[1], view_covariance_factors(bundle, solution.equations)[1]
        squared, freedom = consistency_statistic(
            at.information, F @ np.swapaxes(F, -1, -2), at.gradient, bundle.settings.variances.min_redundancy
        )
        return float(squared[3]), int(freedom[3])

    size = 1e-3
    for _ in range(4):
        squared, freedom = statistic(size)
        size *= np.sqrt(chi2.isf(probability, freedom) / squared)
    assert statistic(size)[0] == pytest.approx(chi2.isf(probability, freedom), rel=0.01)
    assert contradicting(*displaced(size))[1][3] == rejected


def test_of_one_board_only_the_worst_view_is_an_outlier() -> None:
    exact, rng = scene(("lidar", "camera", "lidar2", "laser"), boards=10), np.random.default_rng(0)
    bundle = moved_views(exact, moved_views(exact, exact.measured(rng), 1, [3], rng), 3, [3], rng)
    found = contradicting(bundle, minimize_bundle(bundle, exact.truth))
    assert sum(bool(bad[3]) for bad in found) == 1


def test_views_are_outliers_beyond_the_significance_level() -> None:
    """Of exact views, one is moved until its statistic is 5 % below or above the chi-squared quantile of 1e-5."""
    exact = scene(("lidar", "camera", "lidar2", "laser"), boards=10)

    def move_view(distance: float) -> tuple[Bundle, MinimizedBundle]:
        T = relative_poses(exact.truth.T_root_sensor[1], exact.truth.T_root_board)
        off = np.zeros((10, 6))
        off[3, 2] = distance
        moved = remeasured(exact.bundle.views[1], se3.retract(T, off), np.random.default_rng(0), noise=0.0)
        bundle = replace(exact.bundle, views=(exact.bundle.views[0], moved, *exact.bundle.views[2:]))
        return bundle, minimize_bundle(bundle, exact.truth)

    def excess(distance: float) -> float:
        bundle, solution = move_view(distance)
        at, F = solution.equations.views[1], view_covariance_factors(bundle, solution.equations)[1]
        squared, freedom = consistency_statistic(
            at.information, F @ np.swapaxes(F, -1, -2), at.gradient, bundle.settings.variances.min_redundancy
        )
        return float(squared[3] / chi2.isf(1e-5, freedom[3]))

    for target in (0.95, 1.05):
        at_target = brentq(lambda distance, t=target: excess(distance) - t, 0.001, 0.3, xtol=1e-5)
        found = [int(bad.sum()) for bad in contradicting(*move_view(at_target))]
        assert found == [0, int(target > 1), 0, 0]


def test_noise_is_at_least_the_least_ratio_of_that_stated() -> None:
    """From residuals of zero with many degrees of freedom, which outweigh the noise as stated."""
    settings = VarianceComponentSettings(min_noise_ratio=0.1)
    assert _shrink_noise_scale(0.0, 1e9, settings) == pytest.approx(0.1)


@pytest.mark.parametrize(("min_noise_change", "kept"), [(0.2, True), (0.0, False)])
def test_views_whose_noise_hardly_changes_are_kept(min_noise_change: float, kept: bool) -> None:
    exact = scene(boards=12)
    bundle = exact.measured(np.random.default_rng(0), noise=1.02)
    variances = bundle.settings.variances.model_copy(update={"min_noise_change": min_noise_change})
    bundle = replace(bundle, settings=bundle.settings.model_copy(update={"variances": variances}))
    solution = minimize_bundle(bundle, exact.truth)
    updated = update_variance_components(bundle, solution, view_covariance_factors(bundle, solution.equations))
    same = [after is before for after, before in zip(updated.views, bundle.views, strict=True)]
    assert same == [kept] * 3
