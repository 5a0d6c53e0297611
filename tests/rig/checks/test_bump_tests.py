"""Remarks on bumps: what moved, by how much, between which captures, and what follows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import load_rig
from calgraph.graph.spanning_tree import SpanningTree
from calgraph.rig.bundle.problem import Problem, SolverOptions
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.holds import Hold
from calgraph.rig.checks.bump_tests import describe_bumps
from calgraph.rig.checks.pose_steps import PoseStep

SOLUTION = RigSolution("bundle", {"lidar": np.eye(4), "laser": np.eye(4)}, np.zeros((12, 12)), {}, converged=True)
MOVED = "laser moved by 12.3 mm and 0.50° between captures 5 and 7 (8.0 to 9.5 s from the start)"


@pytest.fixture
def problem(tmp_path: Path) -> Problem:
    """Of a recording from 100 s on."""
    (tmp_path / "rig.yaml").write_text(
        "root: lidar\n"
        "target: {kind: board, size: [1.2, 0.9]}\n"
        "sensors: {lidar: {kind: lidar3d, topic: /lidar}, laser: {kind: lidar2d, topic: /laser}}\n"
    )
    holds = Hold(5, 107.0, 108.0), Hold(7, 109.5, 110.0)
    tree = SpanningTree("lidar", {}, {})
    return Problem(
        load_rig(tmp_path / "rig.yaml"), CaptureSet(100.0, {}, holds, {}, {}, {}), {}, tree, SolverOptions()
    )


def bump(*sensors: str) -> PoseStep:
    step = np.array([0.0123, 0, 0, 0, np.radians(0.5), 0])
    return PoseStep(sensors, np.array([1, 2, 5]), np.array([7, 8, 9, 12]), step, 1.0)


def test_one_bump_is_between_the_last_capture_before_and_the_first_after_it(problem: Problem) -> None:
    (finding,) = describe_bumps([bump("laser")], [], problem, SOLUTION, resolved=True)
    assert finding.text == f"{MOVED}: the result is its pose after that, from 4 captures"
    assert finding.sensors == ()


def test_a_sensor_that_moves_twice_is_weak(problem: Problem) -> None:
    first, second = describe_bumps([bump("laser")], [bump("laser")], problem, SOLUTION, resolved=True)
    assert first.text == f"{MOVED}, and not only then: fix it to the robot, and record again"
    assert (first.sensors, second.sensors) == (("laser",), ("laser",))


def test_a_bump_that_too_few_captures_follow_makes_its_sensor_weak_and_the_roots_all(problem: Problem) -> None:
    of_laser, of_root = describe_bumps([bump("laser"), bump("lidar")], [], problem, SOLUTION, resolved=False)
    assert of_laser.text == f"{MOVED}, and the captures after that do not suffice: record again"
    assert (of_laser.sensors, of_root.sensors) == (("laser",), ("lidar", "laser"))


def test_detections_without_times_and_sensors_that_are_not_told_apart_are_stated(problem: Problem) -> None:
    without_times = replace(problem.captures, start=0.0, holds=(Hold(5, 0.0, 0.0), Hold(7, 0.0, 0.0)))
    problem = replace(problem, captures=without_times)
    (finding,) = describe_bumps([bump("lidar", "laser")], [], problem, SOLUTION, resolved=True)
    assert finding.text.startswith(
        "lidar or laser, these captures do not determine which, moved by 12.3 mm and 0.50° "
        "between captures 5 and 7: the result"
    )
