"""Simulation of stationary 3-D LiDARs, and 2-D scanners, in a hall with people; its files and ground truth."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from calgraph.config import Rig
from calgraph.geometry import Array, se3
from calgraph.io.text_writing import save_yaml
from calgraph.recording.record_list import IndexedRecording
from calgraph.recording.writer import serialize_message
from calgraph.sensors import LaserScan, PointCloud, RecordedMessage
from calgraph.simulation.drive_beams import Columns, draw_scanner_errors
from calgraph.simulation.drive_scenario import DriveSensor
from calgraph.simulation.hall_beams import simulate_sweeps
from calgraph.simulation.hall_mounts import HallMount, mount_sensors
from calgraph.simulation.hall_scenario import HallScenario
from calgraph.simulation.hall_world import Hall, build_hall
from calgraph.simulation.simulation_files import (
    LATENCIES,
    Progress,
    SerializedMessage,
    describe_rig,
    write_simulation,
)
from calgraph.simulation.truth import GroundTruth

_STAMP_JITTER, _LOST_MESSAGES = 0.0002, 0.002
"""Standard deviation of stamps, s, and probability that a message is not recorded, as in drives."""


@dataclass(frozen=True, eq=False)
class HallTruth:
    """The ground truth."""

    root: str
    T_root_sensor: Mapping[str, Array]
    """(4, 4) by sensor, at the end where one was bumped, and in the middle where one swings."""
    clock_offsets: Mapping[str, float]
    """By sensor, the sensor's clock minus the root's in the middle of the recording, without jumps, s."""
    T_world_root: Array
    """(4, 4) to the frame of the hall: z up, the floor at z = 0 in its middle."""
    mounts: tuple[HallMount, ...]
    hall: Hall


@dataclass(frozen=True, eq=False)
class SimulatedHall:
    """A recording with its ground truth."""

    scenario: HallScenario
    ranges: Mapping[str, NDArray[np.float32]]
    """(K, G * B) by sensor, m; NaN without a return."""
    stamps: Mapping[str, Array]
    """(K,) of sweeps by sensor, s."""
    truth: HallTruth

    @property
    def rig(self) -> Rig:
        """As a user would write it, without any pose."""
        sensors: dict[str, Any] = {
            mount.sensor.name: {
                "kind": "lidar2d" if mount.sensor.kind == "scanner" else "lidar3d",
                "topic": topic_of(mount.sensor),
                "frame_id": mount.sensor.name,
            }
            for mount in self.truth.mounts
        }
        return Rig.model_validate({"root": self.truth.root, "target": {"kind": "people"}, "sensors": sensors})

    @cached_property
    def recording(self) -> IndexedRecording:
        """All messages, which are made of the ranges when they are read; they arrive by the root's clock."""
        rng = np.random.default_rng((self.scenario.seed, 50))
        records, types = [], {}
        for mount in self.truth.mounts:
            name, topic = mount.sensor.name, topic_of(mount.sensor)
            types[topic] = "scan" if mount.sensor.kind == "scanner" else "cloud"
            delay = float(mount.columns.times[-1]) - self.truth.clock_offsets[name]
            beams = None if mount.sensor.kind == "scanner" else mount.columns.directions.reshape(-1, 3)
            for stamp, ranges in zip(self.stamps[name].tolist(), self.ranges[name], strict=True):
                decode = partial(_read_message, stamp, name, mount.columns, beams, ranges)
                arrival = stamp + delay + rng.uniform(*LATENCIES)
                records.append(RecordedMessage(topic, stamp, arrival, decode))
        return IndexedRecording(Path("messages"), records, types)


def _read_message(
    stamp: float, name: str, columns: Columns, beams: Array | None, ranges: NDArray[np.float32]
) -> LaserScan | PointCloud:
    measured = ranges.astype(np.float64)
    if beams is None:
        increment = float(columns.times[-1]) / (len(columns.times) - 1)
        return LaserScan(stamp, name, columns.azimuths, measured, increment)
    kept = np.flatnonzero(np.isfinite(measured))
    column, ring = np.divmod(kept, columns.elevations.shape[1])
    points = measured[kept, None] * beams[kept]
    return PointCloud(stamp, name, points, ring.astype(np.int32), columns.times[column])


def topic_of(sensor: DriveSensor) -> str:
    """The topic of a sensor's messages."""
    return f"/{sensor.name}/{'scan' if sensor.kind == 'scanner' else 'points'}"


def simulate_hall(scenario: HallScenario) -> SimulatedHall:
    """Simulates a recording.

    Raises:
        InputError: there are too many people for the hall, or no place for a sensor.
    """
    hall = build_hall(scenario)
    return simulate_sensors(
        scenario, hall, mount_sensors(scenario, hall, np.random.default_rng((scenario.seed, 10)))
    )


