"""Errors of poses by errors of stated values, against a calibration with such an error."""

import numpy as np
import pytest

from calgraph.geometry import se3
from calgraph.result import Calibration, PriorErrors
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
)
from ideal_detections import simulate_detections
from rig_errors import ModelErrors, ScannerErrors

BIAS = 0.005
"""m; a quarter of its prior standard deviation."""
SCENARIO = RigScenario(
    camera=CameraOptions(width=640, height=480, texels_per_mm=0.5),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1),
    bearings=(-30, 0, 30),
    radii=(1.7, 2.2),
    samples=2,
)


def calibrate(range_bias: float) -> Calibration:
    errors = ModelErrors(scanners={"lidar": ScannerErrors(range_bias=range_bias)})
    rig, captures, _ = simulate_detections(build_world(SCENARIO, 3, images=False), 0, errors=errors)
    options = RigOptions(folds=0)
    return solve_problem(build_problem_from_captures(rig, captures, options, np.random.default_rng(0)))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(0.0)


def known_errors(calibration: Calibration) -> PriorErrors:
    assert calibration.prior_errors is not None
    return calibration.prior_errors


def test_a_wrong_stated_value_moves_poses_as_predicted(calibration: Calibration) -> None:
    """Ranges that are too long by a bias are a stated bias that is too small: the opposite sign."""
    errors = known_errors(calibration)
    column = errors.poses[6:12, errors.parameters.index(("lidar", "range bias"))]
    predicted = -BIAS / 0.02 * column
    moved = se3.difference(calibrate(BIAS)["camera"].T_root_sensor, calibration["camera"].T_root_sensor)
    assert np.linalg.norm(predicted[:3]) > 3e-4
    assert moved[:3] == pytest.approx(predicted[:3], abs=0.1 * float(np.linalg.norm(predicted[:3])))


def test_what_is_shared_is_part_of_the_covariance(calibration: Calibration) -> None:
    errors = known_errors(calibration)
    assert not errors.poses[:6].any()
    rest = calibration.joint_covariance - errors.cross_covariance(errors)
    values = np.linalg.eigvalsh(rest[6:, 6:])
    assert values[0] > 0
    assert np.trace(rest) < 0.95 * np.trace(calibration.joint_covariance)


def test_parameters_of_one_calibration_alone_are_not_shared() -> None:
    one = PriorErrors((("camera", "cx"), ("board", "bow")), np.array([[1.0, 2.0]]))
    other = PriorErrors((("board", "bow"), ("lidar", "range bias")), np.array([[3.0, 4.0]]))
    assert one.cross_covariance(other) == pytest.approx(6.0)
