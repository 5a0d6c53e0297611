"""Networks of 3-D LiDARs from messages: poses and clocks of a simulated hall."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

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
def test_a_clock_is_uncertain_by_a_sweep_where_points_have_no_times() -> None:
    hall = simulate_hall(HallScenario(5, duration=25.0, lidars=("xt32",) * 2))
    messages = {
        topic: [one.decode() for one in hall.recording.records([topic])] for topic in hall.rig.topics.values()
    }
    clouds = [one for one in messages[hall.rig.topics["lidar_2"]] if isinstance(one, PointCloud)]
    messages[hall.rig.topics["lidar_2"]] = [replace(one, times=None) for one in clouds]
    calibration = calibrate_network(hall.rig, MessageRecording(messages), NetworkOptions())
    assert any("clouds of lidar_2 have no times of points" in one for one in calibration.evidence.remarks)
    _, sensor = calibration.sensors
    assert sensor.clock_offset is not None
    assert sensor.clock_offset_stddev is not None
    # A sweep takes 0.1 s, in which times are equally likely: 29 ms.
    assert 0.029 < sensor.clock_offset_stddev < 0.05
    assert abs(sensor.clock_offset - hall.truth.clock_offsets["lidar_2"]) < 3 * sensor.clock_offset_stddev
