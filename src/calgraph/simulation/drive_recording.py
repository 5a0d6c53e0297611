"""The files of a simulated drive: recording, rig.yaml and ground truth."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calgraph.geometry import so3
from calgraph.io.text_writing import save_yaml
from calgraph.recording.writer import RecordingWriter, serialize_message
from calgraph.sensors import CameraInfo
from calgraph.simulation.drive_images import render_images
from calgraph.simulation.drive_scenario import DRIVE_KINDS, RANGING, DriveScenario
from calgraph.simulation.drive_simulation import SimulatedDrive, simulate_drive
from calgraph.simulation.truth import GroundTruth, save_truth

_LATENCY_RANGE = 0.002, 0.02
"""Bounds of the time from the end of a measurement to its arrival at the recorder, s."""

_Event = tuple[int, str, str, bytes | memoryview]
"""Arrival, ns, topic, ROS type and CDR of a message."""


def record_drive(scenario: DriveScenario, out: Path, progress: Callable[[int, int], None] | None = None) -> None:
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
    events = sorted(_list_events(drive), key=lambda event: event[0])
    with RecordingWriter(out / "recording") as writer:
        for done, (arrival, topic, ros_type, data) in enumerate(events, start=1):
            writer.write_serialized(topic, ros_type, data, arrival)
            if progress is not None:
                progress(done, len(events))
    sensors: dict[str, dict[str, Any]] = {
        sensor.name: {
            "kind": DRIVE_KINDS[sensor.kind],
            "topic": drive.topics[sensor.name],
            "frame_id": sensor.name,
        }
        for sensor in scenario.sensors
    }
    for name in drive.truth.boards.cameras:
        sensors[name]["camera_info"] = f"/{name}/camera_info"
    target: dict[str, Any] = {"kind": "surroundings"}
    if drive.truth.boards.boards:
        target["boards"] = [
            one.board.model_dump(mode="json", exclude_defaults=True) for one in drive.truth.boards.boards
        ]
    save_yaml(out / "rig.yaml", {"root": drive.root, "target": target, "sensors": sensors})
    truth = drive.truth
    save_truth(
        out / "truth.yaml",
        GroundTruth(
            drive.root,
            truth.T_root_sensor,
            (),
            truth.clock_offsets,
            errors=_describe_faults(scenario),
            T_base_root=truth.T_base_root,
        ),
    )
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


def _list_events(drive: SimulatedDrive) -> Iterator[_Event]:
    """All messages with their arrivals, of the root's clock."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    rng = np.random.default_rng((drive.scenario.seed, 50))
    offsets = drive.truth.clock_offsets

    def arrival(name: str, end: float) -> int:
        return round(1e9 * (end - offsets[name] + rng.uniform(*_LATENCY_RANGE)))

    def measured(names: Iterable[str]) -> Iterator[_Event]:
        for name in names:
            for message in drive.messages[drive.topics[name]]:
                end = message.stamp + getattr(message, "duration", 0.0)
                yield arrival(name, end), drive.topics[name], *serialize_message(store, message)

    yield from measured(sensor.name for sensor in drive.scenario.sensors if sensor.kind in RANGING)
    for mount in drive.truth.mounts:
        if mount.sensor.kind != "camera":
            continue
        name, camera = mount.sensor.name, drive.truth.boards.cameras[mount.sensor.name].stated
        for image in render_images(drive, mount):
            at = arrival(name, image.stamp)
            yield at, drive.topics[name], *serialize_message(store, image, "jpeg")
            info = CameraInfo(image.stamp, name, camera)
            yield at, f"/{name}/camera_info", *serialize_message(store, info)
    yield from measured([*drive.trajectories, *drive.rates])
