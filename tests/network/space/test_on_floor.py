"""The floor as the root: what is not known of it, and calibrations with and without it."""

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.errors import InputError
from calgraph.geometry import Array, plane, se3, so3
from calgraph.network.space.floor_plane import level
from calgraph.network.space.observations import SpaceObservations, StaticPoints
from calgraph.network.space.on_floor import express_on_floor, leave_floor, spread_floor
from calgraph.result import Calibration, SensorPose, Verdict

TILTS = [(0.3, 0.5), (-2.9, 0.2), (0.1, 1.55)]
"""Roll and pitch, the last with x near the vertical, rad."""


def tilted(roll: float, pitch: float) -> Array:
    """A levelled sensor 3 m over the floor."""
    R = so3.exp(np.array([0.0, pitch, 0.0])) @ so3.exp(np.array([roll, 0.0, 0.0]))
    return level(np.append(R[2], 3.0))


@pytest.mark.parametrize(("roll", "pitch"), TILTS)
def test_errors_of_the_floor_move_all_sensors_as_another_floor_does(roll: float, pitch: float) -> None:
    """A floor that is tilted by 1e-6 rad and 1e-6 m lower; linear theory against levelling again."""
    T_first = tilted(roll, pitch)
    T_second = T_first @ se3.pose(so3.exp(np.array([0.2, -0.4, 1.0])), np.array([4.0, -3.0, 0.5]))
    error = 1e-6 * np.array([0.7, -0.4, 1.0])
    moved = se3.pose(so3.exp(np.append(error[:2], 0.0)) @ T_first[:3, :3], np.array([0.0, 0.0, 3.0 + error[2]]))
    again = level(plane.transform(se3.inverse(moved), np.array([0.0, 0.0, 1.0, 0.0])))
    T_floor_first = again @ se3.inverse(T_first)
    found = np.concatenate([se3.difference(T_floor_first @ T, T) for T in (T_first, T_second)])
    np.testing.assert_allclose(
        spread_floor([T_first, T_second], np.outer(error, error)), np.outer(found, found), atol=1e-15
    )


def network(T_floor_first: Array) -> tuple[Calibration, SpaceObservations]:
    """Three sensors rooted at the first, and what that measured."""
    rng = np.random.default_rng(0)
    T = [np.eye(4), *(se3.pose(so3.exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))]
    sensors = tuple(
        SensorPose(f"lidar_{k}", f"lidar_{k - 1}" if k else None, f"lidar_{k}", "lidar3d", one, Verdict("good"))
        for k, one in enumerate(T)
    )
    A = 0.01 * rng.normal(size=(12, 12))
    nothing = StaticPoints(np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.intp))
    observed = SpaceObservations(
        T_floor_first, np.diag([1e-6, 2e-6, 1e-4]), nothing, np.zeros(0, dtype=np.bool_), (), np.zeros((0, 2))
    )
    return Calibration("lidar_0", sensors, np.pad(A @ A.T, (6, 0))), observed


def test_relative_poses_are_the_same_with_the_floor_as_root_and_without_it() -> None:
    found, observed = network(tilted(0.3, 0.5))
    on_floor = express_on_floor(found, observed)
    assert [(one.name, one.parent) for one in on_floor.sensors][:2] == [("floor", None), ("lidar_0", "floor")]
    np.testing.assert_allclose(on_floor["lidar_0"].T_root_sensor, observed.T_floor_sensor)
    assert on_floor["lidar_0"].covariance[2, 2] == pytest.approx(1e-4)
    assert on_floor["lidar_0"].covariance[0, 0] == 0.0
    np.testing.assert_allclose(on_floor.transform("lidar_1", "lidar_2"), found.transform("lidar_1", "lidar_2"))
    back = leave_floor(on_floor, "lidar_0")
    assert [(one.name, one.parent) for one in back.sensors] == [(one.name, one.parent) for one in found.sensors]
    np.testing.assert_allclose(back.joint_covariance, found.joint_covariance, atol=1e-12)


def test_a_floor_below_an_unknown_sensor_cannot_be_extended() -> None:
    with pytest.raises(InputError, match=r"`extend`: has no lidar_9, the first 3-D LiDAR"):
        leave_floor(express_on_floor(*network(tilted(0.3, 0.5))), "lidar_9")


@pytest.mark.parametrize(
    ("kind", "target"), [("lidar2d", {"kind": "people"}), ("lidar3d", {"kind": "surroundings"})]
)
def test_the_floor_is_the_root_of_networks_of_lidars_only(kind: str, target: dict[str, str]) -> None:
    sensors = {"one": {"kind": kind, "topic": "/one"}, "two": {"kind": kind, "topic": "/two"}}
    with pytest.raises(ValueError, match=r"'floor' needs 3-D LiDARs in target: \{kind: people\}"):
        Rig.model_validate({"root": "floor", "target": target, "sensors": sensors})
