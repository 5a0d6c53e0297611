"""Adds to a calibration the board poses that would improve it most."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings
from calgraph.diagnostics.rig.next_best_pose import suggest_board_poses
from calgraph.estimation.rig.solution import SolvedBundle
from calgraph.result import Calibration, SensorPose, Suggestion, Verdict


def add_suggestions(
    calibration: Calibration,
    solved: SolvedBundle,
    size: tuple[float, float],
    rng: np.random.Generator,
    tolerance: Tolerance,
    settings: DiagnosticsSettings = DiagnosticsSettings(),
) -> Calibration:
    """The calibration with the suggested board poses.

    Args:
        calibration: poses and verdicts.
        solved: the joint solution that they come from.
        size: width and height of the board, m.
        rng: draws candidate board poses.
        tolerance: the largest acceptable error of poses.
        settings: of the diagnostics.
    """
    kinds = {sensor.name: sensor.kind for sensor in calibration.sensors}
    suggestions = suggest_board_poses(solved, kinds, size, rng, tolerance, settings)
    return replace(
        calibration,
        sensors=tuple(_add_advice(sensor, suggestions) for sensor in calibration.sensors),
        evidence=replace(calibration.evidence, suggestions=suggestions),
    )


def _add_advice(sensor: SensorPose, suggestions: Sequence[Suggestion]) -> SensorPose:
    """The sensor with the first pose suggested for it in its verdict, unless it is good."""
    first = next((s for s in suggestions if s.sensor == sensor.name), None)
    if first is None or sensor.verdict.grade == "good":
        return sensor
    return replace(sensor, verdict=Verdict(sensor.verdict.grade, f"{sensor.verdict.reason}; first {first.hold}"))
