"""Descriptions of board poses for the person who carries the board."""

import numpy as np
import pytest

from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.geometry import Array, se3, so3
from calgraph.rig.checks.next_best_pose import describe_pose

SETTINGS = RigDiagnosticsSettings()
KINDS = {"laser": "lidar2d", "camera": "camera"}
FACING = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])
"""Axes of an upright board that faces a scanner which looks along x."""
T_SCANNER_CAMERA = se3.pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))


def board(
    distance: float, bearing: float = 0.0, height: float = 0.0, turn: float = 0.0, back: float = 0.0
) -> Array:
    """T_scanner_board, with degrees to the left, the turn seen from above, counter-clockwise, and the tilt."""
    left = so3.exp(np.radians([0, 0, bearing]))
    R = left @ so3.exp(np.radians([0, 0, turn])) @ so3.exp(np.radians([0, back, 0])) @ FACING
    return se3.pose(R, left @ np.array([distance, 0, 0]) + [0, 0, height])


@pytest.mark.parametrize(
    ("T", "expected"),
    [
        (board(2.14), "2.1 m in front of"),
        (board(2.14, bearing=7), "2.1 m in front of"),
        (board(2.14, bearing=8), "2.1 m from laser, 10° to its left"),
        (board(2.14, bearing=-28), "2.1 m from laser, 30° to its right"),
        (board(2.14, bearing=178), "2.1 m from laser, 180° to its left"),
        (board(2.14, height=0.14), "2.1 m in front of"),
        (board(2.14, height=0.16), "2.1 m in front of laser, 0.2 m above it"),
        (board(2.14, height=-0.43), "2.1 m in front of laser, 0.4 m below it"),
        (board(2.14, turn=7), "2.1 m in front of"),
        (board(2.14, bearing=40, turn=12), "2.1 m from laser, 40° to its left, turned 10° to the right"),
        (board(2.14, turn=-38), "2.1 m in front of laser, turned 40° to the left"),
        (board(2.14, back=7), "2.1 m in front of"),
        (board(2.14, back=23), "2.1 m in front of laser, tilted back by 25°"),
        (board(2.14, back=-23), "2.1 m in front of laser, tilted forward by 25°"),
    ],
)
def test_small_heights_and_angles_are_not_mentioned(T: Array, expected: str) -> None:
    """Below 0.15 m and 7.5 degrees; angles are rounded to 5 degrees."""
    expected = f"hold the board {expected}" + (" laser" if expected.endswith("of") else "")
    expected += " as viewed from the sensor" if "turned" in expected else ""
    assert describe_pose("laser", KINDS, {"laser": T}) == expected
    in_camera = se3.inverse(T_SCANNER_CAMERA) @ T
    assert describe_pose("camera", KINDS, {"camera": in_camera}) == expected.replace("laser", "camera")


def test_a_sensor_that_does_not_detect_the_board_is_replaced_by_the_nearest() -> None:
    poses = {"camera": se3.inverse(T_SCANNER_CAMERA) @ board(3.0), "laser": board(2.0)}
    assert describe_pose("rear", KINDS, poses) == "hold the board 2.0 m in front of laser"
    assert describe_pose("camera", KINDS, poses) == "hold the board 3.0 m in front of camera"
