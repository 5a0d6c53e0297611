"""Time and memory of the joint solution of a network, against its scanners and minutes.

Each number of scanners is a grid of them, with two walkers for five. Ten minutes are one minute ten times over,
shifted. Pairs are not estimated: the start is the ground truth, wrong by 2 cm and 0.2 degrees. Seconds are of one
processor; memory is the peak of the whole process, and what it was before the solution began.

    python benchmarks/lrf_network.py --tables time
"""

import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calgraph.config import Lidar2dSpec, People
from calgraph.config.settings import NetworkEstimationSettings, TrackingSettings
from calgraph.geometry import se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.joint.estimate import solve_network
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.simulation import NetworkScenario, build_network, network_rig, network_truth, simulate_scans

SCANNERS, MINUTES = (6, 30, 100), (1, 10)
WALKERS = 0.4
"""For each scanner."""
START = (0.02, 0.02, np.radians(0.2))
"""Standard deviations of the start's errors, m and rad."""
PAUSE = 62.0
"""From one copy of the minute to the next, s."""


class Measured(NamedTuple):
    """What one solution took."""

    minutes: int
    seconds: float
    """Processor time, s."""
    megabytes: float
    """Most that the process ever held."""


def print_times() -> None:
    """Prints the table."""
    print("\nTime and memory of the joint solution")
    print(f"{'scanners':>9}{'minutes':>9}{'seconds':>9}{'MB':>7}{'MB before':>11}")
    for count in SCANNERS:
        # A separate process, so that the peak memory is that of this network.
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            before, measured = pool.submit(measure, count).result()
        for one in measured:
            print(f"{count:9d}{one.minutes:9d}{one.seconds:9.1f}{one.megabytes:7.0f}{before:11.0f}", flush=True)


def measure(count: int) -> tuple[float, list[Measured]]:
    """Solves networks of ``count`` scanners; memory before, MB, and time and memory by duration."""
    walkers = max(2, round(WALKERS * count))
    scenario = NetworkScenario(
        layout="grid",
        clutter=2 * count,
        scanner={"count": count},  # type: ignore[arg-type]
        people={"count": walkers},  # type: ignore[arg-type]
    )
    network = build_network(scenario, seed=0)
    rig, truth = network_rig(network), network_truth(network).T_root_sensor
    tracked = {}
    for scanner in network.scanners:
        spec = rig.sensors[scanner.name]
        assert isinstance(spec, Lidar2dSpec)
        assert isinstance(rig.target, People)
        found = track_scanner(
            simulate_scans(network, scanner), rig.target, spec.noise, settings=TrackingSettings()
        )
        if isinstance(found, ScannerTracks):
            tracked[scanner.name] = found
    T = np.array([truth[name][np.ix_((0, 1, 3), (0, 1, 3))] for name in tracked])
    off = np.random.default_rng(0).normal(0, START, (len(T), 3))
    off[0] = 0
    start = PoseGraphSolution(se2.retract(T, off), np.zeros(0, dtype=np.bool_))
    graph = PoseGraph(len(T), np.zeros((0, 2), dtype=np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    assert isinstance(rig.target, People)
    before, measured = measure_peak_memory(), []
    for minutes in MINUTES:
        repeated = [repeat_tracks(one, minutes) for one in tracked.values()]
        begin = time.process_time()
        solve_network(rig.target, repeated, start, graph, settings=NetworkEstimationSettings())
        measured.append(Measured(minutes, time.process_time() - begin, measure_peak_memory()))
    return before, measured


def repeat_tracks(tracked: ScannerTracks, times: int) -> ScannerTracks:
    """The tracks repeated one after the other."""
    tracks = [
        replace(track, times=track.times + k * PAUSE, hits=replace(track.hits, times=track.hits.times + k * PAUSE))
        for k in range(times)
        for track in tracked.tracks
    ]
    return replace(tracked, tracks=tuple(tracks))


def measure_peak_memory() -> float:
    """Peak memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
