"""Vehicles that two levelled sensors measure, each on its own side."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.config.settings import TrackingSettings
from calgraph.geometry import Array, se2, se3, se_n
from calgraph.network.scanner_pairs import CorrectedPairs
from calgraph.network.space.joint import solve_space
from calgraph.network.space.observations import BodyTrack, SpaceObservations, StaticPoints
from calgraph.network.space.static_directions import MovingPoints
from calgraph.network.space.vehicle_pairs import find_vehicle_pairs, reduce_vehicles
from calgraph.network.space.vehicle_start import pair_by_vehicles
from calgraph.network.space.vehicles import find_vehicles
from calgraph.network.tracking.track import ScannerTracks
from calgraph.surfaces.sensor_states import SensorState, move_states
from network.space.space_scenes import Scene, build_scene, perturb, prior_of

_T_A_B = se2.pose(2.0, np.array([6.0, -3.0]))
_LEVEL = se3.from_xyz_quaternion(np.array([0.0, 0.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0]))
_CLOCK = 0.03


def test_a_vehicle_is_followed_by_a_point_of_it_while_other_sides_appear() -> None:
    times, poses = _drive(12.0)
    moving = _measure(times, poses, np.array([1.2, 0.6]), np.random.default_rng(0))

    tracks = find_vehicles(moving, _LEVEL, TrackingSettings())

    assert sum(float(np.ptp(one.times)) for one in tracks) > 8.0
    for track in tracks:
        assert track.yaws is not None
        true = np.column_stack([np.interp(track.times, times, column) for column in poses.T])
        ahead = _turn(track.yaws)
        off = se_n.apply(_LEVEL, track.centers)[:, :2] - true[:, :2]
        offset = np.einsum("nji,nj->ni", ahead, off)
        assert np.sqrt(np.mean(np.var(offset, axis=0))) < 0.06
        assert np.std(track.yaws - true[:, 2]) < np.radians(3)


def test_what_is_as_small_as_a_person_is_no_vehicle() -> None:
    times, poses = _drive(12.0)
    moving = _measure(times, poses, np.array([0.3, 0.2]), np.random.default_rng(0))

    assert find_vehicles(moving, _LEVEL, TrackingSettings()) == ()


@pytest.mark.parametrize("seed", range(3))
def test_poses_are_found_without_a_guess_from_different_points_of_a_vehicle(seed: int) -> None:
    observed = _observe(np.random.default_rng(seed))

    (pair,) = pair_by_vehicles(observed, _without_people(observed), frozenset("a")).values()

    error = se2.difference(pair.T_a_b, _T_A_B)
    assert np.hypot(error[0], error[1]) < 0.15
    assert abs(error[2]) < np.radians(1.5)
    assert abs(pair.hypotheses[0].clock_offset - _CLOCK) < 0.04


def test_vehicles_that_drive_straight_ahead_connect_nothing() -> None:
    """Where along their way, and beside it, each sensor follows them is not known."""
    observed = _observe(np.random.default_rng(0), straight=True)

    assert not pair_by_vehicles(observed, _without_people(observed), frozenset("a"))


def test_vehicles_that_a_second_sensor_did_not_measure_connect_nothing() -> None:
    observed = _observe(np.random.default_rng(0))
    other = _observe(np.random.default_rng(9), seed=5)

    assert not pair_by_vehicles({"a": observed["a"], "b": other["b"]}, _without_people(observed), frozenset("a"))


def test_clocks_that_people_showed_are_those_of_vehicles() -> None:
    """Both clocks are 2 s ahead, as is known; that of b is 0.03 s ahead of a's besides."""
    observed = {
        name: replace(one, vehicles=tuple(replace(track, times=track.times + 2.0) for track in one.vehicles))
        for name, one in _observe(np.random.default_rng(0)).items()
    }
    known = replace(_without_people(observed), clock_offset={"a": 2.0, "b": 2.0})
    (pair,) = pair_by_vehicles(observed, known, frozenset("a")).values()
    assert abs(pair.hypotheses[0].clock_offset - _CLOCK) < 0.04


def test_sensors_that_people_connect_are_not_paired_again() -> None:
    observed = _observe(np.random.default_rng(0))
    assert not pair_by_vehicles(observed, _without_people(observed), frozenset("ab"))


