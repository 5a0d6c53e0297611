"""Estimated noise, view bias and outlier views, over many seeds; intervals hold with 99 % and more."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2
from scipy.stats import t as student_t

from bundle_scenes import LEVER, RANGE, Scene, bias_variances, remeasured, scene
from calgraph.geometry import se3
from calgraph.rig.bundle.bundle_solver import Bundle, MinimizedBundle, minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance, view_covariance_factors
from calgraph.rig.bundle.estimate import MAX_ROUNDS
from calgraph.rig.bundle.observations import BoardViews, relative_poses
from calgraph.rig.bundle.range_observations import RangeObservations
from calgraph.rig.bundle.settling import MAX_SETTLED_CHANGE
from calgraph.rig.bundle.variance_components import (
    _USUAL_VIEW_BIAS,
    ViewConsistency,
    _shrink_noise_scale,
    measure_consistency,
    select_consistent_views,
    update_variance_components,
)

pytestmark = pytest.mark.slow

SEEDS = 20
FEW_SEEDS = 12
"""Where the interval is as wide as their number makes it."""


def settled(exact: Scene, bundle: Bundle) -> tuple[Bundle, MinimizedBundle]:
    """The bundle after solving and estimating noise and view bias until they have settled."""
    solution = minimize_bundle(bundle, exact.truth)
    for _ in range(MAX_ROUNDS):
        factors = view_covariance_factors(bundle, solution.equations)
        bundle, change = update_variance_components(bundle, solution, factors)
        solution = minimize_bundle(bundle, solution.state, iterations=3)
        if change < MAX_SETTLED_CHANGE:
            break
    return bundle, solution


def consistency(bundle: Bundle, solution: MinimizedBundle) -> list[ViewConsistency]:
    """Of each sensor's views with all views."""
    factors = view_covariance_factors(bundle, solution.equations)
    return measure_consistency(solution.equations, factors)


def contradicting(bundle: Bundle, solution: MinimizedBundle) -> list[NDArray[np.bool_]]:
    """By sensor, a mask (V,) of the views that are rejected."""
    selected = select_consistent_views(bundle, consistency(bundle, solution), every_view(bundle))
    return [~kept for kept in selected]


def every_view(bundle: Bundle) -> list[NDArray[np.bool_]]:
    return [np.ones(len(views.board), dtype=np.bool_) for views in bundle.all_views]


@pytest.mark.parametrize("noise", [0.1, 2.0])
def test_wrongly_stated_noise_is_estimated(noise: float) -> None:
    exact = scene(boards=6)
    found = []
    for seed in range(FEW_SEEDS):
        bundle = exact.measured(np.random.default_rng(seed), noise)
        solution = minimize_bundle(bundle, exact.truth)
        for _ in range(3):
            bundle, _ = update_variance_components(
                bundle, solution, view_covariance_factors(bundle, solution.equations)
            )
            solution = minimize_bundle(bundle, solution.state, iterations=3)
        found.append([views.noise_scale for views in bundle.views])
    # Corners have 6 x 24 - 6 x 6 degrees of freedom; the stated noise counts as three more.
    freedom = np.array([6 * 108 - 18, 108, len(exact.bundle.views[2].start) * 50])
    spread = noise / np.sqrt(2 * freedom * FEW_SEEDS)
    pull = 3 / freedom * abs(np.log(noise)) * noise
    assert np.all(np.abs(np.mean(found, axis=0) - noise) < 3 * spread + pull)


@pytest.mark.parametrize("noise", [0.3, 2.0])
def test_noise_is_estimated_from_the_scatter_among_views(noise: float) -> None:
    """Two beams on a board always fit it: noise and view bias are determined together by where the lines are."""
    exact = scene(("lidar", "camera", "laser"), boards=15)
    found = []
    for seed in range(FEW_SEEDS):
        measured = exact.measured(np.random.default_rng(seed), noise)
        bundle = replace(measured, views=(*measured.views[:2], with_two_beams(measured.views[2])))
        bundle, _ = settled(exact, bundle)
        displacement, rotation, *_ = bundle.bias_variance[2]
        # The ends of a line are some 0.55 m from the middle of the board.
        of_bias = (displacement + 0.55**2 * rotation) / RANGE.range**2
        found.append(np.sqrt(bundle.views[2].noise_scale ** 2 + of_bias))
    freedom = 2 * 15 - 6
    spread = noise / np.sqrt(2 * freedom * FEW_SEEDS)
    pull = 3 / freedom * abs(np.log(noise)) * noise
    assert abs(np.mean(found) - noise) < 3 * spread + pull