def simulate_sensors(
    scenario: HallScenario,
    hall: Hall,
    mounts: tuple[HallMount, ...],
    select_near: Callable[[Hall, HallMount], Hall] = lambda hall, _: hall,
) -> SimulatedHall:
    """Simulates what sensors measure in a hall, or of the part of it that is near to each."""
    ranges, stamps = {}, {}
    for index, mount in enumerate(mounts):
        rng = np.random.default_rng((scenario.seed, 100 + index))
        near = select_near(hall, mount)
        ranges[mount.sensor.name], stamps[mount.sensor.name] = _simulate_sensor(scenario, near, mount, rng)
    return SimulatedHall(scenario, ranges, stamps, _describe_truth(hall, mounts))


def _describe_truth(hall: Hall, mounts: tuple[HallMount, ...]) -> HallTruth:
    last = [mount.poses[len(mount.poses) // 2 if mount.swing_period else -1] for mount in mounts]
    names = [mount.sensor.name for mount in mounts]
    T_root_world = se3.inverse(last[0])
    return HallTruth(
        names[0],
        {name: T_root_world @ T for name, T in zip(names, last, strict=True)},
        {mount.sensor.name: mount.clock.offset - mounts[0].clock.offset for mount in mounts},
        last[0],
        mounts,
        hall,
    )


def _simulate_sensor(
    scenario: HallScenario, hall: Hall, mount: HallMount, rng: np.random.Generator
) -> tuple[NDArray[np.float32], Array]:
    """Ranges (K, G * B) and stamps (K,) of a sensor."""
    faults, sensor, clock = scenario.faults, mount.sensor, mount.clock
    errors = replace(
        scenario.errors,
        noise=rng.uniform(*scenario.noise) if scenario.errors.noise else 0.0,
        ring_bias=faults.ring_bias or scenario.errors.ring_bias,
    )
    own = draw_scanner_errors(errors, sensor.rings, rng)
    starts = np.arange(clock.phase, scenario.duration - clock.period, clock.period)
    ranges = simulate_sweeps(
        hall, sensor, mount.columns, mount.poses, mount.pose_of(starts), starts, errors, own, rng
    )
    if sensor.name == scenario.faulty and faults.range_scale:
        ranges *= np.float32(1 + faults.range_scale)
    if faults.false_returns:
        _add_false_returns(ranges, faults.false_returns, rng)
    stamps = scenario.start_time + clock.stamps(starts) + rng.normal(0, _STAMP_JITTER, len(starts))
    sent = np.flatnonzero(rng.random(len(starts)) >= _LOST_MESSAGES)
    return ranges[sent], stamps[sent]


def _add_false_returns(ranges: NDArray[np.float32], share: float, rng: np.random.Generator) -> None:
    """Drops return some beams before what they would hit, near ones more often, in place."""
    for row in ranges:
        rays = rng.choice(len(row), rng.poisson(share * len(row)))
        row[rays] = np.minimum(np.nan_to_num(row[rays], nan=20.0), 0.5 + 15.0 * rng.random(len(rays)) ** 2)


def record_hall(simulated: SimulatedHall, out: Path, progress: Progress) -> None:
    """Writes ``out/recording`` (rosbag2, MCAP), ``out/rig.yaml``, ``out/truth.yaml`` and ``out/scenario.yaml``.

    Args:
        simulated: what is written.
        out: folder, created if missing; it must not hold a recording yet.
        progress: called with the number of messages written, and with that in total.

    Raises:
        InputError: there is a recording in ``out`` already.
    """
    scenario, truth, store = simulated.scenario, simulated.truth, get_typestore(Stores.ROS2_HUMBLE)
    total = sum(topic.count for topic in simulated.recording.topics)
    messages = (
        SerializedMessage(round(1e9 * one.arrival), one.topic, *serialize_message(store, one.decode()))
        for one in simulated.recording.records()
    )
    found = GroundTruth(truth.root, truth.T_root_sensor, (), truth.clock_offsets)
    rig = describe_rig(simulated.rig)
    # Measured with a tape, to 2 cm; walls and people do not show it.
    errors = np.random.default_rng((scenario.seed, 5)).normal(0, 0.02, len(scenario.scanners))
    heights = (np.array(scenario.scanners) + errors).round(3).tolist()
    for sensor, height in zip(scenario.sensors[len(scenario.lidars) :], heights, strict=True):
        rig["sensors"][sensor.name]["height"] = height
    write_simulation(out, rig, found, messages, lambda done: progress(done, total))
    save_yaml(out / "scenario.yaml", asdict(scenario), f"seed: {scenario.seed}")
