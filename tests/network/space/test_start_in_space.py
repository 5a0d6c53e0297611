"""From clouds of stationary LiDARs with people to floors, tracks and start poses."""

import numpy as np
import pytest

from calgraph.config import Lidar3dSpec, People, Rig
from calgraph.config.settings import TrackingSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.network.options import NetworkOptions
from calgraph.network.space.floor_plane import level
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.pipeline import observe_clouds
from calgraph.network.space.start import start_in_space
from calgraph.network.space.static_directions import CloudSplitter
from calgraph.parallel.progress import no_progress
from calgraph.sensors import PointCloud
from calgraph.simulation import HallScenario, simulate_hall
from network.space.people_hall import Hall, Lidar, build_hall, build_lidars, mount, simulate_clouds

DURATION = 20.0


def observe(hall: Hall, lidar: Lidar, rng: np.random.Generator, duration: float = DURATION) -> SpaceObservations:
    """What a LiDAR measures."""
    splitter = CloudSplitter()
    for cloud in simulate_clouds(hall, lidar, duration, rng):
        splitter.add(cloud)
    found = observe_clouds(splitter, Lidar3dSpec(topic="lidar"), TrackingSettings(), rng)
    assert isinstance(found, SpaceObservations), found.reason
    return found


def floor_error(found: SpaceObservations, lidar: Lidar) -> Array:
    """(3,) of roll, pitch (rad) and height (m)."""
    T = lidar.T_world_sensor
    true = level(np.append(T[2, :3], T[2, 3]))
    turned = so3.log(found.T_floor_sensor[:3, :3] @ true[:3, :3].T)
    return np.append(turned[:2], found.T_floor_sensor[2, 3] - true[2, 3])


@pytest.mark.parametrize(
    ("target", "roll"), [([8, 5.5, 1.0], 0.1), ([8, 5.5, -1.0], np.pi), ([3, 4.0, 1.0], -0.2)]
)
def test_the_floor_levels_a_tilted_sensor_within_its_stddev(target: list[float], roll: float) -> None:
    """The ceiling, tables and walls are not taken for it, and a sensor may hang upside down."""
    rng = np.random.default_rng(5)
    hall = build_hall(3, DURATION, rng)
    lidar = Lidar(mount(np.array([0.6, 0.7, 3.4]), np.array(target), roll), 32)
    found = observe(hall, lidar, rng)
    error = floor_error(found, lidar)
    stddev = np.sqrt(np.diag(found.floor_covariance))
    assert np.all(np.abs(error) < 3 * stddev)
    assert np.all(stddev < [2e-3, 2e-3, 0.03])
    heights = se3.apply(lidar.T_world_sensor, found.static.points[found.floor_points])[:, 2]
    assert np.quantile(np.abs(heights), 0.99) < 0.06


def test_tracks_are_at_the_fronts_of_people_and_static_points_stand_still() -> None:
    """Centres are on the line of sight to the axis of a body to 5 cm, and nearer by its depth."""
    rng = np.random.default_rng(1)
    hall = build_hall(2, DURATION, rng)
    lidar = build_lidars(1, 32, rng)["lidar_0"]
    found = observe(hall, lidar, rng)
    assert sum(len(np.unique(track.times)) for track in found.tracks) > 0.5 * 2 * DURATION / 0.1
    errors = []
    for track in found.tracks:
        at = se3.apply(lidar.T_world_sensor, track.centers)[:, :2]
        off = min((p.path(track.times - 1000) - at for p in hall.people), key=lambda e: float(np.abs(e).sum()))
        sight = at - lidar.T_world_sensor[:2, 3]
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        errors.append(np.column_stack([np.sum(off * sight, 1), off[:, 1] * sight[:, 0] - off[:, 0] * sight[:, 1]]))
    radial, tangential = np.concatenate(errors).T
    chest = np.concatenate([track.slices for track in found.tracks]) == 1
    assert 0.09 < np.mean(radial[chest]) < 0.16
    assert np.quantile(np.abs(tangential), 0.95) < 0.05
    assert abs(np.median(tangential)) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_network_starts_within_15_cm(seed: int) -> None:
    """Two to four LiDARs of 16 and 32 rings, some upside down, with other clocks."""
    rng = np.random.default_rng(seed)
    hall = build_hall(2 + seed, DURATION, rng)
    lidars = build_lidars(2 + seed % 3, (16, 32)[seed % 2], rng)
    observed = {name: observe(hall, lidar, rng) for name, lidar in lidars.items()}
    rig = Rig(root="lidar_0", target=People(), sensors={name: Lidar3dSpec(topic=name) for name in lidars})
    states = start_in_space(rig, observed, {}, NetworkOptions(), rng, no_progress).states
    assert next(iter(states)) == "lidar_0"
    assert set(states) == set(lidars)
    for name, state in states.items():
        T = se3.inverse(states["lidar_0"].T_root_sensor) @ state.T_root_sensor
        clock = state.clock_offset
        true = se3.inverse(lidars["lidar_0"].T_world_sensor) @ lidars[name].T_world_sensor
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) < 0.15
        assert np.degrees(np.linalg.norm(so3.log(T[:3, :3] @ true[:3, :3].T))) < 0.5
        assert abs(clock - lidars[name].clock) < 0.05


def test_a_hall_without_people_has_no_floor() -> None:
    """Without bodies, floors and walls are the same."""
    rng = np.random.default_rng(0)
    lidar = build_lidars(1, 16, rng)["lidar_0"]
    splitter = CloudSplitter()
    for cloud in simulate_clouds(Hall(build_hall(0, 5.0, rng).boxes, ()), lidar, 5.0, rng):
        splitter.add(cloud)
    found = observe_clouds(splitter, Lidar3dSpec(topic="lidar"), TrackingSettings(), rng)
    assert isinstance(found, Rejected)
    assert "let people walk in its view" in found.reason
    assert isinstance(
        observe_clouds(CloudSplitter(), Lidar3dSpec(topic="lidar"), TrackingSettings(), rng), Rejected
    )


def test_a_hall_without_people_in_which_a_floor_is_found_has_none_to_track() -> None:
    hall = simulate_hall(HallScenario(4, duration=8.0, lidars=("xt32",) * 2, people=0))
    splitter = CloudSplitter()
    for record in hall.recording.records([hall.rig.topics["lidar_2"]]):
        cloud = record.decode()
        assert isinstance(cloud, PointCloud)
        splitter.add(cloud)
    found = observe_clouds(splitter, Lidar3dSpec(topic="lidar"), TrackingSettings(), np.random.default_rng(0))
    assert isinstance(found, Rejected)
    assert found.reason.startswith("no person or vehicle could be tracked")
    assert found.reason.endswith("let people walk in its view")
