"""Clocks from when messages were stamped and when they arrived."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from calgraph.recording import Recording, RecordingWriter, correct_stamps, inspect_recording, open_recording
from calgraph.recording.clocks import Arrivals, ClockDifference, compare_clocks, find_differences
from calgraph.recording.record_list import IndexedRecording
from calgraph.recording.recording import JoinedRecording
from calgraph.sensors import LaserScan, RecordedMessage, Trigger

NOW = 1.7e9
POWER_UP = -1_699_990_000.0


def arrivals(offset: float = 0.0, delay: float = 0.02, rate: float = 10.0, seed: int = 0) -> Arrivals:
    """A minute of messages whose clock is ahead by an offset, s, with up to 30 ms of jitter in their delay."""
    rng = np.random.default_rng(seed)
    measured = NOW + rng.uniform(0, 1 / rate) + np.arange(0, 60, 1 / rate)
    return Arrivals(measured + offset, measured + delay + rng.uniform(0, 0.03, len(measured)))


def differences(**offsets: float) -> dict[str, ClockDifference]:
    return find_differences({name: arrivals(o, seed=i) for i, (name, o) in enumerate(offsets.items())})


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate", [1.0, 3.0, 40.0])
@pytest.mark.parametrize("delay", [0.0, 0.05, 0.3])
def test_one_clock_shows_no_difference(delay: float, rate: float, seed: int) -> None:
    topics = {"camera": arrivals(delay=delay, rate=rate, seed=seed), "lidar": arrivals(seed=seed + 10)}
    assert find_differences(topics) == {}


@pytest.mark.parametrize(
    ("offset", "cause"),
    [
        (POWER_UP, "count from power-up"),
        (37.0, "differ by the leap seconds of TAI against UTC"),
        (-37.0, "differ by the leap seconds of TAI against UTC"),
        (18.0, "differ by the leap seconds of GPS time against UTC"),
        (-7200.0, "are of another time zone"),
        (20_700.0, "are of another time zone"),
        (4321.0, ""),
        (0.5, ""),
    ],
)
def test_a_clock_that_differs_is_found_and_named(offset: float, cause: str) -> None:
    found = differences(camera=0.0, lidar=offset, trigger=0.0)
    assert list(found) == ["lidar"]
    assert (found["lidar"].certain, found["lidar"].cause) == (True, cause)
    # Where the cause is known, the offset is exact.
    exact = cause and offset != POWER_UP
    assert found["lidar"].offset == pytest.approx(offset, rel=0, abs=1e-9 if exact else 0.1)
    assert found["lidar"].stddev == 0.1


def test_sensors_may_each_count_from_their_own_power_up() -> None:
    own = {"camera": POWER_UP, "lidar": POWER_UP - 500, "laser": POWER_UP + 9000}
    found = differences(**own, trigger=0.0)
    assert {name: one.offset for name, one in found.items()} == pytest.approx(own, rel=0, abs=0.1)


@pytest.mark.parametrize("epoch", [5e7, -5e7])
def test_a_replay_of_another_time_is_of_one_clock(epoch: float) -> None:
    assert differences(camera=epoch, lidar=epoch, laser=epoch) == {}


def test_in_a_replay_the_odd_one_out_is_found() -> None:
    found = differences(camera=5e7, lidar=POWER_UP, laser=5e7)
    assert list(found) == ["lidar"]
    assert found["lidar"].offset == pytest.approx(POWER_UP - 5e7, rel=0, abs=0.1)


@pytest.mark.parametrize("late", [0.6, 2.0, 8.0])
def test_messages_that_arrive_late_are_not_of_another_clock_for_sure(late: float) -> None:
    found = find_differences(
        {"camera": arrivals(delay=late), "lidar": arrivals(seed=1), "laser": arrivals(seed=2)}
    )
    assert not found["camera"].certain
    assert found["camera"].offset == pytest.approx(-late, abs=0.1)


def test_bursts_change_no_clock_and_hide_none() -> None:
    def flush(one: Arrivals) -> Arrivals:
        return replace(one, arrivals=2.0 * np.ceil(one.arrivals / 2.0))

    topics = {
        "camera": flush(arrivals()),
        "laser": flush(arrivals(seed=1)),
        "lidar": flush(arrivals(37.0, seed=2)),
    }
    found = find_differences(topics)
    assert {name: one.offset for name, one in found.items()} == {"lidar": 37.0}


def test_a_clock_that_was_set_meanwhile_is_not_corrected() -> None:
    lidar = arrivals(seed=1)
    stamps = lidar.stamps.copy()
    stamps[: len(stamps) // 2] += POWER_UP
    assert (
        find_differences({"camera": arrivals(), "laser": arrivals(seed=2), "lidar": replace(lidar, stamps=stamps)})
        == {}
    )


def test_a_sweep_arrives_when_it_ends() -> None:
    sweep = arrivals(-20.5, delay=2.02, rate=0.5)
    found = find_differences(
        {"camera": arrivals(), "laser": arrivals(seed=1), "lidar": replace(sweep, duration=2.0)}
    )
    assert found["lidar"].offset == pytest.approx(-20.5, abs=0.1)


def test_a_sweep_whose_arrival_is_its_stamp_has_no_clock_ahead() -> None:
    stamped = arrivals(seed=1)
    lidar = Arrivals(stamped.arrivals, stamped.arrivals, duration=3.0)
    assert find_differences({"camera": arrivals(), "lidar": lidar}) == {}


def recording(offsets: dict[str, float], topics: str = "ab", shift: float = 0.0) -> Recording:
    """Scans of several topics for 10 s, all measured at the same times; arrivals are later by ``shift``, s."""
    records = []
    for time in NOW + np.arange(0, 10, 0.1):
        for topic in topics:
            stamp = float(time + offsets.get(topic, 0.0))
            scan = LaserScan(stamp, topic, np.zeros(3), np.ones(3))
            records.append(RecordedMessage(topic, stamp, float(time + 0.02 + shift), partial(replace, scan)))
    return IndexedRecording(Path("made"), records, dict.fromkeys(topics, "scan"))


def test_computers_have_recorders_of_their_own() -> None:
    """Stamps are by one clock; the second recorder's clock is half an hour late."""
    joined = JoinedRecording([recording({}), recording({}, topics="cd", shift=1811.0)])
    assert compare_clocks(joined, list("abcd")).differences == {}


