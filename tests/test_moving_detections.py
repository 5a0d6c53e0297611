"""Detections of a board that never rests, and the calibration from them."""

import numpy as np
import pytest

from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import CameraOptions, LaserOptions, build_world
from ideal_detections import IdealDetectorOptions
from moving_boards import MovingBoardOptions, scenario, simulate_moving_detections
from worlds import find_errors

pytestmark = pytest.mark.slow


def test_a_rig_is_calibrated_from_a_board_that_never_rests() -> None:
    """At 0.3 m/s, with stamps 10 ms apart that are wrong by 2 ms."""
    motion = MovingBoardOptions(speed=0.3, spread=0.01, jitter=0.002)
    world = build_world(scenario(), 5, images=False)
    rig, captures, truth = simulate_moving_detections(world, 5, motion, IdealDetectorOptions(scans_per_hold=1))
    problem = build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(5))
    errors = find_errors(solve_problem(problem), truth.T_root_sensor)
    assert len(errors) == 3
    for error in errors.values():
        assert error.metres < 0.02
        assert error.degrees < 0.7
        assert error.nees < 3


def test_the_times_of_a_rolling_shutter_are_found() -> None:
    """Its stamps are of the first row: the middle one is 10 ms later, and the last one 20 ms."""
    one = scenario().model_copy(update={"camera": CameraOptions(count=1), "laser": LaserOptions(count=0)})
    motion = MovingBoardOptions(speed=0.6, jitter=0.001, readout=0.02, captures=20)
    world = build_world(one, 1, images=False)
    rig, captures, _ = simulate_moving_detections(world, 1, motion, IdealDetectorOptions(scans_per_hold=1))
    calibration = solve_problem(build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(0)))
    times = {found.quantity: found for found in calibration.systematic if found.unit == "s"}
    assert {found.of for found in times.values()} == {"camera"}
    assert times["stamp delay"].value == pytest.approx(0.010, abs=0.003)
    assert times["readout time"].value == pytest.approx(0.020, abs=0.003)
    assert times["readout time"].stddev < 0.002
