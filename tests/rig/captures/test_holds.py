"""Holds from a timeline: by trigger, from snapshots, by stillness."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from calgraph.config import Capture
from calgraph.config.settings import CaptureSettings
from calgraph.errors import CalibrationError
from calgraph.geometry import Array
from calgraph.rig.captures.capture_mode import is_snapshot_recording
from calgraph.rig.captures.holds import find_holds, select_middles
from calgraph.rig.captures.rests import find_rests
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes

START = 1_700_000_000.0


def times(
    first: float,
    last: float,
    period: float,
    duration: float = 0.0,
    activity: Callable[[Array], Array] | None = None,
) -> SensorTimes:
    stamps = START + np.arange(first, last, period)
    return SensorTimes(stamps, duration, np.zeros(len(stamps)) if activity is None else activity(stamps - START))


def timeline(triggers: Sequence[float] = (), **sensors: SensorTimes) -> RecordingTimeline:
    return RecordingTimeline(START, sensors, START + np.array(triggers, dtype=float))


def test_a_triggered_hold_lasts_until_the_slowest_sensor_has_measured_twice() -> None:
    recording = timeline([10.0], fast=times(0, 30, 0.05, 0.025), slow=times(0.3, 30, 1.5, 1.5))
    (hold,) = find_holds(recording, Capture(trigger="/go"), settings=CaptureSettings())
    # Sweeps start at 10.8 and 12.3; the second one ends at 13.8.
    assert hold.start == START + 10
    assert hold.end - START == pytest.approx(13.8)
    np.testing.assert_allclose(hold.stamps["slow"] - START, [10.8, 12.3])


def test_only_messages_measured_entirely_within_the_hold_are_used() -> None:
    recording = timeline([10.0], fast=times(0, 30, 0.05, 0.04), slow=times(0.3, 30, 1.5, 1.5))
    (hold,) = find_holds(recording, Capture(trigger="/go"), settings=CaptureSettings())
    fast = hold.stamps["fast"]
    assert fast.min() >= hold.start
    assert fast.max() + 0.04 <= hold.end + 1e-6
    assert len(fast) > 70


def test_first_message_is_left_out_where_its_duration_is_unknown() -> None:
    """Its stamp may be that of its last point: the board may have moved meanwhile (MSG-Cal, III)."""
    recording = timeline([10.0], slow=times(0.3, 30, 1.5))
    (hold,) = find_holds(recording, Capture(trigger="/go"), settings=CaptureSettings())
    np.testing.assert_allclose(hold.stamps["slow"] - START, [12.3])


def test_of_a_rest_with_a_missed_move_in_its_middle_the_quiet_part_is_used() -> None:
    """A camera of 5 Hz sees the move from 4.6 to 5.4 s; in other rests and in all other images is noise."""

    def change(t: Array) -> Array:
        return np.where((t > 4.6) & (t < 5.5), 0.052, 0.002)

    recording = timeline(camera=times(0, 20, 0.2, activity=change))
    middles = (
        np.array(select_middles(recording, [(START + 2.0, START + 8.0), (START + 10.0, START + 16.0)])) - START
    )
    (start, end), ordinary = middles
    assert end - start == pytest.approx(1.0)
    assert end <= 4.7 or start >= 5.2
    assert start >= 2.5
    assert end <= 7.5
    np.testing.assert_allclose(ordinary, [12.5, 13.5])


def test_a_hold_ends_at_the_next_trigger() -> None:
    recording = timeline([10.0, 11.0], slow=times(0, 30, 1.5, 1.5))
    first, _ = find_holds(recording, Capture(trigger="/go"), settings=CaptureSettings())
    assert first.end == START + 11


def test_excluded_times_and_background_have_no_holds() -> None:
    recording = timeline([2.0, 10.0, 20.0], fast=times(0, 30, 0.1))
    (hold,) = find_holds(
        recording,
        Capture(trigger="/go", background=(0.0, 5.0), exclude=((9.0, 10.05),)),
        settings=CaptureSettings(),
    )
    assert hold.start == START + 20
    assert hold.index == 0


def test_single_shots_are_grouped_by_pose() -> None:
    snapshots = timeline(camera=times(0, 100, 10), lidar=times(0.05, 100, 10))
    holds = find_holds(snapshots, Capture(), settings=CaptureSettings())
    assert is_snapshot_recording(snapshots, max_gap=1.0)
    assert len(holds) == 10
    assert all(len(hold.stamps[name]) == 1 for hold in holds for name in ("camera", "lidar"))


def test_snapshot_of_one_sensor_alone_is_no_hold() -> None:
    snapshots = timeline(camera=times(0, 50, 10), lidar=times(0, 100, 10))
    assert len(find_holds(snapshots, Capture(), settings=CaptureSettings())) == 5


def board_motion(t: Array) -> Array:
    """The board moves for a second every five seconds, with noise in between."""
    noise = np.random.default_rng(1).uniform(0.001, 0.004, len(t))
    return np.where(t % 5 < 1, 0.1, noise)


def test_holds_are_found_where_nothing_moves() -> None:
    recording = timeline(
        camera=times(0, 60, 0.25, activity=board_motion),
        laser=times(0, 60, 0.05, activity=board_motion),
        slow=times(0, 60, 1.2, 1.2),
    )
    holds = find_holds(recording, Capture(), settings=CaptureSettings())
    assert len(holds) == 12
    for hold in holds:
        assert (hold.start - START) % 5 >= 0.9
        # Twice the period of the slow sensor, of the middle of the rest.
        assert hold.end - hold.start == pytest.approx(2.4, abs=0.01)
        assert len(hold.stamps["slow"]) >= 1


def test_the_middle_second_of_a_rest_is_used() -> None:
    """Boards slow down before a rest: in its last 0.2 s a board moves by 2 cm."""
    recording = timeline(laser=times(0, 60, 0.05, activity=board_motion))
    (rest,) = [r for r in find_rests(recording, CaptureSettings()) if r[0] < START + 23 < r[1]]
    (hold,) = [h for h in find_holds(recording, Capture(), CaptureSettings()) if h.start < START + 23 < h.end]
    assert hold.end - hold.start == pytest.approx(1.0)
    assert hold.start - rest[0] == pytest.approx(rest[1] - hold.end)
    assert len(hold.stamps["laser"]) in (20, 21)


def test_rests_shorter_than_the_slowest_sensor_are_no_holds() -> None:
    recording = timeline(laser=times(0, 60, 0.05, activity=board_motion), slow=times(0, 60, 4.5, 4.5))
    with pytest.raises(CalibrationError, match="never rests"):
        find_holds(recording, Capture(), settings=CaptureSettings())


def test_stillness_needs_a_fast_sensor() -> None:
    recording = timeline(slow=times(0, 60, 1.0, 1.0))
    with pytest.raises(CalibrationError, match="never rests"):
        find_holds(recording, Capture(), settings=CaptureSettings())


def test_a_trigger_topic_without_messages_is_named() -> None:
    with pytest.raises(CalibrationError, match=r"the topic /go has no message: check capture\.trigger"):
        find_holds(timeline([], fast=times(0, 30, 0.05)), Capture(trigger="/go"), settings=CaptureSettings())
