"""Adds to a calibration the board poses that would improve it most."""

from collections.abc import Sequence
from dataclasses import replace

from calgraph.result import Calibration, SensorPose, Suggestion, Verdict


def add_suggestions(calibration: Calibration, suggestions: Sequence[Suggestion]) -> Calibration:
    """The calibration with the suggested board poses.

    Args:
        calibration: poses and verdicts.
        suggestions: see :func:`calgraph.rig.checks.next_best_pose.suggest_board_poses`.
    """
    return replace(
        calibration,
        sensors=tuple(_add_advice(sensor, suggestions) for sensor in calibration.sensors),
        evidence=replace(calibration.evidence, suggestions=tuple(suggestions)),
    )


def _add_advice(sensor: SensorPose, suggestions: Sequence[Suggestion]) -> SensorPose:
    """The sensor with the first pose suggested for it in its verdict, unless it is good."""
    first = next((s for s in suggestions if s.sensor == sensor.name), None)
    if first is None or sensor.verdict.grade == "good":
        return sensor
    return replace(sensor, verdict=Verdict(sensor.verdict.grade, f"{sensor.verdict.reason}; first {first.hold}"))
