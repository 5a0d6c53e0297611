"""A live session of a rig takes the captures that the calibration of its recording finds."""

import asyncio
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calgraph.config import Capture, Rig
from calgraph.live.rig_session import RigSession, count_analysis_processes
from calgraph.live.rig_solution import LiveSolution
from calgraph.live.sensor_solution import SensorSolution
from calgraph.live.session import SessionPools
from calgraph.live.source import LiveMessage, make_message
from calgraph.live.state import SceneState
from calgraph.parallel.processes import worker_pool
from calgraph.rig.capture_collection import collect_captures
from calgraph.rig.captures.detect import CaptureSet
from calgraph.rig.options import RigOptions
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
)
from live_sessions import ImmediateExecutor, send_messages, start_session
from simulated_rigs import SimulatedRecording, build_recording, simulate_scenario

SCENARIO = RigScenario(
    background=2.0,
    bearings=(-20, 0, 20),
    radii=(1.7,),
    samples=1,
    hold_time=1.5,
    move_time=0.6,
    trigger=False,
    clutter=4,
    camera=CameraOptions(count=1, width=640, height=480, rate=5.0),
    laser=LaserOptions(count=3, rate=10, resolution=0.5),
    spinning=SpinningOptions(count=0),
    multibeam=MultibeamOptions(count=1, rate=5, resolution=0.5),
)


def change_settings(rig: Rig, group: str, **values: float) -> Rig:
    """The rig with other settings of live capture."""
    live = rig.settings.live
    changed = live.model_copy(update={group: getattr(live, group).model_copy(update=values)})
    return rig.model_copy(update={"settings": rig.settings.model_copy(update={"live": changed})})


def ignore(_: object) -> None:
    """Takes windows and lines that do not matter."""


