"""Descriptions of board poses for the person who carries the board."""

from collections.abc import Mapping

import numpy as np

from calgraph.config.settings import RigDiagnosticsSettings
from calgraph.geometry import Array

# Rotation from the axes of a camera to forward, left, up: the axes of a scanner.
_CAMERA_TO_SCANNER_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def describe_pose(
    sensor: str, kinds: Mapping[str, str], T_sensor_board: Mapping[str, Array], settings: RigDiagnosticsSettings
) -> str:
    """Describes a board pose relative to a sensor, or to the nearest one if that sensor does not detect the board.

    Args:
        sensor: the sensor whose pose the board improves.
        kinds: camera, lidar2d or lidar3d, by sensor.
        T_sensor_board: (4, 4) for every sensor that detects the board.
        settings: the least height and angle that are mentioned.

    Returns:
        A phrase such as ``hold the board 2.1 m from laser, 30° to its left, tilted back by 40°``.
    """
    if sensor not in T_sensor_board:
        sensor = min(T_sensor_board, key=lambda name: float(np.linalg.norm(T_sensor_board[name][:3, 3])))
    axes = _CAMERA_TO_SCANNER_AXES if kinds[sensor] == "camera" else np.eye(3)
    center, normal = axes @ T_sensor_board[sensor][:3, 3], axes @ T_sensor_board[sensor][:3, 2]
    distance, bearing = np.hypot(center[0], center[1]), np.degrees(np.arctan2(center[1], center[0]))
    forward = center[:2] / distance
    left = np.array([-forward[1], forward[0]])
    turned = np.degrees(np.arctan2(normal[:2] @ left, -normal[:2] @ forward))
    tilted = np.degrees(np.arcsin(np.clip(normal[2], -1, 1)))
    least_angle = np.degrees(settings.min_description_angle)
    is_ahead = abs(bearing) < least_angle
    parts = [f"hold the board {distance:.1f} m {'in front of' if is_ahead else 'from'} {sensor}"]
    if not is_ahead:
        parts.append(f"{_round_to_five(bearing)} to its {'left' if bearing > 0 else 'right'}")
    if abs(center[2]) >= settings.min_description_height:
        parts.append(f"{abs(center[2]):.1f} m {'above' if center[2] > 0 else 'below'} it")
    if abs(turned) >= least_angle:
        side = "left" if turned > 0 else "right"
        parts.append(f"turned {_round_to_five(turned)} to the {side} as viewed from the sensor")
    if abs(tilted) >= least_angle:
        parts.append(f"tilted {'back' if tilted > 0 else 'forward'} by {_round_to_five(tilted)}")
    return ", ".join(parts)


def _round_to_five(degrees: float) -> str:
    return f"{5 * round(abs(degrees) / 5)}°"
