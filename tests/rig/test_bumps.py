"""Sensors that are bumped during a recording: the remark, the captures that are used, and the pose afterwards."""

import numpy as np
import pytest

from calgraph.geometry import se3
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
)
from ideal_detections import simulate_detections
from rig_errors import Bump, CameraErrors, ModelErrors, ScannerErrors

SCENARIO = RigScenario(
    camera=CameraOptions(distortion=(-0.1, 0.03, 0.0005, -0.0005, 0.0)),
    laser=LaserOptions(count=1),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, resolution=1.0),
    bearings=(-30, -15, 0, 15, 30),
)
WORLD = build_world(SCENARIO, 0, images=False)
ROOT = "lidar"
TURN = (0.0, float(np.radians(1.0)), 0.0)


def calibrate(errors: ModelErrors) -> tuple[Calibration, GroundTruth]:
    rig, captured, truth = simulate_detections(WORLD, 0, errors=errors)
    problem = build_problem_from_captures(rig, captured, RigOptions(folds=0), np.random.default_rng(0))
    return solve_problem(problem), truth


def squared_error(found: Calibration, truth: GroundTruth, name: str) -> float:
    """Squared Mahalanobis distance of a pose from the truth."""
    off = se3.difference(found[name].T_root_sensor, truth.T_root_sensor[name])
    return float(off @ np.linalg.solve(found[name].covariance, off))


@pytest.mark.parametrize("translation", [0.0, 0.02])
def test_a_bumped_camera_is_calibrated_from_its_captures_afterwards(translation: float) -> None:
    bump = Bump(0.5, rotation=TURN, translation=(translation, 0.0, 0.0))
    found, truth = calibrate(ModelErrors(cameras={"camera": CameraErrors(bump=bump)}))
    (remark,) = found.evidence.remarks
    assert remark.startswith("camera moved by ")
    assert " s from the start): the result is its pose after that" in remark
    assert squared_error(found, truth, "camera") < 25
    earlier = {row.capture for row in found.evidence.captures if row.reason == "before the sensor moved"}
    used = {row.capture for row in found.evidence.captures if row.sensor == "camera" and row.used}
    assert earlier
    assert max(earlier) < min(used)


def test_a_bumped_root_is_named() -> None:
    bump = Bump(0.5, translation=(0.03, 0.0, 0.0), rotation=TURN)
    found, truth = calibrate(ModelErrors(scanners={ROOT: ScannerErrors(bump=bump)}))
    assert found.evidence.remarks[0].startswith(f"{ROOT} moved by ")
    assert squared_error(found, truth, "camera") < 25


def test_too_few_captures_after_a_bump_make_the_sensor_weak() -> None:
    # The last four captures do not suffice to calibrate the laser alone.
    bump = Bump(0.8, translation=(0.0, 0.0, 0.1), rotation=(0.1, 0.1, 0.0))
    found, _ = calibrate(ModelErrors(scanners={"laser_front": ScannerErrors(bump=bump)}))
    assert any(remark.startswith("laser_front moved by ") for remark in found.evidence.remarks)
    assert found["laser_front"].verdict.grade != "good"


def test_a_sensor_that_drifts_is_not_good() -> None:
    bump = Bump(0.0, 1.0, rotation=(0.0, 0.08, 0.0))
    found, _ = calibrate(ModelErrors(cameras={"camera": CameraErrors(bump=bump)}))
    assert found["camera"].verdict.grade != "good"
    assert any("the pose of camera drifts by" in remark for remark in found.evidence.remarks)


def test_a_right_recording_has_no_remark() -> None:
    found, _ = calibrate(ModelErrors())
    assert found.evidence.remarks == ()