@pytest.fixture(scope="module", autouse=True)
def draw_seldom() -> Iterator[None]:
    """Pictures take longest."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calgraph.live.message_analysis._PICTURE_RATE", 0.4)
        yield


@pytest.fixture(scope="module")
def walk() -> tuple[Rig, list[LiveMessage], GroundTruth]:
    """A rig of five sensors, its messages, and the truth."""
    rig, recording, truth = simulate_scenario(SCENARIO, seed=3)
    return rig, list(send_messages(recording)), truth


@pytest.fixture(scope="module")
def session(walk: tuple[Rig, list[LiveMessage], GroundTruth]) -> tuple[RigSession, deque[LiveMessage]]:
    """A session without the button that has received all messages, and its triggers."""
    rig, messages, _ = walk
    running, triggers = start_session(rig)
    for message in messages:
        running.feed(message)
    return running, triggers


def record(messages: Sequence[LiveMessage], rig: Rig) -> SimulatedRecording:
    """The recording of messages."""
    return build_recording(message.read("recorded", rig.settings.limits) for message in messages)


def calibrated_captures(rig: Rig, messages: Sequence[LiveMessage]) -> CaptureSet:
    """The captures as calgraph calibrate finds them."""
    return collect_captures(rig, record(messages, rig), RigOptions(), np.random.default_rng(RigOptions().seed))


def assert_equal_captures(live: CaptureSet, recorded: CaptureSet) -> None:
    assert [(hold.index, hold.start, hold.end) for hold in live.holds] == [
        (hold.index, hold.start, hold.end) for hold in recorded.holds
    ]
    for ours, theirs in zip(live.holds, recorded.holds, strict=True):
        for name, stamps in theirs.stamps.items():
            np.testing.assert_array_equal(ours.stamps[name], stamps)
    assert live.rejections == recorded.rejections
    assert {name: list(found) for name, found in live.detections.items()} == {
        name: list(found) for name, found in recorded.detections.items()
    }
    for name, by_capture in recorded.detections.items():
        for capture, found in by_capture.items():
            for one, other in zip(live.detections[name][capture], found, strict=True):
                assert vars(one).keys() == vars(other).keys()
                for key, value in vars(other).items():
                    np.testing.assert_array_equal(vars(one)[key], value)


def test_captures_are_those_of_the_recording_to_the_bit(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, deque[LiveMessage]]
) -> None:
    running, triggers = session
    live = running.captures()
    assert len(live.holds) == len(triggers) == 3
    assert_equal_captures(live, calibrated_captures(running.rig, [*walk[1], *triggers]))


def test_every_automatic_capture_lies_in_a_hold(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, deque[LiveMessage]]
) -> None:
    holds = session[0].captures().holds
    assert [(b.trigger <= h.start, h.end <= b.end) for b, h in zip(walk[2].boards, holds, strict=True)] == [
        (True, True)
    ] * 3


def feed_until(running: RigSession, messages: Sequence[LiveMessage], time: float) -> list[LiveMessage]:
    """Feeds the messages of the first seconds; returns the others."""
    first = messages[0].arrival
    count = sum(message.arrival <= first + time * 1e9 for message in messages)
    for message in messages[:count]:
        running.feed(message)
    return list(messages[count:])


def test_an_interrupted_session_continues_with_its_captures(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, deque[LiveMessage]]
) -> None:
    rig, messages, _ = walk
    first, triggers = start_session(rig)
    rest = feed_until(first, messages, 6.5)
    recorded = messages[: len(messages) - len(rest)]
    assert len(triggers) == 2
    second, later = start_session(rig)
    second.rebuild(record([*recorded, *triggers], rig))
    assert second.state().captures == 2
    for message in rest:
        second.feed(message)
    assert_equal_captures(second.captures(), session[0].captures())
    assert len(later) == 1


def test_a_session_of_a_sensor_with_another_clock_continues_with_its_captures(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    name, spec = next((name, spec) for name, spec in rig.sensors.items() if spec.kind == "lidar2d")
    rig = rig.model_copy(update={"sensors": {**rig.sensors, name: spec.model_copy(update={"clock_offset": 3.0})}})

    def be_early(message: LiveMessage) -> LiveMessage:
        if message.channel.topic != spec.topic:
            return message
        scan = message.read("walk", rig.settings.limits).decode()
        return make_message(spec.topic, replace(scan, stamp=scan.stamp + 3.0), message.arrival)

    messages = [be_early(message) for message in messages]
    first, triggers = start_session(rig)
    rest = feed_until(first, messages, 4.5)
    assert first.state().captures == 1
    second, _ = start_session(rig)
    second.rebuild(record([*messages[: len(messages) - len(rest)], *triggers], rig))
    assert_equal_captures(second.captures(), first.captures())


def test_a_resumed_session_measures_noise_in_the_recorded_background(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    first, triggers = start_session(rig)
    feed_until(first, messages, SCENARIO.background)
    levels = {name: first.analysis.rests.level(name) for name in rig.sensors}
    rest = feed_until(first, messages, 6.5)
    second, _ = start_session(rig)
    second.rebuild(record([*messages[: len(messages) - len(rest)], *triggers], rig))
    for name, level in levels.items():
        assert second.analysis.rests.level(name) == pytest.approx(level, rel=0.3), name


def test_the_button_waits_until_the_board_rests(walk: tuple[Rig, list[LiveMessage], GroundTruth]) -> None:
    rig, messages, truth = walk
    running, triggers = start_session(rig)
    running.command("manual")
    rest = feed_until(running, messages, 6.4)
    assert not triggers
    running.command("trigger")
    state = running.state()
    assert state.phase == "waiting"
    assert state.headline.startswith("Hold the board still (motion in ")
    assert any(sensor.moving for sensor in state.sensors)
    for message in rest:
        running.feed(message)
    (hold,) = running.captures().holds
    assert truth.boards[2].trigger <= hold.start < hold.end <= truth.boards[2].end
    assert running.state().event.taken


def test_the_second_press_searches_a_moving_board(walk: tuple[Rig, list[LiveMessage], GroundTruth]) -> None:
    rig, messages, _ = walk
    running, _ = start_session(rig)
    running.command("manual")
    rest = feed_until(running, messages, 6.4)
    running.command("trigger")
    running.command("trigger")
    for message in rest[:40]:
        running.feed(message)
    assert not running.captures().holds
    text = running.state().event.text
    assert text.startswith("No capture: camera, lidar")
    assert "do not detect the board (the board moved)" in text


def test_a_board_that_never_rests_is_refused_with_the_sensors_that_see_it_move(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    running, triggers = start_session(change_settings(rig, "capture", timeout=0.3))
    running.command("manual")
    rest = feed_until(running, messages, 4.3)
    running.command("trigger")
    feed_until(running, rest, 0.35)
    event = running.state().event
    assert (event.number, event.taken) == (1, False)
    assert event.text.startswith("No capture: still moving (")
    assert not triggers


def test_a_silent_sensor_refuses_captures_by_name(walk: tuple[Rig, list[LiveMessage], GroundTruth]) -> None:
    rig, messages, _ = walk
    running, triggers = start_session(rig)
    for message in messages:
        if message.channel.topic != rig.sensors["laser_left"].topic or message.arrival - messages[0].arrival < 1e9:
            running.feed(message)
    assert not triggers
    state = running.state()
    assert state.headline == "No captures are possible: laser_left has sent no message for 7 s"
    assert {sensor.name: sensor.problem for sensor in state.sensors if sensor.problem} == {
        "laser_left": "has sent no message for 7 s"
    }
    running.command("trigger")
    assert running.state().event.text == "No capture: laser_left has sent no message for 7 s"


def test_a_capture_that_is_left_out_is_excluded_from_the_recording(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    excluded: list[tuple[float, float]] = []
    running, triggers = start_session(rig, exclude=excluded.append)
    rest = feed_until(running, messages, 6.0)
    running.command("discard")
    for message in rest:
        running.feed(message)
    assert len(triggers) == 3
    assert len(running.captures().holds) == 2
    capture = running.rig.capture.model_copy(update={"exclude": tuple(excluded)})
    recorded = calibrated_captures(running.rig.model_copy(update={"capture": capture}), [*messages, *triggers])
    assert_equal_captures(running.captures(), recorded)


@pytest.mark.parametrize("days", [-1000, 1000])
def test_clocks_that_differ_from_arrivals_do_not_keep_captures_from_being_taken_and_left_out(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], days: float
) -> None:
    rig, messages, _ = walk
    later = [replace(message, arrival=message.arrival - round(days * 86400e9)) for message in messages]
    excluded: list[tuple[float, float]] = []
    running, triggers = start_session(rig, exclude=excluded.append)
    rest = feed_until(running, later, 6.0)
    running.command("discard")
    for message in rest:
        running.feed(message)
    assert len(triggers) == 3
    capture = Capture.model_validate(running.rig.capture.model_dump() | {"exclude": excluded})
    recorded = calibrated_captures(running.rig.model_copy(update={"capture": capture}), [*later, *triggers])
    assert_equal_captures(running.captures(), recorded)


class BusyExecutor(ImmediateExecutor):
    """Never completes a call."""

    def submit(self, *_: Any, **__: Any) -> Future[Any]:
        return Future()


def test_the_lag_is_the_age_of_the_first_message_that_is_not_analysed(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    pools = SessionPools(BusyExecutor(), 1, BusyExecutor(), lambda function: function())
    busy = RigSession(rig, "simulated", pools, exclude=ignore, print_line=ignore)
    idle, _ = start_session(rig)
    feed_until(busy, messages, 1.0)
    feed_until(idle, messages, 1.0)
    assert busy.lag == pytest.approx(1.0, abs=0.25)
    assert idle.lag == 0.0


def test_unusable_messages_are_counted_and_change_nothing(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, deque[LiveMessage]]
) -> None:
    rig, messages, _ = walk
    running, triggers = start_session(rig)
    for number, message in enumerate(messages):
        running.feed(message)
        if number % 17 == 10:
            running.feed(replace(message, data=message.data[: 8 if number % 2 else 60]))
    assert [trigger.data for trigger in triggers] == [trigger.data for trigger in session[1]]
    assert all("unusable messages" in sensor.problem for sensor in running.state().sensors)


def test_the_state_says_what_each_sensor_detects(session: tuple[RigSession, deque[LiveMessage]]) -> None:
    state = session[0].state()
    assert (state.phase, state.captures, state.event.taken) == ("ready", 3, True)
    assert {sensor.name: (sensor.sees_board, sensor.reason) for sensor in state.sensors} == {
        "camera": (True, ""),
        "lidar": (True, ""),
        "laser_front": (True, ""),
        "laser_left": (True, ""),
        "laser_right": (False, "not in view"),
    }
    camera = state.sensors[0]
    assert camera.coverage[4] == 1.0
    assert len(session[0].picture("camera") or b"") < 20_000


def delay_stamp(message: LiveMessage, seconds: int) -> LiveMessage:
    """The message with a stamp of a clock that is early by whole seconds."""
    stamp = int.from_bytes(message.data[4:8], "little") + seconds
    return replace(message, data=message.data[:4] + stamp.to_bytes(4, "little") + message.data[8:])


def problems_of(running: RigSession) -> dict[str, str]:
    return {sensor.name: sensor.problem for sensor in running.state().sensors if sensor.problem}


def test_a_clock_that_differs_is_named_unless_it_is_stated(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    topic = rig.sensors["laser_left"].topic
    early = [delay_stamp(one, 3) if one.channel.topic == topic else one for one in messages[:60]]
    running, _ = start_session(rig)
    for message in early:
        running.feed(message)
    assert problems_of(running) == {"laser_left": "has a clock that is 3.0 s early: state its clock_offset"}
    spec = rig.sensors["laser_left"].model_copy(update={"clock_offset": 3.0})
    stated, _ = start_session(rig.model_copy(update={"sensors": {**rig.sensors, "laser_left": spec}}))
    for message in early:
        stated.feed(message)
    assert problems_of(stated) == {}


def test_damaged_stamps_do_not_end_captures(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, deque[LiveMessage]]
) -> None:
    rig, messages, _ = walk
    running, triggers = start_session(rig)
    damaged = []
    for number, message in enumerate(messages):
        seconds = {50: 10**8, 90: -(10**8), 150: 10**6}.get(number)
        damaged.append(delay_stamp(message, seconds) if seconds else message)
        running.feed(damaged[-1])
    assert len(triggers) == len(session[1])
    assert problems_of(running) == {}
    assert_equal_captures(running.captures(), calibrated_captures(running.rig, [*damaged, *triggers]))


def test_messages_of_another_kind_are_named(walk: tuple[Rig, list[LiveMessage], GroundTruth]) -> None:
    rig, messages, _ = walk
    scans, clouds = rig.sensors["laser_left"].topic, rig.sensors["lidar"].topic
    exchanged = {scans: clouds, clouds: scans}
    running, _ = start_session(rig)
    for message in messages[:60]:
        topic = exchanged.get(message.channel.topic, message.channel.topic)
        running.feed(replace(message, channel=replace(message.channel, topic=topic)))
    # A 2-D scanner's driver may send clouds.
    assert problems_of(running) == {"lidar": "sends LaserScan messages, and its kind is lidar3d"}


def test_a_camera_without_intrinsics_is_part_of_captures(walk: tuple[Rig, list[LiveMessage], GroundTruth]) -> None:
    rig, messages, _ = walk
    running, _ = start_session(rig)
    for message in messages[:160]:
        if not message.channel.topic.endswith("camera_info"):
            running.feed(message)
    camera = running.state().sensors[0]
    assert (camera.captures, camera.sees_board) == (1, True)
    assert running.captures().rejections[0, "camera"].startswith("its intrinsics are not known")


def delay(message: LiveMessage, seconds: int) -> LiveMessage:
    """The message as if it had been measured and sent later."""
    return replace(delay_stamp(message, seconds), arrival=message.arrival + seconds * 10**9)


def test_captures_with_one_sensor_or_of_a_known_pose_are_refused(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    pair = {name: rig.sensors[name] for name in ("camera", "laser_right")}
    topics = {rig.sensors[name].topic for name in pair} | {"/camera/camera_info"}
    running, triggers = start_session(rig.model_copy(update={"root": "camera", "sensors": pair}))
    sent = [message for message in messages if message.channel.topic in topics]
    told: dict[int, str] = {}
    for message in [*sent, *(delay(one, 10) for one in sent)]:
        running.feed(message)
        event = running.state().event
        told[event.number] = event.text
    assert list(told.values()) == [
        "",
        "Capture 1: camera, laser_right",
        "Capture 2: camera, laser_right",
        "No capture: laser_right does not detect the board (not in view)",
        "No capture: the pose is that of capture 1",
        "No capture: laser_right does not detect the board (not in view)",
    ]
    assert len(triggers) == 2


def kill_process(*_: object) -> None:
    raise BrokenProcessPool("terminated abruptly")


class KilledExecutor(ImmediateExecutor):
    """Processes of which one is killed."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(kill_process, fn, *args, **kwargs)


