"""Halves of the captures: their differences are as large as their covariances state, unless something changed."""

from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import LEVER, Scene, bias_variances, remeasured, scene
from calgraph.config.settings import DiagnosticsSettings
from calgraph.geometry import Array, se3
from calgraph.result.finding import Finding
from calgraph.rig.bundle.bundle_solver import Bundle, minimize_bundle
from calgraph.rig.bundle.covariances import gradient_by_board
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.bundle.solution import SolvedBundle
from calgraph.rig.checks.contradictions import compare_halves, find_changes
from calgraph.rig.checks.drift_tests import measure_drifts
from calgraph.solver.squared_distances import compute_squared_distances

BOARDS, SEEDS = 16, 30
FIRST = np.arange(BOARDS) < BOARDS // 2


def solve(exact: Scene, bundle: Bundle) -> SolvedBundle:
    return SolvedBundle(bundle, minimize_bundle(bundle, exact.truth), np.arange(BOARDS))


def compare(solved: SolvedBundle) -> tuple[Array, Array]:
    equations = solved.minimized.equations
    axes = np.eye(solved.bundle.parameter_count)
    return next(compare_halves(solved.bundle, equations, FIRST[None], axes))


def displaced(exact: Scene, bundle: Bundle, sensor: int, step: Array) -> Bundle:
    """The bundle with a sensor that is displaced by a step (6,) in its second half."""
    views = bundle.views[sensor]
    T = relative_poses(exact.truth.T_root_sensor[sensor], exact.truth.T_root_board[views.board])
    after = se3.inverse(se3.retract(np.eye(4), step)) @ T
    moved = remeasured(views, np.where(FIRST[views.board][:, None, None], T, after), np.random.default_rng(1), 0.0)
    return replace(bundle, views=tuple(moved if s == sensor else v for s, v in enumerate(bundle.views)))


def find_changes_of(solved: SolvedBundle) -> list[Finding]:
    return list(find_changes(solved, measure_drifts(solved), DiagnosticsSettings()))


def test_gradients_of_boards_add_up_to_that_of_the_cost(rng: np.random.Generator) -> None:
    exact = scene(boards=BOARDS)
    solved = solve(exact, exact.measured(rng))
    _, g, _ = solved.minimized.equations.eliminate_boards()
    by_board = gradient_by_board(solved.bundle, solved.minimized.equations)
    np.testing.assert_allclose(by_board.sum(axis=0), g, atol=1e-6 * np.abs(by_board).max())


def test_the_difference_is_that_of_the_solutions_of_halves(rng: np.random.Generator) -> None:
    exact = scene(boards=BOARDS)
    solved = solve(exact, exact.measured(rng))
    halves = [
        minimize_bundle(
            solved.bundle.with_views([v.select(half[v.board]) for v in solved.bundle.all_views]),
            solved.minimized.state,
        ).state.T_root_sensor
        for half in (FIRST, ~FIRST)
    ]
    difference, covariance = compare(solved)
    expected = np.concatenate([se3.difference(b, a) for a, b in zip(*halves, strict=True)])[6:]
    assert np.all(np.abs(difference - expected) < 0.1 * np.sqrt(np.diag(covariance)))


def test_covariances_of_differences_hold() -> None:
    exact, squares = scene(boards=BOARDS), []
    for seed in range(SEEDS):
        bundle = exact.measured(np.random.default_rng(seed), view_bias=0.002)
        bundle = replace(bundle, bias_variance=bias_variances(3, 0.002))
        difference, covariance = compare(solve(exact, bundle))
        squares.append(compute_squared_distances(difference, covariance, 1e-12)[0] / 12)
    # The standard deviation of the mean is 7 %; robust weights and linearization cost some more.
    assert 0.8 < np.mean(squares) < 1.25


@pytest.mark.parametrize("seed", range(4))
def test_halves_of_right_recordings_agree(seed: int) -> None:
    exact = scene(boards=BOARDS)
    assert find_changes_of(solve(exact, exact.measured(np.random.default_rng(seed)))) == []


def test_a_sensor_that_moved_is_named(rng: np.random.Generator) -> None:
    exact = scene(boards=BOARDS)
    step = np.array([0.03, 0, 0, 0, 0, 0.03 / LEVER])
    found = find_changes_of(solve(exact, displaced(exact, exact.measured(rng), 2, step)))
    # The boards that it displaces may make others suspect as well.
    assert ("laser",) in [one.sensors for one in found]


def test_a_drift_is_named_with_its_size(rng: np.random.Generator) -> None:
    exact = scene(boards=BOARDS)
    bundle, share = exact.measured(rng), np.linspace(0, 1, BOARDS)
    laser = bundle.views[2]
    T = relative_poses(exact.truth.T_root_sensor[2], exact.truth.T_root_board[laser.board])
    drifted = [se3.retract(np.eye(4), s * np.array([0.04, 0, 0, 0, 0, 0])) for s in share[laser.board]]
    moved = remeasured(laser, se3.inverse(np.array(drifted)) @ T, rng, 0.0)
    findings = find_changes_of(solve(exact, replace(bundle, views=(*bundle.views[:2], moved))))
    (found,) = [one for one in findings if one.sensors == ("laser",)]
    size = float(found.text.removeprefix("the pose of laser drifts by ").split(maxsplit=1)[0])
    assert 25 < size < 60


def test_directions_without_covariance_are_not_compared() -> None:
    squared, freedom = compute_squared_distances(np.array([2.0, 0.0]), np.diag([4.0, 0.0]), 1e-12)
    assert squared == pytest.approx(1.0)
    assert freedom == 1
