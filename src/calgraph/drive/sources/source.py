"""What a drive needs of a sensor of any kind: a trajectory for the start, and measurements to adjust."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calgraph.config import Rig
from calgraph.drive.measurements import Measurements
from calgraph.drive.segments import Segments
from calgraph.errors import Rejected
from calgraph.geometry import Array
from calgraph.sensors import Message
from calgraph.sensors.kinds import SensorSpec
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorPoints, SensorState
from calgraph.surfaces.trajectory import SplineTrajectory

# Of poses before the adjustment: no prior, but a number that is far above what any robot measures, m and rad.
POSE_STDDEV = 10.0
# Of sensors without points on surfaces, of which motion alone may not determine a height or a turn: metres within
# a vehicle, and any rotation.
_PLACE_STDDEV, _ROTATION_STDDEV = 1.0, 2.0
# Of a clock offset, s: turn rates determine it to a sweep's period.
CLOCK_STDDEV = 0.1


class Source(ABC):
    """What one sensor measured during a drive; immutable, and pickled to be tracked in another process."""

    dimension: int
    """2 or 3."""

    @property
    def gap(self) -> float:
        """Time between measurements in which nothing is measured, s; 0 of those that need no denser knots."""
        return 0.0

    @abstractmethod
    def track(self, rng: np.random.Generator) -> Segments | Rejected:
        """The trajectory of the sensor by its own clock, or why it has none."""

    def thin(self, rng: np.random.Generator) -> "Source":  # noqa: ARG002
        """The source with as much of its data as is adjusted."""
        return self

    def points(self, start: float, end: float) -> SensorPoints:  # noqa: ARG002
        """Points on surfaces within an interval of its clock, s, with those that clocks may shift into it."""
        return SensorPoints(np.zeros((0, self.dimension)), np.zeros(0))

    def measurements(
        self,
        k: int,  # noqa: ARG002
        trajectory: SplineTrajectory,  # noqa: ARG002
        state: SensorState,  # noqa: ARG002
    ) -> Sequence[Measurements]:
        """What it measured of the trajectory itself.

        Args:
            k: its number.
            trajectory: of the root during a part of the drive, at its start value.
            state: of the sensor, at its start value.
        """
        return ()


class Reader(Protocol):
    """Collects what is kept of the messages of one sensor, as they are read."""

    def add(self, message: Message) -> None:
        """Takes a message, in order of arrival; those of other types are ignored."""
        ...

    def finish(self) -> Source:
        """What the sensor measured."""
        ...


@dataclass(frozen=True)
class SourceKind:
    """How a kind of sensor is used in a drive."""

    make_reader: Callable[[Rig, str, int, np.random.Generator], Reader] | None
    """Of the rig, the sensor's name, the dimension of the drive (2 or 3), and for random draws; None of cameras,
    whose images are searched by several processes."""
    stddev: Callable[[SensorSpec, int], Array]
    """(n + d + 6,) standard deviations before the adjustment, by what rig.yaml states and the dimension: pose,
    clock, range bias and scale, and timing; 0 of what it has not, or what nothing measures."""
    has_surfaces: bool = False
    """Whether it measures points on surfaces."""
    has_place: bool = True
    """Whether its trajectory has positions."""


def without_ranges(spec: SensorSpec, n: int) -> Array:  # noqa: ARG001
    """(n + d + 6,) of sensors that measure no ranges."""
    return np.array(
        [*[_PLACE_STDDEV] * n, *[_ROTATION_STDDEV] * (n * (n - 1) // 2), CLOCK_STDDEV, *[0.0] * (BESIDE_POSE - 1)]
    )
