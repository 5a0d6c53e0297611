"""Motions of the boards that a sensor measured: velocities, and what is not known of displacements."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index


def stack_motions(values: Sequence[Array]) -> Array:
    """(V, 6) twists or variances of detections, (0, 6) where all are zero: boards at rest."""
    stacked = np.array(values).reshape(-1, 6)
    return stacked if np.any(stacked) else np.zeros((0, 6))


def select_motions(values: Array, keep: NDArray[np.bool_] | Index) -> Array:
    """Twists or variances of some of the views: a mask (V,), or indices, which may repeat."""
    return values[keep] if len(values) else values


def velocity_along_sensor(twist: Array, T_sensor_board: Array) -> Array | None:
    """(V, 6) velocity of poses (V, 4, 4) along the sensor's axes, from twists (V, 6); None for boards at rest."""
    if not len(twist):
        return None
    linear, angular = twist[:, :3], twist[:, 3:]
    return np.concatenate([linear + np.cross(angular, T_sensor_board[:, :3, 3]), angular], axis=-1)
