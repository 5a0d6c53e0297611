"""The bundle's solver against SciPy and dense matrices, and on problems with exact solutions."""

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from bundle_scenes import scene
from calgraph.errors import CalibrationError
from calgraph.geometry import Array, se3, so3
from calgraph.rig.bundle.bundle_parameters import SensorPrior
from calgraph.rig.bundle.bundle_solver import Bundle, BundleState, linearize_bundle, minimize_bundle, retract_state
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.linearization import CachedLinearization
from calgraph.rig.bundle.normal_equations import ViewNormalEquations
from dense_bundles import dense_jacobian, residuals_after, unbiased_scene


def disturbed(state: BundleState, rng: np.random.Generator, size: float = 0.02) -> BundleState:
    """A start off the truth, except the root."""
    sensors = size * rng.normal(size=(len(state.T_root_sensor), 6))
    sensors[0] = 0
    boards = size * rng.normal(size=(len(state.T_root_board), 6))
    return BundleState(
        se3.retract(state.T_root_sensor, sensors), se3.retract(state.T_root_board, boards), state.extra
    )


def solved_by_scipy(bundle: Bundle, start: BundleState, **options: Any) -> tuple[BundleState, float]:
    """The best state, and its cost."""
    oracle = scipy.optimize.least_squares(
        lambda step: residuals_after(bundle, start, step),
        np.zeros(bundle.parameter_count + 6 * len(start.T_root_board)),
        jac=lambda step: dense_jacobian(bundle, start, step),
        x_scale="jac",
        **options,
    )
    best = retract_state(
        bundle, start, oracle.x[: bundle.parameter_count], oracle.x[bundle.parameter_count :].reshape(-1, 6)
    )
    return best, float(oracle.cost)


def test_exact_measurements_give_the_truth_from_a_poor_start(rng: np.random.Generator) -> None:
    exact = unbiased_scene()
    solution = minimize_bundle(exact.bundle, disturbed(exact.truth, rng, size=0.1))
    assert solution.converged
    error = se3.difference(solution.state.T_root_sensor, exact.truth.T_root_sensor)
    # The tolerance is a thousandth of a standard deviation.
    assert np.abs(error).max() < 1e-6


