"""The result of one recording of a fleet, and recording.json, the file in its folder that completes it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from calgraph.errors import CalibrationError, InputError
from calgraph.geometry import Array, se3
from calgraph.io.atomic import write_text
from calgraph.io.text_writing import format_json
from calgraph.result import Calibration, ExtrinsicsFile, PriorErrors


@dataclass(frozen=True, eq=False)
class PoseSet:
    """Poses of N sensors in the frame of the first one, the root."""

    names: tuple[str, ...]
    T_root_sensor: Array
    """(N, 4, 4)."""
    covariance: Array
    """(6N, 6N) of the errors in the root's fixed axes, m and rad; zero for the root, NaN where nothing was
    measured."""
    prior_errors: PriorErrors | None = None
    """Errors that recordings of the same rig share; None where they are not known."""

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "PoseSet":
        """The poses of a calibration."""
        return cls(
            tuple(sensor.name for sensor in calibration.sensors),
            np.array([sensor.T_root_sensor for sensor in calibration.sensors]),
            calibration.joint_covariance,
            calibration.prior_errors,
        )

    @classmethod
    def from_extrinsics(cls, given: ExtrinsicsFile, calibration: Calibration) -> "PoseSet":
        """The given poses of a calibration's sensors, in the frame of its root.

        Raises:
            InputError: the root or all other sensors are not in the file, or nothing fixed connects them there.
        """
        frame_ids = {sensor.name: sensor.frame_id for sensor in calibration.sensors}
        root = given.frame_of_sensor(calibration.root, frame_ids)
        frames = given.frames_of_sensors(frame_ids)
        T = np.array([given.transform(root, frame) for frame in frames.values()])
        return cls(tuple(frames), T, _covariance_in_frame(given, root, tuple(frames.values())))

    def select(self, names: Sequence[str]) -> "PoseSet":
        """The poses of some sensors, of which the first has to be the root."""
        numbers = np.array([self.names.index(name) for name in names], dtype=np.intp)
        rows = (6 * numbers[:, None] + np.arange(6)).ravel()
        errors = self.prior_errors and PriorErrors(self.prior_errors.parameters, self.prior_errors.poses[rows])
        return PoseSet(tuple(names), self.T_root_sensor[numbers], self.covariance[np.ix_(rows, rows)], errors)


def _covariance_in_frame(given: ExtrinsicsFile, root: str, frames: Sequence[str]) -> Array:
    """The joint covariance (6N, 6N) of given poses in the frame of one; zero where the file has none."""
    calibration = given.calibration
    if calibration is None or not calibration.has_correlations:
        return np.zeros((6 * len(frames), 6 * len(frames)))
    poses = PoseSet.from_calibration(calibration).select([root, *(one for one in frames if one != root)])
    T, count = poses.T_root_sensor, len(frames)
    by_root, by_sensor = se3.relative_pose_jacobians(np.broadcast_to(T[0], T.shape), T)
    J = np.kron(np.eye(count), by_sensor[0])
    J[:, :6] += by_root.reshape(-1, 6)
    covariance = J @ np.nan_to_num(poses.covariance) @ J.T
    unmeasured = np.isnan(np.diag(poses.covariance))
    covariance[unmeasured] = covariance[:, unmeasured] = np.nan
    reordered = PoseSet(poses.names, T, covariance).select(frames)
    return reordered.covariance


FILE_NAME = "recording.json"
_FORMAT = "calgraph-fleet-recording/1"
FailureKind = Literal["input", "data", "memory", "killed", "internal"]
Grade = Literal["good", "weak", "unobservable", "unconnected"]
Outcome = Literal["pass", "warn", "fail"]


@dataclass(frozen=True)
class Failure:
    """Why a recording has no calibration."""

    kind: FailureKind
    """``input``: it cannot be read, or does not fit the rig; ``data``: it determines nothing; ``memory``: memory
    ran out; ``killed``: its process was killed; ``internal``: an error of calgraph."""
    message: str
    traceback: str = ""
    """Of internal errors."""

    @classmethod
    def of(cls, error: Exception, traceback: str) -> "Failure":
        """The failure that an exception reports."""
        if isinstance(error, InputError):
            return cls("input", str(error))
        if isinstance(error, CalibrationError):
            return cls("data", str(error))
        if isinstance(error, MemoryError):
            return cls("memory", "memory ran out; reduce `jobs`, or give a shorter recording")
        return cls("internal", f"{type(error).__name__}: {error}", traceback)


@dataclass(frozen=True)
class SensorResult:
    """The verdict on one sensor."""

    name: str
    kind: str
    grade: Grade
    reason: str = ""
    outcome: Outcome | None = None
    """Of the comparison with the reference, where it was checked,"""
    difference: str = ""
    """and its reason."""


@dataclass(frozen=True, eq=False)
class RecordingResult:
    """The result of one recording."""

    robot: str
    recording: str
    path: str
    key: str
    """Hash of everything that the result depends on."""
    seconds: float
    """Time that it took."""
    failure: Failure | None = None
    start: float | None = None
    """Of the recording, s."""
    duration: float | None = None
    """s."""
    sensors: tuple[SensorResult, ...] = ()
    """The root first; also those without a pose."""
    poses: PoseSet | None = None
    reference: PoseSet | None = None
    """The poses of the reference, where there is one."""
    warnings: tuple[str, ...] = ()
    """Such as that a file is cut off, and how far it was read."""

    @property
    def lost(self) -> tuple[str, ...]:
        """Sensors without a usable pose."""
        return tuple(one.name for one in self.sensors if one.grade in ("unobservable", "unconnected"))

    @property
    def failed_checks(self) -> tuple[str, ...]:
        """Sensors whose poses differ from the reference."""
        return tuple(one.name for one in self.sensors if one.outcome == "fail")

    @property
    def is_weak(self) -> bool:
        """Whether a sensor is weak, or a comparison does not decide."""
        return any(one.grade == "weak" or one.outcome == "warn" for one in self.sensors)


def save_result(result: RecordingResult, folder: Path) -> None:
    """Writes recording.json in one step.

    Raises:
        InputError: the folder cannot be written to.
    """
    write_text(folder / FILE_NAME, format_json({"format": _FORMAT, **asdict(result)}) + "\n")


def load_result(folder: Path) -> RecordingResult | None:
    """The result in a folder; None if there is none, or it is damaged or of another version."""
    try:
        content = json.loads((folder / FILE_NAME).read_text(encoding="utf-8"))
        if content.pop("format") != _FORMAT:
            return None
        failure = content.pop("failure")
        return RecordingResult(
            failure=Failure(**_checked(failure, "kind", FailureKind)) if failure else None,
            sensors=tuple(SensorResult(**_checked(one, "grade", Grade)) for one in content.pop("sensors")),
            poses=_decode_poses(content.pop("poses")),
            reference=_decode_poses(content.pop("reference")),
            warnings=tuple(content.pop("warnings")),
            **content,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _checked(entry: dict[str, Any], key: str, allowed: Any) -> dict[str, Any]:
    if entry[key] not in get_args(allowed):
        raise ValueError(f"{key}: {entry[key]}")
    return entry


def _decode_poses(entry: Mapping[str, Any] | None) -> PoseSet | None:
    if entry is None:
        return None
    names, errors = tuple(entry["names"]), entry["prior_errors"]
    count = len(names)
    return PoseSet(
        names,
        _array(entry["T_root_sensor"], (count, 4, 4)),
        _array(entry["covariance"], (6 * count, 6 * count)),
        PriorErrors(
            tuple((of, quantity) for of, quantity in errors["parameters"]),
            _array(errors["poses"], (6 * count, len(errors["parameters"]))),
        )
        if errors
        else None,
    )


def _array(values: Any, shape: tuple[int, ...]) -> Array:
    """Nested lists as an array; null, which JSON has for NaN, becomes NaN."""
    return np.array(values, dtype=np.float64).reshape(shape)
