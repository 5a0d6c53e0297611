"""Whether a moved scanner is named, and no scanner in an unchanged network.

An office is calibrated from one minute of two people, and compared with the next minute: unchanged, and with a
random scanner, the root included, moved by 3 cm (even seeds) or rotated by half a degree.

    python benchmarks/lrf_network.py --seeds 20 --jobs 2 --tables moved
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calgraph.config import Rig
from calgraph.config.settings import DiagnosticsSettings
from calgraph.geometry import se2
from calgraph.network.checks.moved_scanners import find_moved_scanners
from calgraph.network.joint.planar_poses import PlanarPoses
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, estimate_scanner_pairs
from calgraph.sensors import LaserScan
from calgraph.simulation import NetworkScenario, build_network, network_rig, simulate_scans
from network_runs import JOINT, USUAL_PEOPLE, solve_poses, track_scanners

MINUTE = 60.0
SETTINGS = DiagnosticsSettings()
STEP = (0.03, np.radians(0.5))
"""m and rad."""


class Outcome(NamedTuple):
    """Result of two checks of one network."""

    moved: str
    """The scanner that was moved."""
    named: tuple[str, ...]
    """Scanners that the check names."""
    displacement: tuple[float, ...]
    """Its estimated displacement, m and rad."""
    alarms: tuple[str, ...]
    """Scanners named in the unchanged network."""


def print_moved(seeds: Sequence[int], jobs: int) -> None:
    """Prints the table."""
    with ProcessPoolExecutor(jobs) as pool:
        outcomes = list(pool.map(check, seeds))
    print("\nMoved: office, 2 people, a minute; even seeds: by 3 cm, odd seeds: by 0.5 degrees")
    print(f"{'seed':>6} {'moved':12}{'named':24}{'mm':>8}{'deg':>8} {'named where none was'}")
    for seed, one in zip(seeds, outcomes, strict=True):
        metres, turn = one.displacement or (np.nan, np.nan)
        size = f"{1000 * metres:8.1f}{np.degrees(turn):8.2f}"
        print(f"{seed:6d} {one.moved:12}{' '.join(one.named):24}{size} {' '.join(one.alarms)}")
    right = sum(one.named == (one.moved,) for one in outcomes)
    quiet = sum(not one.alarms for one in outcomes)
    print(f"{right} of {len(outcomes)} named, and no other; {quiet} of {len(outcomes)} without any when none was")


def check(seed: int) -> Outcome:
    """Calibrates a network, and checks it by further recordings."""
    scenario = NetworkScenario(duration=2 * MINUTE, people={"count": USUAL_PEOPLE})  # type: ignore[arg-type]
    network = build_network(scenario, seed)
    rig, middle = network_rig(network), scenario.start_time + MINUTE
    rng = np.random.default_rng(seed)
    k, direction = int(rng.integers(len(network.scanners))), rng.uniform(0, 2 * np.pi)
    step = (
        np.array([STEP[0] * np.cos(direction), STEP[0] * np.sin(direction), 0])
        if seed % 2 == 0
        else np.array([0, 0, STEP[1] * np.sign(np.pi - direction)])
    )
    pushed = replace(network.scanners[k], T_world_scanner=se2.retract(network.scanners[k].T_world_scanner, step))
    shifted = replace(network, scanners=(*network.scanners[:k], pushed, *network.scanners[k + 1 :]))
    scans = {scanner.name: list(simulate_scans(network, scanner)) for scanner in network.scanners}
    before = solve_recording(
        rig, {name: [scan for scan in one if scan.stamp < middle] for name, one in scans.items()}
    )
    later = {name: [scan for scan in one if scan.stamp >= middle] for name, one in scans.items()}
    _, alarms = find_moved_scanners(before, solve_recording(rig, later), SETTINGS)
    moved_scans = [scan for scan in simulate_scans(shifted, pushed) if scan.stamp >= middle]
    _, named = find_moved_scanners(before, solve_recording(rig, {**later, pushed.name: moved_scans}), SETTINGS)
    displacement = next(((one.distance, one.rotation) for one in named if one.name == pushed.name), ())
    return Outcome(pushed.name, tuple(one.name for one in named), displacement, tuple(one.name for one in alarms))


def solve_recording(rig: Rig, scans: Mapping[str, list[LaserScan]]) -> PlanarPoses:
    """The joint solution of a recording."""
    tracked, rng = track_scanners(rig, scans, "nls"), np.random.default_rng(0)
    estimates = estimate_scanner_pairs(tracked, rng)
    pairs = [pair for pair in estimates.values() if isinstance(pair, ScannerPairEstimate)]
    one = solve_poses(rig, tracked, pairs, JOINT, rng)
    return PlanarPoses(one.names, one.T_root_scanner, one.covariance)
