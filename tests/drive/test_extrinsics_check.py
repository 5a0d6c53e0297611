"""Audits by a drive, from messages."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive, compare_drive_extrinsics
from calgraph.geometry import se2, se3, so3
from calgraph.recording import MessageRecording
from calgraph.result import ExtrinsicsFile
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.sensors import Pose
from drive_scenes import drive, scan_drive


@pytest.mark.slow
def test_odometry_of_wheels_shows_how_far_a_scanner_is_to_the_side() -> None:
    """0.3 m to the left of the axle; the odometry is of base_link, and exports have that frame once."""
    messages = scan_drive({"front": se3.pose(np.eye(3), np.array([0.2, 0.3, 0.0]))}, 32.0)
    times = np.arange(0.0, 32.0, 0.05)
    path = se2.to_se3(drive(times, 2))
    messages["/odom"] = [
        Pose(float(t), "base_link", T[:3, 3], so3.quaternion(T[:3, :3])) for t, T in zip(times, path, strict=True)
    ]
    odometry = {"kind": "trajectory", "topic": "/odom", "frame_id": "base_link"}
    rig = Rig.model_validate(
        {
            "root": "front",
            "target": {"kind": "surroundings"},
            "base": {"wheels": "odom"},
            "sensors": {"front": {"kind": "lidar2d", "topic": "/front"}, "odom": odometry},
        }
    )
    calibration = calibrate_drive(rig, MessageRecording(messages), DriveOptions())
    base = calibration.base
    assert base is not None
    assert base.T_base_root[1, 3] == pytest.approx(0.3, abs=0.01)
    assert abs(base.T_base_root[1, 3] - 0.3) < 3 * np.sqrt(base.covariance[1, 1])
    assert "y of front" not in base.verdict.reason
    assert calibration["odom"].frame_id == "odom"


@pytest.mark.slow
def test_scanners_are_audited_from_messages() -> None:
    """In the plane, from a simulated drive of 32 s, with one scanner moved by 10 cm in the file."""
    T_front_rear = se3.pose(so3.exp(np.array([0.0, 0.0, 3.0])), np.array([-0.8, 0.2, 0.0]))
    messages = scan_drive({"front": np.eye(4), "rear": T_front_rear}, 32.0)
    rig = Rig.model_validate(
        {
            "root": "front",
            "target": {"kind": "surroundings"},
            "base": {"y": 0.0},
            "sensors": {name: {"kind": "lidar2d", "topic": f"/{name}"} for name in ("front", "rear")},
        }
    )
    moved = se3.retract(T_front_rear, np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    file = ExtrinsicsFile(Path("robot.urdf"), FrameTree("robot.urdf", {"rear": FrameLink("front", moved)}))
    calibration, found = compare_drive_extrinsics(rig, MessageRecording(messages), file, DriveOptions())
    rear = found.sensors[0]
    assert rear.outcome != "pass"
    assert max(abs(axis.offset) for axis in rear.axes[:3]) == pytest.approx(0.1, abs=0.02)
    # The scanner in front is at the axle of this robot, and looks ahead.
    base = calibration.base
    assert base is not None
    assert base.frame == "base_link"
    assert base.T_base_root[0, 3] == pytest.approx(0.0, abs=0.01)
    assert base.T_base_root[1, 3] == 0
    assert np.isnan(base.T_base_root[2, 3])
    assert np.arctan2(base.T_base_root[1, 0], base.T_base_root[0, 0]) == pytest.approx(0.0, abs=0.01)
