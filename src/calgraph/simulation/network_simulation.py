"""Simulation of a network scenario: building, scanners and people, and the scans of every scanner.

Scanners are not synchronised: phases, rate errors and optional clock offsets are random. Each scanner has a
separate random generator, so that its scans do not depend on what else is simulated.

Recordings are made in pieces so that memory does not grow with their duration. Scanners are simulated in groups,
each in order of arrival. Of several groups each is first written to a temporary bag, possibly by a process for
each; the recording is then merged from these.
"""

import heapq
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore

from calgraph.config import Capture, Cylinder, Lidar2dSpec, People, RangeNoise, Rig
from calgraph.config.settings import LimitSettings
from calgraph.geometry import Array, se2, se3
from calgraph.io.atomic import make_temporary_folder, remove_temporary_folder
from calgraph.parallel.engine import Processes
from calgraph.parallel.kept_values import Kept
from calgraph.recording.bag_files import BagFiles
from calgraph.recording.bags import BagRecording
from calgraph.recording.writer import RecordingWriter, serialize_message
from calgraph.sensors import LaserScan
from calgraph.simulation.network_beams import USUAL_MAX_SPEED, ScanPlane, View, build_views, simulate_true_ranges
from calgraph.simulation.network_floor import Floor, FreeSpace, find_free_space
from calgraph.simulation.network_layouts import CHAIR_REACH, build_layout, move_chairs, place_chairs, place_mirrors
from calgraph.simulation.network_people import build_bodies, form_parties, separate_people
from calgraph.simulation.network_scanners import StationaryScanner, build_scanners
from calgraph.simulation.network_scenario import NetworkScenario, ScannerOptions
from calgraph.simulation.network_walks import BodyIndex, Party, SimulatedWalk, body_clearance, draw_walks
from calgraph.simulation.scanners import add_mixed_pixels
from calgraph.simulation.simulation_files import (
    LATENCIES,
    Progress,
    SerializedMessage,
    describe_rig,
    write_simulation,
)
from calgraph.simulation.truth import GroundTruth, PersonTruth

_BATCH = 500
"""Scans per batch, which bounds memory."""
_DRIVING_INTERVAL = 0.05
"""Between two poses of a scanner that drives, s."""
_TRUTH_RATE = 20.0
"""Samples of the people's true positions, per second."""


@dataclass(frozen=True, eq=False)
class SimulatedNetwork:
    """A simulated building in which scans can be taken."""

    scenario: NetworkScenario
    seed: int
    root: str
    floor: Floor
    scanners: tuple[StationaryScanner, ...]
    walks: tuple[SimulatedWalk, ...]
    """Of people or cylinders, one each."""
    bodies: tuple[SimulatedWalk, ...]
    """What beams hit of them and of chairs."""
    mirrors: Array
    """(Q, 2, 2) end points of mirrors, m."""

    @cached_property
    def _body_index(self) -> BodyIndex:
        return BodyIndex(self.bodies)

    @cached_property
    def _max_speed(self) -> float:
        """Of all bodies, m/s."""
        return max((body.max_speed for body in self.bodies), default=0.0)

    def find_bodies(self, views: Sequence[View], times: Array, max_range: float) -> list[SimulatedWalk]:
        """The bodies that scans (C, M) at ``times`` may hit, and some others."""
        if not len(times):
            return []
        # Bodies move while a scan lasts.
        margin = max(self._max_speed, USUAL_MAX_SPEED) * float((times[:, -1] - times[:, 0]).max())
        places = np.array([view.plane.origin for view in views])
        return self._body_index.near(places, max_range + margin, float(times[0, 0]), float(times[-1, -1]))


