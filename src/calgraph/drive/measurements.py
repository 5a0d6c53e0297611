"""Parts of a drive with what sensors measure there: points on surfaces, and the trajectory itself."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array

from calgraph.geometry import Array, Index, se_n
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorPoints, SensorState
from calgraph.surfaces.trajectory import SplineTrajectory


@dataclass(frozen=True, eq=False)
class LinearRows:
    """M residuals in their standard deviations, with robust weights and derivatives."""

    residual: Array
    """(M,)."""
    sensor: Index
    """(M,) number of the sensor."""
    time: Array
    """(M,) by the root's clock, s."""
    by_control: csr_array
    """(M, C) by the control points of the trajectory, row by row."""
    by_sensor: Array
    """(M, n + d + 6) by the state of the sensor."""
    by_unknown: csr_array
    """(M, E) by the unknowns of the measurements themselves."""
    by_shared: Array
    """(M, G) by the unknowns that all parts of the drive share."""


def sparse_rows(blocks: Array, first: Index, columns: int) -> csr_array:
    """(V R, columns) of blocks (V, R, k) whose columns begin at ``first`` (V,)."""
    V, R, k = blocks.shape
    index = np.broadcast_to((first[:, None] + np.arange(k))[:, None], blocks.shape)
    pointer = np.arange(V * R + 1) * k
    return csr_array((blocks.ravel(), index.ravel(), pointer), shape=(V * R, columns))


@dataclass(frozen=True, eq=False)
class PlacedSensor:
    """Poses of a sensor at K times, with derivatives of their errors along and about the world's axes."""

    poses: Array
    """(K, n+1, n+1) ``T_world_sensor``."""
    first: Index
    """(K,) control point,"""
    by_control: Array
    """(K, n + d, 4 (n + d)) by it and the three after it,"""
    by_state: Array
    """(K, n + d, n + d + 6) and by the state of the sensor."""


def place_sensor(trajectory: SplineTrajectory, times: Array, T_root_sensor: Array) -> PlacedSensor:
    """Poses by the trajectory of the root, at times (K,) by its clock, s, of one or K poses on it."""
    at = trajectory.at(times)
    R, T = se_n.rotation(at.poses), at.poses @ T_root_sensor
    n = T.shape[-1] - 1
    adjoint = se_n.rotation_adjoint(R)
    from_root = np.zeros_like(adjoint) + np.eye(adjoint.shape[-1])
    from_root[:, :n, n:] = se_n.rotation_jacobian(se_n.translation(T) - se_n.translation(at.poses))
    by_value = from_root.copy()
    by_value[:, :, n:] = from_root[:, :, n:] @ at.rotation_jacobian
    by_control = (at.basis[:, None, :, None] * by_value[:, :, None]).reshape(*by_value.shape[:2], -1)
    by_clock = -from_root @ np.concatenate([at.velocity, at.turn_rate], axis=1)[:, :, None]
    by_state = np.concatenate([adjoint, by_clock, np.zeros((*by_clock.shape[:2], BESIDE_POSE - 1))], axis=2)
    return PlacedSensor(T, at.first, by_control, by_state)


VarianceOf = Callable[[csr_array], Array]
"""Variances (M,) of linear functions (M, C + E) of the control points and the unknowns of measurements."""
MAX_VARIANCES = 300
"""About as many rows are asked for: variances of neighbours are nearly equal."""


class Measurements(Protocol):
    """Measurements of the trajectory during a part of the drive; immutable."""

    @property
    def unknown_count(self) -> int:
        """Number E of unknowns that only these measurements depend on, such as poses of boards."""
        ...

    def linearize(self, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array) -> LinearRows:
        """The residuals at a trajectory, states of the sensors, and unknowns (G,) that all parts share."""
        ...

    def moved(self, step: Array) -> "Measurements":
        """The measurements with their unknowns after a step (E,)."""
        ...

    def reweighted(
        self, trajectory: SplineTrajectory, states: Sequence[SensorState], shared: Array, variance_of: VarianceOf
    ) -> "Measurements":
        """The measurements with their noise estimated again, by residuals and what the trajectory follows of them.

        Those whose noise is known are returned as they are.

        Args:
            trajectory: as of :meth:`linearize`.
            states: as of :meth:`linearize`.
            shared: as of :meth:`linearize`.
            variance_of: takes as long as an iteration for a thousand rows.
        """
        ...


@dataclass(frozen=True, eq=False)
class DrivePart:
    """A part of the drive with a separate world."""

    points: Sequence[SensorPoints]
    """By sensor; the first is the root."""
    trajectory: SplineTrajectory
    """Of the root, by its clock."""
    measurements: Sequence[Measurements] = ()
    """Of the trajectory, besides points."""
    size: int | None = None
    """Number of the shared unknown that is the relative size of this world, which only priors determine: the scale
    of prints. Scales of ranges change with it."""
