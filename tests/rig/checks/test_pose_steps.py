"""Tests of steps in the poses of sensors: how often they are found, with a step and without one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import beta, chi2, kstest

from bundle_scenes import remeasured, scene
from calgraph.geometry import Array, se3
from calgraph.rig.bundle.bundle_solver import Bundle, minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.observations import relative_poses
from calgraph.rig.checks.pose_changes import release_poses
from calgraph.rig.checks.pose_steps import (
    _SINGLE_VIEW_PROBABILITY,
    PoseStep,
    _select_largest,
    find_pose_steps,
    score_steps,
    score_without_any_one,
)

pytestmark = pytest.mark.slow

BOARDS = 20
SCENE = scene(boards=BOARDS)
SENSORS = SCENE.bundle.sensors
VIEW_BIAS = 1e-3
RIGHT_RUNS = 300


def measured(rng: np.random.Generator, sensor: int = 0, step: Array | None = None, first: int = 0) -> Bundle:
    """The bundle of a sensor whose pose has a step (6,) before the board ``first``."""
    bundle = SCENE.measured(rng, view_bias=VIEW_BIAS)
    if step is None:
        return bundle
    moved = se3.retract(SCENE.truth.T_root_sensor[sensor], step)
    T_root_sensor = np.tile(SCENE.truth.T_root_sensor[sensor], (BOARDS, 1, 1))
    T_root_sensor[first:] = moved
    views = list(bundle.views)
    exact = SCENE.bundle.views[sensor]
    T = se3.retract(
        se3.inverse(T_root_sensor) @ SCENE.truth.T_root_board, VIEW_BIAS * rng.normal(size=(BOARDS, 6))
    )
    views[sensor] = remeasured(exact, T, rng, 1.0)
    return replace(bundle, views=tuple(views))


def find(bundle: Bundle) -> list[PoseStep]:
    """The steps that are found."""
    return find_pose_steps(bundle, minimize_bundle(bundle, SCENE.truth))


def is_between(step: PoseStep, first: int) -> bool:
    """Whether the board ``first`` may be the first after a step, and few others."""
    return bool(step.before[-1] < first <= step.after[0] <= step.before[-1] + 3)


def test_the_statistic_of_a_given_time_is_chi_squared() -> None:
    statistics = []
    for seed in range(100):
        bundle = measured(np.random.default_rng(seed))
        solution = minimize_bundle(bundle, SCENE.truth)
        released = release_poses(bundle, solution.state, solution.equations)
        # The camera measures all six parameters.
        statistics.append(score_steps(released[1], BOARDS // 2)[0][0])
    assert kstest(statistics, chi2(6).cdf).pvalue > 1e-3


def test_a_step_is_that_of_a_bundle_with_two_sensors(rng: np.random.Generator) -> None:
    """The first-order step, and its statistic, against a solution with separate poses before and after."""
    step = np.array([0.004, -0.003, 0.002, 0.002, -0.001, 0.003])
    bundle = measured(rng, 1, step, 12)
    solution = minimize_bundle(bundle, SCENE.truth)
    released = release_poses(bundle, solution.state, solution.equations)
    squared, steps = score_steps(released[1], 4)
    after = np.arange(BOARDS) >= 12
    camera = bundle.views[1]
    split = replace(
        bundle,
        sensors=(*bundle.sensors, "after"),
        views=(bundle.views[0], camera.select(~after), bundle.views[2], camera.select(after)),
        body=np.arange(4),
        bias_variance=bundle.bias_variance[[0, 1, 2, 1]],
    )
    T = solution.state.T_root_sensor
    solved = minimize_bundle(split, replace(solution.state, T_root_sensor=np.concatenate([T, T[1:2]])))
    found = se3.difference(solved.state.T_root_sensor[3], solved.state.T_root_sensor[1])
    joint = pose_covariance(split, solved.state, solved.equations).reshape(4, 6, 4, 6)
    covariance = joint[1, :, 1] + joint[3, :, 3] - joint[1, :, 3] - joint[3, :, 1]
    assert steps[12 - 4] == pytest.approx(found, abs=0.1 * float(np.sqrt(np.diag(covariance).min())))
    assert squared[12 - 4] == pytest.approx(found @ np.linalg.solve(covariance, found), rel=0.02)


@pytest.mark.parametrize("sensor", range(3))
@pytest.mark.parametrize(
    "step", [(0.02, 0, 0, 0, 0, 0), (0, 0.005, 0, 0, 0.02, 0), (0.03, 0, 0.01, 0, 0.02, 0.05)]
)
def test_a_step_is_found_with_its_sensor_and_time(sensor: int, step: tuple[float, ...]) -> None:
    bundle = measured(np.random.default_rng(sensor), sensor, np.array(step), 11)
    (found,) = find(bundle)
    assert found.sensors == (SENSORS[sensor],)
    assert is_between(found, 11)


def test_two_steps_are_found() -> None:
    rng = np.random.default_rng(0)
    first = measured(rng, 1, np.array([0.02, 0, 0, 0, 0.01, 0]), 7)
    second = measured(rng, 2, np.array([0, 0, 0, 0, 0.03, 0]), 14)
    bundle = replace(first, views=(*first.views[:2], second.views[2]))
    laser, camera = sorted(find(bundle), key=lambda step: len(step.sensors))
    # Beside the laser's step, the root's explains the views nearly as well.
    assert "camera" in camera.sensors
    assert is_between(camera, 7)
    assert laser.sensors == ("laser",)
    assert is_between(laser, 14)


def test_of_two_sensors_either_may_have_moved() -> None:
    bundle = measured(np.random.default_rng(0), 1, np.array([0.02, 0, 0, 0, 0, 0]), 10)
    pair = replace(
        bundle,
        sensors=SENSORS[:2],
        views=bundle.views[:2],
        body=np.arange(2),
        bias_variance=bundle.bias_variance[:2],
    )
    state = replace(SCENE.truth, T_root_sensor=SCENE.truth.T_root_sensor[:2])
    (step,) = find_pose_steps(pair, minimize_bundle(pair, state))
    assert set(step.sensors) == set(SENSORS[:2])


def test_no_more_false_alarms_than_stated() -> None:
    """At most 5 in 1000; one alarm in 300 runs states less than 1.6 % with 95 % confidence, none less than 1 %."""
    alarms = sum(bool(find(measured(np.random.default_rng(seed)))) for seed in range(RIGHT_RUNS))
    assert alarms <= 1
    assert beta.ppf(0.95, alarms + 1, RIGHT_RUNS - alarms) < 0.016


def test_slipping_boards_are_no_steps() -> None:
    """A third of the captures slip by 50 mm between the sensors' measurements."""
    alarms = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        bundle = measured(rng)
        slipped = rng.random(BOARDS) < 1 / 3
        slip = slipped[:, None] * rng.normal(size=(BOARDS, 6)) * np.repeat([0.05, 0.05], 3)
        T = relative_poses(SCENE.truth.T_root_sensor[1], se3.retract(SCENE.truth.T_root_board, slip))
        views = (bundle.views[0], remeasured(SCENE.bundle.views[1], T, rng, 1.0), bundle.views[2])
        alarms += bool(find(replace(bundle, views=views)))
    assert alarms <= 1


