"""Audits by a drive, from messages."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.drive.audit import compare_drive_extrinsics
from calgraph.drive.options import DriveOptions
from calgraph.geometry import se3, so3
from calgraph.recording import MessageRecording
from calgraph.result import ExtrinsicsFile
from calgraph.result.frame_tree import FrameLink, FrameTree
from drive_scenes import scan_drive


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
