"""Audits by a drive: which sensor has moved, and what a drive leaves open."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.drive.audit import compare_drive_extrinsics, compare_with_drive
from calgraph.drive.options import DriveOptions
from calgraph.geometry import Array, se3, so3
from calgraph.recording import MessageRecording
from calgraph.result import Calibration, ExtrinsicsFile, SensorPose, Verdict
from calgraph.result.frame_tree import FrameLink, FrameTree
from drive_scenes import scan_drive

POSES = {
    "front": np.eye(4),
    "left": se3.pose(so3.exp(np.array([0.1, 0.0, 1.5])), np.array([-0.3, 0.4, 0.1])),
    "rear": se3.pose(so3.exp(np.array([0.0, 0.1, 3.0])), np.array([-1.0, 0.1, 0.2])),
}


def rig_of(kind: str = "lidar3d", tolerance: tuple[float, float] = (0.005, 0.05)) -> Rig:
    return Rig.model_validate(
        {
            "root": "front",
            "target": {"kind": "surroundings"},
            "tolerance": {"translation": tolerance[0], "rotation": tolerance[1]},
            "sensors": {name: {"kind": kind, "topic": f"/{name}"} for name in POSES},
        }
    )


def calibrated(stddev: float, reason: str = "") -> Calibration:
    verdict = Verdict("weak", reason) if reason else Verdict("good")
    sensors = tuple(
        SensorPose(name, None if name == "front" else "front", name, "lidar3d", T, verdict)
        for name, T in POSES.items()
    )
    covariance = np.diag([*[0.0] * 6, *[*[stddev**2] * 3, *[(stddev / 10) ** 2] * 3] * 2])
    return Calibration("front", sensors, covariance)


def given(moved: str, shift: Array) -> ExtrinsicsFile:
    poses = {name: se3.retract(T, shift) if name == moved else T for name, T in POSES.items()}
    links = {
        name: FrameLink("front", se3.inverse(poses["front"]) @ T) for name, T in poses.items() if name != "front"
    }
    return ExtrinsicsFile(Path("robot.urdf"), FrameTree("robot.urdf", links))


BUMP = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("moved", POSES)
def test_the_sensor_that_moved_fails(moved: str) -> None:
    """The root, too: then the others are as they were relative to each other."""
    found = compare_with_drive(rig_of(), calibrated(0.001), given(moved, BUMP))
    assert found.failed == (moved,)


def test_sensors_in_place_pass() -> None:
    found = compare_with_drive(rig_of(), calibrated(0.001), given("left", 0.02 * BUMP))
    assert found.outcome == "pass"


def test_a_pose_that_is_contradicted_fails_nothing() -> None:
    doubted = calibrated(0.001, "the joint adjustment has not converged")
    found = compare_with_drive(rig_of(), doubted, given("left", BUMP))
    left = next(one for one in found.sensors if one.sensor == "left")
    assert found.outcome == left.outcome == "warn"
    assert "-19.9 mm (σ 1.0 mm), beyond 5.0 mm" in left.reason
    assert "not decided: the joint adjustment has not converged" in left.reason


def test_a_pose_that_is_only_uncertain_fails_what_is_far_off() -> None:
    uncertain = calibrated(0.004, "position ±8 mm (95 %) of left exceeds the tolerance of 5 mm; drive longer")
    found = compare_with_drive(rig_of(), uncertain, given("left", 5 * BUMP))
    assert found.failed == ("left",)


def test_what_would_decide_is_a_longer_recording() -> None:
    found = compare_with_drive(rig_of(), calibrated(0.004), given("left", 0.0 * BUMP))
    assert "a recording that is at least 2.5 times as long" in found.remedy


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
