"""The joint solution of networks in space: right, as certain as it states, and aware of what contradicts it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.geometry import Array, se3, so3
from calgraph.network.space.joint import SpaceSolution, solve_space
from calgraph.network.space.static_surfaces import compare_walls
from calgraph.surfaces.sensor_states import DRIFT, expand_covariance
from network.space.space_scenes import Scene, build_scene, perturb, prior_of


def solve(scene: Scene, seed: int = 0, bias: float = 0.02, scale: float = 0.003) -> SpaceSolution:
    start = perturb(scene.truth, np.random.default_rng(seed))
    return solve_space(scene.observations, start, prior_of(len(start), bias, scale))


def errors_of(solution: SpaceSolution, scene: Scene) -> list[tuple[Array, Array]]:
    """Of each sensor besides the root, errors (7,) of pose and clock, and their covariance (7, 7)."""
    number = np.cumsum(solution.free).reshape(solution.free.shape) - 1
    return [
        (state.deviation_from(true)[:7], solution.covariance[np.ix_(number[k, :7], number[k, :7])])
        for k, (state, true) in enumerate(zip(solution.states, scene.truth, strict=True))
        if k
    ]


def test_sensors_are_found_to_millimetres_and_their_clocks() -> None:
    """From starts that are 9 cm and 0.3 degrees off; ranges are exact but for noise."""
    scene = build_scene(0)
    for error, covariance in errors_of(solve(scene, bias=0.001, scale=1e-4), scene):
        assert np.linalg.norm(error[:3]) < 0.006
        assert np.degrees(np.linalg.norm(error[3:6])) < 0.05
        assert abs(error[6]) < 0.004
        assert np.all(np.abs(error) < 4.5 * np.sqrt(np.diag(covariance)))


@pytest.mark.slow
def test_errors_are_as_large_as_stated() -> None:
    """6 sensors in 3 halls: with biases of ranges, within the 99.9 % limits of their mean."""
    squares = []
    for seed in range(3):
        scene = build_scene(seed, bias=0.02)
        for error, covariance in errors_of(solve(scene, seed), scene):
            squares.append(error[:6] @ np.linalg.solve(covariance[:6, :6], error[:6]))
    total = 6 * len(squares)
    assert chi2.ppf(0.0005, total) / 3 < sum(squares) < chi2.ppf(0.9995, total) * 1.5


@pytest.mark.slow
def test_errors_of_outlines_do_not_change_the_size_of_a_network() -> None:
    """Bodies that are measured up to 20 mm too near, by the square of the distance, which no shape explains."""
    scene = build_scene(100, people=4)
    nearer = [
        replace(one, tracks=tuple(replace(t, centers=_bring_nearer(t.centers)) for t in one.tracks))
        for one in scene.observations
    ]
    exact, other = (
        [state.T_root_sensor[:2, 3] for state in solve(one, scale=0.02).states]
        for one in (scene, replace(scene, observations=nearer))
    )
    for k in range(1, len(exact)):
        ratio = np.linalg.norm(other[k] - other[0]) / np.linalg.norm(exact[k] - exact[0])
        assert abs(ratio - 1) < 5e-5


def _bring_nearer(centers: Array) -> Array:
    distance = np.linalg.norm(centers, axis=1, keepdims=True)
    return np.asarray(centers * (1 - 2e-4 * distance))


def test_nothing_changes_where_nothing_does_and_maps_agree() -> None:
    solution = solve(build_scene(1))
    assert not solution.changes
    assert solution.squared_step < 0.1
    assert np.all(solution.agreement[0, 1:] > 8)
    assert np.all(solution.balance[0, 1:] > 0.8)


@pytest.mark.parametrize("move", [(0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.02)])
def test_maps_of_a_sensor_that_is_elsewhere_do_not_agree(move: tuple[float, ...]) -> None:
    scene = build_scene(1)
    x, y, yaw = move
    T = se3.pose(so3.exp(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.0]))
    states = [*scene.truth[:-1], replace(scene.truth[-1], T_root_sensor=T @ scene.truth[-1].T_root_sensor)]
    _, balance = compare_walls(
        [one.static.points for one in scene.observations], states, np.zeros(len(states), dtype=np.bool_)
    )
    assert np.all(balance[-1, :-1] < 0.5)


@pytest.mark.parametrize("seed", [0, 1, 3, 4])
def test_a_clock_that_jumps_is_named(seed: int) -> None:
    """In one hall, people whom the third sensor measured show the jump nearly as well as one of another clock."""
    solution = solve(build_scene(seed, jump=0.15, duration=40.0))
    (change, *_) = solution.changes
    assert change.kind == "clock"
    assert 2 in change.sensors
    assert change.sensors == (2,) or seed == 3
    assert change.time is not None
    assert abs(change.time - 20.0) < 3.1
    assert abs(change.size[0]) > 0.05


@pytest.mark.slow
def test_a_clock_that_drifts_as_it_may_is_corrected() -> None:
    """A minute shows a drift of 0.1 % to a fifth; where clocks must not drift, it is a change."""
    scene = build_scene(0, duration=60.0, drift=1e-3)
    start = perturb(scene.truth, np.random.default_rng(0))
    fixed, free = (solve_space(scene.observations, start, prior_of(3, drift=one)) for one in (0.0, 1e-3))
    assert [one.sensors for one in fixed.changes if one.kind == "clock"] == [(2,)]
    assert not free.changes
    stddev = float(np.sqrt(np.diag(expand_covariance(free.covariance, free.free))[DRIFT]))
    drift = free.states[2].timing[0]
    assert abs(drift - 1e-3) < 3 * stddev
    assert stddev < 2.5e-4
    assert abs(free.states[2].clock_offset - scene.truth[2].clock_offset) < 0.004


def test_a_network_without_common_people_has_no_changes() -> None:
    """Walls alone place its sensors; clocks stay open."""
    scene = build_scene(4, duration=4.0, people=0)
    solution = solve(scene)
    assert not solution.persons
    assert list(solution.changes) == []
    for error, covariance in errors_of(solution, scene):
        assert np.linalg.norm(error[:3]) < 0.05
        assert np.sqrt(covariance[6, 6]) > 0.09
