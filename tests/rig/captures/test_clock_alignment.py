"""Clock offsets from the times at which views change."""

from collections.abc import Sequence
from dataclasses import replace
from time import process_time

import numpy as np
import pytest

from calgraph.config import Rig
from calgraph.geometry import Array
from calgraph.recording import MessageRecording
from calgraph.recording.clocks import UNKNOWN_CLOCKS, ClockDifference, Clocks
from calgraph.result.finding import Finding
from calgraph.rig.captures.clock_alignment import align_views, estimate_clock_offsets, find_late_views
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.sensors import Image

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


def rig_of(stated: float | str | None = None, root: str = "root") -> Rig:
    content = {
        "root": root,
        "target": {"kind": "board", "size": [1.2, 0.9], "tags": [{"id": 0, "size": 0.3}]},
        "sensors": {
            "root": {"kind": "camera", "topic": "a"},
            "third": {"kind": "camera", "topic": "c"},
            "other": {"kind": "camera", "topic": "b", "clock_offset": stated},
        },
    }
    return Rig.model_validate(content)


def views(clock_offset: float) -> RecordingTimeline:
    moves = {"root": (1, 0.0), "third": (2, 0.0), "other": (3, clock_offset)}
    return timeline(**{name: view(MOVES, 15, offset, seed) for name, (seed, offset) in moves.items()})


def aligned(
    rig: Rig, clock_offset: float, clocks: Clocks = UNKNOWN_CLOCKS
) -> tuple[RecordingTimeline, Sequence[Finding]]:
    """The timeline after alignment, and what is said of it."""
    blank = np.zeros((2, 2), dtype=np.uint8)
    recording = MessageRecording({topic: [Image(0.0, "", blank)] for topic in "abc"})
    corrected, shifted, findings = align_views(rig, recording, views(clock_offset), clocks)
    stamps = {record.topic: record.stamp for record in corrected.records()}
    for name, topic in rig.topics.items():  # recording and timeline agree
        moved = shifted.sensors[name].stamps[0] - views(clock_offset).sensors[name].stamps[0]
        assert stamps[topic] == pytest.approx(moved, abs=1e-6)
    return shifted, findings


def moved(rig: Rig, clock_offset: float, clocks: Clocks = UNKNOWN_CLOCKS) -> dict[str, float]:
    """By sensor whose stamps were changed, by how much, s."""
    shifted, _ = aligned(rig, clock_offset, clocks)
    before = views(clock_offset).sensors
    changes = {name: float(before[name].stamps[0] - one.stamps[0]) for name, one in shifted.sensors.items()}
    return {name: change for name, change in changes.items() if change}


@pytest.mark.parametrize("late", [0.5, -0.5, 1.2])
def test_a_sensor_that_is_late_is_corrected_and_named(late: float) -> None:
    """No arrival tells of it: the stamps are those of a driver that is late."""
    assert moved(rig_of(), late) == {"other": pytest.approx(late, abs=0.05)}
    _, [finding] = aligned(rig_of(), late)
    assert finding.text.startswith("the clock of other minus that of the others is ")
    assert finding.sensors == ()


def test_a_late_root_is_corrected_like_any_other_sensor() -> None:
    assert moved(rig_of(root="other"), 0.5) == {"other": pytest.approx(0.5, abs=0.05)}


@pytest.mark.parametrize(("clock_offset", "stated"), [(0.0, None), (0.15, None), (2.0, 0.0)])
def test_small_and_stated_offsets_stay(clock_offset: float, stated: float | None) -> None:
    assert moved(rig_of(stated), clock_offset) == {}


def test_sensors_without_time_in_common_are_estimated_without_being_asked() -> None:
    assert moved(rig_of(), -1.7e9) == {"other": pytest.approx(-1.7e9, rel=0, abs=0.05)}


@pytest.mark.parametrize("stated", [None, "estimate"])
@pytest.mark.parametrize("clock_offset", [0.0, -3.0])
def test_views_decide_whether_messages_arrive_late_or_clocks_differ(
    clock_offset: float, stated: str | None
) -> None:
    difference = ClockDifference(-3.0, 0.1, certain=False)
    clocks = Clocks({"b": difference}, {}, informative=("a", "b", "c"))
    expected = {"other": pytest.approx(clock_offset, abs=0.05)} if clock_offset else {}
    assert moved(rig_of(stated), clock_offset, clocks) == expected


def test_a_clock_that_is_not_found_makes_the_sensor_weak() -> None:
    unlike = Clocks({}, {}, informative=())
    rig = rig_of("estimate")
    still = replace(views(0.0).sensors["other"], activity=np.zeros(len(views(0.0).sensors["other"].stamps)))
    sensors = replace(views(0.0), sensors={**views(0.0).sensors, "other": still})
    recording = MessageRecording({"b": [Image(0.0, "", np.zeros((2, 2), dtype=np.uint8))]})
    _, _, [finding] = align_views(rig, recording, sensors, unlike)
    assert finding.sensors == ("other",)
    assert "cannot be estimated" in finding.text


@pytest.mark.parametrize("seed", range(20))
def test_views_of_boards_that_pass_one_after_the_other_show_no_offset(seed: int) -> None:
    """Frames of equal stamps; the board comes into each view when it has left the one before."""
    rng = np.random.default_rng(seed)
    times = np.arange(0, 24, 1 / 6)
    entries = np.cumsum(rng.uniform(1.0, 2.5, 3))
    sensors = {}
    for name, entry in zip(("root", "third", "other"), entries, strict=True):
        seen = (times > entry) & (times < entry + 5)
        activity = np.where(seen, rng.uniform(0.5, 1.0, len(times)), 0.0)
        sensors[name] = SensorTimes(times + rng.uniform(0, 0.008, len(times)), 0.0, activity)
    shifted = find_late_views(timeline(**sensors), "root", list(sensors), {})
    assert shifted == {}
    assert estimate_clock_offsets(timeline(**sensors), "root", ["third", "other"]) == {}
