"""The files of a simulated drive: recording, rig.yaml and ground truth."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calgraph.geometry import so3
from calgraph.recording.writer import serialize_message
from calgraph.sensors import CameraInfo, Message
from calgraph.simulation.drive_images import render_images
from calgraph.simulation.drive_scenario import DRIVE_KINDS, RANGING, DriveScenario
from calgraph.simulation.drive_simulation import SimulatedDrive, simulate_drive, topic_of
from calgraph.simulation.simulation_files import LATENCIES, Progress, SerializedMessage, write_simulation
from calgraph.simulation.truth import GroundTruth


def record_drive(scenario: DriveScenario, out: Path, progress: Progress) -> None:
    """Writes ``out/recording`` (rosbag2, MCAP), ``out/rig.yaml``, ``out/truth.yaml`` and ``out/trajectory.txt``.

    Poses of other programs are nav_msgs/Odometry, rates of gyroscopes sensor_msgs/Imu, images
    of cameras are rendered. The last file is the root's
    true trajectory, a row per pose: stamp, x, y, z, qx, qy, qz, qw.

    Args:
        scenario: sensors, path and surroundings.
        out: folder, created if missing; it must not hold a recording yet.
        progress: called with the number of messages written, and with that in total.

    Raises:
        InputError: the sensors' fields are too wide, or there is a recording in ``out`` already.
    """
    drive = simulate_drive(scenario)
    truth = drive.truth
    messages = sorted(_list_messages(drive), key=lambda message: message.arrival)
    sensors: dict[str, dict[str, Any]] = {
        sensor.name: {
            "kind": DRIVE_KINDS[sensor.kind],
            "topic": drive.topics[sensor.name],
            "frame_id": sensor.name,
        }
        for sensor in scenario.sensors
    }
    for name in truth.boards.cameras:
        sensors[name]["camera_info"] = f"/{name}/camera_info"
    target: dict[str, Any] = {"kind": "surroundings"}
    if truth.boards.boards:
        target["boards"] = [
            one.board.model_dump(mode="json", exclude_defaults=True) for one in truth.boards.boards
        ]
    rig = {"root": drive.root, "target": target, "sensors": sensors}
    found = GroundTruth(
        drive.root, truth.T_root_sensor, (), truth.clock_offsets, errors=_describe_faults(scenario),
        T_base_root=truth.T_base_root,
    )  # fmt: skip
    write_simulation(out, rig, found, messages, lambda done: progress(done, len(messages)))
    rows = np.column_stack(
        [truth.times, truth.T_world_root[:, :3, 3], so3.quaternion(truth.T_world_root[:, :3, :3])]
    )
    np.savetxt(out / "trajectory.txt", rows, "%.6f")


def _describe_faults(scenario: DriveScenario) -> dict[str, dict[str, Any]]:
    """What is wrong with the faulty sensor, if anything is."""
    faults = scenario.faults
    found: dict[str, Any] = {
        name: getattr(faults, name)
        for name in ("clock_drift", "clock_jump", "range_scale")
        if getattr(faults, name)
    }
    if any(faults.bump):
        found["bump"] = list(faults.bump)
    return {scenario.faulty: {**found, "time": faults.time * scenario.duration}} if found else {}


def _list_messages(drive: SimulatedDrive) -> Iterator[SerializedMessage]:
    """All messages with their arrivals, of the root's clock."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    rng = np.random.default_rng((drive.scenario.seed, 50))
    offsets = drive.truth.clock_offsets

    def arrival(name: str, end: float) -> int:
        return round(1e9 * (end - offsets[name] + rng.uniform(*LATENCIES)))

    def serialize(at: int, topic: str, message: Message) -> SerializedMessage:
        return SerializedMessage(at, topic, *serialize_message(store, message, "jpeg"))

    def measured(*kinds: str) -> Iterator[SerializedMessage]:
        for sensor in drive.scenario.sensors:
            for message in drive.messages[topic_of(sensor)] if sensor.kind in kinds else ():
                end = message.stamp + getattr(message, "duration", 0.0)
                yield serialize(arrival(sensor.name, end), topic_of(sensor), message)

    yield from measured(*RANGING)
    for mount in drive.truth.mounts:
        if mount.sensor.kind != "camera":
            continue
        name, camera = mount.sensor.name, drive.truth.boards.cameras[mount.sensor.name].stated
        for image in render_images(drive, mount):
            at = arrival(name, image.stamp)
            yield serialize(at, drive.topics[name], image)
            yield serialize(at, f"/{name}/camera_info", CameraInfo(image.stamp, name, camera))
    yield from measured("odometry", "trajectory")
    yield from measured("gyroscope")
