"""Suggested board poses as advice in verdicts."""

from typing import Literal

import numpy as np
import pytest
from scipy.linalg import block_diag

from bundle_scenes import HEIGHT, WIDTH, scene
from calgraph.config import Tolerance
from calgraph.config.settings import DiagnosticsSettings
from calgraph.result import Calibration, SensorPose, Suggestion, Verdict
from calgraph.rig.bundle.bundle_solver import minimize_bundle
from calgraph.rig.bundle.covariances import pose_covariance
from calgraph.rig.bundle.solution import RigSolution, SolvedBundle
from calgraph.rig.checks.next_best_pose import add_drifts, add_suggestions, suggest_board_poses
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors.kinds import KINDS as SENSOR_KINDS
from calgraph.simulation import RigScenario, build_world
from ideal_detections import simulate_detections

KINDS: dict[str, Literal["camera", "lidar2d", "lidar3d"]] = {
    "lidar": "lidar3d",
    "camera": "camera",
    "laser": "lidar2d",
}


def suggest(grade: Literal["good", "weak"]) -> Calibration:
    """Of three sensors and six boards, after which the laser is the least certain; all have the grade given."""
    exact = scene(boards=6)
    solved = minimize_bundle(exact.bundle, exact.truth)
    verdict = Verdict(grade, "some axis ±3 mm")
    sensors = tuple(
        SensorPose(name, "lidar" if k else None, name, KINDS[name], exact.truth.T_root_sensor[k], verdict)
        for k, name in enumerate(exact.bundle.sensors)
    )
    joint = pose_covariance(exact.bundle, solved.state, solved.equations)
    calibration = Calibration("lidar", sensors, joint_covariance=joint)
    rng = np.random.default_rng(0)
    problem = SolvedBundle(exact.bundle, solved, np.arange(6))
    return add_suggestions(
        calibration,
        suggest_board_poses(problem, KINDS, (WIDTH, HEIGHT), rng, Tolerance(), settings=DiagnosticsSettings()),
    )


def test_the_first_suggestion_for_a_weak_sensor_is_in_its_verdict() -> None:
    found = suggest("weak")
    (first, *_) = found.evidence.suggestions
    reasons = {sensor.name: sensor.verdict.reason for sensor in found.sensors}
    assert reasons[first.sensor] == f"some axis ±3 mm; first {first.hold}"
    suggested = {suggestion.sensor for suggestion in found.evidence.suggestions}
    assert {reasons[name] for name in reasons if name not in suggested} <= {"some axis ±3 mm"}
    assert suggested != set(reasons)


def test_good_sensors_need_no_advice() -> None:
    assert {sensor.verdict.reason for sensor in suggest("good").sensors} == {"some axis ±3 mm"}


def test_the_standard_deviations_of_suggestions_are_those_of_the_published_poses() -> None:
    """Serial correlation doubles variances, and drifts add 16 mm², which a capture does not change."""
    exact = scene(boards=6)
    T, name = dict(zip(exact.bundle.sensors, exact.truth.T_root_sensor, strict=True)), "laser"
    R = np.kron(np.eye(2), T[name][:3, :3])
    plain = R @ np.diag([9e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6]) @ R.T
    before, after = (
        RigSolution("bundle", T, block_diag(*np.zeros((2, 6, 6)), covariance), {}, converged=True)
        for covariance in (plain, 2 * plain + 1.6e-5 * np.eye(6))
    )
    suggestion = Suggestion("here", name, "forward (x)", "m", 0.003, 0.001, np.eye(4))
    (found,) = add_drifts([suggestion], KINDS, before, after, 2.0)
    assert found.stddev == pytest.approx(np.sqrt(2 * 9e-6 + 1.6e-5))
    assert found.expected == pytest.approx(np.sqrt(2 * 1e-6 + 1.6e-5))


@pytest.mark.parametrize("tolerance", [0.05, 0.001])
@pytest.mark.parametrize("jobs", [1, 2])
def test_captures_are_suggested_only_if_a_pose_is_not_good(tolerance: float, jobs: int) -> None:
    rig, captures, _ = simulate_detections(build_world(RigScenario(), 1, images=False), 1)
    rig = rig.model_copy(update={"tolerance": Tolerance(translation=tolerance, rotation=3.0)})
    problem = build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(0))
    calibration = solve_problem(problem, jobs)
    for one in calibration.evidence.suggestions[:1]:
        published = calibration[one.sensor].axis_stddev[
            SENSOR_KINDS[calibration[one.sensor].kind].axes.index(one.axis)
        ]
        assert one.stddev == pytest.approx(published, rel=1e-6)
    good = {sensor.verdict.grade for sensor in calibration.sensors} == {"good"}
    assert good == (tolerance == 0.05)
    assert bool(calibration.evidence.suggestions) != good
