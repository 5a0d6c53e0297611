"""Detections of a board that never rests, and the calibration from them."""

import numpy as np
import pytest

import moving_boards
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.simulation import CameraOptions, LaserOptions, build_world
from ideal_detections import IdealDetectorOptions
from moving_boards import MovingBoardOptions, simulate_moving_detections

pytestmark = pytest.mark.slow


def test_a_rig_is_calibrated_from_a_board_that_never_rests() -> None:
    """At 0.3 m/s, with stamps 10 ms apart that are wrong by 2 ms."""
    found = moving_boards.run(5, MovingBoardOptions(speed=0.3, spread=0.01, jitter=0.002))
    assert len(found) == 3
    for metres, degrees, squared, confidently_wrong in found:
        assert metres < 0.02
        assert degrees < 0.7
        assert squared < 3
        assert not confidently_wrong


def test_the_times_of_a_rolling_shutter_are_found() -> None:
    """Its stamps are of the first row: the middle one is 10 ms later, and the last one 20 ms."""
    scenario = moving_boards.scenario().model_copy(
        update={"camera": CameraOptions(count=1), "laser": LaserOptions(count=0)}
    )
    motion = MovingBoardOptions(speed=0.6, jitter=0.001, readout=0.02, captures=20)
    world = build_world(scenario, 1, images=False)
    rig, captures, _ = simulate_moving_detections(world, 1, motion, IdealDetectorOptions(scans_per_hold=1))
    calibration = solve_problem(build_problem_from_captures(rig, captures, RigOptions(), np.random.default_rng(0)))
    times = {one.quantity: one for one in calibration.systematic if one.unit == "s"}
    assert {one.of for one in times.values()} == {"camera"}
    assert times["stamp delay"].value == pytest.approx(0.010, abs=0.003)
    assert times["readout time"].value == pytest.approx(0.020, abs=0.003)
    assert times["readout time"].stddev < 0.002
