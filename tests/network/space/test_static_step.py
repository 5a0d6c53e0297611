"""A stationary LiDAR that is bumped: what stands still is at other ranges afterwards."""

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.network.space.observations import StaticStep
from calgraph.network.space.static_directions import CloudSplitter
from calgraph.sensors import PointCloud

SIZE = np.array([12.0, 9.0, 4.0])
SWEEPS, PERIOD = 200, 0.1


def find_step(turn: float, seed: int) -> StaticStep | None:
    """Of 20 s in a box with a noise of 1 cm, after 10 s of which the sensor is turned by degrees."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(np.arange(0, 2 * np.pi, 0.035), np.radians(np.arange(-24.0, 8.0, 2.0)))
    level = np.cos(elevation)
    beams = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    splitter = CloudSplitter()
    for k in range(SWEEPS):
        R = so3.exp(np.radians([0.0, turn, 0.0])) if 2 * k >= SWEEPS else np.eye(3)
        T = se3.pose(R, np.array([2.0, 3.0, 2.5]))
        directions: Array = beams @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            ranges = np.maximum((0 - T[:3, 3]) / directions, (SIZE - T[:3, 3]) / directions).min(axis=1)
        ranges += 0.01 * rng.normal(size=len(ranges))
        splitter.add(PointCloud(100 + PERIOD * k, "lidar", beams * ranges[:, None]))
    split = splitter.finish()
    assert split is not None
    return split.step


@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_that_rests_has_no_step(seed: int) -> None:
    assert find_step(0.0, seed) is None


def test_a_sensor_that_is_turned_by_half_a_degree_has_one() -> None:
    step = find_step(0.5, 0)
    assert step is not None
    assert abs(step.time - 110.0) < 0.2
    # The median over directions: floors are met at an angle, walls ahead are not.
    assert 0.002 < step.size < 0.05
