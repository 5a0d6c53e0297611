"""Recordings of simulated robots that need no file, and ways to spoil them."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from calgraph.calibrate import Options, calibrate_rig
from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.recording import Recording
from calgraph.recording.recording import TopicInfo, select_topics
from calgraph.result import Calibration
from calgraph.sensors import CameraInfo, Message, RecordedMessage, Trigger
from calgraph.simulation import (
    RigScenario,
    Stage,
    Truth,
    rig_of,
    set_stage,
    truth_of,
)
from calgraph.simulation.rig_simulation import TRIGGER_TOPIC, topic_of
from calgraph.simulation.robot import MountedCamera
from calgraph.simulation.world import measurement


@dataclass(frozen=True)
class SimulatedRecording:
    """A recording whose measurements are simulated when they are decoded: only those looked at cost time."""

    path: Path
    topics: tuple[TopicInfo, ...]
    start: float
    end: float
    messages: tuple[RecordedMessage, ...]

    def records(
        self, topics: Collection[str] | None = None, start: float | None = None, end: float | None = None
    ) -> Iterator[RecordedMessage]:
        wanted = select_topics(self.path, self.topics, topics)
        return (
            r
            for r in self.messages
            if r.topic in wanted and (start is None or r.arrival >= start) and (end is None or r.arrival <= end)
        )

    def close(self) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass


def recorded(messages: Iterable[RecordedMessage]) -> SimulatedRecording:
    """A recording of records, which are brought into order of arrival."""
    ordered = tuple(sorted(messages, key=lambda r: r.arrival))
    count: dict[str, int] = {}
    for record in ordered:
        count[record.topic] = count.get(record.topic, 0) + 1
    topics = tuple(TopicInfo(name, "", count[name]) for name in sorted(count))
    return SimulatedRecording(Path("simulated"), topics, ordered[0].arrival, ordered[-1].arrival, ordered)


def recording_of(stage: Stage) -> SimulatedRecording:
    """All that the robot of a stage records."""
    t0, rng = stage.scenario.start_time, np.random.default_rng(stage.seed)
    messages = []
    for sensor in stage.robot:
        topic = topic_of(sensor, stage.scenario)
        for index in sensor.clock.within(0, stage.timeline.end):
            stamp = t0 + sensor.clock.start(index)
            arrival = stamp + sensor.clock.duration + rng.uniform(0.002, 0.02)
            messages.append(RecordedMessage(topic, stamp, arrival, partial(measurement, stage, sensor, index)))
        if isinstance(sensor, MountedCamera):
            info = CameraInfo(t0, sensor.frame_id, sensor.camera)
            messages.append(RecordedMessage(f"/{sensor.name}/camera_info", t0, t0 + 0.01, partial(_said, info)))
    if stage.scenario.trigger:
        for hold in stage.timeline.holds:
            at = t0 + hold.start
            messages.append(RecordedMessage(TRIGGER_TOPIC, at, at, partial(Trigger, at)))
    return recorded(messages)


def _said(message: Message) -> Message:
    return message


def _changed(record: RecordedMessage, change: Callable[[Message], Message]) -> Message:
    return change(record.decode())


def altered(recording: SimulatedRecording, topic: str, change: Callable[[Message], Message]) -> SimulatedRecording:
    """The recording with the messages of one topic changed as they are decoded."""
    return recorded(
        replace(r, decode=partial(_changed, r, change)) if r.topic == topic else r for r in recording.messages
    )


def errors(calibration: Calibration, truth: Truth) -> dict[str, Array]:
    """By calibrated sensor, its error (6,) in the root's axes, m and rad."""
    return {
        sensor.name: se3.difference(sensor.T_root_sensor, truth.T_root_sensor[sensor.name])
        for sensor in calibration.sensors
        if sensor.name != calibration.root
    }


def calibrated(rig: Rig, recording: Recording, options: Options | None = None) -> Calibration:
    return calibrate_rig(rig, recording, options or Options())


def staged(scenario: RigScenario, seed: int = 1) -> tuple[Rig, SimulatedRecording, Truth]:
    """Rig, recording and truth of a scenario."""
    stage = set_stage(scenario, seed)
    return rig_of(stage), recording_of(stage), truth_of(stage)
