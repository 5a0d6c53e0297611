"""Rest and motion while a board is recorded."""

import numpy as np
import pytest

from calgraph.config.settings import CaptureSettings
from calgraph.geometry import Array
from calgraph.live.motion import RestMonitor
from calgraph.rig.captures.motion_detection import ActivityMeter
from calgraph.rig.captures.rests import find_rests
from calgraph.rig.captures.timeline import RecordingTimeline, build_timeline
from calgraph.simulation import CameraOptions, LaserOptions, MultibeamOptions, RigScenario, SpinningOptions
from simulated_rigs import simulate_scenario

SCENARIO = RigScenario(
    background=2.0,
    bearings=(-30, 60),
    radii=(2.0,),
    samples=1,
    hold_time=1.5,
    move_time=1.0,
    trigger=False,
    clutter=4,
    camera=CameraOptions(count=1, width=320, height=240, rate=5.0),
    laser=LaserOptions(count=2, rate=10, resolution=0.5),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=5, resolution=0.5),
)


def make_monitor(*sensors: str) -> RestMonitor:
    return RestMonitor(sensors)


def watch(
    monitor: RestMonitor, timeline: RecordingTimeline, background: float
) -> list[tuple[float, float, float]]:
    """The rests as they are noticed: start, first time at which it is known, and end, s."""
    messages = sorted(
        (stamp, name, change)
        for name, times in timeline.sensors.items()
        for stamp, change in zip(times.stamps.tolist(), times.activity.tolist(), strict=True)
    )
    rests: list[tuple[float, float, float]] = []
    resting = False
    for stamp, name, change in messages:
        monitor.add(name, [stamp], [change], None, quiet=stamp < timeline.start + background)
        rest = monitor.find_rest(timeline.sensors)
        if rest and not resting:
            rests.append((rest.start, stamp, stamp))
        elif rest:
            rests[-1] = (*rests[-1][:2], stamp)
        resting = rest is not None
    return rests


@pytest.mark.parametrize("seed", [5, 7])
def test_rests_are_those_of_the_whole_recording_and_known_soon(seed: int) -> None:
    rig, recording, truth = simulate_scenario(SCENARIO, seed)
    meters = {name: ActivityMeter(0.0) for name in rig.sensors}
    records = recording.records(rig.topics.values())
    timeline = build_timeline(records, recording.start, rig.topics, None, meters=meters)
    live = watch(make_monitor(*rig.sensors), timeline, SCENARIO.background)
    shown = truth.boards[0].trigger - SCENARIO.move_time
    held = [rest for rest in live if rest[0] > shown and rest[2] - rest[0] >= CaptureSettings().min_hold]
    found = [rest for rest in find_rests(timeline, CaptureSettings()) if rest[0] > shown]
    assert len(held) == len(found) == len(truth.boards)
    for (start, known, end), (found_start, found_end) in zip(held, found, strict=True):
        assert abs(start - found_start) < 0.35
        assert known - start < 0.25
        assert end > found_end - 0.05


def quiet_changes(rng: np.random.Generator, count: int) -> Array:
    """The changes of a scanner's view at rest."""
    return 0.015 * rng.lognormal(0, 0.2, count)


def add(monitor: RestMonitor, changes: Array, start: float, *, quiet: bool = False) -> float:
    stamps = start + 0.1 * np.arange(len(changes))
    monitor.add("laser", stamps.tolist(), changes.tolist(), None, quiet=quiet)
    return float(stamps[-1]) + 0.1


def test_a_view_that_only_rests_never_moves(rng: np.random.Generator) -> None:
    monitor = make_monitor("laser")
    end = add(monitor, quiet_changes(rng, 30), 0.0, quiet=True)
    for change in quiet_changes(rng, 1000):
        end = add(monitor, np.array([change]), end)
        assert monitor.find_rest(["laser"]) is not None


def test_without_a_time_without_operator_the_quietest_messages_show_the_noise(rng: np.random.Generator) -> None:
    monitor = make_monitor("laser")
    end = add(monitor, np.concatenate([quiet_changes(rng, 30), rng.uniform(0.05, 0.15, 20)]), 0.0)
    assert monitor.find_rest(["laser"]) is None
    add(monitor, quiet_changes(rng, 5), end)
    rest = monitor.find_rest(["laser"])
    assert rest is not None
    assert rest.start == pytest.approx(end - 0.1)


def test_a_hand_that_trembles_is_at_rest_once_motion_was_seen(rng: np.random.Generator) -> None:
    # The empty room does not change; a board that is held does, by a tenth of what it changes in motion, but not
    # where it turns back.
    monitor = make_monitor("laser")
    end = add(monitor, np.zeros(30), 0.0, quiet=True)
    trembling = 0.01 * rng.lognormal(0, 0.3, 40) * (np.arange(40) % 4 > 0)
    end = add(monitor, trembling, end)
    assert monitor.find_rest(["laser"]) is None
    end = add(monitor, 0.1 * rng.lognormal(0, 0.3, 30), end)
    add(monitor, trembling, end)
    assert monitor.find_rest(["laser"]) is not None


def test_a_view_that_changes_completely_moves_however_often_it_does() -> None:
    monitor = make_monitor("laser")
    add(monitor, np.ones(200), 0.0)
    assert monitor.find_rest(["laser"]) is None


def test_the_rest_begins_when_the_last_sensor_stops() -> None:
    monitor = make_monitor("a", "b")
    monitor.add("a", [0.0, 0.1, 0.2, 0.3], [0.1, 0.1, 0.0, 0.0], None, quiet=False)
    monitor.add("b", [0.05, 0.15, 0.25, 0.35], [0.1, 0.1, 0.1, 0.0], None, quiet=False)
    rest = monitor.find_rest(["a", "b"])
    assert rest is not None
    assert (rest.start, rest.measured) == (0.25, {"a": 0.3, "b": 0.35})
