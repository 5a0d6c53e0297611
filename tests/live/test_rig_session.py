"""A live session of a rig takes the captures that the calibration of its recording finds."""

from collections.abc import Sequence

import numpy as np
import pytest

from calgraph.calibrate import RigOptions
from calgraph.calibrate.capture_collection import collect_captures
from calgraph.captures import CaptureSet
from calgraph.config import Rig
from calgraph.live.record_reader import RecordReader
from calgraph.live.rig_session import RigSession
from calgraph.live.source import LiveMessage
from calgraph.simulation import (
    CameraOptions,
    GroundTruth,
    LaserOptions,
    MultibeamOptions,
    RigScenario,
    SpinningOptions,
)
from live_sessions import send_messages, start_session
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


@pytest.fixture(scope="module")
def walk() -> tuple[Rig, list[LiveMessage], GroundTruth]:
    """A rig of five sensors, its messages, and the truth."""
    rig, recording, truth = simulate_scenario(SCENARIO, seed=3)
    return rig, list(send_messages(recording)), truth


@pytest.fixture(scope="module")
def session(walk: tuple[Rig, list[LiveMessage], GroundTruth]) -> tuple[RigSession, list[LiveMessage]]:
    """A session without the button that has received all messages, and its triggers."""
    rig, messages, _ = walk
    running, triggers = start_session(rig)
    for message in messages:
        running.feed(message)
    return running, triggers


def record(messages: Sequence[LiveMessage], rig: Rig) -> SimulatedRecording:
    """The recording of messages."""
    reader = RecordReader("recorded", rig.settings.limits)
    return build_recording(reader.read(message) for message in messages)


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
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, list[LiveMessage]]
) -> None:
    running, triggers = session
    live = running.captures()
    assert len(live.holds) == len(triggers) == 3
    assert_equal_captures(live, calibrated_captures(running.rig, [*walk[1], *triggers]))


def test_every_automatic_capture_lies_in_a_hold(
    walk: tuple[Rig, list[LiveMessage], GroundTruth], session: tuple[RigSession, list[LiveMessage]]
) -> None:
    holds = session[0].captures().holds
    assert [(b.trigger <= h.start, h.end <= b.end) for b, h in zip(walk[2].boards, holds, strict=True)] == [
        (True, True)
    ] * 3
