"""Observations of boards by one sensor, and their residuals as functions of the board's pose before the sensor.

A *view* is the set of one sensor's measurements of one board: corners in pixels, or ranges along beams. They
depend on ``T_sensor_board`` alone, so residuals are differentiated by that pose: by perturbations (translation,
rotation) along the sensor's fixed axes, as :func:`calgraph.geometry.se3.retract` applies them.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Self, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from calgraph.boards.detections import Detection
from calgraph.geometry import Array, Index, se3
from calgraph.rig.bundle.bundle_parameters import NO_PARAMETERS, LocalParameters


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


@dataclass(frozen=True, eq=False)
class BoardViews(ABC):
    """All views of one sensor."""

    board: Index
    """(V,) index of each view's board; no board twice."""
    first: Index
    """(V,) the first corner, beam or edge of each view."""
    noise_scale: float = field(default=1.0, kw_only=True)
    """Standard deviation of the noise over that stated."""
    parameters: LocalParameters = field(default=NO_PARAMETERS, kw_only=True)
    """The sensor's systematic parameters: the local parameters after those of the pose."""
    twist: Array = field(default_factory=lambda: np.zeros((0, 6)), kw_only=True)
    """(V, 6) velocity of each board, as detections have it; (0, 6) if all rest."""
    motion_variance: Array = field(default_factory=lambda: np.zeros((0, 6)), kw_only=True)
    """(V, 6) as of detections; (0, 6) if all boards rest."""
    dimension: ClassVar[int] = 1
    """Number k of each measurement's coordinates."""
    unit: ClassVar[Literal["px", "m"]] = "m"
    """Of errors that are not whitened."""

    @property
    def start(self) -> Index:
        """(V,) the first measurement of each view."""
        return self.first

    @abstractmethod
    def linearize(self, T_sensor_board: Array, extra: Array) -> LinearizedResiduals:
        """Residuals and derivatives at poses (V, 4, 4) and the sensor's extra parameters (e,)."""

    @abstractmethod
    def unwhiten(self, residual: Array) -> Array:
        """Residuals (N, k), or their norms (N, 1), as errors in px, or in m along the beams.

        Those of outlines are in m across the side.
        """

    def local_jacobian(self, T_sensor_board: Array) -> Array:  # noqa: ARG002
        """(V, q, 6 + e) derivatives of the local parameters by the pose and the extra parameters."""
        return self.parameters.jacobian(np.eye(6)[None])

    def local_difference(self, T_before: Array, T_sensor_board: Array, extra: Array) -> Array:
        """(V, q) difference of the local parameters between two poses, for a difference ``extra`` (e,)."""
        return np.concatenate([se3.difference(T_sensor_board, T_before), self.parameters.gather(extra)], axis=-1)

    def is_defined(self, T_sensor_board: Array, extra: Array) -> bool:  # noqa: ARG002
        """Whether the residuals exist: no model of a lens projects all points."""
        return True

    @abstractmethod
    def update_noise(self, T_sensor_board: Array, scale: float) -> Self:
        """The same views with the noise at these poses, ``scale`` times that stated."""

    @abstractmethod
    def select(self, keep: NDArray[np.bool_] | Index) -> Self:
        """Some of the views: a mask (V,), or indices, which may repeat."""

    def select_shared(self, keep: NDArray[np.bool_] | Index) -> dict[str, Any]:
        """The fields of some of the views that those of all sensors have."""
        return {
            "board": self.board[keep],
            "parameters": self.parameters.select(keep),
            "twist": select_some(self.twist, keep),
            "motion_variance": select_some(self.motion_variance, keep),
        }


Values = TypeVar("Values", bound=NDArray[Any])


def select_some(values: Values, keep: NDArray[np.bool_] | Index) -> Values:
    """Those of some of the views, of an array that is empty where views have none."""
    return cast("Values", values[keep]) if len(values) else values


def stack_motions(detections: Sequence[Detection]) -> dict[str, Any]:
    """Fields ``twist`` and ``motion_variance`` (V, 6) of views, (0, 6) where all are zero: boards at rest."""
    stacked = {
        name: np.array([getattr(one, name) for one in detections]).reshape(-1, 6)
        for name in ("twist", "motion_variance")
    }
    return {name: values if np.any(values) else np.zeros((0, 6)) for name, values in stacked.items()}


def velocity_along_sensor(twist: Array, T_sensor_board: Array) -> Array | None:
    """(V, 6) velocity of poses (V, 4, 4) along the sensor's axes, from twists (V, 6); None for boards at rest."""
    if not len(twist):
        return None
    linear, angular = twist[:, :3], twist[:, 3:]
    return np.concatenate([linear + np.cross(angular, T_sensor_board[:, :3, 3]), angular], axis=-1)


def relative_poses(T_root_sensor: Array, T_root_board: Array) -> Array:
    """``T_sensor_board`` (V, 4, 4) of boards (V, 4, 4) for one sensor (4, 4)."""
    return np.asarray(se3.inverse(T_root_sensor) @ T_root_board)


def stack_poses(parts: Sequence[Array]) -> Array:
    """Array (n, 4, 4) of a sequence of poses, which may be empty."""
    return np.array(parts, dtype=np.float64).reshape(-1, 4, 4)


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