def test_a_third_sensor_of_unknown_pose_determines_no_other() -> None:
    a, b = _observe(np.random.default_rng(0)).values()
    c = _observe(np.random.default_rng(1))["b"]
    T = np.asarray(se2.to_se3(_T_A_B) @ _LEVEL)
    states = [SensorState(_LEVEL), SensorState(T, _CLOCK), SensorState(T, _CLOCK)]
    free = np.zeros((3, 12), dtype=np.bool_)
    free[1:, [0, 1, 5, 6]] = True
    two, three = (
        np.sqrt(
            np.diag(
                np.linalg.inv(reduce_vehicles(find_vehicle_pairs(some, states, 0.5), states, free[:n]).information)
            )
        )
        for some, n in (([a, b], 2), ([a, b, c], 3))
    )
    np.testing.assert_allclose(three[:4], two, rtol=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_vehicles_correct_poses_and_clocks_with_the_covariance_that_they_state(seed: int) -> None:
    observed = list(_observe(np.random.default_rng(seed)).values())
    start = se2.retract(_T_A_B, np.array([0.2, -0.1, 0.02]))
    states = [SensorState(_LEVEL), SensorState(np.asarray(se2.to_se3(start) @ _LEVEL))]
    free = np.zeros((2, 12), dtype=np.bool_)
    free[1, [0, 1, 5, 6]] = True

    for gate in (0.5, 0.3, 0.3, 0.3):
        driven = reduce_vehicles(find_vehicle_pairs(observed, states, gate), states, free)
        step = np.asarray(-np.linalg.solve(driven.information, driven.gradient), dtype=np.float64)
        states = move_states(states, free, step)

    T = states[1].T_root_sensor
    error = np.array([*(T[:2, 3] - _T_A_B[:2, 2]), np.arctan2(T[1, 0], T[0, 0]) - 2.0])
    error = np.append(error, states[1].clock_offset - _CLOCK)
    assert np.hypot(error[0], error[1]) < 0.05
    assert error @ driven.information @ error < 20


def test_errors_of_registrations_do_not_change_the_size_of_a_network() -> None:
    """Vehicles that are measured 0.3 % too near: walls determine the size."""
    scene = build_scene(0, duration=32.0, people=0)
    start, prior = perturb(scene.truth, np.random.default_rng(0)), prior_of(3)
    exact, other = (solve_space(_drive_through(scene, scale), start, prior).states for scale in (1.0, 0.997))
    for k in (1, 2):
        near, far = (
            np.linalg.norm(some[k].T_root_sensor[:3, 3] - some[0].T_root_sensor[:3, 3]) for some in (other, exact)
        )
        assert abs(near / far - 1) < 1e-4


@pytest.mark.parametrize("sensor", [0, 1])
@pytest.mark.parametrize("number", [6, 9])
def test_gradients_by_a_clock_and_its_drift(sensor: int, number: int) -> None:
    """Of tracks without noise, so that second derivatives do not count; both clocks are 5 s ahead."""
    observed = [
        replace(one, vehicles=tuple(replace(track, times=track.times + 5.0) for track in one.vehicles))
        for one in _observe(np.random.default_rng(0), noise=0.0).values()
    ]
    T = np.asarray(se2.to_se3(_T_A_B) @ _LEVEL)
    states = [SensorState(_LEVEL, 5.0, mid_time=15.0), SensorState(T, 5.0 + _CLOCK, mid_time=19.0)]
    free = np.zeros((2, 12), dtype=np.bool_)
    free[sensor, [5, number]] = True
    pairs, step = find_vehicle_pairs(observed, states, 0.5), np.zeros(2)
    step[1] = 1e-3
    forth, back = (
        reduce_vehicles(pairs, move_states(states, free, sign * step), free).gradient for sign in (1.0, -1.0)
    )
    exact = reduce_vehicles(pairs, states, free).information[:, 1]
    np.testing.assert_allclose(((forth - back) / 2e-3)[1], exact[1], rtol=0.1)


def test_an_eliminated_direction_is_not_determined() -> None:
    """That in which the second sensor moves along x and the other way along y; others stay determined."""
    observed = list(_observe(np.random.default_rng(0)).values())
    states = [SensorState(_LEVEL), SensorState(np.asarray(se2.to_se3(_T_A_B) @ _LEVEL), _CLOCK)]
    free = np.zeros((2, 12), dtype=np.bool_)
    free[1, [0, 1, 5, 6]] = True
    driven = reduce_vehicles(find_vehicle_pairs(observed, states, 0.5), states, free)
    direction = np.array([1.0, -1.0, 0.0, 0.0])
    left = driven.without(direction)
    for all_of, rest in (
        (driven.information, left.information), (driven.gradient, left.gradient), (driven.scores, left.scores)
    ):  # fmt: skip
        assert np.abs(all_of @ direction).max() > 1.0
        np.testing.assert_allclose(rest @ direction, 0.0, atol=1e-6)
    assert np.linalg.matrix_rank(left.information, tol=1e-3) == 3


def _drive_through(scene: Scene, scale: float) -> list[SpaceObservations]:
    """What sensors measured, with a vehicle at a scale of its places."""
    times, poses = _drive(32.0)
    places = np.column_stack([poses[:, :2] - poses[:, :2].mean(axis=0) + [7.0, 5.0], np.full(len(times), 0.8)])
    observed = []
    for one, state in zip(scene.observations, scene.truth, strict=True):
        centers = scale * se_n.apply(se_n.inverse(state.T_root_sensor), places)
        stddev, slices = np.full(len(times), 0.05), np.zeros(len(times), dtype=np.intp)
        track = BodyTrack(times + state.clock_offset, centers, stddev, stddev, slices, poses[:, 2])
        observed.append(replace(one, T_floor_sensor=state.T_root_sensor, vehicles=(track,)))
    return observed


def _drive(duration: float, seed: int = 0, straight: bool = False) -> tuple[Array, Array]:
    """Times (T,) and x, y, yaw (T, 3) on a winding way of changing speed, which returns; or straight ahead."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, duration, 0.1)
    speed = 1.1 + 0.5 * np.sin(0.5 * times + rng.uniform(0, 6))
    yaw = rng.uniform(0, 6) + 1.5 * np.sin(0.31 * times + rng.uniform(0, 6)) + 0.17 * times
    yaw = np.full(len(times), 0.3) if straight else yaw
    step = 0.1 * speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return times, np.column_stack([np.array([4.0, 1.0]) + np.cumsum(step, axis=0), yaw])


def _turn(yaw: Array) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c, -s, s, c], axis=-1).reshape(-1, 2, 2)


def _measure(times: Array, poses: Array, half: Array, rng: np.random.Generator) -> MovingPoints:
    """The sides of a box that face a sensor at the origin, with a cabin on one half of it."""
    points, sweep = [], []
    edge = np.linspace(-1, 1, 15)
    for k, (x, y, yaw) in enumerate(poses):
        R = _turn(np.array([yaw]))[0]
        for height in (0.4, 0.7, 1.0, 1.3):
            low, high = (-half, half) if height < 0.9 else (-half, half * [0.0, 1.0])
            middle, size = (low + high) / 2, (high - low) / 2
            for normal in np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]):
                side = middle + size * (normal + edge[:, None] * normal[::-1])
                at = side @ R.T + [x, y]
                if (R @ normal) @ at.mean(axis=0) < 0:
                    points.append(np.column_stack([at, np.full(len(at), height)]))
                    sweep.append(np.full(len(at), k))
    every = np.concatenate(points) + rng.normal(0, 0.01, (sum(map(len, points)), 3))
    index = np.concatenate(sweep)
    return MovingPoints(se_n.apply(se_n.inverse(_LEVEL), every), times[index], index, 0.1)


def _observe(
    rng: np.random.Generator, seed: int = 0, noise: float = 0.03, straight: bool = False
) -> dict[str, SpaceObservations]:
    """Two sensors, of which each follows another point of each of two vehicles, for 8 s at a time."""
    to_b = se2.inverse(_T_A_B)
    sensors = {"a": (np.eye(3), 0.0), "b": (to_b, _CLOCK)}
    found = {}
    for name, (T, clock) in sensors.items():
        tracks = []
        for vehicle in range(2):
            times, poses = _drive(32.0, 10 * seed + vehicle, straight)
            for part in np.split(np.arange(0, len(times), 2), 4):
                offset = rng.uniform(-0.4, 0.4, 2)
                at = poses[part, :2] + np.einsum("nij,j->ni", _turn(poses[part, 2]), offset)
                at = se2.apply(T, at) + rng.normal(0, noise, (len(part), 2))
                yaws = poses[part, 2] + float(np.arctan2(T[1, 0], T[0, 0]))
                centers = np.column_stack([at, np.full(len(at), -2.2)])
                stddev = np.full(len(part), 0.05)
                slices = np.zeros(len(part), dtype=np.intp)
                tracks.append(BodyTrack(times[part] + clock, centers, stddev, stddev, slices, yaws))
        static = StaticPoints(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.intp))
        nothing = SpaceObservations(
            _LEVEL, 1e-6 * np.eye(3), static, np.zeros(0, dtype=np.bool_), (), np.array([[0.0, 33.0]])
        )
        found[name] = replace(nothing, vehicles=tuple(tracks))
    return found


def _without_people(observed: dict[str, SpaceObservations]) -> CorrectedPairs:
    return CorrectedPairs({name: ScannerTracks((), np.zeros((0, 2)), 0.02) for name in observed}, {})