def build_network(scenario: NetworkScenario, seed: int) -> SimulatedNetwork:
    """Draws building, scanners and walks.

    Raises:
        InputError: the scanners' jitter puts them into walls, or the floor is too small for all people.
    """
    rng = np.random.default_rng((seed, 0))
    layout = build_layout(scenario, rng)
    root = scenario.root or scenario.names[0]
    error_rng = np.random.default_rng((seed, 0, 0, 1))
    scanners = build_scanners(scenario, layout.mounts, root, rng, error_rng)
    chair_rng, people_rng = (np.random.default_rng((seed, 0, 0, k)) for k in (2, 3))
    places = layout.mounts[:, :2]
    mirrors = place_mirrors(layout.floor, scenario.mirrors, places, chair_rng)
    chairs = place_chairs(layout.floor, scenario.chairs, np.concatenate([places, layout.stations]), chair_rng)

    def find_space(reach: float) -> FreeSpace:
        clear = body_clearance(scenario.people, reach)
        near_scanners = np.column_stack([places, np.full(len(places), clear + 0.1)])
        near_chairs = np.column_stack([chairs, np.full(len(chairs), reach + CHAIR_REACH)])
        return find_free_space(layout.floor, clear, np.concatenate([near_scanners, near_chairs]))

    parties = form_parties(scenario.people, find_space)
    together = draw_walks(
        parties, layout.stations, scenario.people, scenario.background, scenario.duration, rng, layout.trip
    )
    walks = separate_people(scenario.people, together, people_rng)
    if scenario.errors.driving:
        free_space = find_space(scenario.people.reach)
        scanners = _let_one_drive(scanners, scenario, root, free_space, error_rng)
    solid = scenario.people.shape == "ellipse"
    furniture = move_chairs(chairs, scenario.duration, solid, chair_rng)
    bodies = (*build_bodies(scenario, walks, seed), *furniture)
    return SimulatedNetwork(scenario, seed, root, layout.floor, scanners, walks, bodies, mirrors)


def simulate_network_scans(
    scenario: NetworkScenario, seed: int = 0
) -> tuple[dict[str, list[LaserScan]], GroundTruth]:
    """Simulates the scans by scanner, in order, and the ground truth, without writing a recording.

    Raises:
        InputError: the scanners' jitter puts them into walls, or the floor is too small for all people.
    """
    network = build_network(scenario, seed)
    scans = {scanner.name: list(simulate_scans(network, scanner)) for scanner in network.scanners}
    return scans, network_truth(network)


def network_rig(network: SimulatedNetwork) -> Rig:
    """The rig.yaml of a simulated network: what its user would write, without any pose."""
    scenario, people = network.scenario, network.scenario.people
    # Noise-free ranges still need a positive noise as weight.
    noise = RangeNoise(range=max(scenario.scanner.range_noise, 1e-4), angle=1e-5)
    return Rig(
        root=network.root,
        target=Cylinder(kind="cylinder", diameter=people.diameter)
        if people.kind == "cylinder"
        else People(kind="people", axes=people.axes),
        capture=Capture(background=(0.0, scenario.background) if scenario.background else None),
        sensors={
            name: Lidar2dSpec(kind="lidar2d", topic=network_topic(name), frame_id=name, noise=noise)
            for name in scenario.names
        },
    )


def network_truth(network: SimulatedNetwork) -> GroundTruth:
    """The true poses, clocks and walks, in the root's frame and clock."""
    T_root_world = se3.inverse(next(s.true_pose() for s in network.scanners if s.name == network.root))
    return GroundTruth(
        root=network.root,
        T_root_sensor={s.name: T_root_world @ s.true_pose() for s in network.scanners},
        boards=(),
        clock_offsets={s.name: s.clock_offset for s in network.scanners},
        people=tuple(_person_truth(network.scenario, walk, T_root_world) for walk in network.walks),
        errors={s.name: s.errors() for s in network.scanners if s.errors()},
    )


