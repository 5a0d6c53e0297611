"""Remedies of weak sensors, against calibrations after they were taken."""

from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.result import Calibration, ExtrinsicsFile, Remedy, load_calibration, save_calibration
from calgraph.result.frame_tree import FrameLink, FrameTree
from calgraph.result.sensor_pose import stddev_along_axes
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_jointly, solve_problem
from calgraph.rig.verification import compare_extrinsics
from calgraph.sensors.kinds import KINDS
from calgraph.verdict.comparison import ExtrinsicsComparison
from ideal_detections import simulate_detections
from model_error_rigs import rig_world
from model_errors import with_captures
from taken_remedies import state_uncertainty

SEED = 100


def detect(captures: int) -> tuple[Rig, CaptureSet]:
    """A camera and a LiDAR, and the first of some captures."""
    world = with_captures(rig_world("pair", SEED), captures, np.random.default_rng(SEED))
    rig, detected, _ = simulate_detections(world, SEED)
    return rig, detected


def solve(rig: Rig, captures: CaptureSet) -> Calibration:
    return solve_problem(
        build_problem_from_captures(rig, captures, RigOptions(folds=0), np.random.default_rng(SEED))
    )


@pytest.fixture(scope="module")
def weak() -> Calibration:
    return solve(*detect(10))


def remedies(calibration: Calibration) -> tuple[Remedy, ...]:
    found = calibration.evidence.remedies
    assert found
    return found


def test_a_known_lens_gives_the_standard_deviation_that_was_predicted(weak: Calibration) -> None:
    remedy = next(one for one in remedies(weak) if "camera" in one.uncertainty)
    rig, captures = detect(10)
    after = solve(state_uncertainty(rig, remedy), captures)["camera"]
    axis = KINDS["camera"].axes.index(remedy.axis)
    assert remedy.expected < 0.9 * remedy.stddev
    assert after.axis_stddev[axis] == pytest.approx(remedy.expected, rel=0.05)


def test_those_that_suffice_come_first(weak: Calibration) -> None:
    suffices = [one.suffices for one in remedies(weak)]
    assert suffices == sorted(suffices, reverse=True)
    assert suffices[0]


def test_the_verdict_states_the_largest_source_and_the_first_remedy(weak: Calibration) -> None:
    reason, first = weak["camera"].verdict.reason, remedies(weak)[0]
    assert weak["camera"].verdict.grade == "weak"
    assert "the largest source of pitch (about x): noise of camera (" in reason
    assert f"{first.action}: {first.axis} ±" in reason
    assert reason.count("hold the board") == first.action.count("hold the board")


def test_a_good_sensor_has_none() -> None:
    calibration = solve(*detect(60))
    assert calibration["camera"].verdict.grade == "good"
    assert not calibration.evidence.remedies


def test_remedies_are_in_the_file(weak: Calibration, tmp_path: Path) -> None:
    save_calibration(weak, tmp_path / "calibration.yaml")
    again = load_calibration(tmp_path / "calibration.yaml").evidence.remedies
    assert [str(one) for one in again] == [str(one) for one in remedies(weak)]


@pytest.fixture(scope="module")
def checked(weak: Calibration) -> tuple[Calibration, ExtrinsicsComparison]:
    """The same captures against the poses that were estimated from them, as a file without covariances."""
    rig, captures = detect(10)
    problem = build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(SEED))
    above = {name.frame_id: FrameLink("lidar", name.T_root_sensor) for name in weak.sensors if name.parent}
    return compare_extrinsics(problem, ExtrinsicsFile(Path("robot.urdf"), FrameTree("robot.urdf", above)))


def test_a_check_states_remedies_of_its_own_standard_deviations(
    checked: tuple[Calibration, ExtrinsicsComparison],
) -> None:
    """These leave drifts out, and remedies do so, too: before a lens is known better, and after."""
    calibration, _ = checked
    remedy = next(one for one in remedies(calibration) if one.uncertainty and not one.captures)
    axis = KINDS["camera"].axes.index(remedy.axis)
    assert calibration["camera"].axis_stddev[axis] == pytest.approx(remedy.stddev, rel=1e-9)
    rig, captures = detect(10)
    known = state_uncertainty(rig, remedy)
    problem = build_problem_from_captures(known, captures, RigOptions(), np.random.default_rng(SEED))
    after = solve_jointly(problem)[0].covariance["camera"]
    T = calibration["camera"].T_root_sensor
    assert stddev_along_axes(T, after)[axis] == pytest.approx(remedy.expected, rel=0.03)


def test_what_decides_a_check_is_the_first_remedy(checked: tuple[Calibration, ExtrinsicsComparison]) -> None:
    calibration, comparison = checked
    first = remedies(calibration)[0]
    assert comparison.remedy.startswith(f"{first}, or a tolerance of ")
    (camera,) = comparison.sensors
    assert f"; {first.action}: {first.axis} ±" in camera.reason
    assert "tilt and turn the board" not in camera.reason
