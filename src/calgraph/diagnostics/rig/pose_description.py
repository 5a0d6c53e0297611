"""Where to hold a board, in words for the person who carries it."""

from collections.abc import Mapping

import numpy as np

from calgraph.geometry import Array

# Less than this is not worth saying: of the board's height above a sensor, m, and of its angles, degrees.
_LEVEL, _STRAIGHT = 0.15, 7.5
# From a camera's axes to forward, left, up, which are a scanner's.
_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def describe_pose(sensor: str, kinds: Mapping[str, str], T_sensor_board: Mapping[str, Array]) -> str:
    """How to hold a board before a sensor, or before the nearest if that sensor does not see it.

    Args:
        sensor: the sensor that the board is for.
        kinds: camera, lidar2d or lidar3d, by sensor.
        T_sensor_board: (4, 4) for every sensor that sees the board.

    Returns:
        A phrase such as ``hold the board 2.1 m from laser, 30° to its left, tilted back by 40°``.
    """
    if sensor not in T_sensor_board:
        sensor = min(T_sensor_board, key=lambda name: float(np.linalg.norm(T_sensor_board[name][:3, 3])))
    axes = _OPTICAL if kinds[sensor] == "camera" else np.eye(3)
    center, normal = axes @ T_sensor_board[sensor][:3, 3], axes @ T_sensor_board[sensor][:3, 2]
    distance, bearing = np.hypot(center[0], center[1]), np.degrees(np.arctan2(center[1], center[0]))
    ahead = center[:2] / distance
    left = np.array([-ahead[1], ahead[0]])
    turned = np.degrees(np.arctan2(normal[:2] @ left, -normal[:2] @ ahead))
    tilted = np.degrees(np.arcsin(np.clip(normal[2], -1, 1)))
    words = [f"hold the board {distance:.1f} m {'in front of' if abs(bearing) < _STRAIGHT else 'from'} {sensor}"]
    if abs(bearing) >= _STRAIGHT:
        words.append(f"{_round_to_five(bearing)} to its {'left' if bearing > 0 else 'right'}")
    if abs(center[2]) >= _LEVEL:
        words.append(f"{abs(center[2]):.1f} m {'above' if center[2] > 0 else 'below'} it")
    if abs(turned) >= _STRAIGHT:
        words.append(
            f"its face turned {_round_to_five(turned)} to the {'left' if turned > 0 else 'right'}"
            " as seen from there"
        )
    if abs(tilted) >= _STRAIGHT:
        words.append(f"tilted {'back' if tilted > 0 else 'forward'} by {_round_to_five(tilted)}")
    return ", ".join(words)


def _round_to_five(degrees: float) -> str:
    return f"{5 * round(abs(degrees) / 5)}°"
