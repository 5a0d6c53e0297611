"""Clock offsets between two scanners that one real scanner stands for: every second scan is of the other one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calgraph.config import People, RangeNoise
from calgraph.config.settings import NetworkEstimationSettings, TrackingSettings
from calgraph.geometry import se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.joint.estimate import solve_network
from calgraph.network.tracking.track import ScannerTracks
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.recording import open_recording
from calgraph.sensors import LaserScan

pytestmark = pytest.mark.slow

TURN = 0.3
"""Rotation of the second scanner, rad."""


@pytest.fixture(scope="module")
def scans(data_dir: Path) -> list[LaserScan]:
    with open_recording(data_dir / "real-legs-one-laser/positive_3.bag") as recording:
        messages = [record.decode() for record in recording.records(["right_scan"])]
    return [message for message in messages if isinstance(message, LaserScan)]


@pytest.mark.parametrize("offset", [0.05, -0.03, 0.0])
def test_clock_offsets_of_real_legs_are_found(scans: list[LaserScan], offset: float) -> None:
    second = [replace(scan, stamp=scan.stamp + offset, angles=scan.angles - TURN) for scan in scans[1::2]]
    noise = RangeNoise(range=0.02, angle=0.001)
    tracked = [track_scanner(part, People(), noise, settings=TrackingSettings()) for part in (scans[::2], second)]
    legs = [found for found in tracked if isinstance(found, ScannerTracks)]
    assert len(legs) == 2
    true = np.stack([np.eye(3), se2.pose(TURN, np.zeros(2))])
    start = PoseGraphSolution(
        se2.retract(true, np.array([[0, 0, 0], [0.01, -0.01, 0.002]])), np.zeros(0, dtype=np.bool_)
    )
    nothing = PoseGraph(2, np.zeros((0, 2), dtype=np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    solution = solve_network(People(), legs, start, nothing, settings=NetworkEstimationSettings())
    found, sigma = solution.clocks[1]
    assert abs(found - offset) < min(0.003, 3 * sigma)
    error = se2.difference(solution.T_root_scanner, true)[1]
    assert np.hypot(*error[:2]) < 0.01
    assert np.degrees(abs(error[2])) < 0.1
