"""Remarks on bumps: what moved, by how much, between which captures, and what follows."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig, load_rig
from calgraph.rig.bundle.solution import RigSolution
from calgraph.rig.checks.bump_tests import Bump, describe_bumps

SOLUTION = RigSolution("bundle", {"lidar": np.eye(4), "laser": np.eye(4)}, np.zeros((12, 12)), {}, converged=True)
MOVED = "laser moved by 12.3 mm and 0.50° between captures 5 and 7 (8.0 to 9.5 s from the start)"


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    (tmp_path / "rig.yaml").write_text(
        "root: lidar\n"
        "target: {kind: board, size: [1.2, 0.9]}\n"
        "sensors: {lidar: {kind: lidar3d, topic: /lidar}, laser: {kind: lidar2d, topic: /laser}}\n"
    )
    return load_rig(tmp_path / "rig.yaml")


def bump(*sensors: str, interval: tuple[float, float] = (8.0, 9.5)) -> Bump:
    return Bump(sensors, (1, 2, 5), (7, 8, 9, 12), interval, 0.0123, float(np.radians(0.5)), 9.0)


def test_one_bump_is_between_the_last_capture_before_and_the_first_after_it(rig: Rig) -> None:
    (finding,) = describe_bumps([bump("laser")], [], rig, SOLUTION, resolved=True)
    assert finding.text == f"{MOVED}: the result is its pose after that, from 4 captures"
    assert finding.sensors == ()


def test_a_sensor_that_moves_twice_is_weak(rig: Rig) -> None:
    first, second = describe_bumps([bump("laser")], [bump("laser")], rig, SOLUTION, resolved=True)
    assert first.text == f"{MOVED}, and not only then: fix it to the robot, and record again"
    assert (first.sensors, second.sensors) == (("laser",), ("laser",))


def test_a_bump_that_too_few_captures_follow_makes_its_sensor_weak_and_the_roots_all(rig: Rig) -> None:
    of_laser, of_root = describe_bumps([bump("laser"), bump("lidar")], [], rig, SOLUTION, resolved=False)
    assert of_laser.text == f"{MOVED}, and the captures after that do not suffice: record again"
    assert (of_laser.sensors, of_root.sensors) == (("laser",), ("lidar", "laser"))


def test_detections_without_times_and_sensors_that_are_not_told_apart_are_stated(rig: Rig) -> None:
    (finding,) = describe_bumps([bump("lidar", "laser", interval=(0.0, 0.0))], [], rig, SOLUTION, resolved=True)
    assert finding.text.startswith(
        "lidar or laser, these captures do not determine which, moved by 12.3 mm and 0.50° "
        "between captures 5 and 7: the result"
    )
