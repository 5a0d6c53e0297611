"""Whether given extrinsics still hold, by a drive: which sensor has moved, without a board."""

from dataclasses import replace

from calgraph.config import Rig
from calgraph.drive.options import DriveOptions
from calgraph.drive.pipeline import calibrate_drive
from calgraph.parallel.progress import Progress, no_progress
from calgraph.recording import Recording
from calgraph.result import Calibration, ExtrinsicsFile, SensorPose
from calgraph.result.reasons import split_clauses
from calgraph.verdict.comparison import ExtrinsicsComparison, SensorComparison, compare_poses, match_poses
from calgraph.verdict.grades import grade_pose


def compare_drive_extrinsics(
    rig: Rig, recording: Recording, given: ExtrinsicsFile, options: DriveOptions, progress: Progress = no_progress
) -> tuple[Calibration, ExtrinsicsComparison]:
    """Comparison of given extrinsics with the calibration of a drive, by the rig's tolerance.

    Raises:
        InputError: the extrinsics lack the root, or nothing fixed connects the sensors there; and as for
            :func:`calgraph.drive.pipeline.calibrate_drive`.
    """
    calibration = calibrate_drive(rig, recording, options, progress)
    return calibration, compare_with_drive(rig, calibration, given)


def compare_with_drive(rig: Rig, calibration: Calibration, given: ExtrinsicsFile) -> ExtrinsicsComparison:
    """Comparison with what a drive gave; poses that something contradicts fail no given ones."""
    settings = rig.settings.diagnostics.verdict
    found = compare_poses(match_poses(calibration, given, rig.tolerance, settings, "motions"))
    contradicted = {one.name for one in calibration.sensors if _is_contradicted(rig, one)}
    if found.reference in contradicted:
        contradicted |= {one.sensor for one in found.sensors}
    sensors = tuple(_leave_open(one, calibration) if one.sensor in contradicted else one for one in found.sensors)
    return replace(found, sensors=sensors)


def _is_contradicted(rig: Rig, sensor: SensorPose) -> bool:
    """Whether a pose is not good for other reasons than its standard deviations."""
    if sensor.parent is None:
        return False
    alone = grade_pose(
        sensor.name, sensor.kind, sensor.T_root_sensor, sensor.measured_covariance,
        tolerance=rig.tolerance, settings=rig.settings.diagnostics.verdict,
    )  # fmt: skip
    stated, expected = (len(split_clauses(one.reason)) if one.reason else 0 for one in (sensor.verdict, alone))
    return stated > expected


def _leave_open(one: SensorComparison, calibration: Calibration) -> SensorComparison:
    """The comparison, with a fail as a warning."""
    if one.outcome != "fail":
        return one
    why = calibration[one.sensor].verdict.reason
    return replace(one, outcome="warn", reason=f"{one.reason}; not decided: {why}" if why else one.reason)
