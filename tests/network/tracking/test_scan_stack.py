"""Scans stacked into arrays, and the intervals that they cover."""

import numpy as np

from calgraph.network.tracking.scan_stack import coverage_intervals, select_scans, stack_scans
from calgraph.network.tracking.track_scanner import MAX_SCAN_GAP
from calgraph.sensors import LaserScan

ANGLES = np.linspace(-1, 1, 5)


def scan(stamp: float, range_: float = 2.0) -> LaserScan:
    return LaserScan(stamp, "laser", ANGLES, np.full(5, range_), 0.0)


def test_a_pause_longer_than_half_a_second_splits_the_coverage() -> None:
    stamps = np.concatenate([np.arange(0, 20), np.arange(24, 40), np.arange(46, 60)]) / 10
    intervals = coverage_intervals(stack_scans(map(scan, stamps)), MAX_SCAN_GAP)
    np.testing.assert_allclose(intervals, [[0.0, 3.9], [4.6, 5.9]])


def test_the_first_of_two_scans_with_one_stamp_is_kept() -> None:
    (run,) = stack_scans([scan(0.0), scan(0.1, 3.0), scan(0.1, 4.0), scan(0.05, 5.0), scan(0.2, 6.0)])
    assert run.read(np.arange(3))[:, 0].tolist() == [2.0, 3.0, 6.0]


def test_scans_of_an_interval_are_selected() -> None:
    runs = select_scans(stack_scans(map(scan, np.arange(10) / 10)), (0.25, 0.5))
    assert [run.stamps.tolist() for run in runs] == [[0.3, 0.4, 0.5]]
    assert select_scans(runs, (2.0, 3.0)) == ()
