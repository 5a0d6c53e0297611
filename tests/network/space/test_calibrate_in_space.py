"""Networks of 3-D LiDARs from messages: poses and clocks of a simulated hall."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Tolerance
from calgraph.geometry import Array, se3
from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network, compare_network_extrinsics
from calgraph.recording.record_list import MessageRecording
from calgraph.result import ExtrinsicsFile
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.sensors import PointCloud
from calgraph.simulation import HallScenario, simulate_hall


def given(poses: Mapping[str, Array], moved: str) -> ExtrinsicsFile:
    """The poses (4, 4) by sensor, the root first, with one sensor 0.5 m higher."""
    root, *others = poses
    up = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    links = {name: FrameLink(root, se3.retract(poses[name], up * (name == moved))) for name in others}
    return ExtrinsicsFile(Path("hall.urdf"), FrameTree("hall.urdf", links))


@pytest.mark.slow
def test_lidars_of_a_hall_are_calibrated_and_checked() -> None:
    """Bodies and walls that the estimator does not know; clocks up to 50 ms apart."""
    hall = simulate_hall(HallScenario(5, duration=25.0, lidars=("xt32",) * 3))
    file = given(hall.truth.T_root_sensor, "lidar_3")
    calibration, found = compare_network_extrinsics(hall.rig, hall.recording, file, NetworkOptions())
    assert found.failed == ("lidar_3",)
    assert calibration.evidence.unconnected == {}
    assert not any("no times of points" in one for one in calibration.evidence.remarks)
    drifts = [(one.of, one.quantity, one.prior) for one in calibration.systematic]
    assert drifts == [(name, "clock drift", 3e-5) for name in ("lidar_2", "lidar_3")]
    assert all(abs(one.value) < 3 * one.stddev < 3e-4 for one in calibration.systematic)
    for k, sensor in enumerate(calibration.sensors[1:], start=1):
        block = slice(6 * k, 6 * k + 6)
        error = se3.difference(sensor.T_root_sensor, hall.truth.T_root_sensor[sensor.name])
        stddev = np.sqrt(np.diag(calibration.joint_covariance[block, block]))
        assert np.abs(error / stddev).max() < 4
        assert np.linalg.norm(error[:3]) < 0.06
        assert np.degrees(np.linalg.norm(error[3:])) < 0.3
        assert sensor.clock_offset == pytest.approx(hall.truth.clock_offsets[sensor.name], abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lidar_1", "lidar_2"])
def test_a_clock_is_uncertain_by_a_sweep_where_points_have_no_times(name: str) -> None:
    """Of the root as well, as clocks are relative to it."""
    hall = simulate_hall(HallScenario(5, duration=25.0, lidars=("xt32",) * 2))
    messages = {
        topic: [one.decode() for one in hall.recording.records([topic])] for topic in hall.rig.topics.values()
    }
    clouds = [one for one in messages[hall.rig.topics[name]] if isinstance(one, PointCloud)]
    messages[hall.rig.topics[name]] = [replace(one, times=None) for one in clouds]
    calibration = calibrate_network(hall.rig, MessageRecording(messages), NetworkOptions())
    assert any(f"clouds of {name} have no times of points" in one for one in calibration.evidence.remarks)
    _, sensor = calibration.sensors
    assert sensor.clock_offset is not None
    assert sensor.clock_offset_stddev is not None
    # A sweep takes 0.1 s, and times are equally likely up to that before and after the stamp: 58 ms.
    assert 0.057 < sensor.clock_offset_stddev < 0.08
    assert abs(sensor.clock_offset - hall.truth.clock_offsets["lidar_2"]) < 3 * sensor.clock_offset_stddev


@pytest.mark.slow
def test_lidars_that_vehicles_alone_connect_are_weak_with_any_tolerance() -> None:
    hall = simulate_hall(HallScenario(3, duration=30.0, lidars=("vlp16",) * 2, people=0, carts=3))
    rig = hall.rig.model_copy(update={"tolerance": Tolerance(translation=1.0, rotation=5.0)})
    calibration = calibrate_network(rig, hall.recording, NetworkOptions())
    assert calibration.evidence.unconnected == {}
    remark = "vehicles connect lidar_2 to the others, along whose ways poses may be wrong"
    assert any(one.startswith(remark) for one in calibration.evidence.remarks)
    sensor = calibration["lidar_2"]
    assert sensor.verdict.grade == "weak"
    assert remark in sensor.verdict.reason
    error = se3.difference(sensor.T_root_sensor, hall.truth.T_root_sensor["lidar_2"])
    assert np.abs(error / np.sqrt(np.diag(sensor.covariance))).max() < 5