def simulate_scans(network: SimulatedNetwork, scanner: StationaryScanner) -> Iterator[LaserScan]:
    """All scans of one scanner, in order; stamps are of the scanner's clock."""
    scenario, options = network.scenario, scanner.options
    rng = np.random.default_rng((network.seed, 1 + network.scanners.index(scanner)))
    within = scanner.time_increment * np.arange(len(scanner.angles))
    starts: Array = scanner.phase + scanner.period * np.arange(count_scans(scenario, scanner), dtype=np.float64)
    stamps = scenario.start_time + starts + scanner.clock_offset
    stamps += scanner.clock_drift * (starts - scenario.duration / 2)
    before, views = None, tuple[View, ...]()
    for first, last, T_world_scanner in _batches(scanner, starts):
        if T_world_scanner is not before:
            plane = scanner.plane_at(T_world_scanner)
            views = build_views(plane, network.floor, network.mirrors, _floor_distance(plane, scenario))
            before = T_world_scanner
        times = starts[first:last, None] + within
        bodies = network.find_bodies(views, times, options.max_range)
        true = simulate_true_ranges(views, times, bodies, options.max_range)
        true = (1 + scanner.range_scale) * scanner.stretch * true + scanner.range_bias
        for stamp, ranges in zip(stamps[first:last], _simulate_measured_ranges(true, options, rng), strict=True):
            yield LaserScan(float(stamp), scanner.name, scanner.angles, ranges, scanner.time_increment)


def _batches(scanner: StationaryScanner, starts: Array) -> Iterator[tuple[int, int, Array]]:
    """First and past last scan of each batch, and the scanner's pose (3, 3) in it."""
    changes = np.searchsorted(starts, [end for end, _ in scanner.earlier]).tolist()
    for begin, end in pairwise([0, *changes, len(starts)]):
        for first in range(begin, end, _BATCH):
            yield first, min(first + _BATCH, end), scanner.pose_at(float(starts[first]))


def _floor_distance(plane: ScanPlane, scenario: NetworkScenario) -> Array:
    """(M,) where beams reach the floor, m; scanners that observe ellipses are too high up for that."""
    falling = (plane.slopes < 0) & (scenario.people.shape == "legs")
    return np.where(falling, plane.height / np.where(falling, -plane.slopes, 1.0), np.inf)


def _let_one_drive(
    scanners: tuple[StationaryScanner, ...],
    scenario: NetworkScenario,
    root: str,
    free_space: FreeSpace,
    rng: np.random.Generator,
) -> tuple[StationaryScanner, ...]:
    """The scanners, of which one besides the root drives on a separate path."""
    rider = scenario.people.model_copy(
        update={"speed": scenario.errors.driving, "speed_spread": 0.0, "stop_every": 0.0}
    )
    party = Party(scenario.people.reach, free_space)
    [path] = draw_walks([party], np.zeros((0, 2)), rider, 0.0, scenario.duration, rng)
    times = np.arange(_DRIVING_INTERVAL, scenario.duration, _DRIVING_INTERVAL)
    places, headings = path.pose_at(times - _DRIVING_INTERVAL / 2)
    poses = se2.pose(headings, places)
    chosen = int(rng.choice([k for k, name in enumerate(scenario.names) if name != root]))
    earlier = tuple(zip(times.tolist(), poses, strict=True))
    driving = replace(scanners[chosen], T_world_scanner=poses[-1], earlier=earlier)
    return (*scanners[:chosen], driving, *scanners[chosen + 1 :])


def _simulate_measured_ranges(true: Array, options: ScannerOptions, rng: np.random.Generator) -> Array:
    """Ranges (C, M) with noise, mixed pixels, quantisation and dropouts; NaN without a return."""
    index = np.arange(true.size).reshape(true.shape)
    # A scan's last beam has no neighbour but itself.
    neighbours = np.minimum(index + 1, index[:, -1:]).ravel()
    ranges = add_mixed_pixels(true.ravel(), neighbours, options.mixed_pixels, rng).reshape(true.shape)
    ranges += rng.normal(0.0, options.range_noise, true.shape)
    if options.quantisation:
        ranges = options.quantisation * np.round(ranges / options.quantisation)
    lost = rng.random(true.shape) < options.dropout
    return np.where(
        (ranges > 0) & (ranges >= options.min_range) & (ranges <= options.max_range) & ~lost, ranges, np.nan
    )


