"""Errors that successive captures have in common increase variances; others do not."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import bias_variances, remeasured, scene
from calgraph.geometry import se3
from calgraph.rig.bundle.bundle_solver import Bundle, minimize_bundle
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.checks.pose_steps import find_pose_steps
from calgraph.rig.checks.serial_correlation import measure_score_correlation, measure_serial_correlation

BOARDS = 40
SCENE = scene(boards=BOARDS)


def measure(bundle: Bundle) -> float:
    return measure_serial_correlation(bundle, minimize_bundle(bundle, SCENE.truth), np.arange(BOARDS))


def wandering(seed: int, stddev: float, together: int) -> Bundle:
    """The bundle of a camera whose views are displaced, a number of successive ones in the same way."""
    rng = np.random.default_rng(seed)
    bundle = SCENE.measured(rng, view_bias=1e-4)
    exact = SCENE.bundle.views[1]
    T = relative_poses(SCENE.truth.T_root_sensor[1], SCENE.truth.T_root_board[exact.board])
    shifts = np.repeat(rng.normal(0, stddev, (BOARDS // together, 6)), together, axis=0)
    views = remeasured(exact, se3.retract(T, shifts), rng, 1.0)
    bundle = bundle.with_views([bundle.views[0], views, *bundle.views[2:]])
    return replace(bundle, bias_variance=bias_variances(3, stddev))


def test_independent_captures_keep_their_variances() -> None:
    factors = [measure(wandering(seed, 0.003, 1)) for seed in range(40)]
    assert sum(factor > 1 for factor in factors) <= 2


def test_common_errors_of_successive_captures_increase_variances() -> None:
    factors = [measure(wandering(seed, 0.02, 8)) for seed in range(10)]
    # With a false-alarm probability of 1 %, three of ten are no chance.
    assert sum(factor > 1.2 for factor in factors) >= 3


def test_the_factor_does_not_depend_on_axes_and_units() -> None:
    """Under any linear change of the parameters of each pose."""
    bundle = wandering(3, 0.02, 8)
    solution = minimize_bundle(bundle, SCENE.truth)
    order, rng = np.arange(BOARDS), np.random.default_rng(0)
    change = np.eye(bundle.parameter_count)
    for body in range(bundle.body_count):
        block = slice(6 * body, 6 * body + 6)
        change[block, block] = np.geomspace(1, 1e3, 6)[:, None] * rng.normal(size=(6, 6))
    equations = solution.equations
    changed = replace(
        equations,
        H=change.T @ equations.H @ change,
        g=equations.g @ change,
        H_board_sensor=equations.H_board_sensor @ change,
        views=tuple(
            replace(views, by_sensor=views.by_sensor @ change[np.ix_(columns, columns)])
            for views, columns in zip(equations.views, map(bundle.pose_columns, range(3)), strict=True)
        ),
    )
    factor = measure_serial_correlation(bundle, solution, order)
    assert factor > 1
    assert measure_serial_correlation(bundle, replace(solution, equations=changed), order) == pytest.approx(
        factor, rel=1e-3
    )


def test_few_captures_are_not_tested() -> None:
    bundle = SCENE.measured(np.random.default_rng(0))
    few = bundle.with_views([views.select(views.board < 8) for views in bundle.views])
    solution = minimize_bundle(few, SCENE.truth)
    assert measure_serial_correlation(few, solution, np.arange(8)) == 1.0


def test_no_steps_beside_common_errors_of_successive_captures() -> None:
    found = 0
    for seed in range(6):
        bundle = wandering(seed, 0.02, 8)
        found += bool(find_pose_steps(bundle, minimize_bundle(bundle, SCENE.truth)))
    assert found <= 1


def test_the_factor_of_scores_is_that_of_their_most_correlated_direction() -> None:
    """Autoregression with 0.8 in one of six directions has a long-run variance of 9; six lags show half."""
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(120, 6))
    independent = measure_score_correlation(scores)
    for i in range(1, len(scores)):
        scores[i, 2] = 0.8 * scores[i - 1, 2] + 0.6 * scores[i, 2]
    assert 1 <= independent < 1.6
    assert 2 < measure_score_correlation(scores) < 6