def with_two_beams(views: BoardViews) -> BoardViews:
    """The views with the first and the last beam of each."""
    assert isinstance(views, RangeObservations)
    ends = np.stack([views.start, np.append(views.start[1:], len(views.ranges)) - 1], axis=-1).ravel()
    return replace(
        views,
        first=2 * np.arange(len(views.first)),
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
def test_view_bias_is_estimated_without_bias(view_bias: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the usual one has no weight."""
    monkeypatch.setattr("calgraph.rig.bundle.variance_components._USUAL_BIAS_WEIGHT", 0.0)
    exact = scene(("lidar", "camera", "laser", "camera"), boards=15)
    measured = [exact.measured(np.random.default_rng(seed), view_bias=view_bias) for seed in range(FEW_SEEDS)]
    variances = np.array([settled(exact, one)[0].bias_variance[:, :2] for one in measured])
    # Variances of displacement and rotation over the true ones: their means over seeds against their scatter.
    relative_size = variances / bias_variances(4, view_bias)[:, :2]
    standard_error = relative_size.std(axis=0, ddof=1) / np.sqrt(FEW_SEEDS)
    # 99.8 % of each, as 3.5 standard errors of 20 seeds.
    quantile = student_t.isf(1.2e-3, FEW_SEEDS - 1)
    assert np.all(np.abs(relative_size.mean(axis=0) - 1) < quantile * standard_error + 0.02)


@pytest.mark.parametrize(("weight", "largest_median", "largest"), [(0.0, 5e-4, 3.5e-3), (2.0, 1.5e-3, 3.0e-3)])
def test_without_view_bias_its_estimate_is_at_most_the_usual_one(
    weight: float, largest_median: float, largest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.rig.bundle.variance_components._USUAL_BIAS_WEIGHT", weight)
    exact = scene(boards=15)
    measured = [exact.measured(np.random.default_rng(seed)) for seed in range(SEEDS)]
    biases = np.sqrt([settled(exact, one)[0].bias_variance[:, :2] * [1, LEVER**2] for one in measured])
    # Larger by chance for some; still a small part of the noise.
    assert np.median(biases) < largest_median
    assert biases.max() < largest


def test_few_views_do_not_suffice_for_a_view_bias_of_zero() -> None:
    exact = scene(boards=5)
    usual = _USUAL_VIEW_BIAS
    for seed in range(SEEDS):
        bundle, _ = settled(exact, exact.measured(np.random.default_rng(seed)))
        displacement, rotation, *_ = np.sqrt(bundle.bias_variance).T
        assert min(displacement.min(), LEVER * rotation.min()) > 0.3 * usual


def test_the_usual_view_bias_is_assumed_if_its_weight_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.rig.bundle.variance_components._USUAL_BIAS_WEIGHT", 1e6)
    exact = scene(boards=10)
    bundle, _ = settled(exact, exact.measured(np.random.default_rng(0), view_bias=0.005))
    usual = _USUAL_VIEW_BIAS
    np.testing.assert_allclose(
        np.sqrt(bundle.bias_variance), np.tile([usual, usual / LEVER, 0, 0], (3, 1)), rtol=0.02
    )


@pytest.mark.parametrize(
    ("view_bias", "weight", "largest"), [(0.0015, 2.0, 1.2), (0.005, 0.0, 1.2), (0.005, 2.0, 1.5)]
)
def test_with_view_bias_errors_are_consistent_with_the_covariance(
    view_bias: float, weight: float, largest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it is as usual; at three times that, components that are hardly measured are too small."""
    monkeypatch.setattr("calgraph.rig.bundle.variance_components._USUAL_BIAS_WEIGHT", weight)
    exact = scene(boards=20)
    nees = []
    for seed in range(FEW_SEEDS):
        measured = exact.measured(np.random.default_rng(seed), view_bias=view_bias)
        bundle, solution = settled(exact, measured)
        spread = pose_covariance(bundle, solution.state, solution.equations)[6:, 6:]
        error = se3.difference(solution.state.T_root_sensor, exact.truth.T_root_sensor)[1:].ravel()
        nees.append(error @ np.linalg.solve(spread, error))
    low, high = chi2.ppf([0.005, 0.995], 12 * len(nees)) / (12 * len(nees))
    # A view bias estimated from twenty views of a sensor is itself uncertain, which Student's t would make wider.
    assert low < np.mean(nees) / 12 < high * largest


def moved_views(exact: Scene, bundle: Bundle, sensor: int, wrong: list[int], rng: np.random.Generator) -> Bundle:
    """The bundle with outlier views of one sensor, 5 cm and 3 degrees off."""
    off = np.zeros((len(exact.truth.T_root_board), 6))
    off[wrong] = 0.05 * rng.choice([-1, 1], (len(wrong), 6))
    T = relative_poses(exact.truth.T_root_sensor[sensor], exact.truth.T_root_board)
    views = list(bundle.views)
    views[sensor] = remeasured(exact.bundle.views[sensor], se3.retract(T, off), rng, 1.0)
    return replace(bundle, views=tuple(views), bias_variance=bias_variances(len(views), 0.003))


def named(exact: Scene, bundle: Bundle, rounds: int = 3) -> list[tuple[int, int]]:
    """Sensors and boards of the outlier views, rejected round by round."""
    found = []
    for _ in range(rounds):
        bundle = replace(bundle, robust_views=True)
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
        of_camera = consistency(bundle, solution)[1]
        return float(of_camera.squared[3]), int(of_camera.freedom[3])

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
        of_camera = consistency(bundle, solution)[1]
        return float(of_camera.squared[3] / chi2.isf(1e-5, of_camera.freedom[3]))

    for target in (0.95, 1.05):
        at_target = brentq(lambda distance, t=target: excess(distance) - t, 0.001, 0.3, xtol=1e-5)
        found = [int(bad.sum()) for bad in contradicting(*move_view(at_target))]
        assert found == [0, int(target > 1), 0, 0]


def test_noise_is_at_least_the_least_ratio_of_that_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """From residuals of zero with many degrees of freedom, which outweigh the noise as stated."""
    monkeypatch.setattr("calgraph.rig.bundle.variance_components._MIN_NOISE_RATIO", 0.1)
    assert _shrink_noise_scale(0.0, 1e9) == pytest.approx(0.1)


@pytest.mark.parametrize(("min_noise_change", "kept"), [(0.2, True), (0.0, False)])
def test_views_whose_noise_hardly_changes_are_kept(
    min_noise_change: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.rig.bundle.variance_components._MIN_NOISE_CHANGE", min_noise_change)
    exact = scene(boards=12)
    bundle = exact.measured(np.random.default_rng(0), noise=1.02)
    solution = minimize_bundle(bundle, exact.truth)
    updated, _ = update_variance_components(bundle, solution, view_covariance_factors(bundle, solution.equations))
    same = [after is before for after, before in zip(updated.views, bundle.views, strict=True)]
    assert same == [kept] * 3
