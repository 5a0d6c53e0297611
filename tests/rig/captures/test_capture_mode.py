"""How a recording shows the board, from its stamps."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import Capture
from calgraph.config.settings import CaptureSettings, MovingBoardSettings
from calgraph.geometry import Array
from calgraph.recording import open_recording
from calgraph.rig.captures.capture_mode import recognize_mode, recognize_recording
from calgraph.rig.captures.holds import find_holds
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes

START = 1_700_000_000.0
ALL = CaptureSettings(moving_board=MovingBoardSettings(max_captures=1000))
"""Every set of frames is a capture."""


def sensor(stamps: Sequence[float] | Array, activity: Array | None = None) -> SensorTimes:
    stamps = np.sort(START + np.asarray(stamps, dtype=float))
    return SensorTimes(stamps, 0.0, np.zeros(len(stamps)) if activity is None else activity)


def timeline(triggers: Sequence[float] = (), **sensors: SensorTimes) -> RecordingTimeline:
    return RecordingTimeline(START, sensors, START + np.array(triggers, dtype=float))


def moving(stamps: Array, seed: int) -> Array:
    """Activity of a view in which the board always moves, 10 to 20 cm from frame to frame."""
    return np.random.default_rng(seed).uniform(0.02, 0.04, len(stamps))


def moving_pair(spread: float, seed: int = 0) -> RecordingTimeline:
    """Two cameras at 20 Hz with stamps up to ``spread``, s, apart."""
    shot = np.arange(0, 20, 0.05)
    late = shot + np.random.default_rng(seed).uniform(0, spread, len(shot))
    return timeline(left=sensor(shot, moving(shot, 1)), right=sensor(late, moving(shot, 2)))


def test_a_trigger_marks_rests() -> None:
    recognized = recognize_mode(
        timeline([1.0, 5.0], left=sensor([1.1, 5.2])), Capture(trigger="/go"), settings=CaptureSettings()
    )
    assert (recognized.mode, recognized.reason) == ("rest", "each of 2 triggers starts a capture")


def test_what_rig_yaml_states_counts() -> None:
    assert (
        recognize_mode(moving_pair(0.01), Capture(mode="snapshots"), settings=CaptureSettings()).mode
        == "snapshots"
    )


def test_close_irregular_poses_are_snapshots() -> None:
    poses = np.cumsum(np.random.default_rng(3).uniform(0.8, 3.0, 20))
    recording = timeline(left=sensor(poses), right=sensor(poses + 0.2))
    assert recognize_mode(recording, Capture(), settings=CaptureSettings()).mode == "snapshots"
    holds = find_holds(recording, Capture(), settings=CaptureSettings())
    assert len(holds) == 20
    assert all(hold.stamps["right"] - hold.stamps["left"] == pytest.approx(0.2, abs=1e-6) for hold in holds)


def test_a_slow_periodic_stream_is_not_one_of_snapshots() -> None:
    recording = timeline(left=sensor(np.arange(0, 60, 1.0)), right=sensor(np.arange(0.2, 60, 1.0)))
    assert recognize_mode(recording, Capture(), settings=CaptureSettings()).mode == "rest"


def test_several_messages_of_a_pose_are_one_capture() -> None:
    poses = np.cumsum(np.random.default_rng(4).uniform(3.0, 6.0, 10))
    recording = timeline(left=sensor(np.r_[poses, poses + 0.1, poses + 0.2]), lidar=sensor(poses + 0.3))
    holds = find_holds(recording, Capture(), settings=CaptureSettings())
    assert [(len(hold.stamps["left"]), len(hold.stamps["lidar"])) for hold in holds] == [(3, 1)] * 10


@pytest.mark.parametrize(("seconds", "mode"), [(0.4, "snapshots"), (0.6, "rest")])
def test_bursts_as_long_as_a_hold_are_recordings_of_rests(seconds: float, mode: str) -> None:
    """A hold has at least half a second; one of the sensors measures once in each."""
    starts = np.cumsum(np.random.default_rng(4).uniform(1.2, 4.0, 20))
    stamps = (starts[:, None] + np.linspace(0, seconds, 7)).ravel()
    recording = timeline(left=sensor(stamps), right=sensor(starts + 0.1))
    assert recognize_mode(recording, Capture(), settings=CaptureSettings()).mode == mode


def test_a_driver_that_answers_after_seconds_belongs_to_its_pose() -> None:
    rng = np.random.default_rng(5)
    poses = np.cumsum(rng.uniform(9.0, 15.0, 12))
    answers = poses + rng.uniform(2.5, 3.9, 12)
    holds = find_holds(
        timeline(camera=sensor(poses), lidar=sensor(answers)), Capture(), settings=CaptureSettings()
    )
    assert len(holds) == 12
    np.testing.assert_allclose([hold.stamps["lidar"][0] - START for hold in holds], answers)


def test_a_sensor_may_miss_a_pose() -> None:
    poses = np.arange(0, 100, 10.0)
    recording = timeline(camera=sensor(poses), lidar=sensor(poses[1:] + 0.5), third=sensor(np.delete(poses, 4)))
    holds = find_holds(recording, Capture(), settings=CaptureSettings())
    assert len(holds) == 10
    assert [len(hold.stamps["lidar"]) for hold in holds] == [0] + [1] * 9
    assert len(holds[4].stamps["third"]) == 0


@pytest.mark.parametrize(("rests", "mode"), [(6, "synchronized"), (12, "rest")])
def test_some_short_rests_leave_a_board_moving_and_a_dozen_are_the_captures(rests: int, mode: str) -> None:
    shot = np.arange(0, 60, 0.05)
    resting = (shot % (60 / rests)) < 0.9
    still = {side: np.where(resting, 0.0, moving(shot, seed)) for side, seed in (("left", 1), ("right", 2))}
    recording = timeline(left=sensor(shot, still["left"]), right=sensor(shot + 0.001, still["right"]))
    assert recognize_mode(recording, Capture(), settings=CaptureSettings()).mode == mode


def test_frames_with_equal_stamps_of_a_moving_board_are_synchronized() -> None:
    recognized = recognize_mode(moving_pair(0.004), Capture(), settings=CaptureSettings())
    assert recognized.mode == "synchronized"
    assert recognized.spread == pytest.approx(0.002, abs=0.0005)
    assert recognized.reason.startswith("the board never rests, and the stamps of 400 sets of frames lie 2.")


def test_without_activity_a_stream_is_not_said_to_move() -> None:
    shot = np.arange(0, 20, 0.05)
    recognized = recognize_mode(
        timeline(left=sensor(shot), right=sensor(shot + 0.001)), Capture(), settings=CaptureSettings()
    )
    assert recognized.mode == "rest"
    assert recognized.spread == pytest.approx(0.001, abs=1e-6)
    assert "was not measured" in recognized.reason


def test_every_set_of_frames_is_a_capture() -> None:
    recording = moving_pair(0.004)
    holds = find_holds(recording, Capture(), ALL)
    assert len(holds) == 400
    np.testing.assert_allclose([hold.stamps["left"][0] for hold in holds], recording.sensors["left"].stamps)


def test_frames_farther_apart_than_stated_are_no_set() -> None:
    holds = find_holds(moving_pair(0.010), Capture(mode="synchronized", max_spread=0.005), ALL)
    holds = tuple(hold for hold in holds if not hold.auxiliary)
    assert 170 < len(holds) < 230
    assert all(hold.end - hold.start <= 0.005 for hold in holds)


def test_a_lost_frame_does_not_shift_the_sets() -> None:
    shot = np.arange(0, 20, 0.05)
    left, right = np.delete(shot, [10, 200]), np.delete(shot + 0.003, [50])
    recording = timeline(left=sensor(left, moving(left, 1)), right=sensor(right, moving(right, 2)))
    holds = [hold for hold in find_holds(recording, Capture(), ALL) if not hold.auxiliary]
    assert len(holds) == len(shot) - 3
    assert all(hold.end - hold.start == pytest.approx(0.003, abs=1e-6) for hold in holds)


def test_of_many_sets_of_frames_the_slow_ones_are_captures() -> None:
    shot = np.arange(0, 60, 0.05)
    speed = 0.02 + 0.015 * np.sin(2 * np.pi * shot / 0.5)
    holds = find_holds(
        timeline(left=sensor(shot, speed), right=sensor(shot + 0.002, speed)),
        Capture(),
        settings=CaptureSettings(),
    )
    chosen = [hold for hold in holds if not hold.auxiliary]
    assert len(chosen) == 120
    at = np.array([hold.start for hold in chosen]) - START
    assert np.interp(at, shot, speed).max() < 0.008
    assert np.diff(at).max() <= 1.01


def test_captures_have_the_frames_before_and_after_beside_them() -> None:
    holds = find_holds(moving_pair(0.004), Capture(), settings=CaptureSettings())
    stamps = [float(hold.stamps["left"][0]) for hold in holds if len(hold.stamps["left"])]
    chosen = [float(hold.stamps["left"][0]) for hold in holds if not hold.auxiliary]
    assert len(stamps) == len(set(stamps))
    for stamp in chosen[1:-1]:
        assert np.sort(np.abs(np.array(stamps) - stamp))[2] < 0.051


def test_a_recording_with_a_stamp_a_year_ahead_has_no_mode(tmp_path: Path) -> None:
    """A draft of rig.yaml leaves the mode open; the calibration names the sensor."""
    ranges = 3 + np.random.default_rng(0).normal(0, 0.01, (60, 100)) - (np.arange(60) > 30)[:, None]
    for name, last in (("left", 365 * 86400.0), ("right", 0.0)):
        (tmp_path / name).mkdir()
        for i, row in enumerate(ranges):
            stamp = 1000 + 0.1 * i + (last if i == len(ranges) - 1 else 0.0)
            np.savez(
                tmp_path / name / f"{stamp:.1f}.npz",
                stamp=stamp, angle_min=-0.5, angle_increment=0.01, time_increment=0.0, ranges=row,
            )  # fmt: skip
    with open_recording(tmp_path) as recording:
        assert recognize_recording(recording, ["left", "right"], CaptureSettings()) is None