def test_a_killed_process_is_shown_and_messages_are_still_taken(
    walk: tuple[Rig, list[LiveMessage], GroundTruth],
) -> None:
    rig, messages, _ = walk
    pools = SessionPools(KilledExecutor(), 1, ImmediateExecutor(), lambda function: function())
    running = RigSession(rig, "simulated", pools, exclude=ignore, print_line=ignore)
    for message in messages[:60]:
        running.feed(message)
    state = running.state()
    assert state.headline.startswith("Only recording goes on: a process was killed")
    assert all(sensor.rate > 0 for sensor in state.sensors)


def solve_camera(rig: Rig, captures: CaptureSet, _start: LiveSolution | None) -> LiveSolution:
    """A pose of the camera that is as uncertain as its captures are few."""
    stddev = np.array([1, 2, 4, 0.001, 0.002, 0.003]) * 1e-3 / len(captures.holds)
    sensors = (
        SensorSolution(rig.root, "lidar3d", np.eye(4), np.zeros(6), np.zeros((3, 3)), 0.0, "good"),
        SensorSolution("camera", "camera", np.eye(4), stddev, np.diag(stddev[:3] ** 2), 2.0, "weak"),
        SensorSolution("laser_left", "lidar2d"),
    )
    return LiveSolution(sensors, len(captures.holds), scene=SceneState(sensors[:2]))


