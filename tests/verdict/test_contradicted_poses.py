"""Given extrinsics beside a calibration: what has moved, and what is left open where a pose is contradicted."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import Array, se3, so3
from calgraph.result import Calibration, ExtrinsicsFile, SensorPose, Verdict
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.verdict.comparison import ExtrinsicsComparison
from calgraph.verdict.contradicted_poses import compare_with_contradictions

POSES = {
    "front": np.eye(4),
    "left": se3.pose(so3.exp(np.array([0.1, 0.0, 1.5])), np.array([-0.3, 0.4, 0.1])),
    "rear": se3.pose(so3.exp(np.array([0.0, 0.1, 3.0])), np.array([-1.0, 0.1, 0.2])),
}


def rig_of() -> Rig:
    return Rig.model_validate(
        {
            "root": "front",
            "target": {"kind": "surroundings"},
            "tolerance": {"translation": 0.005, "rotation": 0.05},
            "sensors": {name: {"kind": "lidar3d", "topic": f"/{name}"} for name in POSES},
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


def compare(calibration: Calibration, file: ExtrinsicsFile) -> ExtrinsicsComparison:
    return compare_with_contradictions(rig_of(), calibration, file, "motions")


@pytest.mark.parametrize("moved", POSES)
def test_the_sensor_that_moved_fails(moved: str) -> None:
    """The root, too: then the others are as they were relative to each other."""
    found = compare(calibrated(0.001), given(moved, BUMP))
    assert found.failed == (moved,)


def test_sensors_in_place_pass() -> None:
    found = compare(calibrated(0.001), given("left", 0.02 * BUMP))
    assert found.outcome == "pass"


def test_a_pose_that_is_contradicted_fails_nothing() -> None:
    contradicted = calibrated(0.001, "the joint adjustment has not converged")
    found = compare(contradicted, given("left", BUMP))
    left = next(one for one in found.sensors if one.sensor == "left")
    assert found.outcome == left.outcome == "warn"
    assert "-19.9 mm (σ 1.0 mm), beyond 5.0 mm" in left.reason
    assert "not decided: the joint adjustment has not converged" in left.reason


def test_a_pose_that_is_only_uncertain_fails_what_is_far_off() -> None:
    uncertain = calibrated(0.004, "position ±8 mm (95 %) of left exceeds the tolerance of 5 mm; drive longer")
    found = compare(uncertain, given("left", 5 * BUMP))
    assert found.failed == ("left",)


def test_what_an_uncertainty_comes_from_contradicts_nothing() -> None:
    error = "position ±8 mm (95 %) of left exceeds the tolerance of 5 mm"
    reason = f"{error}; the largest source of it: range errors (98 %); measure the range errors"
    assert compare(calibrated(0.004, reason), given("left", 5 * BUMP)).failed == ("left",)


def test_what_would_decide_is_a_longer_recording() -> None:
    found = compare(calibrated(0.004), given("left", 0.0 * BUMP))
    assert "a recording that is at least 2.5 times as long" in found.remedy
