"""What a solved bundle says beyond its poses: how well it predicts, and which captures are missing."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calgraph.diagnostics.rig.cross_validation import cross_validate
from calgraph.diagnostics.rig.next_best_pose import suggest_board_poses
from calgraph.estimation.rig.solution import SolvedBundle
from calgraph.result import Calibration, SensorPose, Suggestion, Verdict


def add_assessment(
    calibration: Calibration,
    adjusted: SolvedBundle,
    size: tuple[float, float],
    folds: int,
    rng: np.random.Generator,
) -> Calibration:
    """The calibration with its cross-validation, and with the captures that would help most.

    Args:
        calibration: poses and verdicts.
        adjusted: what they were made from.
        size: width and height of the board, m.
        folds: of the cross-validation; 0 for none.
        rng: draws the boards that are tried.

    Raises:
        InputError: there is one fold.
    """
    kinds = {sensor.name: sensor.kind for sensor in calibration.sensors}
    suggestions = suggest_board_poses(adjusted, kinds, size, rng)
    return replace(
        calibration,
        sensors=tuple(_add_advice(sensor, suggestions) for sensor in calibration.sensors),
        evidence=replace(
            calibration.evidence,
            cross_validation=cross_validate(adjusted, folds) if folds else {},
            suggestions=suggestions,
        ),
    )


def _add_advice(sensor: SensorPose, suggestions: Sequence[Suggestion]) -> SensorPose:
    """The sensor with the first capture that would help it in its verdict, unless it is good already."""
    first = next((s for s in suggestions if s.sensor == sensor.name), None)
    if first is None or sensor.verdict.grade == "good":
        return sensor
    return replace(sensor, verdict=Verdict(sensor.verdict.grade, f"{sensor.verdict.reason}; first {first.hold}"))
