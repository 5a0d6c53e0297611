"""Clock offsets from the times at which views change."""

from collections.abc import Sequence
from time import process_time

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.rig.captures.clock_alignment import estimate_clock_offsets, find_late_views
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes

MOVES = np.cumsum(np.random.default_rng(0).uniform(1.5, 4.0, 30))
"""Times at which a board begins to move, for 0.7 s."""
EQUAL_MOVES = np.arange(1.0, 90.0, 3.0)


def view(moves: Array, rate: float, clock_offset: float, seed: int, start: float = 0.0) -> SensorTimes:
    """A sensor whose view changes by different amounts while the board moves, and a little by noise at rest."""
    rng = np.random.default_rng(seed)
    times = np.arange(start + rng.uniform(0, 1 / rate), 95.0, 1 / rate)
    between = times - 0.5 / rate  # a change is that since the message before
    number = np.searchsorted(moves, between) - 1
    moving = (number >= 0) & (between - moves[number] < 0.7)
    activity = np.where(moving, rng.uniform(0.005, 0.1, len(times)), rng.uniform(0, 3e-4, len(times)))
    return SensorTimes(times + clock_offset, 0.0, activity)


def timeline(**sensors: SensorTimes) -> RecordingTimeline:
    return RecordingTimeline(0.0, sensors, np.zeros(0))


def offset_of(other: SensorTimes, moves: Array = MOVES) -> float | None:
    found = estimate_clock_offsets(timeline(root=view(moves, 15, 0, 1), other=other), "root", ["other"])
    return found["other"].offset if found else None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate", [5, 10, 30])
def test_clocks_are_found_to_half_a_period(rate: float, seed: int) -> None:
    true = np.random.default_rng(seed).uniform(-20, 20)
    assert offset_of(view(MOVES, rate, true, seed + 10)) == pytest.approx(true, abs=0.5 / rate)


def test_a_sensor_may_be_started_later() -> None:
    assert offset_of(view(MOVES, 15, -17.0, 3, start=17.0)) == pytest.approx(-17.0, abs=0.03)


def test_clocks_of_boot_time_are_found() -> None:
    assert offset_of(view(MOVES, 15, -1.7e9, 4)) == pytest.approx(-1.7e9, abs=0.03)


def test_small_offsets_are_none() -> None:
    assert offset_of(view(MOVES, 15, 0.003, 5)) == 0.0


def test_moves_at_equal_times_determine_no_offset() -> None:
    assert offset_of(view(EQUAL_MOVES, 15, 1.0, 6), EQUAL_MOVES) is None


def test_other_motion_determines_no_offset() -> None:
    others = np.cumsum(np.random.default_rng(9).uniform(1.5, 4.0, 30))
    assert offset_of(view(others, 15, 1.0, 7)) is None


def test_a_view_without_changes_determines_no_offset() -> None:
    still = view(MOVES, 15, 0.0, 8)
    assert offset_of(SensorTimes(still.stamps, 0.0, np.zeros(len(still.stamps)))) is None


@pytest.mark.parametrize("far", [-1e5, 0.0, 1e9, 1e300])
def test_one_stamp_of_another_time_takes_neither_time_nor_memory(far: float) -> None:
    times = view(MOVES, 15, 0.0, 14)
    jumping = SensorTimes(np.sort(np.append(1e9 + times.stamps, far)), 0.0, np.append(times.activity, 0.0))
    begin = process_time()
    offset_of(jumping)
    assert process_time() - begin < 2


def test_a_sensor_whose_view_the_root_does_not_share_is_compared_with_another() -> None:
    nothing = view(np.array([300.0]), 15, 0.0, 11)
    sensors = timeline(root=nothing, with_root=view(MOVES, 15, 0.0, 12), other=view(MOVES, 10, 2.5, 13))
    assert estimate_clock_offsets(sensors, "root", ["other"])["other"].offset == pytest.approx(2.5, abs=0.05)


def remarks(clock_offset: float, stated: float | None = None) -> Sequence[str]:
    content = {
        "root": "root",
        "target": {"kind": "board", "size": [1.2, 0.9], "tags": [{"id": 0, "size": 0.3}]},
        "sensors": {
            "root": {"kind": "camera", "topic": "a"},
            "other": {"kind": "camera", "topic": "b", "clock_offset": stated},
        },
    }
    sensors = timeline(root=view(MOVES, 15, 0.0, 1), other=view(MOVES, 15, clock_offset, 2))
    return [finding.text for finding in check_clocks(Rig.model_validate(content), sensors)]


def test_clocks_that_differ_are_remarked_on() -> None:
    [text] = remarks(2.0)
    assert text.startswith("by its stamps, the view of other changes ")
    assert " after that of root: their clocks differ; state sensors.other.clock_offset: " in text
    assert float(text.split("clock_offset: ")[1].split(",")[0]) == pytest.approx(2.0, abs=0.03)


@pytest.mark.parametrize(("clock_offset", "stated"), [(0.2, None), (2.0, 0.0)])
def test_small_and_stated_offsets_are_not_remarked_on(clock_offset: float, stated: float | None) -> None:
    assert remarks(clock_offset, stated) == []
