"""Clock offsets between two scanners that one real scanner of legs stands for.

python benchmarks/real_legs.py [DATA]       # the folder of real recordings; CALGRAPH_DATA or ../shared/data

Of every two scans, the first is of one scanner, the second of another, with a rotation and a clock offset put in.
Both have one viewpoint, so that errors of ranges and radii cancel: it tests clocks and noise, not the size.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calgraph.config import People, RangeNoise
from calgraph.config.settings import NetworkEstimationSettings, TrackingSettings
from calgraph.geometry import se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.joint.estimate import NetworkSolution, solve_network
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.recording import open_recording
from calgraph.sensors import LaserScan
from real_recordings import DATA

TOPICS = {
    "positive_1": "right_scan",
    "positive_2": "right_scan",
    "positive_3": "right_scan",
    "positive_4": "right_scan",
    "positive_7": "/rear_scan",
}
OFFSETS = 0.05, -0.03, 0.0
"""s."""
TURN = 0.3
"""Of the second scanner, rad."""
NOISE = RangeNoise(range=0.02, angle=0.001)


def read_scans(path: Path, topic: str) -> list[LaserScan]:
    """All scans of a recording."""
    with open_recording(path) as recording:
        messages = [record.decode() for record in recording.records([topic])]
    return [message for message in messages if isinstance(message, LaserScan)]


def solve(scans: Sequence[LaserScan], offset: float) -> NetworkSolution:
    """The solution of two scanners, from a start that is 14 mm and 0.1 degrees off."""
    second = [replace(scan, stamp=scan.stamp + offset, angles=scan.angles - TURN) for scan in scans[1::2]]
    tracked = [track_scanner(part, People(), NOISE, settings=TrackingSettings()) for part in (scans[::2], second)]
    legs = [found for found in tracked if isinstance(found, ScannerTracks)]
    poses = np.stack([np.eye(3), se2.pose(TURN + 0.002, np.array([0.01, -0.01]))])
    nothing = PoseGraph(2, np.zeros((0, 2), dtype=np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    return solve_network(
        People(),
        legs,
        PoseGraphSolution(poses, np.zeros(0, dtype=np.bool_)),
        nothing,
        settings=NetworkEstimationSettings(),
    )


def main() -> None:
    """Prints a row for each recording and offset."""
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else DATA
    print("recording    clock ms   found   sigma   error    x mm    y mm     deg")
    for name, topic in TOPICS.items():
        scans = read_scans(data / "real-legs-one-laser" / f"{name}.bag", topic)
        for offset in OFFSETS:
            solution = solve(scans, offset)
            found, sigma = 1000 * solution.clocks[1]
            true = np.stack([np.eye(3), se2.pose(TURN, np.zeros(2))])
            x, y, angle = se2.difference(solution.T_root_scanner, true)[1] * [1000, 1000, np.degrees(1)]
            print(
                f"{name:12} {1000 * offset:8.0f} {found:7.1f} {sigma:7.1f} {found - 1000 * offset:7.1f}"
                f" {x:7.1f} {y:7.1f} {angle:7.2f}"
            )


if __name__ == "__main__":
    main()
