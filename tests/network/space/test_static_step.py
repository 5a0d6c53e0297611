"""A stationary LiDAR that is bumped: what stands still is elsewhere afterwards, in its frame."""

import numpy as np
import pytest

from calgraph.geometry import Array, se3, so3
from calgraph.network.space.observations import StaticStep
from calgraph.network.space.static_directions import CloudSplitter
from calgraph.sensors import PointCloud

SIZE = np.array([12.0, 9.0, 4.0])
SWEEPS, PERIOD = 200, 0.1


def find_step(move: Array, seed: int, pitch: float = 0.0) -> StaticStep | None:
    """Of 20 s in a box, with a noise of 1 cm, after 10 s of which the sensor is moved (6,), m and degrees."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(np.arange(0, 2 * np.pi, 0.035), np.radians(np.arange(-24.0, 8.0, 2.0)))
    level = np.cos(elevation)
    beams = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    splitter = CloudSplitter()
    T_box_sensor = se3.pose(so3.exp(np.radians([0.0, pitch, 0.0])), np.array([2.0, 3.0, 2.5]))
    for k in range(SWEEPS):
        moved = 2 * k >= SWEEPS
        T = T_box_sensor @ se3.pose(so3.exp(np.radians(move[3:] * moved)), move[:3] * moved)
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
    assert find_step(np.zeros(6), seed) is None


# About the vertical, a sensor that is tilted down meets the floor at the same ranges in most directions.
@pytest.mark.parametrize("axis", range(6))
def test_a_sensor_that_is_moved_along_or_about_an_axis_has_one(axis: int) -> None:
    move = np.zeros(6)
    move[axis] = 0.006 if axis < 3 else 0.2
    step = find_step(move, axis, pitch=30.0)
    assert step is not None
    assert abs(step.time - 110.0) < 0.2
    assert abs(step.shift - np.linalg.norm(move[:3])) < 0.0015
    assert abs(np.degrees(step.turn) - np.linalg.norm(move[3:])) < 0.02


def test_a_sensor_that_falls_has_one() -> None:
    assert find_step(np.array([0.1, 0.0, -0.2, 0.0, 20.0, 0.0]), 0) is not None


def test_a_sensor_without_flat_surroundings_has_none() -> None:
    rng = np.random.default_rng(0)
    splitter = CloudSplitter()
    trees = rng.uniform(2.0, 20.0, size=(300, 1)) * rng.normal(size=(300, 3))
    for k in range(SWEEPS):
        splitter.add(PointCloud(100 + PERIOD * k, "lidar", trees))
    assert (split := splitter.finish()) is not None
    assert split.step is None