def test_other_processes_detect_and_solve_what_one_process_does(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, deque[LiveMessage]]
) -> None:
    rig, messages, _ = walk
    lines: list[str] = []

    async def run() -> RigSession:
        with worker_pool(1) as analysis, worker_pool(1) as solving:
            post = asyncio.get_running_loop().call_soon_threadsafe
            pools = SessionPools(analysis, 1, solving, post)
            running = RigSession(rig, "simulated", pools, solve_camera, exclude=ignore, print_line=lines.append)
            for message in messages[:160]:
                running.feed(message)
                while running.busy:
                    await asyncio.sleep(0)
            running.close()
            return running

    running = asyncio.run(run())
    assert [trigger.data for trigger in running.triggers] == [session[1][0].data]
    assert lines == [running.state().event.text]
    assert running.picture("camera")
    scene = running.state().scene
    assert scene is not None
    assert [sensor.name for sensor in scene.sensors] == ["lidar", "camera"]
    sensors = {sensor.name: sensor for sensor in running.state().sensors}
    assert sensors["camera"].stddev_mm == pytest.approx(4.0)
    assert sensors["camera"].progress == 0.5
    assert sensors["camera"].stddev_degrees == pytest.approx(np.degrees(3e-6))
    assert [sensors[name].stddev_mm for name in ("lidar", "laser_left")] == [None, None]
    assert [sensors[name].grade for name in ("lidar", "camera", "laser_left")] == ["good", "weak", ""]


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system does not limit cores")
@pytest.mark.parametrize(("cores", "processes"), [(1, 1), (2, 1), (3, 2), (64, 3)])
def test_cores_that_the_process_may_use_detect(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], monkeypatch: pytest.MonkeyPatch, cores: int, processes: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    assert count_analysis_processes(walk[0]) == processes
