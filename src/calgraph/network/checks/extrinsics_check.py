"""Compares given poses of a network with those of a recording, and finds the scanners that have moved."""

from dataclasses import replace

import numpy as np

from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings
from calgraph.errors import InputError
from calgraph.network.checks.moved_scanners import MovedScanner, find_moved_scanners
from calgraph.network.joint.planar_poses import PlanarPoses, extract_planar_poses, project_to_plane
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.verdict.comparison import ExtrinsicsComparison, SensorComparison, match_poses


def compare_network_poses(
    found: Calibration, given: ExtrinsicsFile, tolerance: Tolerance, *, settings: DiagnosticsSettings
) -> ExtrinsicsComparison:
    """Compares given poses of a network with estimated ones, and finds the fewest scanners that have moved.

    A scanner that has moved by more than the tolerance fails; within the tolerance, it gets a warning. In a
    network without a moved scanner, the probability of a false alarm is that of the settings, regardless of its
    size.

    Args:
        found: the calibration of the recording.
        given: the poses to be checked.
        tolerance: deviations that are acceptable.
        settings: the probability of a false alarm, and the rounding of poses.

    Raises:
        InputError: the root or all other scanners are not in the file, or no fixed transforms connect them there.
    """
    compared = match_poses(found, given, tolerance, settings.verdict.false_alarm_probability)
    frames, T = compared.frames, np.array(list(compared.T_root_sensor.values()))
    before = PlanarPoses(tuple(frames), project_to_plane(T), np.zeros((3 * len(T),) * 2))
    if given.calibration is not None:
        poses = _extract_given_poses(given.calibration).change_root(frames[found.root])
        before = replace(before, covariance=poses.select(tuple(frames.values())).covariance)
    reference, moved = find_moved_scanners(before, extract_planar_poses(found), settings)
    from_reference = compared.compare_in_frame(reference, {})
    moved_by_name = {one.name: one for one in moved}
    sensors = (
        _assess_scanner(sensor, moved_by_name.get(sensor.sensor), compared.tolerance)
        for sensor in from_reference.sensors
    )
    return replace(from_reference, sensors=tuple(sensors))


def _extract_given_poses(calibration: Calibration) -> PlanarPoses:
    try:
        return extract_planar_poses(calibration)
    except InputError as error:
        raise InputError(f"`against`: {error}") from error


def _assess_scanner(
    sensor: SensorComparison, moved: MovedScanner | None, tolerance: Tolerance
) -> SensorComparison:
    """The result of a scanner's comparison, overruled by the joint test for moved scanners."""
    if moved is None:
        return replace(sensor, outcome="warn") if sensor.outcome == "fail" else sensor
    far = moved.distance > tolerance.translation or abs(np.degrees(moved.rotation)) > tolerance.rotation
    displacement = f"has moved by {moved}{'' if far else ', which is within the tolerance'}"
    reason = f"{displacement}; {sensor.reason}" if sensor.reason else displacement
    return replace(sensor, outcome="fail" if far else "warn", reason=reason)
