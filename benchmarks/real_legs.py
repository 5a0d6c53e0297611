"""Clock offsets between two scanners that one real scanner of legs stands for.

python benchmarks/real_legs.py [DATA]       # the folder of real recordings; CALGRAPH_DATA or ../shared/data

Of every two scans, the first is of one scanner, the second of another, with a rotation and a clock offset put in.
Both have one viewpoint, so that errors of ranges and radii cancel: it tests clocks and noise, not the size.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

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
from worlds import Layout, make_parser, run_worlds

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
TABLE = Layout("recording:12 clock_ms:8.0f found:7.1f sigma:7.1f error:7.1f x_mm:7.1f y_mm:7.1f deg:7.2f")


class Row(NamedTuple):
    """One recording and offset."""

    recording: str
    milliseconds: float
    found: float
    sigma: float
    error: float
    """ms."""
    x: float
    y: float
    """mm."""
    degrees: float


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
    parser = make_parser(__doc__, jobs=1)
    parser.add_argument("data", nargs="?", type=Path, default=DATA)
    arguments = parser.parse_args()
    work = [(name, 1000 * offset, arguments.data) for name in TOPICS for offset in OFFSETS]
    rows = run_worlds(Row, run, work, arguments, key=2)
    print(TABLE.head)
    for row in rows:
        print(TABLE.line(*row))


def run(name: str, milliseconds: float, data: Path) -> Row:
    """One recording with a clock offset."""
    scans = read_scans(data / "real-legs-one-laser" / f"{name}.bag", TOPICS[name])
    solution = solve(scans, milliseconds / 1000)
    found, sigma = (1000 * solution.clocks[1]).tolist()
    true = np.stack([np.eye(3), se2.pose(TURN, np.zeros(2))])
    off = se2.difference(solution.T_root_scanner, true)[1] * [1000, 1000, np.degrees(1)]
    return Row(name, milliseconds, found, sigma, found - milliseconds, *off.tolist())


if __name__ == "__main__":
    main()