def count_scans(scenario: NetworkScenario, scanner: StationaryScanner) -> int:
    """Number of scans of a scanner that begin and end within the recording."""
    last = scanner.time_increment * (len(scanner.angles) - 1)
    return max(0, int((scenario.duration - last - scanner.phase) / scanner.period) + 1)


def _person_truth(scenario: NetworkScenario, walk: SimulatedWalk, T_root_world: Array) -> PersonTruth:
    times = np.arange(walk.start, scenario.duration, 1 / _TRUTH_RATE)
    places, headings = walk.pose_at(times)
    level = np.zeros(len(times))
    facing = np.column_stack([np.cos(headings), np.sin(headings), level]) @ T_root_world[:3, :3].T
    return PersonTruth(
        axes=walk.axes,
        times=scenario.start_time + times,
        positions=se3.apply(T_root_world, np.column_stack([places, level]))[:, :2],
        headings=np.arctan2(facing[:, 1], facing[:, 0]),
    )


def network_topic(name: str) -> str:
    """The topic of a scanner's scans."""
    return f"/{name}/scan"


_GROUP_SIZE = 16
"""Scanners that are simulated together: each takes some 7 MB then, and each group an open file later."""


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

    def report(done: int) -> None:
        if progress:
            progress(done, total)

    # Nothing is simulated before the first message is asked for, when it is known that no recording exists yet.
    with closing(_simulate_groups(network, groups, out / "recording", jobs, report)) as messages:
        write_simulation(
            out,
            describe_rig(network_rig(network)),
            network_truth(network),
            messages,
            lambda done: report(total - scans + done),
            scenario.max_file_duration,
        )


def _simulate_groups(
    network: SimulatedNetwork, groups: Sequence[range], recording: Path, jobs: int, report: Callable[[int], None]
) -> Generator[SerializedMessage, None, None]:
    """The messages of all groups of scanners in order; ``report`` hears of the scans simulated before."""
    if len(groups) == 1:
        yield from _simulate_group(network, groups[0])
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
        streams = [_read_group(path, stack) for *_, path in work]
        yield from heapq.merge(*streams, key=lambda message: message.arrival)


def _write_group(network: SimulatedNetwork, scanners: range, path: Path) -> int:
    """Writes the messages of some scanners, by number, as a bag; their number."""
    count = 0
    with RecordingWriter(path) as writer:
        for message in _simulate_group(network, scanners):
            writer.write_serialized(message.topic, message.ros_type, message.data, message.arrival)
            count += 1
    return count


def _read_group(path: Path, stack: ExitStack) -> Iterator[SerializedMessage]:
    bag = BagRecording(path, BagFiles((path / f"{path.name}.mcap",), ()), LimitSettings())
    stack.callback(bag.close)
    messages = bag.raw_messages([topic.name for topic in bag.topics])
    return (SerializedMessage(one.arrival, one.topic, one.definition.name, one.data) for one in messages)


def _simulate_group(network: SimulatedNetwork, scanners: range) -> Iterator[SerializedMessage]:
    """The messages of some scanners, by number, in order of arrival."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    streams = [_simulate_arrivals(network, number) for number in scanners]
    for arrival, name, scan in heapq.merge(*streams, key=lambda item: item[0]):
        yield SerializedMessage(round(arrival * 1e9), network_topic(name), *serialize_message(store, scan))


def _simulate_arrivals(network: SimulatedNetwork, number: int) -> Iterator[tuple[float, str, LaserScan]]:
    """Scans of one scanner with their arrival times at the recorder, whose clock is the root's."""
    scanner = network.scanners[number]
    delays = np.random.default_rng((network.seed, 1 + number, 1))
    latest = 0.0
    for scan in simulate_scans(network, scanner):
        done = scan.stamp - scanner.clock_offset + scan.duration
        latest = max(latest, done + delays.uniform(*LATENCIES))
        yield latest, scanner.name, scan
