"""Poses of a rig's sensors with their joint covariance, from a recording or a file of extrinsics."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.geometry import Array, se3
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
