"""Finds the scanners that have moved: the fewest that explain the difference of two sets of poses."""

from dataclasses import dataclass, replace

import numpy as np

from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings
from calgraph.geometry import se_n
from calgraph.network.joint.planar_poses import NetworkPoses, extract_planar_poses, project_to_plane
from calgraph.result import Calibration, ExtrinsicsFile
from calgraph.verdict.comparison import ExtrinsicsComparison, SensorComparison, match_poses
from calgraph.verdict.displaced_nodes import find_displaced_nodes


@dataclass(frozen=True)
class MovedScanner:
    """How far a scanner has moved relative to one that has not."""

    name: str
    distance: float
    """m."""
    rotation: float
    """rad, counter-clockwise; about any axis in space."""

    def __str__(self) -> str:
        """The displacement in words; adding zero removes the sign of a negative zero."""
        return f"{1000 * self.distance:.1f} mm and {round(float(np.degrees(self.rotation)), 2) + 0.0:+.2f}°"


# m; error of poses by rounding in files, added before moved scanners are searched: URDF and tf files are often
# written by hand with four decimals.
_POSITION_ROUNDING = 1e-4
# rad; the same of angles, of which files have about five decimals.
_ROTATION_ROUNDING = 1e-5
# Sets of one size of moved scanners that are all tested, in about a second; where there are more, the best
# smaller set grows by one scanner.
_MAX_SETS = 3000


def find_moved_scanners(
    before: NetworkPoses, after: NetworkPoses, settings: DiagnosticsSettings
) -> tuple[str, tuple[MovedScanner, ...]]:
    """Finds the scanners that have moved between two sets of poses, and how far.

    Args:
        before: poses of the same scanners, in the frame of the same root.
        after: estimated independently.
        settings: the probability of a false alarm, and the rounding of poses.

    Returns:
        A scanner that has not moved, the root if possible; and the displacements relative to it.
    """
    after = after.select(before.names)
    difference = se_n.difference(after.T_root_scanner, before.T_root_scanner)
    n, d = before.T_root_scanner.shape[-1] - 1, before.size
    rounding = n * [_POSITION_ROUNDING] + (d - n) * [_ROTATION_ROUNDING]
    of_rounding = np.diag(np.tile(np.square(rounding), len(before.names)))
    covariance = before.covariance + after.covariance + of_rounding
    nodes, *_ = find_displaced_nodes(
        before.T_root_scanner, difference, covariance, settings.verdict.false_alarm_probability, _MAX_SETS
    )
    reference = next(name for k, name in enumerate(before.names) if k not in nodes)
    selected = [reference, *(before.names[k] for k in nodes)]
    T_before = before.change_root(reference).select(selected).T_root_scanner
    T_after = after.change_root(reference).select(selected).T_root_scanner
    steps = se_n.difference(T_after, T_before)
    return reference, tuple(
        MovedScanner(name, float(np.linalg.norm(step[:n])), float(step[n] if n == 2 else np.linalg.norm(step[n:])))
        for name, step in zip(selected[1:], steps[1:], strict=True)
    )


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
    compared = match_poses(found, given, tolerance, settings.verdict)
    frames, T = compared.frames, np.array(list(compared.T_root_sensor.values()))
    before = NetworkPoses(tuple(frames), project_to_plane(T), np.zeros((3 * len(T),) * 2))
    if given.calibration is not None:
        poses = extract_planar_poses(given.calibration, "`against`: ").change_root(frames[found.root])
        before = replace(before, covariance=poses.select(tuple(frames.values())).covariance)
    reference, moved = find_moved_scanners(before, extract_planar_poses(found), settings)
    from_reference = compared.compare_in_frame(reference, {})
    moved_by_name = {one.name: one for one in moved}
    sensors = (
        _assess_scanner(sensor, moved_by_name.get(sensor.sensor), compared.tolerance)
        for sensor in from_reference.sensors
    )
    return replace(from_reference, sensors=tuple(sensors))


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
