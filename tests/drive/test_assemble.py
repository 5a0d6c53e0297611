"""Verdicts of drives: what keeps a pose whose standard deviations are small from being good."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.config import Rig
from calgraph.drive.adjustment import Adjustment
from calgraph.drive.assemble import DriveResult, assemble_drive
from calgraph.drive.start import MotionStart
from calgraph.result.finding import Finding
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel

RIG = Rig.model_validate({
    "root": "front",
    "target": {"kind": "surroundings"},
    "sensors": {name: {"kind": "lidar3d", "topic": f"/{name}"} for name in ("front", "rear")},
})  # fmt: skip


def solution() -> Adjustment:
    """Two LiDARs with standard deviations of 1 mm and 1 mrad, whose maps agree."""
    free: NDArray[np.bool_] = np.ones((2, 6 + BESIDE_POSE), dtype=bool)
    free[0, :7] = False
    P = 1e-6 * np.eye(int(free.sum()))
    T_front_rear = np.eye(4)
    T_front_rear[:3, 3] = -0.5, 0.1, 0.2
    return Adjustment(
        [SensorState(np.eye(4)), SensorState(T_front_rear)], [], P, P, free,
        NoiseModel(np.full(2, 0.02), np.zeros(2)),
        20.0 * (1 - np.eye(2)), np.full(2, 1e5), 0.01,
    )  # fmt: skip


START = MotionStart(np.eye(4), 0.0, 0.7, 0.99, 57, np.full(3, 0.2))


def grade(adjusted: Adjustment, start: MotionStart = START, findings: Sequence[Finding] = ()) -> tuple[str, str]:
    views = dict.fromkeys(("front", "rear"), np.zeros((0, 2)))
    result = DriveResult(["front", "rear"], {}, {"rear": start}, adjusted, findings, views)
    verdict = assemble_drive(RIG, result)["rear"].verdict
    return verdict.grade, verdict.reason


def test_a_certain_pose_that_nothing_contradicts_is_good() -> None:
    assert grade(solution()) == ("good", "")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"squared_step": 30.0}, "has not converged"),
        ({"agreement": np.array([[0.0, 2], [2, 0]])}, "agree with those of other sensors in 2 places"),
        ({"point_counts": np.array([0, 1e5])}, "it and the root do not both measure surfaces"),
    ],
)
def test_a_solution_that_is_not_to_be_trusted_is_weak(change: dict[str, Any], reason: str) -> None:
    found, text = grade(replace(solution(), **change))
    assert found == "weak"
    assert reason in text


@pytest.mark.parametrize(("agreeing", "grade_of_both"), [([(0, 1), (1, 2)], "good"), ([(1, 2)], "weak")])
def test_maps_agree_with_that_of_the_root_by_chains(agreeing: list[tuple[int, int]], grade_of_both: str) -> None:
    """Two sensors whose maps agree with each other only may have the same wrong odometry."""
    names = ["front", "rear", "right"]
    sensors = {name: {"kind": "lidar3d", "topic": f"/{name}"} for name in names}
    rig = Rig.model_validate({"root": "front", "target": {"kind": "surroundings"}, "sensors": sensors})
    two, agreement = solution(), np.zeros((3, 3))
    for i, j in agreeing:
        agreement[i, j] = agreement[j, i] = 20.0
    free = two.free[[0, 1, 1]]
    P = 1e-6 * np.eye(int(free.sum()))
    three = replace(
        two, states=[*two.states, two.states[1]], covariance=P, independent_covariance=P, free=free,
        agreement=agreement, noise=NoiseModel(np.full(3, 0.02), np.zeros(2)), point_counts=np.full(3, 1e5),
    )  # fmt: skip
    views = dict.fromkeys(names, np.zeros((0, 2)))
    found = assemble_drive(rig, DriveResult(names, {}, {"rear": START, "right": START}, three, [], views))
    assert [found[name].verdict.grade for name in names[1:]] == [grade_of_both] * 2


def test_lidars_whose_turn_rates_agree_in_part_are_weak() -> None:
    """Beside a lorry the correlation is 0.65 to 0.93, and on real scans at least 0.948."""
    assert grade(solution(), replace(START, correlation=0.95))[0] == "good"
    found, text = grade(solution(), replace(START, correlation=0.93))
    assert found == "weak"
    assert "in part only (correlation 0.93)" in text


def test_the_correlation_with_another_root_is_the_lower_of_both() -> None:
    other = replace(START, correlation=0.5)
    assert (START.relative_to(other).correlation, other.relative_to(START).correlation) == (0.5, 0.5)


def test_a_sensor_that_moved_is_weak() -> None:
    assert grade(solution(), findings=[Finding("rear moved", ("rear",))]) == ("weak", "rear moved")
