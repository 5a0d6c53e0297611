"""The recording of a simulated network, made in pieces so that memory does not grow with its duration.

Scanners are simulated in groups, each in order of arrival. Of several groups each is first written to a temporary
bag, possibly by a process for each; the recording is then merged from these.
"""

import heapq
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calgraph.config.settings import LimitSettings
from calgraph.io.atomic import make_temporary_folder, remove_temporary_folder
from calgraph.io.text_writing import save_yaml
from calgraph.parallel.engine import Processes
from calgraph.parallel.kept_values import Kept
from calgraph.recording.bag_files import BagFiles
from calgraph.recording.bags import BagRecording
from calgraph.recording.writer import RecordingWriter, serialize_message
from calgraph.sensors import LaserScan
from calgraph.simulation.network_scenario import NetworkScenario
from calgraph.simulation.network_simulation import (
    SimulatedNetwork,
    build_network,
    count_scans,
    network_rig,
    network_topic,
    network_truth,
    simulate_scans,
)
from calgraph.simulation.truth import save_truth

_LATENCY_RANGE = 0.002, 0.02
"""Bounds of the time from the end of a scan to its arrival at the recorder, s."""
_GROUP_SIZE = 16
"""Scanners that are simulated together: each takes some 7 MB then, and each group an open file later."""

Progress = Callable[[int, int], None]


class _Serialized(NamedTuple):
    """A scan as the recording has it."""

    arrival: int
    """ns."""
    topic: str
    ros_type: str
    data: bytes | memoryview
    """CDR."""


def simulate_network(
    scenario: NetworkScenario, out: Path, seed: int = 0, progress: Progress | None = None, jobs: int = 1
) -> None:
    """Writes ``out/recording`` (rosbag2, MCAP), ``out/rig.yaml`` and ``out/truth.yaml``.

    Args:
        scenario: building, scanners and people.
        out: folder, created if missing; it must not hold a recording yet.
        seed: the same seed and scenario give the same files.
        progress: called with the number of scans simulated and written, and with that in total. Scans of several
            groups count twice: when they are simulated, and when they are written.
        jobs: maximum number of processes; files are the same for any number.

    Raises:
        InputError: the scanners' jitter puts them into walls, the floor is too small for all people, or there is a
            recording in ``out`` already.
        CalibrationError: a process was killed or cannot be started.
    """
    network = build_network(scenario, seed)
    scanners = range(len(network.scanners))
    groups = [scanners[k : k + _GROUP_SIZE] for k in scanners[::_GROUP_SIZE]]
    scans = sum(count_scans(scenario, scanner) for scanner in network.scanners)
    total = scans if len(groups) == 1 else 2 * scans
    report = progress or _ignore
    with (
        RecordingWriter(out / "recording", scenario.max_file_duration) as writer,
        _simulate_groups(network, groups, out / "recording", jobs, lambda done: report(done, total)) as streams,
    ):
        for done, message in enumerate(heapq.merge(*streams, key=lambda message: message.arrival), start=1):
            writer.write_serialized(message.topic, message.ros_type, message.data, message.arrival)
            report(total - scans + done, total)
    rig = network_rig(network)
    save_yaml(out / "rig.yaml", rig.model_dump(mode="json", exclude_none=True, exclude={"settings"}))
    save_truth(out / "truth.yaml", network_truth(network))


@contextmanager
def _simulate_groups(
    network: SimulatedNetwork, groups: Sequence[range], recording: Path, jobs: int, report: Callable[[int], None]
) -> Iterator[list[Iterable[_Serialized]]]:
    """The messages of each group of scanners in order; ``report`` hears of the scans simulated before."""
    if len(groups) == 1:
        yield [_simulate_group(network, groups[0])]
        return
    with ExitStack() as stack:
        place = make_temporary_folder(recording)
        stack.callback(remove_temporary_folder, place)
        given = Kept.of(network)
        work = [(given, group, place / str(k)) for k, group in enumerate(groups)]
        done = 0
        for count in Processes(jobs).map(_write_group, work):
            done += count
            report(done)
        yield [_read_group(path, stack) for *_, path in work]


def _write_group(network: SimulatedNetwork, scanners: range, path: Path) -> int:
    """Writes the messages of some scanners, by number, as a bag; their number."""
    count = 0
    with RecordingWriter(path) as writer:
        for message in _simulate_group(network, scanners):
            writer.write_serialized(message.topic, message.ros_type, message.data, message.arrival)
            count += 1
    return count


def _read_group(path: Path, stack: ExitStack) -> Iterator[_Serialized]:
    bag = BagRecording(path, BagFiles((path / f"{path.name}.mcap",), ()), LimitSettings())
    stack.callback(bag.close)
    messages = bag.raw_messages([topic.name for topic in bag.topics])
    return (_Serialized(one.arrival, one.topic, one.definition.name, one.data) for one in messages)


def _simulate_group(network: SimulatedNetwork, scanners: range) -> Iterator[_Serialized]:
    """The messages of some scanners, by number, in order of arrival."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    streams = [_simulate_arrivals(network, number) for number in scanners]
    for arrival, name, scan in heapq.merge(*streams, key=lambda item: item[0]):
        yield _Serialized(round(arrival * 1e9), network_topic(name), *serialize_message(store, scan))


def _simulate_arrivals(network: SimulatedNetwork, number: int) -> Iterator[tuple[float, str, LaserScan]]:
    """Scans of one scanner with their arrival times at the recorder, whose clock is the root's."""
    scanner = network.scanners[number]
    delays = np.random.default_rng((network.seed, 1 + number, 1))
    latest = 0.0
    for scan in simulate_scans(network, scanner):
        done = scan.stamp - scanner.clock_offset + scan.duration
        latest = max(latest, done + delays.uniform(*_LATENCY_RANGE))
        yield latest, scanner.name, scan


def _ignore(_done: int, _total: int) -> None:
    """Hears of progress and does nothing."""