def test_solution_is_that_of_scipys_least_squares(rng: np.random.Generator) -> None:
    exact = unbiased_scene(boards=5)
    # So little noise that no residual is down-weighted.
    bundle, start = exact.measured(rng, noise=0.3), disturbed(exact.truth, rng, size=0.003)
    solution = minimize_bundle(bundle, start)
    best, cost = solved_by_scipy(bundle, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert solution.equations.cost == pytest.approx(cost, rel=1e-7)
    assert np.abs(se3.difference(solution.state.T_root_sensor, best.T_root_sensor)).max() < 1e-6


def test_outliers_are_weighted_as_in_scipys_huber_loss(rng: np.random.Generator) -> None:
    exact = unbiased_scene(("lidar", "laser"), boards=6)
    bundle, start = exact.measured(rng, noise=1.5), disturbed(exact.truth, rng, size=0.003)
    solution = minimize_bundle(bundle, start)
    best, cost = solved_by_scipy(
        bundle, start, loss="huber", f_scale=2.5, max_nfev=300, xtol=1e-13, ftol=1e-13, gtol=1e-13
    )
    assert solution.equations.cost <= cost * (1 + 1e-7)
    # A small part of the standard deviations, which are millimetres.
    assert np.abs(se3.difference(solution.state.T_root_sensor, best.T_root_sensor)).max() < 1e-4


def test_a_prior_acts_as_a_kalman_update(rng: np.random.Generator) -> None:
    exact = unbiased_scene()
    bundle = exact.measured(rng, noise=0.3)
    free = minimize_bundle(bundle, exact.truth)
    P = pose_covariance(bundle, free.state, free.equations)[6:12, 6:12]
    sizes = np.array([2, 3, 4, 2, 3, 4]) * 1e-4
    R = np.diag(sizes**2)
    mean = se3.retract(free.state.T_root_sensor[1], np.array([5, -5, 5, -5, 5, -5]) * 1e-4)
    pulled = minimize_bundle(replace(bundle, priors=(SensorPrior(1, mean, np.diag(sizes**-2)),)), exact.truth)
    gain = P @ np.linalg.inv(P + R)
    moved_by = se3.difference(pulled.state.T_root_sensor[1], free.state.T_root_sensor[1])
    expected = gain @ se3.difference(mean, free.state.T_root_sensor[1])
    np.testing.assert_allclose(moved_by, expected, atol=0.02 * np.abs(expected).max())
    spread = pose_covariance(bundle, pulled.state, pulled.equations)[6:12, 6:12]
    np.testing.assert_allclose(spread, P - gain @ P, atol=0.02 * np.abs(P - gain @ P).max())


@pytest.mark.parametrize("damping", [1e-5, 1.0, 100.0])
def test_the_predicted_decrease_is_that_of_the_cost(damping: float, rng: np.random.Generator) -> None:
    exact = unbiased_scene()
    state = disturbed(exact.truth, rng, size=1e-4)
    equations = linearize_bundle(exact.bundle, state)
    step, predicted = equations.solve(damping)
    decrease = equations.cost - linearize_bundle(exact.bundle, retract_state(exact.bundle, state, *step)).cost
    assert decrease == pytest.approx(predicted, rel=0.02)


def test_a_sensor_without_views_is_at_the_mean_of_its_prior() -> None:
    exact = unbiased_scene()
    blind = replace(
        exact.bundle, views=(*exact.bundle.views[:2], exact.bundle.views[2].select(np.zeros(8, dtype=bool)))
    )
    mean = se3.retract(exact.truth.T_root_sensor[2], np.array([0.3, -0.2, 0.1, 0.5, -0.4, 0.3]))
    solution = minimize_bundle(replace(blind, priors=(SensorPrior(2, mean, 1e6 * np.eye(6)),)), exact.truth)
    np.testing.assert_allclose(solution.state.T_root_sensor[2], mean, atol=1e-8)


def test_relative_poses_on_one_body_do_not_change(rng: np.random.Generator) -> None:
    exact = unbiased_scene(("lidar", "camera", "laser", "laser2"))
    bundle = replace(exact.measured(rng), body=np.array([0, 1, 1, 2]))
    T = exact.truth.T_root_sensor.copy()
    # The body starts far enough from its pose for several steps.
    turn = se3.pose(so3.exp(np.array([0.1, -0.1, 0.1])), np.array([0.1, -0.1, 0.1]))
    T[1:3] = turn @ T[1:3]
    solution = minimize_bundle(bundle, replace(exact.truth, T_root_sensor=T)).state.T_root_sensor
    np.testing.assert_allclose(se3.inverse(solution[1]) @ solution[2], se3.inverse(T[1]) @ T[2], atol=1e-12)
    assert np.abs(se3.difference(solution[1], exact.truth.T_root_sensor[1])).max() < 0.01


def test_sensors_on_the_roots_body_do_not_move(rng: np.random.Generator) -> None:
    exact = unbiased_scene()
    bundle = replace(exact.measured(rng), body=np.array([0, 0, 1]))
    solution = minimize_bundle(bundle, exact.truth)
    np.testing.assert_array_equal(solution.state.T_root_sensor[1], exact.truth.T_root_sensor[1])
    assert not pose_covariance(bundle, solution.state, solution.equations)[:12].any()


def test_a_sensor_without_views_stays_and_has_no_influence(rng: np.random.Generator) -> None:
    exact = unbiased_scene()
    bundle = exact.measured(rng)
    blind = replace(bundle, views=(*bundle.views[:2], bundle.views[2].select(np.zeros(8, dtype=bool))))
    with_blind = minimize_bundle(blind, exact.truth)
    pair = Bundle(("lidar", "camera"), bundle.views[:2], np.arange(2), np.zeros((2, 4)), bundle.lever)
    without = minimize_bundle(pair, replace(exact.truth, T_root_sensor=exact.truth.T_root_sensor[:2]))
    np.testing.assert_allclose(with_blind.state.T_root_sensor[:2], without.state.T_root_sensor, atol=1e-6)
    np.testing.assert_allclose(with_blind.state.T_root_sensor[2], exact.truth.T_root_sensor[2], atol=1e-12)
    # Its variance is that of the prior.
    assert pose_covariance(blind, with_blind.state, with_blind.equations)[12:15, 12:15].max() == pytest.approx(
        100.0
    )


def test_a_board_observed_by_one_sensor_has_no_influence(rng: np.random.Generator) -> None:
    exact = unbiased_scene()
    bundle = exact.measured(rng)
    alone = np.arange(8) != 7
    one_more = replace(
        bundle, views=(bundle.views[0].select(alone), bundle.views[1], bundle.views[2].select(alone))
    )
    fewer = replace(bundle, views=tuple(views.select(alone) for views in bundle.views))
    found, expected = minimize_bundle(one_more, exact.truth), minimize_bundle(fewer, exact.truth)
    np.testing.assert_allclose(found.state.T_root_sensor, expected.state.T_root_sensor, atol=1e-6)
    np.testing.assert_allclose(
        pose_covariance(one_more, found.state, found.equations),
        pose_covariance(fewer, expected.state, expected.equations),
        rtol=1e-3, atol=1e-12,
    )  # fmt: skip


def test_the_cost_never_rises(rng: np.random.Generator) -> None:
    exact = scene(boards=8)
    bundle, start = exact.measured(rng, noise=3.0, view_bias=0.02), disturbed(exact.truth, rng, size=0.3)
    costs = [minimize_bundle(bundle, start, iterations=n).equations.cost for n in (1, 2, 3, 5, 8, 20)]
    assert np.all(np.diff(costs) <= 0)


def test_a_solver_that_was_stopped_early_has_not_converged(rng: np.random.Generator) -> None:
    exact = unbiased_scene()
    start = disturbed(exact.truth, rng, size=0.2)
    assert [minimize_bundle(exact.bundle, start, iterations=count).converged for count in (1, 5, 20)] == [
        False,
        False,
        True,
    ]


def test_a_start_with_a_board_behind_a_camera_is_refused() -> None:
    exact = unbiased_scene()
    T = exact.truth.T_root_sensor.copy()
    T[1] = T[1] @ np.diag([-1.0, 1, -1, 1])
    with pytest.raises(CalibrationError, match="behind a camera"):
        minimize_bundle(exact.bundle, replace(exact.truth, T_root_sensor=T))


def test_extrapolation_does_not_take_boards_out_of_a_cameras_view(monkeypatch: pytest.MonkeyPatch) -> None:
    """To first order, a board at three times its distance moves behind the camera."""
    monkeypatch.setattr("calgraph.rig.bundle.linearization._MAX_RESIDUAL_CHANGE", 1e6)
    monkeypatch.setattr("calgraph.rig.bundle.linearization._MAX_ROTATION", 0.99)
    exact = unbiased_scene()
    far = exact.truth.T_root_board.copy()
    camera = exact.truth.T_root_sensor[exact.bundle.sensors.index("camera"), :3, 3]
    far[0, :3, 3] = camera + 3 * (far[0, :3, 3] - camera)
    bundle = exact.bundle.with_views([
        views if name == "camera" else views.select(views.board > 0)
        for name, views in zip(exact.bundle.sensors, exact.bundle.views, strict=True)
    ])  # fmt: skip
    found = minimize_bundle(bundle, replace(exact.truth, T_root_board=far), tolerance=1e-3, exact=False)
    assert np.isfinite(linearize_bundle(bundle, found.state).cost)


def test_extrapolation_that_leads_off_the_minimum_is_given_up(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle, start = unbiased_scene().measured(rng), disturbed(unbiased_scene().truth, rng)
    expected = minimize_bundle(bundle, start)
    gains = count(1.0)

    def extrapolate(cached: CachedLinearization, *_: object) -> ViewNormalEquations:
        """Equations by which every further step is a gain."""
        return replace(cached.equations, robust_cost_offset=cached.equations.robust_cost_offset - next(gains))

    monkeypatch.setattr(CachedLinearization, "extrapolate", extrapolate)
    found = minimize_bundle(bundle, start)
    assert found.converged
    off = se3.difference(found.state.T_root_sensor, expected.state.T_root_sensor)
    assert np.abs(off).max() < 1e-5


def test_the_gradient_of_a_prior_is_that_of_its_cost() -> None:
    """By finite differences, half a radian from the prior about each axis, with different standard deviations."""
    exact = unbiased_scene()
    off = np.array([0.1, -0.2, 0.05, 0.5, -0.4, 0.6])
    mean = se3.retract(exact.truth.T_root_sensor[1], off)
    prior = SensorPrior(1, mean, np.diag(np.array([0.01, 0.02, 0.05, 0.01, 0.03, 0.1]) ** -2))
    bundle = replace(exact.bundle, priors=(prior,))

    def prior_cost(step: Array) -> float:
        state = retract_state(bundle, exact.truth, step, np.zeros((len(exact.truth.T_root_board), 6)))
        return linearize_bundle(bundle, state).cost - linearize_bundle(exact.bundle, state).cost

    found = linearize_bundle(bundle, exact.truth).g - linearize_bundle(exact.bundle, exact.truth).g
    steps = 1e-5 * np.eye(bundle.parameter_count)
    expected = [(prior_cost(step) - prior_cost(-step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