def test_takes_after_a_restart_have_no_common_offset() -> None:
    joined = JoinedRecording(
        [recording({"b": POWER_UP}, "abc"), recording({"b": POWER_UP + 600}, "abc", shift=0.0)]
    )
    assert compare_clocks(joined, list("abc")).differences == {}


def test_corrections_add_up() -> None:
    once = correct_stamps(recording({"a": 37.0}), {"a": 36.0})
    twice = correct_stamps(once, {"a": 1.0, "b": 0.5})
    stamps = {r.topic: r.stamp - NOW for r in twice.records(end=NOW + 0.05)}
    assert stamps == pytest.approx({"a": 0.0, "b": -0.5}, abs=1e-6)
    assert all(record.decode().stamp == record.stamp for record in twice.records())
    assert correct_stamps(once, {"b": 0.0}) is once


def test_inspect_says_what_a_calibration_corrects(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for time in NOW + np.arange(0, 10, 0.1):
            for topic, offset in (("/camera", 0.0), ("/lidar", 37.0), ("/laser", 0.0)):
                scan = LaserScan(float(time + offset), "laser", np.linspace(-1, 1, 11), np.full(11, 2.0))
                writer.write(topic, scan, float(time + 0.01))
            writer.write("/trigger", Trigger(float(time)), float(time + 0.001))
    with open_recording(tmp_path / "bag") as opened:
        inspection = inspect_recording(opened, lambda _: None)
        clocks = compare_clocks(opened, ["/camera", "/lidar", "/laser"])
    assert inspection.clock_offsets == clocks.certain_offsets() == {"/lidar": 37.0}
    findings = {topic.name: topic.findings for topic in inspection.topics if topic.findings}
    assert findings == {"/lidar": (f"its stamps {clocks.differences['/lidar'].describe()}",)}
    assert "leap seconds of TAI against UTC: they are 37.000 s ahead" in findings["/lidar"][0]
