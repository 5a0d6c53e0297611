"""The messages of a simulated robot capture by capture, without those between and without a recording."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.config import CameraSpec, Rig
from calgraph.geometry import Array, se3
from calgraph.result import Calibration
from calgraph.rig.captures.detect import CaptureSet, SensorCapture, collect_detections
from calgraph.rig.captures.detectors import draw_seeds, learn_background, make_detectors
from calgraph.rig.captures.holds import Hold
from calgraph.rig.captures.timeline import RecordingTimeline, SensorTimes
from calgraph.sensors import Message
from calgraph.simulation import BoardTruth, GroundTruth, RigScenario, World, build_world, ground_truth, world_rig
from calgraph.simulation.rig_scenario import MEASUREMENTS_PER_HOLD
from calgraph.simulation.robot import MountedCamera, RobotSensor
from calgraph.simulation.world import simulate_measurement


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """The measurements of one hold."""

    board: BoardTruth
    messages: Mapping[str, tuple[Message, ...]]
    """By sensor, the measurements that lie fully in the hold."""


def simulate_background(world: World) -> Mapping[str, tuple[Message, ...]]:
    """By sensor, the measurements of the empty room."""
    return {
        s.name: _simulate_messages(world, s, s.clock.within(0, world.scenario.background)) for s in world.robot
    }


def simulate_captures(
    world: World, measurements: int | None = MEASUREMENTS_PER_HOLD, sensors: Sequence[str] | None = None
) -> Iterator[SimulatedCapture]:
    """Simulates capture by capture the measurements that lie in its hold, without writing a recording.

    Args:
        world: to measure in.
        measurements: number of the first measurements of each sensor to simulate; all if None.
        sensors: the names of those that measure; all if None.
    """
    chosen = [s for s in world.robot if sensors is None or s.name in sensors]
    for truth, hold in zip(ground_truth(world).boards, world.trajectory.holds, strict=True):
        indices = {s.name: s.clock.within(hold.start, hold.end)[:measurements] for s in chosen}
        yield SimulatedCapture(truth, {s.name: _simulate_messages(world, s, indices[s.name]) for s in chosen})


def _simulate_messages(world: World, sensor: RobotSensor, indices: range) -> tuple[Message, ...]:
    return tuple(simulate_measurement(world, sensor, index) for index in indices)


def detected(scenario: RigScenario, seed: int) -> tuple[Rig, CaptureSet, GroundTruth]:
    """Simulates the holds alone, without a recording, and finds the board in them."""
    stage = build_world(scenario, seed)
    rig, truth = world_rig(stage), ground_truth(stage)
    cameras = {s.name: s.camera for s in stage.robot if isinstance(s, MountedCamera)}
    backgrounds = {
        name: learn_background(messages, rig.sensors[name].kind, rig.settings.detection)
        for name, messages in simulate_background(stage).items()
        if not isinstance(rig.sensors[name], CameraSpec)
    }
    detect = make_detectors(rig, cameras, backgrounds, None, draw_seeds(rig, np.random.default_rng(seed)))
    holds = [Hold(i, board.trigger, board.end) for i, board in enumerate(truth.boards)]
    observations = [
        SensorCapture(i, name, detect[name](messages))
        for i, capture in enumerate(simulate_captures(stage))
        for name, messages in capture.messages.items()
    ]
    never = SensorTimes(np.zeros(0), 0.0, np.zeros(0))
    timeline = RecordingTimeline(scenario.start_time, dict.fromkeys(rig.sensors, never), np.zeros(0))
    return rig, collect_detections(rig, timeline, holds, observations, cameras), truth


def errors(poses: dict[str, Array], truth: GroundTruth) -> tuple[Array, Array]:
    """Translation (m) and rotation (degrees) errors of all sensors but the root."""
    d = np.array([se3.difference(T, truth.T_root_sensor[n]) for n, T in poses.items() if n != truth.root])
    return np.linalg.norm(d[:, :3], axis=1), np.degrees(np.linalg.norm(d[:, 3:], axis=1))


def poses_of(calibration: Calibration) -> dict[str, Array]:
    """T_root_sensor by sensor."""
    return {sensor.name: sensor.T_root_sensor for sensor in calibration.sensors}
