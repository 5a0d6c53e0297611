"""Simulated buildings of bays with a 3-D LiDAR each."""

import numpy as np

from calgraph.geometry import se3
from calgraph.sensors import PointCloud
from calgraph.simulation import HallScenario
from hall_buildings import simulate_building


def test_lidars_of_a_building_measure_its_floor_and_walls() -> None:
    """With the poses of the truth, all points are in the building, and some on its floor."""
    building = simulate_building(HallScenario(2, duration=1.5, lidars=("slow16",) * 4))
    truth, size = building.truth, building.truth.hall.size
    for name, topic in building.rig.topics.items():
        clouds = [record.decode() for record in building.recording.records([topic])]
        assert len(clouds) >= 5
        for cloud in clouds:
            assert isinstance(cloud, PointCloud)
            world = se3.apply(truth.T_world_root @ truth.T_root_sensor[name], cloud.points)
            inside = np.all((world > -0.3) & (world < size + 0.3), axis=1)
            assert inside.mean() > 0.98
            assert np.mean(np.abs(world[:, 2]) < 0.1) > 0.05


def test_a_lidar_of_a_large_building_measures_what_is_near() -> None:
    """Ranges end at 30 m."""
    building = simulate_building(HallScenario(2, duration=1.0, lidars=("slow16",) * 30))
    assert len(building.ranges) == 30
    longest = [float(np.nanmax(ranges)) for ranges in building.ranges.values()]
    assert max(longest) < 30.5
    places = np.array([mount.poses[0][:2, 3] for mount in building.truth.mounts])
    apart = np.linalg.norm(places[:, None] - places, axis=2) + 99 * np.eye(30)
    assert apart.min(axis=1).max() < 15
