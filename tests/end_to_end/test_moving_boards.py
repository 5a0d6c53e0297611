"""Boards that never rest: rendered recordings with wrong stamps, and a sensor that is bumped."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from calgraph.boards.detections import Detection
from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.captures.moving_board import BoardMotion, move_detection, surface_pose
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import build_problem_from_captures, solve_problem
from calgraph.sensors import Image, LaserScan, Message, RecordedMessage
from calgraph.simulation import (
    CameraOptions,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
    build_world,
    ground_truth,
    world_rig,
)
from ideal_detections import IdealDetectorOptions
from moving_boards import MovingBoardOptions, simulate_moving_detections
from simulated_rigs import build_recording, calibrate, pose_errors, simulate_recording

pytestmark = pytest.mark.slow

RATE = 8.0
SCENARIO = RigScenario(
    camera=CameraOptions(width=480, height=360, texels_per_mm=0.5, rate=RATE),
    laser=LaserOptions(count=0),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=RATE, rings=16, resolution=0.4),
    bearings=(-28, -14, 0, 14, 28),
    radii=(1.8, 2.3),
    samples=1,
    clutter=2,
    background=1.0,
    move_time=1.2,
    hold_time=0.01,
    trigger=False,
)
DELAY, JITTER = 0.012, 0.003
"""By which images are measured later than their stamps, and its standard deviation, s."""


def test_a_rendered_recording_of_a_moving_board_is_calibrated() -> None:
    """A camera and a LiDAR, up to 1 m/s. The delays of the images are not inputs of the calibration."""
    world = build_world(SCENARIO, 8)
    phase = world.robot[0].clock.phase
    robot = tuple(replace(sensor, clock=replace(sensor.clock, phase=phase)) for sensor in world.robot)
    recording = simulate_recording(replace(world, robot=robot))
    rng = np.random.default_rng(0)
    recording = build_recording([
        _stamp_earlier(record, DELAY + JITTER * rng.standard_normal()) if "image" in record.topic else record
        for record in recording.messages
    ])  # fmt: skip
    rig = world_rig(world).model_dump(mode="json", exclude_none=True)
    rig["capture"] = {"mode": "synchronized", "max_spread": 0.05, "background": [0.0, 1.0]}
    rig["settings"] = {"captures": {"moving_board": {"max_captures": 40}}}
    found = calibrate(Rig.model_validate(rig), recording)
    (camera,) = [sensor for sensor in found.sensors if sensor.name == "camera"]
    error = pose_errors(found, ground_truth(world))["camera"]
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.degrees(np.linalg.norm(error[3:])) < 0.3
    assert error @ np.linalg.solve(camera.covariance, error) / 6 < 2.5
    assert camera.verdict.grade == "good", camera.verdict.reason
    assert not [remark for remark in found.evidence.remarks if "moved" in remark or "drift" in remark]
    (delay,) = [one for one in found.systematic if one.quantity == "stamp delay"]
    assert delay.value == pytest.approx(DELAY, abs=0.004)


def _stamp_earlier(record: RecordedMessage, delay: float) -> RecordedMessage:
    return replace(record, stamp=record.stamp - delay, decode=partial(_decode_earlier, record, delay))


def _decode_earlier(record: RecordedMessage, delay: float) -> Image:
    image = record.decode()
    assert isinstance(image, Image)
    return replace(image, stamp=image.stamp - delay)


def test_a_sensor_that_is_bumped_before_a_moving_board_is_named() -> None:
    """By 20 mm, in the middle of ideal detections at 0.3 m/s; it is calibrated from those afterwards."""
    scenario = SCENARIO.model_copy(update={"bearings": (-30, -15, 0, 15, 30), "samples": 2})
    world = build_world(scenario, 3, images=False)
    motion = MovingBoardOptions(speed=0.3, jitter=0.002, readout=0.01, captures=60)
    rig, captures, truth = simulate_moving_detections(world, 3, motion, IdealDetectorOptions(scans_per_hold=1))
    moved = se3.pose(np.eye(3), np.array([0.016, 0.0, 0.012]))
    bumped = bump_camera(captures, moved, 30)
    found = solve_problem(build_problem_from_captures(rig, bumped, RigOptions(), np.random.default_rng(0)))
    (remark,) = [remark for remark in found.evidence.remarks if " moved by " in remark]
    assert "the result is its pose after that" in remark
    (sensor,) = [sensor for sensor in found.sensors if sensor.name == "camera"]
    error = se3.difference(sensor.T_root_sensor, truth.T_root_sensor["camera"] @ moved)
    assert np.linalg.norm(error[:3]) < 0.01


def bump_camera(captures: CaptureSet, moved: Array, first: int) -> CaptureSet:
    """The detections of a camera that is displaced by a pose, in its axes, before capture ``first``."""

    def displace(one: Detection) -> Detection:
        T = surface_pose(one)
        motion = BoardMotion(T, se3.difference(se3.inverse(moved) @ T, T), np.zeros(6), np.zeros(6))
        return replace(move_detection(one, motion, 1.0, captures.cameras["camera"]), twist=one.twist)

    order = sorted(captures.holds, key=lambda hold: hold.start)
    late = {hold.index for hold in order[first:]}
    after = {
        capture: tuple(displace(one) for one in found) if capture in late else found
        for capture, found in captures.detections["camera"].items()
    }
    return replace(captures, detections={**captures.detections, "camera": after})


def test_a_scanner_that_turns_against_its_beams_is_recognized_without_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A camera and a 2-D scanner at 15 Hz, whose board moves from beam to beam."""
    monkeypatch.setattr("calgraph.simulation.world._MOTION_STEP", 0.003)
    rate = 15.0
    scenario = SCENARIO.model_copy(
        update={
            "camera": SCENARIO.camera.model_copy(update={"rate": rate}),
            "laser": LaserOptions(count=1, rate=rate, mirror_rate=rate),
            "multibeam": MultibeamOptions(count=0),
            "samples": 2,
        }
    )
    world = build_world(scenario, 8)
    phase = world.robot[0].clock.phase
    robot = tuple(replace(sensor, clock=replace(sensor.clock, phase=phase)) for sensor in world.robot)
    recording = simulate_recording(replace(world, robot=robot))
    recording = build_recording(
        [replace(record, decode=partial(_decode_reversed, record)) for record in recording.messages]
    )
    rig = world_rig(world).model_dump(mode="json", exclude_none=True)
    rig["capture"] = {"mode": "synchronized", "max_spread": 0.05, "background": [0.0, 1.0]}
    found = calibrate(Rig.model_validate(rig), recording)
    text = "the scans of laser_front have no times of beams (time_increment is 0), but the board is where"
    assert text in " ".join(found.evidence.remarks)
    error = pose_errors(found, ground_truth(world))["laser_front"]
    assert np.linalg.norm(error[:3]) < 0.005
    assert np.linalg.norm(error[3:]) < 0.002  # 0.003 without times


def _decode_reversed(record: RecordedMessage) -> Message:
    """Scans as of a scanner that sends its last beam first, without their times."""
    message = record.decode()
    if not isinstance(message, LaserScan):
        return message
    return replace(message, angles=message.angles[::-1], ranges=message.ranges[::-1], time_increment=0.0)
