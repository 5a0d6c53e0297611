"""Comparison of given extrinsics with a calibration some of whose poses something contradicts."""

from dataclasses import replace

from calgraph.config import Rig
from calgraph.result import Calibration, ExtrinsicsFile, SensorPose
from calgraph.result.finding import split_clauses
from calgraph.verdict.comparison import ExtrinsicsComparison, SensorComparison, compare_poses, match_poses
from calgraph.verdict.grades import grade_pose, names_sources


def compare_with_contradictions(
    rig: Rig, calibration: Calibration, given: ExtrinsicsFile, data: str
) -> ExtrinsicsComparison:
    """The comparison by the rig's tolerance; poses that something contradicts fail no given ones.

    Args:
        rig: of the calibration.
        calibration: what a recording gave.
        given: the extrinsics to be checked.
        data: what the calibration is from, in the plural.

    Raises:
        InputError: the extrinsics lack the root, or nothing fixed connects the sensors there.
    """
    settings = rig.settings.diagnostics.verdict
    found = compare_poses(match_poses(calibration, given, rig.tolerance, settings, data))
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
    # Clauses of both, but those that name what the standard deviations come from.
    stated, expected = (
        sum(not names_sources(clause) for clause in split_clauses(one.reason)) if one.reason else 0
        for one in (sensor.verdict, alone)
    )
    return stated > expected


def _leave_open(one: SensorComparison, calibration: Calibration) -> SensorComparison:
    """The comparison, with a fail as a warning."""
    if one.outcome != "fail":
        return one
    why = calibration[one.sensor].verdict.reason
    return replace(one, outcome="warn", reason=f"{one.reason}; not decided: {why}" if why else one.reason)
