"""2-D scanners in a network in space: what they measure, and what of their poses they show."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.config import Lidar2dSpec
from calgraph.geometry import Array, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.network.space.joint import solve_space
from calgraph.network.space.observations import StaticPoints
from calgraph.network.space.start import observe_scanner, stand_on_floor
from calgraph.network.tracking.track import Hits, ScannerTracks, Track
from calgraph.simulation import HallScenario, simulate_hall
from calgraph.surfaces.sensor_states import SensorState
from network.space.space_scenes import build_scene, perturb, prior_of


def track_disc(radius: float) -> Track:
    """A disc that passes at 4 m, hit by a beam each half degree."""
    times = np.arange(0.0, 3.0, 0.1)
    places = np.column_stack([np.full(len(times), 4.0), times - 1.5])
    points: list[Array] = []
    for place in places:
        angles = np.arctan2(place[1], place[0]) + np.radians(np.arange(-10, 10.5, 0.5))
        beams = np.column_stack([np.cos(angles), np.sin(angles)])
        along = beams @ place
        square = radius**2 - (place @ place - along**2)
        hit = square > 0
        points.append(beams[hit] * (along[hit] - np.sqrt(square[hit]))[:, None])
    of = np.repeat(np.arange(len(times)), [len(one) for one in points])
    hits = Hits(np.concatenate(points), times[of], of)
    velocities, covariances = np.tile([0.0, 1.0], (len(times), 1)), np.tile(0.01 * np.eye(2), (len(times), 1, 1))
    return Track(times, places, velocities, covariances, 0, hits)


@pytest.mark.parametrize("inverted", [False, True])
def test_bodies_are_measured_in_the_frame_of_the_scanner(inverted: bool) -> None:
    background = np.array([[5.0, -1.0], [np.nan, np.nan], [5.0, 1.0]])
    spec = Lidar2dSpec(topic="/scan", height=0.4, roll=2.0, pitch=-1.0)
    found = observe_scanner(ScannerTracks((track_disc(0.2),), background, 0.01), spec, inverted)
    assert found.flat
    assert_allclose(found.static.points, [[5.0, -1.0, 0.0], [5.0, 1.0, 0.0]])
    T = found.T_floor_sensor
    assert T[2, 3] == 0.4
    assert (T[2, 2] < 0) == inverted
    assert np.degrees(np.arccos(abs(T[2, 2]))) == pytest.approx(np.hypot(2, 1), abs=0.01)
    centers = found.tracks[0].centers
    bearing = np.arctan2(centers[:, 1], centers[:, 0])
    assert_allclose(bearing, np.arctan2(np.arange(0.0, 3.0, 0.1) - 1.5, 4.0), atol=np.radians(0.3))
    distance = np.hypot(4.0, np.arange(0.0, 3.0, 0.1) - 1.5)
    assert_allclose(np.linalg.norm(centers, axis=1), distance - 0.16, atol=0.02)


@pytest.mark.parametrize(("place", "known"), [(1.0, True), (8.0, False)])
def test_a_stated_height_is_that_over_a_floor_that_is_measured(place: float, known: bool) -> None:
    """A floor 0.3 m over the root's, around x = 0."""
    x, y = np.meshgrid(np.arange(-2.0, 2.0, 0.2), np.arange(-2.0, 2.0, 0.2))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.3)])
    tracks = ScannerTracks((track_disc(0.2),), np.array([[5.0, 1.0]]), 0.01)
    scanner = observe_scanner(tracks, Lidar2dSpec(topic="/scan", height=0.4), False)
    static = StaticPoints(points, np.full(x.size, 0.01), np.full(x.size, 100))
    lidar = replace(scanner, static=static, floor_points=np.ones(x.size, dtype=np.bool_))
    T = se3.pose(np.eye(3), np.array([place, 0.0, 0.4]))
    state, found = stand_on_floor(SensorState(T), scanner, [(SensorState(np.eye(4)), lidar)])
    assert state.T_root_sensor[2, 3] == pytest.approx(0.7 if known else 0.4)
    assert (found.floor_covariance[2, 2] < 0.1**2) == known


@pytest.mark.parametrize("seed", range(2))
def test_walls_and_people_show_the_place_of_a_scanner_and_leave_its_height_open(seed: int) -> None:
    scene = build_scene(seed, duration=20.0, scanner=0.7)
    start = perturb(scene.truth, np.random.default_rng(seed))
    level = scene.truth[2].T_root_sensor.copy()
    yaw = np.arctan2(level[1, 0], level[0, 0])
    level[:3, :3] = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    level[:3, 3] += [0.04, -0.03, 0.2]
    start[2] = SensorState(level)
    prior = prior_of(3)
    prior[2, 2:5] = [0.5, 0.035, 0.035]
    solution = solve_space(scene.observations, start, prior)
    found = solution.states[2].T_root_sensor
    number = np.cumsum(solution.free).reshape(solution.free.shape)[2] - 1
    stddev = np.sqrt(np.diag(solution.covariance))[number[:6]]
    error = se3.difference(found, scene.truth[2].T_root_sensor)
    assert np.linalg.norm(error[:2]) < 0.015
    assert np.degrees(abs(error[5])) < 0.15
    assert np.abs(error[[0, 1, 5]] / stddev[[0, 1, 5]]).max() < 4
    assert found[2, 3] == pytest.approx(level[2, 3], abs=1e-6)
    assert_allclose(stddev[2:5], prior[2, 2:5], rtol=1e-6)
    assert abs(solution.states[2].clock_offset - scene.truth[2].clock_offset) < 0.02
    assert solution.agreement[0, 2] > 2


@pytest.mark.slow
def test_a_mixed_network_is_calibrated() -> None:
    """Two LiDARs and scanners at hips and chests; clocks up to 50 ms apart."""
    hall = simulate_hall(HallScenario(5, duration=20.0, lidars=("vlp16",) * 2, scanners=(0.9, 1.4)))
    found = calibrate_network(hall.rig, hall.recording, NetworkOptions())
    assert found.evidence.unconnected == {}
    for k, name in enumerate(("scanner_1", "scanner_2"), start=2):
        assert found.sensors[k].name == name
        error = hall.truth.T_world_root[:3, :3] @ (
            found[name].T_root_sensor[:3, 3] - hall.truth.T_root_sensor[name][:3, 3]
        )
        assert np.linalg.norm(error[:2]) < 0.06
        assert found[name].verdict.grade == "unobservable"
        assert f"height (z) of {name} is not observable" in found[name].verdict.reason
        assert "state them in rig.yaml" in found[name].verdict.reason
