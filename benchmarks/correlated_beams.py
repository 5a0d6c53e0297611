"""Networks of scanners whose adjacent beams share noise: errors, NEES and verdicts.

python benchmarks/correlated_beams.py --seeds 0 1 2 3 4 5 6 7 8 9           # correlations 0, 0.5, 0.7 and 0.9
python benchmarks/correlated_beams.py --correlations 0.7 --time 0.5         # noise that lasts, s

Noise is autoregressive along the beams of a scan, with the standard deviation of the scanner, and with ``--time``
from scan to scan as well. Columns are those of network_model_errors.py.
"""

import argparse
import logging
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from calgraph.network.options import NetworkOptions
from calgraph.network.pipeline import calibrate_network
from calgraph.parallel.processes import parallel_map
from calgraph.recording.in_memory import MessageRecording
from calgraph.sensors import LaserScan
from calgraph.simulation import build_network, network_rig, network_truth, simulate_scans
from calgraph.simulation.network_simulation import SimulatedNetwork
from network_model_error_kinds import ROOMS, build_scenario
from network_model_errors import HEADER, Outcome, judge, show_line


def main() -> None:
    """Prints a line for each correlation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--correlations", nargs="+", type=float, default=[0.0, 0.5, 0.7, 0.9])
    parser.add_argument("--time", type=float, default=0.0, help="in which noise loses its correlation, s")
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=["office"])
    parser.add_argument("--shape", choices=["ellipse", "legs"], default="ellipse", help="of people")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(3)))
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    logging.disable(logging.WARNING)
    print(HEADER)
    for correlation in arguments.correlations:
        work = [
            (room, seed, correlation, arguments.time, arguments.shape, arguments.duration)
            for room in arguments.rooms
            for seed in arguments.seeds
        ]
        found = [one for of_run in parallel_map(run, work, arguments.jobs) for one in of_run]
        show_line(f"{'beams':14} {correlation:9g} {'all':7}", found)


def run(
    room: str, seed: int, correlation: float, lasting: float, shape: str, duration: float
) -> tuple[Outcome, ...]:
    """Simulates and calibrates one recording."""
    scenario = build_scenario(room, "right", 0.0, duration, shape)
    sigma = scenario.scanner.range_noise
    quiet = scenario.model_copy(update={"scanner": scenario.scanner.model_copy(update={"range_noise": 0.0})})
    network = build_network(quiet, seed)
    rig = network_rig(build_network(scenario, seed))
    scans = {
        rig.topics[scanner.name]: list(simulate_noise(network, k, sigma, correlation, lasting))
        for k, scanner in enumerate(network.scanners)
    }
    began = time.perf_counter()
    found = calibrate_network(rig, MessageRecording(scans), NetworkOptions(seed=seed))
    seconds, truth = time.perf_counter() - began, network_truth(network)
    names = [name for name in truth.T_root_sensor if name != truth.root]
    return tuple(judge(("beams", correlation, room, seed, name), found, truth, seconds) for name in names)


def simulate_noise(
    network: SimulatedNetwork, number: int, sigma: float, correlation: float, lasting: float
) -> Iterator[LaserScan]:
    """The scans of one scanner of a network without noise, with noise of a standard deviation, m."""
    rng = np.random.default_rng((network.seed, 77, number))
    noise, before = np.zeros(0), -np.inf
    for scan in simulate_scans(network, network.scanners[number]):
        white = np.sqrt(1 - correlation**2) * rng.normal(size=len(scan.ranges))
        new, _ = lfilter([1.0], [1.0, -correlation], white, zi=[correlation * rng.normal()])
        kept = np.exp((before - scan.stamp) / lasting) if lasting and len(noise) else 0.0
        noise = kept * noise + np.sqrt(1 - kept**2) * new if len(noise) else new
        before = scan.stamp
        yield replace(scan, ranges=scan.ranges + sigma * noise)


if __name__ == "__main__":
    main()
