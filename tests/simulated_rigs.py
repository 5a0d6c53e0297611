"""Recordings of simulated robots without files, and ways to corrupt them."""

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Self

import numpy as np

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.recording import Recording
from calgraph.recording.recording import TopicInfo, select_topics
from calgraph.result import Calibration
from calgraph.rig.options import RigOptions
from calgraph.rig.pipeline import calibrate_rig
from calgraph.sensors import CameraInfo, Message, RecordedMessage, Trigger
from calgraph.simulation import GroundTruth, RigScenario, World, build_world, ground_truth, world_rig
from calgraph.simulation.rig_simulation import TRIGGER_TOPIC, topic_of
from calgraph.simulation.robot import MountedCamera
from calgraph.simulation.world import simulate_measurement


@dataclass(frozen=True)
class SimulatedRecording:
    """A recording whose measurements are simulated when they are decoded."""

    sources: ClassVar[tuple[Path, ...]] = ()
    opened_from: ClassVar[tuple[str, ...]] = ()
    divisible: ClassVar[bool] = False
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


def build_recording(messages: Iterable[RecordedMessage]) -> SimulatedRecording:
    """A recording of records, sorted by arrival."""
    ordered = tuple(sorted(messages, key=lambda r: r.arrival))
    count: dict[str, int] = {}
    for record in ordered:
        count[record.topic] = count.get(record.topic, 0) + 1
    topics = tuple(TopicInfo(name, "", count[name]) for name in sorted(count))
    return SimulatedRecording(Path("simulated"), topics, ordered[0].arrival, ordered[-1].arrival, ordered)


def simulate_recording(world: World) -> SimulatedRecording:
    """The full recording of a world's robot."""
    t0, rng = world.scenario.start_time, np.random.default_rng(world.seed)
    messages = []
    for sensor in world.robot:
        topic = topic_of(sensor, world.scenario)
        for index in sensor.clock.within(0, world.trajectory.end):
            stamp = t0 + sensor.clock.start(index)
            arrival = stamp + sensor.clock.duration + rng.uniform(0.002, 0.02)
            messages.append(
                RecordedMessage(topic, stamp, arrival, partial(simulate_measurement, world, sensor, index))
            )
        if isinstance(sensor, MountedCamera):
            info = CameraInfo(t0, sensor.frame_id, sensor.camera)
            messages.append(
                RecordedMessage(f"/{sensor.name}/camera_info", t0, t0 + 0.01, partial(_decode_constant, info))
            )
    if world.scenario.trigger:
        for hold in world.trajectory.holds:
            at = t0 + hold.start
            messages.append(RecordedMessage(TRIGGER_TOPIC, at, at, partial(Trigger, at)))
    return build_recording(messages)


def keep_decoded(recording: SimulatedRecording) -> SimulatedRecording:
    """The recording whose measurements are simulated once, for several calibrations."""
    return replace(recording, messages=tuple(replace(r, decode=cache(r.decode)) for r in recording.messages))


def _decode_constant(message: Message) -> Message:
    return message


def _decode_changed(record: RecordedMessage, change: Callable[[Message], Message]) -> Message:
    return change(record.decode())


def alter_messages(
    recording: SimulatedRecording, topic: str, change: Callable[[Message], Message]
) -> SimulatedRecording:
    """The recording with the messages of one topic changed as they are decoded."""
    return build_recording(
        replace(r, decode=partial(_decode_changed, r, change)) if r.topic == topic else r
        for r in recording.messages
    )


def pose_errors(calibration: Calibration, truth: GroundTruth) -> dict[str, Array]:
    """By calibrated sensor, its error (6,) in the root's axes, m and rad."""
    return {
        sensor.name: se3.difference(sensor.T_root_sensor, truth.T_root_sensor[sensor.name])
        for sensor in calibration.sensors
        if sensor.name != calibration.root
    }


def calibrate(rig: Rig, recording: Recording, options: RigOptions | None = None) -> Calibration:
    return calibrate_rig(rig, recording, options or RigOptions())


def without_bootstrap(rig: Rig) -> Rig:
    """The rig with settings by which small recordings do without a bootstrap, as those of 15 captures by default.

    It takes half of the time of their calibrations, and changes no pose.
    """
    tests = rig.settings.diagnostics.rig.model_copy(update={"max_bootstrap_captures": 1})
    diagnostics = rig.settings.diagnostics.model_copy(update={"rig": tests})
    return rig.model_copy(update={"settings": rig.settings.model_copy(update={"diagnostics": diagnostics})})


def simulate_scenario(scenario: RigScenario, seed: int = 1) -> tuple[Rig, SimulatedRecording, GroundTruth]:
    """Rig, recording and truth of a scenario; see :func:`without_bootstrap`."""
    world = build_world(scenario, seed)
    return without_bootstrap(world_rig(world)), simulate_recording(world), ground_truth(world)
