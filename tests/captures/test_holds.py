"""Holds found from when sensors measured: by trigger, from snapshots, by stillness."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from calgraph.captures import SensorTimes, Timeline, find_holds, is_snapshots
from calgraph.config import Capture
from calgraph.errors import CalibrationError
from calgraph.geometry import Array

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


def timeline(triggers: Sequence[float] = (), **sensors: SensorTimes) -> Timeline:
    return Timeline(START, sensors, START + np.array(triggers, dtype=float))


def test_a_triggered_hold_lasts_until_the_slowest_sensor_has_measured_twice() -> None:
    world = timeline([10.0], fast=times(0, 30, 0.05, 0.025), slow=times(0.3, 30, 1.5, 1.5))
    (hold,) = find_holds(world, Capture(trigger="/go"))
    # Sweeps start at 10.8 and 12.3; the second one ends at 13.8.
    assert hold.start == START + 10
    assert hold.end - START == pytest.approx(13.8)
    np.testing.assert_allclose(hold.stamps["slow"] - START, [10.8, 12.3])


def test_only_messages_measured_entirely_within_the_hold_are_used() -> None:
    world = timeline([10.0], fast=times(0, 30, 0.05, 0.04), slow=times(0.3, 30, 1.5, 1.5))
    (hold,) = find_holds(world, Capture(trigger="/go"))
    fast = hold.stamps["fast"]
    assert fast.min() >= hold.start
    assert fast.max() + 0.04 <= hold.end + 1e-6
    assert len(fast) > 70


def test_first_message_is_left_out_where_the_sensor_does_not_say_how_long_it_takes() -> None:
    """Its stamp may be that of its last point: the board may have moved meanwhile (MSG-Cal, III)."""
    world = timeline([10.0], slow=times(0.3, 30, 1.5))
    (hold,) = find_holds(world, Capture(trigger="/go"))
    np.testing.assert_allclose(hold.stamps["slow"] - START, [12.3])


def test_a_hold_ends_at_the_next_trigger() -> None:
    world = timeline([10.0, 11.0], slow=times(0, 30, 1.5, 1.5))
    first, _ = find_holds(world, Capture(trigger="/go"))
    assert first.end == START + 11


def test_excluded_times_and_background_hold_no_captures() -> None:
    world = timeline([2.0, 10.0, 20.0], fast=times(0, 30, 0.1))
    (hold,) = find_holds(world, Capture(trigger="/go", background=(0.0, 5.0), exclude=((9.0, 10.05),)))
    assert hold.start == START + 20
    assert hold.index == 0


def test_single_shots_are_grouped_by_pose() -> None:
    shots = timeline(camera=times(0, 100, 10), lidar=times(0.05, 100, 10))
    holds = find_holds(shots, Capture())
    assert is_snapshots(shots)
    assert len(holds) == 10
    assert all(len(hold.stamps[name]) == 1 for hold in holds for name in ("camera", "lidar"))


def test_a_shot_of_one_sensor_alone_is_no_capture() -> None:
    shots = timeline(camera=times(0, 50, 10), lidar=times(0, 100, 10))
    assert len(find_holds(shots, Capture())) == 5


def walking(t: Array) -> Array:
    """The board moves for a second every five seconds, with noise in between."""
    noise = np.random.default_rng(1).uniform(0.001, 0.004, len(t))
    return np.where(t % 5 < 1, 0.1, noise)


def test_holds_are_found_where_nothing_moves() -> None:
    world = timeline(
        camera=times(0, 60, 0.25, activity=walking),
        laser=times(0, 60, 0.05, activity=walking),
        slow=times(0, 60, 1.2, 1.2),
    )
    holds = find_holds(world, Capture())
    assert len(holds) == 12
    for hold in holds:
        assert (hold.start - START) % 5 >= 0.9
        assert hold.end - hold.start > 3.5
        assert len(hold.stamps["slow"]) >= 1


def test_rests_shorter_than_the_slowest_sensor_are_no_holds() -> None:
    world = timeline(laser=times(0, 60, 0.05, activity=walking), slow=times(0, 60, 4.5, 4.5))
    with pytest.raises(CalibrationError, match="never rests"):
        find_holds(world, Capture())


def test_without_a_fast_sensor_stillness_cannot_be_seen() -> None:
    world = timeline(slow=times(0, 60, 1.0, 1.0))
    with pytest.raises(CalibrationError, match="never rests"):
        find_holds(world, Capture())
