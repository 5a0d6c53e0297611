"""Observations of boards by one sensor, and their residuals as functions of the board's pose before the sensor.

A *view* is the set of one sensor's measurements of one board: corners in pixels, or ranges along beams. They
depend on ``T_sensor_board`` alone, so residuals are differentiated by that pose: by perturbations (translation,
rotation) along the sensor's fixed axes, as :func:`calgraph.geometry.se3.retract` applies them.
"""

from collections.abc import Sequence
from dataclasses import Field, dataclass
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se3
from calgraph.rig.bundle.bundle_parameters import LocalParameters


@dataclass(frozen=True, eq=False)
class LinearizedResiduals:
    """Whitened residuals of N measurements, of dimension k, in V views, and their derivatives.

    A view's measurements may depend on fewer than six parameters, as ranges do on the plane alone: derivatives are
    by q local parameters, which are differentiated by the pose and the sensor's e extra parameters. The last local
    parameters are the biases of rings, each of which acts on its measurements as one of the others does on all.
    """

    residual: Array
    """(N, k) predicted minus measured, in standard deviations."""
    jacobian: Array
    """(N, k, q - R) by the local parameters without those of the R rings."""
    local_jacobian: Array
    """(V, q, 6 + e)."""
    pose_count: int
    """Number of local parameters of the pose, the first ones."""
    ring: Index | None = None
    """(N,) ring of each measurement, 0 to R - 1, ascending within a view."""
    ring_count: int = 0
    """Number of the last local parameters that are biased from view to view: of rings, and footprints."""
    ring_column: int = 0
    """Of the local parameters, the one that acts as the bias of a ring, but on all measurements."""
    velocity: Array | None = None
    """(V, 6) of a moving board's pose before the sensor, along the sensor's axes, m/s and rad/s; None at rest."""


class BoardViews(Protocol):
    """All views of one sensor, a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def board(self) -> Index:
        """(V,) index of each view's board; no board twice."""

    @property
    def start(self) -> Index:
        """(V,) the first measurement of each view."""

    @property
    def noise_scale(self) -> float:
        """Standard deviation of the noise over that stated."""

    @property
    def dimension(self) -> int:
        """Dimension k of each measurement."""

    @property
    def parameters(self) -> LocalParameters:
        """The sensor's systematic parameters: the local parameters after those of the pose."""

    @property
    def twist(self) -> Array:
        """(V, 6) velocity of each board, as detections have it; (0, 6) if all rest."""

    @property
    def motion_variance(self) -> Array:
        """(V, 6) as of detections; (0, 6) if all boards rest."""

    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """Residuals and derivatives at poses (V, 4, 4) and the sensor's extra parameters (e,)."""

    def local_jacobian(self, T_sensor_board: Array) -> Array:
        """(V, q, 6 + e) derivatives of the local parameters by the pose and the extra parameters."""

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """(V, q) difference of the local parameters between two poses, for a difference ``extra`` (e,)."""

    def is_defined(self, T_sensor_board: Array, extra: Array) -> bool:
        """Whether the residuals exist: no model of a lens projects all points."""

    def update_noise(self, T_sensor_board: Array, scale: float) -> Self:
        """The same views with the noise at these poses, ``scale`` times that stated."""

    def select(self, keep: NDArray[np.bool_] | Index) -> Self:
        """Some of the views: a mask (V,), or indices, which may repeat."""


def relative_poses(T_root_sensor: Array, T_root_board: Array) -> Array:
    """``T_sensor_board`` (V, 4, 4) of boards (V, 4, 4) for one sensor (4, 4)."""
    return np.asarray(se3.inverse(T_root_sensor) @ T_root_board)


def stack_poses(parts: Sequence[Array]) -> Array:
    """Array (n, 4, 4) of a sequence of poses, which may be empty."""
    return np.array(parts, dtype=np.float64).reshape(-1, 4, 4)


def difference_along_sensor(T_before: Array, T_sensor_board: Array) -> Array:
    """(V, 6) difference of poses (V, 4, 4) along the sensor's axes."""
    return se3.difference(T_sensor_board, T_before)


def start_indices(counts: Sequence[int]) -> Index:
    """(V,) the first measurement of each view, from the number of measurements of each."""
    return np.cumsum([0, *counts], dtype=np.intp)[:-1]


def view_indices(start: Index, count: int) -> Index:
    """(N,) the view of each measurement."""
    return np.repeat(np.arange(len(start)), np.diff(start, append=count))


def select_measurements(start: Index, count: int, keep: NDArray[np.bool_] | Index) -> tuple[Index, Index]:
    """First measurements of the selected views after selection, and the indices of their measurements."""
    counts = np.diff(start, append=count)[keep]
    after = start_indices(counts.tolist())
    return after, np.repeat(start[keep] - after, counts) + np.arange(counts.sum())
