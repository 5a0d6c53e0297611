"""Comparison of given poses of a network with estimated ones: outcomes by scanner."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings
from calgraph.geometry import se2, so3
from calgraph.network.checks.moved_scanners import compare_network_poses
from calgraph.network.joint.planar_poses import NetworkPoses
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.verdict.comparison import ExtrinsicsComparison
from known_networks import calibration

NAMES = ("a", "b", "c", "d", "e", "f")
SIGMA = np.array([0.001, 0.001, 0.0001])
TOLERANCE = Tolerance(translation=0.01, rotation=0.3)


def estimated(scale: float = 1.0) -> NetworkPoses:
    """Poses with standard deviations of 1 mm and 0.1 mrad times ``scale``."""
    T = se2.pose(np.arange(6.0), np.column_stack([2.0 * np.arange(6), np.arange(6) % 2 * 3.0]))
    covariance = np.diag(np.tile(np.square(scale * SIGMA), 6))
    covariance[:3] = 0
    return NetworkPoses(NAMES, T, covariance)


def compare(poses: NetworkPoses, step: tuple[float, float, float], earlier: float = 0.0) -> ExtrinsicsComparison:
    """Compares poses with given ones, of which c differs by a step in the root's axes.

    Args:
        poses: estimated.
        step: m, m and rad.
        earlier: scale of the covariance of the given poses; they have none at 0.
    """
    steps = np.zeros((6, 3))
    steps[2] = step
    T = se2.retract(poses.T_root_scanner, steps)
    given: Calibration | None = None
    if earlier:
        given = calibration(replace(estimated(earlier), T_root_scanner=T))
    links = {name: FrameLink("a", T_k) for name, T_k in zip(NAMES[1:], se2.to_se3(T)[1:], strict=True)}
    file = ExtrinsicsFile(Path("given.yaml"), FrameTree("given.yaml", links), calibration=given)
    return compare_network_poses(calibration(poses), file, TOLERANCE, settings=DiagnosticsSettings())


def outcomes(comparison: ExtrinsicsComparison) -> dict[str, str]:
    return {sensor.sensor: sensor.outcome for sensor in comparison.sensors}


@pytest.mark.parametrize("step", [(0.02, 0.0, 0.0), (0.0, 0.0, float(np.radians(0.5)))])
def test_a_scanner_that_moved_beyond_the_tolerance_fails(step: tuple[float, float, float]) -> None:
    found = outcomes(compare(estimated(), step))
    assert [name for name, outcome in found.items() if outcome == "fail"] == ["c"]


def test_the_displacement_is_stated() -> None:
    [moved] = [sensor for sensor in compare(estimated(), (0.03, 0.04, 0.0)).sensors if sensor.sensor == "c"]
    assert moved.reason.startswith("has moved by 50.0 mm and +0.00°")


def test_a_displacement_within_the_tolerance_is_a_warning() -> None:
    comparison = compare(estimated(), (0.008, 0.0, 0.0))
    [moved] = [sensor for sensor in comparison.sensors if sensor.sensor == "c"]
    assert moved.outcome == "warn"
    assert "has moved by 8.0 mm and +0.00°, which is within the tolerance" in moved.reason


def test_covariances_of_given_poses_are_added_to_those_of_the_estimate() -> None:
    # 20 mm are 20 standard deviations of the estimate, but only 2 of the given poses.
    assert "has moved" not in " ".join(sensor.reason for sensor in compare(estimated(), (0.02, 0, 0), 10).sensors)


def test_a_failure_that_the_joint_test_does_not_confirm_is_a_warning() -> None:
    # A squared distance of 30 fails the test of one scanner (16.3, three degrees of freedom), but not that of the
    # network (37.7, fifteen).
    found = outcomes(compare(estimated(10.0), (0.01 * np.sqrt(30), 0.0, 0.0)))
    assert found["c"] == "warn"


def test_heights_and_tilts_of_given_poses_are_not_compared() -> None:
    """A network does not measure them."""
    poses = estimated()
    T = se2.to_se3(poses.T_root_scanner)
    T[1:, 2, 3] = 0.5
    T[2, :3, :3] = so3.exp(np.array([0.02, 0.01, 0.0])) @ T[2, :3, :3]
    links = {name: FrameLink("a", T_k) for name, T_k in zip(NAMES[1:], T[1:], strict=True)}
    file = ExtrinsicsFile(Path("given.yaml"), FrameTree("given.yaml", links))
    found = compare_network_poses(calibration(poses), file, TOLERANCE, settings=DiagnosticsSettings())
    assert set(outcomes(found).values()) == {"pass"}
    for sensor in found.sensors:
        assert [np.isnan(axis.stddev) for axis in sensor.axes] == [False, False, True, True, True, False]
    assert found.sensors[0].axes[2].offset == pytest.approx(0.5)
