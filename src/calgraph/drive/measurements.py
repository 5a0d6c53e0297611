"""Parts of a drive with what sensors measure there: points on surfaces, and the trajectory itself."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from scipy.sparse import csr_array

from calgraph.drive.states import SensorPoints, SensorState
from calgraph.geometry import Array, Index
from calgraph.surfaces.trajectory import SplineTrajectory


@dataclass(frozen=True, eq=False)
class LinearRows:
    """M residuals in their standard deviations, with robust weights and derivatives."""

    residual: Array
    """(M,)."""
    sensor: Index
    """(M,) number of the sensor."""
    by_control: csr_array
    """(M, C) by the control points of the trajectory, row by row."""
    by_sensor: Array
    """(M, n + d + 6) by the state of the sensor."""
    by_unknown: csr_array
    """(M, E) by the unknowns of the measurements themselves."""
    by_shared: Array
    """(M, G) by the unknowns that all parts of the drive share."""


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
