"""Simulation of a rig recording: messages, rig.yaml and ground truth."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calgraph.config import CameraSpec, Capture, Lidar2dSpec, Lidar3dSpec, PixelNoise, RangeNoise, Rig, SensorSpec
from calgraph.geometry import Array
from calgraph.recording.writer import serialize_message
from calgraph.sensors import CameraInfo, Message, Trigger
from calgraph.sensors.kinds import DepthCameraSpec, DepthNoise
from calgraph.simulation.rig_scenario import RigScenario
from calgraph.simulation.robot import MountedCamera, MountedDepthCamera, RobotSensor
from calgraph.simulation.simulation_files import (
    LATENCIES,
    Progress,
    SerializedMessage,
    describe_rig,
    write_simulation,
)
from calgraph.simulation.world import World, build_world, ground_truth, simulate_measurement

TRIGGER_TOPIC = "/trigger"
_WITH_LENS = MountedCamera, MountedDepthCamera


def simulate_rig(scenario: RigScenario, out: Path, seed: int = 0, progress: Progress | None = None) -> None:
    """Writes ``out/recording`` (rosbag2, MCAP), ``out/rig.yaml`` and ``out/truth.yaml``.

    Args:
        scenario: robot, board and walk.
        out: folder, created if missing; it must not hold a recording yet.
        seed: the same seed and scenario give the same files.
        progress: called with the number of messages written and in total.

    Raises:
        InputError: the scenario contradicts itself, or there is a recording in ``out`` already.
    """
    write_rig(build_world(scenario, seed), out, progress)


def write_rig(world: World, out: Path, progress: Progress | None = None) -> None:
    """Writes the files of :func:`simulate_rig` of a world.

    Raises:
        InputError: there is a recording in ``out`` already.
    """
    events, store = _schedule_messages(world), get_typestore(Stores.ROS2_HUMBLE)
    total = sum(2 if isinstance(sensor, _WITH_LENS) else 1 for _, sensor, _ in events)
    messages = (
        SerializedMessage(
            round(1e9 * arrival), topic, *serialize_message(store, message, world.scenario.camera.encoding)
        )
        for arrival, sensor, index in events
        for topic, message in _messages_of_event(world, sensor, index)
    )
    rig = describe_rig(world_rig(world))
    write_simulation(out, rig, ground_truth(world), messages, lambda done: progress and progress(done, total))


def world_rig(world: World) -> Rig:
    """The rig.yaml of a simulated robot: what its user would write, without any pose."""
    scenario = world.scenario
    return Rig(
        root=world.root,
        target=scenario.boards if scenario.companions else scenario.board,
        capture=Capture(
            background=(0.0, scenario.background), trigger=TRIGGER_TOPIC if scenario.trigger else None
        ),
        sensors={sensor.name: _sensor_spec(sensor, scenario) for sensor in world.robot},
    )


def topic_of(sensor: RobotSensor, scenario: RigScenario) -> str:
    """The topic of a sensor's measurements."""
    if isinstance(sensor, MountedDepthCamera):
        return f"/{sensor.name}/image_rect_raw"
    if isinstance(sensor, MountedCamera):
        plain = f"/{sensor.name}/image_raw"
        return plain if scenario.camera.encoding == "raw" else f"{plain}/compressed"
    return f"/{sensor.name}/{'scan' if sensor.kind == 'lidar2d' else 'points'}"


def _sensor_spec(sensor: RobotSensor, scenario: RigScenario) -> SensorSpec:
    topic = topic_of(sensor, scenario)
    if isinstance(sensor, MountedCamera):
        return CameraSpec(
            kind="camera",
            topic=topic,
            camera_info=_info_topic(sensor),
            frame_id=sensor.frame_id,
            noise=PixelNoise(),
        )
    if isinstance(sensor, MountedDepthCamera):
        return DepthCameraSpec(
            topic=topic,
            camera_info=_info_topic(sensor),
            frame_id=sensor.frame_id,
            noise=DepthNoise(range=max(sensor.options.noise, 1e-4)),
        )
    # A noise-free simulation still needs a positive noise as weight.
    noise = RangeNoise(range=max(sensor.noise.range_noise, 1e-4), angle=max(sensor.noise.angle_noise, 1e-5))
    if sensor.kind == "lidar2d":
        return Lidar2dSpec(kind="lidar2d", topic=topic, frame_id=sensor.frame_id, noise=noise)
    return Lidar3dSpec(kind="lidar3d", topic=topic, frame_id=sensor.frame_id, noise=noise)


def _info_topic(sensor: RobotSensor) -> str:
    return f"/{sensor.name}/camera_info"


def _schedule_messages(world: World) -> list[tuple[float, RobotSensor | None, int]]:
    """All recorded events in order of arrival: (arrival stamp, sensor or None for the trigger, number)."""
    t0 = world.scenario.start_time
    events: list[tuple[float, RobotSensor | None, int]] = []
    for k, sensor in enumerate(world.robot):
        indices = sensor.clock.within(0, world.trajectory.end)
        delays = np.random.default_rng((world.seed, 1 + k)).uniform(*LATENCIES, len(indices))
        ends: Array = sensor.clock.start(0) + sensor.clock.period * np.array(indices) + sensor.clock.duration
        events += [(float(t0 + t), sensor, i) for t, i in zip(ends + delays, indices, strict=True)]
    if world.scenario.trigger:
        events += [(t0 + hold.start, None, i) for i, hold in enumerate(world.trajectory.holds)]
    return sorted(events, key=lambda event: event[0])


def _messages_of_event(world: World, sensor: RobotSensor | None, index: int) -> Iterator[tuple[str, Message]]:
    """The topics and messages of one event."""
    if sensor is None:
        hold = world.trajectory.holds[index]
        yield TRIGGER_TOPIC, Trigger(world.scenario.start_time + hold.start)
        return
    message = simulate_measurement(world, sensor, index)
    yield topic_of(sensor, world.scenario), message
    if isinstance(sensor, _WITH_LENS):
        yield _info_topic(sensor), CameraInfo(message.stamp, sensor.frame_id, sensor.camera)
