"""calgraph simulate drive: its files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from typer.testing import Result

from calgraph.io.yaml_reading import read_yaml
from calgraph.recording import open_recordings
from calgraph.sensors import PointCloud
from calgraph.simulation import load_truth

Run = Callable[..., Result]


def test_recording_rig_and_ground_truth_are_written(run: Run, tmp_path: Path) -> None:
    run(
        "simulate",
        "drive",
        "-o",
        tmp_path / "a",
        "--rig",
        "mixed",
        "--duration",
        3,
        "--seed",
        1,
        "--world",
        "room",
    )
    rig, truth = read_yaml(tmp_path / "a" / "rig.yaml"), load_truth(tmp_path / "a" / "truth.yaml")
    assert rig["target"] == {"kind": "surroundings"}
    assert truth.T_base_root is not None
    assert 0.2 <= truth.T_base_root[2, 3] <= 1.6
    assert {name: one["kind"] for name, one in rig["sensors"].items()} == {
        "lidar_front": "lidar3d", "lidar_rear": "lidar3d", "odometry": "trajectory", "trajectory": "trajectory",
        "gyroscope": "gyroscope",
    }  # fmt: skip
    assert list(truth.T_root_sensor) == ["lidar_front", "lidar_rear", "odometry", "trajectory", "gyroscope"]
    with open_recordings([tmp_path / "a" / "recording"]) as recording:
        types = {topic.name: topic.type for topic in recording.topics}
        records = [
            record for record in recording.records() if record.topic == rig["sensors"]["lidar_rear"]["topic"]
        ]
    assert types["/odometry/odometry"] == "nav_msgs/msg/Odometry"
    assert types["/gyroscope/imu"] == "sensor_msgs/msg/Imu"
    assert 25 < len(records) < 31
    trajectory = np.loadtxt(tmp_path / "a" / "trajectory.txt")
    assert trajectory.shape == (300, 8)


def test_clouds_are_read_with_times_and_rings(run: Run, tmp_path: Path) -> None:
    run("simulate", "drive", "-o", tmp_path / "a", "--duration", 2, "--seed", 1)
    with open_recordings([tmp_path / "a" / "recording"]) as recording:
        cloud = next(iter(recording.records())).decode()
        assert isinstance(cloud, PointCloud)
        assert cloud.times is not None
        assert cloud.rings is not None
        assert 0.02 < cloud.duration < 0.05
        assert set(cloud.rings.tolist()) <= set(range(16))
