"""A calibration: the poses of sensors as a tree, with one joint covariance, and the evidence for them."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array, Index, se3
from calgraph.result.budget import ErrorBudget, propagate_to_relative
from calgraph.result.correction import Correction
from calgraph.result.estimated_parameter import EstimatedParameter
from calgraph.result.evidence import Evidence
from calgraph.result.file_types import Finite
from calgraph.result.finding import split_clauses
from calgraph.result.pictures import Pictures, correct_pictures
from calgraph.result.pose_table import format_rows, list_poses, rows_to_html
from calgraph.result.sensor_pose import UNMEASURED_IN_PLANE, BaseFrame, SensorPose
from calgraph.sensors.kinds import KINDS


@dataclass(frozen=True)
class InputFile:
    """A file or folder that a calibration was computed from."""

    path: str
    """As it was given."""
    sha256: str
    """Of its size, first and last mebibyte; of a folder, of all files in it."""
    kind: str = ""
    """What it is: rig, recording, problem, prior, rigid group, earlier calibration or reference; empty in files of
    versions before 0.3, which have the rig first, then the recordings."""


@dataclass(frozen=True)
class Provenance:
    """How a calibration was computed."""

    version: str
    """Of calgraph."""
    date: str
    """UTC, ISO 8601."""
    command: str
    """The command line."""
    inputs: tuple[InputFile, ...]
    """All files and folders that were read."""
    start: Finite | None = None
    """Start of the recording, s; None where there was none."""
    duration: Finite | None = None
    """Of the recording, s."""
    messages: int | None = None
    """Number of messages in the recording."""
    cached: tuple[str, ...] = ()
    """Sensors whose detections were taken from an earlier run on the same recording."""


@dataclass(frozen=True, eq=False)
class PriorErrors:
    """Errors of a calibration's poses by the stated values of systematic parameters.

    Estimates of two recordings of one rig with the same board share the errors of what rig.yaml states. With the
    posterior covariance ``P`` of poses and parameters, and the information ``L`` of the priors, an error ``e`` of
    the stated values moves the estimates by ``P L e``; the covariance of the errors of two estimates a and b is
    ``P_a L P_b``.
    """

    parameters: tuple[tuple[str, str], ...]
    """Sensor or target, and quantity, of E systematic parameters."""
    poses: Array
    """(S·6, E) errors of all poses in the root's fixed axes, m and rad, by an error of one prior standard
    deviation."""

    def cross_covariance(self, other: "PriorErrors") -> Array:
        """Covariance (S·6, S'·6) of the errors of these poses with those of another calibration."""
        shared = [one for one in self.parameters if one in other.parameters]
        i = [self.parameters.index(one) for one in shared]
        j = [other.parameters.index(one) for one in shared]
        return np.asarray(self.poses[:, i] @ other.poses[:, j].T)


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """A tree of sensor poses rooted at one sensor."""

    root: str
    sensors: tuple[SensorPose, ...]
    """The root first; unconnected sensors are not in it."""
    joint_covariance: Array
    """(S·6, S·6) of the errors of all ``sensors``, in their order and in the root's fixed axes; zero for the root.
    NaN in rows and columns of what was not measured, and where the correlation of two sensors is unknown. All
    other covariances are views of it."""
    systematic: tuple[EstimatedParameter, ...] = ()
    """Parameters that were estimated besides poses."""
    evidence: Evidence = field(default_factory=Evidence)
    pictures: Pictures = field(default_factory=Pictures)
    provenance: Provenance | None = None
    """How it was computed; None where it was not computed by a command."""
    prior_errors: PriorErrors | None = None
    """Errors that it shares with other recordings of the rig; None where it was read from a file, and of
    networks."""
    budget: ErrorBudget | None = None
    """What the covariance comes from; None of the published estimators."""
    base: BaseFrame | None = None
    """The root on the vehicle, of a robot that drives; None where rig.yaml states no base."""
    corrections: Mapping[str, Correction] = field(default_factory=dict)
    """By sensor, its systematic parameters with their joint covariance; of rigs."""

    def __post_init__(self) -> None:
        count = len(self.sensors)
        if self.joint_covariance.shape != (6 * count, 6 * count):
            raise InputError(f"joint_covariance: must be ({6 * count}, {6 * count}) for {count} sensors")
        sensors = tuple(copy(sensor) for sensor in self.sensors)
        for k, sensor in enumerate(sensors):
            block = self.joint_covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            object.__setattr__(sensor, "covariance", block)
        object.__setattr__(self, "sensors", sensors)

    def __repr__(self) -> str:
        return format_rows(list_poses(self.sensors, self.evidence.unconnected))

    def _repr_html_(self) -> str:
        """The table of poses, as notebooks show it."""
        return rows_to_html(list_poses(self.sensors, self.evidence.unconnected))

    def __getitem__(self, name: str) -> SensorPose:
        """The pose of the sensor called ``name``.

        Raises:
            InputError: there is no such sensor.
            CalibrationError: the sensor is not connected to the root.
        """
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        if name in self.evidence.unconnected:
            raise CalibrationError(
                f"sensor {name!r} has no pose: nothing connects it to {self.root!r} "
                f"({self.evidence.unconnected[name]})"
            )
        names = ", ".join(sensor.name for sensor in self.sensors)
        raise InputError(f"there is no sensor {name!r} in this calibration; it has {names}")

    @property
    def has_correlations(self) -> bool:
        """Whether all that was measured is observed, and all its correlations are known."""
        measured = ~np.isnan(np.diag(self.joint_covariance))
        return bool(np.isfinite(self.joint_covariance[np.ix_(measured, measured)]).all())

    @property
    def correlated_pairs(self) -> Index:
        """(P, 2) indices of two sensors with errors, the earlier first, whose correlation is known."""
        count = len(self.sensors)
        joint = self.joint_covariance.reshape(count, 6, count, 6)
        known = np.isfinite(joint).any(axis=(1, 3))
        variances = np.nan_to_num(np.diag(self.joint_covariance)).reshape(count, 6)
        uncertain = np.asarray(variances.any(axis=1))
        return np.argwhere(np.triu(known & uncertain & uncertain[:, None], k=1))

    def cross_covariance(self, a: int, b: int) -> Array:
        """The block of ``joint_covariance`` of two sensors, of what was measured: (6, 6), in a plane (3, 3)."""
        rows, columns = (6 * k + np.arange(6) for k in (a, b))
        measured = ~np.isnan(np.diag(self.joint_covariance))
        return np.asarray(self.joint_covariance[np.ix_(rows[measured[rows]], columns[measured[columns]])])

    @property
    def further_remarks(self) -> tuple[str, ...]:
        """The remarks on the whole result that are not part of the reason of a verdict."""
        stated = {
            clause
            for sensor in self.sensors
            if sensor.parent is not None
            for clause in split_clauses(sensor.verdict.reason)
        }
        return tuple(one for one in self.evidence.remarks if not stated.issuperset(split_clauses(one)))

    @property
    def planar(self) -> bool:
        """Whether only x, y and yaw were measured, as in a network, whose scanners are taken to scan one plane."""
        others = [sensor for sensor in self.sensors if sensor.parent is not None]
        return bool(others) and all(np.isnan(np.diag(s.covariance)[UNMEASURED_IN_PLANE]).all() for s in others)

    def transform(self, a: str, b: str) -> Array:
        """``T_a_b`` (4, 4), which maps coordinates in sensor b to coordinates in sensor a.

        Raises:
            InputError: there is no sensor a or b.
            CalibrationError: a or b is not connected to the root.
        """
        return np.asarray(se3.inverse(self[a].T_root_sensor) @ self[b].T_root_sensor)

    def correct(self, name: str, points: Array) -> Array:
        """Points (N, 3) of a scanner, as published, without its systematic errors: in its frame, m.

        Parameters that the data hardly determined are left out, see :meth:`calgraph.result.Correction.learned`.
        Points that are not finite remain as they are.

        Raises:
            InputError: there is no such sensor, it is a camera, or ``points`` has another shape.
            CalibrationError: the sensor is not connected to the root, or the result states no corrections of it.
        """
        if not KINDS[self[name].kind].measures_ranges:
            raise InputError(
                f"{name!r} is a camera and has no points to correct: the export camera_info has its corrected "
                "intrinsics"
            )
        if name not in self.corrections:
            raise CalibrationError(
                f"this result states no corrections of {name!r}: those of rigs do, by the default estimator; "
                "calibrate again if it is of an earlier version"
            )
        if np.ndim(points) != 2 or np.shape(points)[1] != 3:
            raise InputError(f"points: must be (N, 3), got {np.shape(points)}")
        return self.corrections[name].learned().correct(points)

    def with_corrected_points(self) -> "Calibration":
        """The calibration with the points of its pictures corrected, where there are any corrections."""
        return replace(self, pictures=correct_pictures(self.pictures, self.corrections))

    def covariance(self, a: str, b: str) -> Array:
        """Covariance (6, 6) of the error of ``T_a_b`` in the fixed axes of a, (translation, rotation), m and rad.

        NaN in the rows and columns of z, roll and pitch of a network, and of the place of a gyroscope, which are
        not measured.

        Raises:
            InputError: there is no sensor a or b.
            CalibrationError: a or b is not connected to the root, or the correlation of their errors is unknown.
        """
        T_root_a, T_root_b = self[a].T_root_sensor, self[b].T_root_sensor
        names = [sensor.name for sensor in self.sensors]
        rows = np.concatenate([6 * names.index(name) + np.arange(6) for name in (a, b)])
        joint = self.joint_covariance[np.ix_(rows, rows)]
        measured = ~np.isnan(np.diag(joint))
        if np.isnan(joint[np.ix_(measured, measured)]).any():
            raise CalibrationError(
                f"the correlation of the errors of {a!r} and {b!r} is unknown: this result does not state it"
            )
        return np.asarray(propagate_to_relative(T_root_a, T_root_b, joint[None])[0])


def join_covariances(covariances: Sequence[Array]) -> Array:
    """A joint covariance (S·6, S·6) of poses with covariances (6, 6) and unknown correlations, which are NaN.

    A pose without error, as the root's, has no correlation: zero.
    """
    count = len(covariances)
    joint = np.full((count, 6, count, 6), np.nan)
    for k, covariance in enumerate(covariances):
        if not covariance.any():
            joint[k], joint[:, :, k] = 0.0, 0.0
    for k, covariance in enumerate(covariances):
        joint[k, :, k] = covariance
    return joint.reshape(6 * count, 6 * count)
