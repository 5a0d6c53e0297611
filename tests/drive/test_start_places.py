"""Heights of LiDARs on a robot that drives on a flat floor."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.sources.lidar import LidarSource
from calgraph.drive.start import MotionStart
from calgraph.drive.start_places import add_heights, leave_open
from calgraph.drive.stated_poses import StatedPose
from calgraph.drive.sweeps import Sweep
from calgraph.errors import Rejected
from calgraph.geometry import Array, se3, so3
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel

UP = so3.exp(np.array([0.2, -0.1, 0.3])) @ [0.0, 0.0, 1.0]
T_ROOT_SENSOR = se3.pose(so3.exp(np.array([0.1, -0.2, 2.5])), np.array([-0.5, 0.1, 0.2]))


def source(T_world_sensor: Array, walls: int, rng: np.random.Generator, floor: bool = True) -> LidarSource:
    """Points of a floor at z = 0, of a ceiling at 2.7 m with fewer, and of walls in between."""
    level = rng.uniform(-5, 5, (900, 3)) * [1, 1, 0] + rng.normal(0, 0.02, (900, 3))
    level[600:, 2] += 2.7
    angle = rng.uniform(0, 2 * np.pi, walls)
    around = np.stack([6 * np.cos(angle), 6 * np.sin(angle), rng.uniform(0, 2.7, walls)], axis=1)
    points = se3.apply(se3.inverse(T_world_sensor), np.concatenate([level if floor else level[:0], around]))
    return LidarSource([Sweep(0.0, points, np.zeros(len(points)), np.zeros(3))], 3, False)


def find(start_height: float, sign: float, floor: bool = True) -> MotionStart | Rejected:
    """The start of a sensor whose height is wrong, by an axis of turning that points up or down."""
    rng = np.random.default_rng(0)
    R = so3.exp(np.array([0.3, 0.2, 0.1]))
    # The root is 0.9 m above the floor; its axis of turning is vertical.
    T_world_root = se3.pose(R, np.array([0.0, 0, 0.9]))
    axis = sign * R.T @ [0.0, 0, 1]
    T = T_ROOT_SENSOR.copy()
    T[:3, 3] += start_height * axis
    start = MotionStart(T, 0.0, 0.7, 0.99, 50, np.array([0.3, 0.0, 0.0]), axis=axis)
    sources = {
        "root": source(T_world_root, 300, rng),
        "rear": source(T_world_root @ T_ROOT_SENSOR, 500, rng, floor),
    }
    return add_heights({"rear": start}, "root", sources, {})["rear"]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("height", [0.0, -0.4])
def test_the_height_is_that_at_which_both_measure_one_floor(height: float, sign: float) -> None:
    found = find(height, sign)
    assert isinstance(found, MotionStart)
    assert_allclose(found.T_root_sensor, T_ROOT_SENSOR, atol=0.01)


def test_without_a_common_floor_the_height_is_open() -> None:
    found = find(0.0, 1.0, floor=False)
    assert isinstance(found, MotionStart)
    assert found.open_height


def test_open_heights_are_as_uncertain_as_robots_are_high() -> None:
    """Of the first of two sensors beside the one that leads, whose pose and clock are free."""
    free = np.zeros((3, 6 + BESIDE_POSE), dtype=bool)
    free[1:, :7] = True
    known = np.diag(np.tile([*[1e-4] * 3, *[1e-6] * 3, 1e-8], 2))
    adjusted = Adjustment(
        [SensorState(np.eye(4))] * 3, [], known, known, free, NoiseModel(np.ones(3), np.ones(4)),
        np.zeros((3, 3)), np.zeros(3), 0.0, responses=[],
    )  # fmt: skip
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.full(3, 0.3), axis=UP)
    widened = leave_open(adjusted, [replace(start, open_height=True), start]).covariance
    change = widened - known
    assert UP @ change[:3, :3] @ UP == pytest.approx(1.0)
    assert np.abs(change[:3, :3] @ np.cross(UP, [1.0, 0.0, 0.0])).max() < 1e-12
    change[:3, :3] = 0.0
    assert np.abs(change).max() == 0.0


def test_heights_are_open_against_a_root_of_open_height() -> None:
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.full(3, 0.3), axis=UP)
    assert start.relative_to(replace(start, open_height=True)).open_height
    assert not start.relative_to(start).open_height


def test_a_stated_height_is_taken() -> None:
    axis = np.array([0.0, 0, 1])
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.array([0.3, 0.0, 0.0]), axis=axis)
    T = T_ROOT_SENSOR.copy()
    T[:3, 3] += [0.3, -0.2, 0.5]
    rng = np.random.default_rng(0)
    sources = {name: source(np.eye(4), 300, rng, floor=False) for name in ("root", "rear")}
    found = add_heights({"rear": start}, "root", sources, {"rear": StatedPose(T, np.eye(6))})["rear"]
    assert isinstance(found, MotionStart)
    assert_allclose(found.T_root_sensor[:3, 3] - T_ROOT_SENSOR[:3, 3], [0, 0, 0.5])


def test_other_starts_stay() -> None:
    start = MotionStart(T_ROOT_SENSOR, 0.0, 0.7, 0.99, 50, np.full(3, 0.3))
    rejected = Rejected("why")
    sources = dict.fromkeys(("root", "rear", "left"), LidarSource([], 3, False))
    assert add_heights({"rear": start, "left": rejected}, "root", sources, {}) == {"rear": start, "left": rejected}
