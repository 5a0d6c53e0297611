"""Whether the given poses of a network agree with what a recording says of them, and which scanner has moved."""

from dataclasses import replace

import numpy as np

from calgraph.diagnostics.comparison import CHANCE, ExtrinsicsComparison, SensorComparison, Tolerance, match_poses
from calgraph.diagnostics.network.moved_scanners import Displacement, displacements
from calgraph.errors import InputError
from calgraph.estimation.network.planar_poses import PlanarPoses, in_plane, planar_poses
from calgraph.result import Calibration, ExtrinsicsFile


def compare_network_poses(
    found: Calibration, given: ExtrinsicsFile, tolerance: Tolerance | None = None
) -> ExtrinsicsComparison:
    """Compares given poses of a network with those found, and names the fewest scanners that explain what differs.

    Scanners fail that have moved by more than the tolerance. If nothing has moved, none is taken to have with a
    probability of 999 in 1000, however many there are; one that has moved within the tolerance is a warning.

    Args:
        found: the calibration that the recording gives.
        given: the poses to be judged.
        tolerance: what may be off without harm.

    Raises:
        InputError: the root or all other scanners are not in the file, or nothing fixed connects them there.
    """
    compared = match_poses(found, given, tolerance)
    frames, T = compared.frames, np.array(list(compared.T_root_sensor.values()))
    before = PlanarPoses(tuple(frames), in_plane(T), np.zeros((3 * len(T),) * 2))
    if given.calibration is not None:
        known = _known(given.calibration).seen_from(frames[found.root])
        before = replace(before, covariance=known.of(tuple(frames.values())).covariance)
    reference, moved = displacements(before, planar_poses(found), CHANCE)
    seen = compared.compare_in_frame(reference, {})
    off = {one.name: one for one in moved}
    judged = (_judged(sensor, off.get(sensor.sensor), compared.tolerance) for sensor in seen.sensors)
    return replace(seen, sensors=tuple(judged))


def _known(calibration: Calibration) -> PlanarPoses:
    try:
        return planar_poses(calibration)
    except InputError as error:
        raise InputError(f"--against: {error}") from error


def _judged(sensor: SensorComparison, moved: Displacement | None, tolerance: Tolerance) -> SensorComparison:
    """A scanner as its own pose looks, and as all of them together say whether it has moved."""
    if moved is None:
        return replace(sensor, outcome="warn") if sensor.outcome == "fail" else sensor
    far = moved.distance > tolerance.position or abs(moved.turn) > tolerance.rotation
    said = f"has moved by {moved}{'' if far else ', which is within the tolerance'}"
    reason = f"{said}; {sensor.reason}" if sensor.reason else said
    return replace(sensor, outcome="fail" if far else "warn", reason=reason)
