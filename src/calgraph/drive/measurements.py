"""Parts of a drive with what sensors measure there: points on surfaces, and the trajectory itself."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from scipy.sparse import csr_array

from calgraph.drive.states import SensorPoints, SensorState
from calgraph.geometry import Array
from calgraph.surfaces.trajectory import SplineTrajectory


@dataclass(frozen=True, eq=False)
class LinearRows:
    """M residuals in their standard deviations, with robust weights and derivatives."""

    residual: Array
    """(M,)."""
    by_control: csr_array
    """(M, C) by the control points of the trajectory, row by row."""
    by_sensor: Array
    """(M, n + d + 3) by the state of the sensor."""
    by_unknown: Array
    """(M, E) by the unknowns of the measurements themselves."""


class Measurements(Protocol):
    """Measurements of one sensor during a part of the drive; immutable."""

    @property
    def sensor(self) -> int:
        """Number of the sensor."""
        ...

    @property
    def unknown_count(self) -> int:
        """Number E of unknowns that only these measurements depend on, such as the pose of a board."""
        ...

    def linearize(self, trajectory: SplineTrajectory, state: SensorState) -> LinearRows:
        """The residuals at a trajectory and a state of the sensor."""
        ...

    def moved(self, step: Array) -> "Measurements":
        """The measurements with their unknowns after a step (E,)."""
        ...


@runtime_checkable
class NoisyMeasurements(Measurements, Protocol):
    """Measurements whose noise is estimated with the rest."""

    def with_noise_of(self, rows: LinearRows, variance: Array) -> "NoisyMeasurements":
        """The measurements with their noise estimated again.

        Args:
            rows: the residuals.
            variance: (M,) of these, that the uncertainty of the trajectory and of the unknowns leaves.
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