def test_a_bump_does_not_rest_on_one_view() -> None:
    """Either a scanner moved before its last four views, or one of these is of something else than the board."""
    moved = measured(np.random.default_rng(0), 2, np.array([0, 0, 0, 0, 0.03, 0]), BOARDS - 4)
    wrong = [wrong_detection(17), wrong_detection(BOARDS - 1)]
    limit, least = chi2.isf([0.1 / (3 * BOARDS), _SINGLE_VIEW_PROBABILITY], 6)
    for bundle, is_bump in [(moved, True), *((one, False) for one in wrong)]:
        solution = minimize_bundle(bundle, SCENE.truth)
        scanner = release_poses(bundle, solution.state, solution.equations)[2]
        assert score_steps(scanner, 4)[0][-1] > limit
        assert (score_without_any_one(scanner, BOARDS - 4) > least) == is_bump


def wrong_detection(board: int) -> Bundle:
    """The bundle in which the scanner detects something 0.1 m beside one board."""
    rng = np.random.default_rng(0)
    bundle = measured(rng)
    T = relative_poses(SCENE.truth.T_root_sensor[2], SCENE.truth.T_root_board)
    T[board] = se3.retract(T[board], np.array([0, 0, 0.1, 0, 0, 0]))
    return replace(bundle, views=(*bundle.views[:2], remeasured(SCENE.bundle.views[2], T, rng, 1.0)))


def test_a_step_has_the_least_views_on_either_side(monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = measured(np.random.default_rng(0), 1, np.array([0.05, 0, 0, 0, 0, 0]), 10)
    monkeypatch.setattr("calgraph.rig.checks.pose_steps._MIN_VIEWS", BOARDS)
    assert find(bundle) == []


def test_views_without_a_time_for_a_step_are_not_selected() -> None:
    assert _select_largest([np.zeros(0), np.zeros(1)]) == (1, 0)
