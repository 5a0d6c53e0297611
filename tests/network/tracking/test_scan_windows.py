"""Medians of ranges over windows."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.tracking.scan_stack import stack_scans
from calgraph.network.tracking.stationarity import AlignedScans, ScanWindows, compute_window_medians
from calgraph.sensors import LaserScan

ANGLES = np.linspace(-1, 1, 5)


@pytest.fixture(autouse=True)
def take_five_scans_of_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """A window has at most five scans."""
    monkeypatch.setattr("calgraph.network.tracking.stationarity._MAX_SCANS_PER_WINDOW", 5)


def take_medians(ranges: Array, rate: float = 10.0) -> ScanWindows:
    scans = [LaserScan(k / rate, "laser", ANGLES, row) for k, row in enumerate(ranges)]
    return compute_window_medians(AlignedScans(stack_scans(scans)))


def test_windows_have_the_stated_length() -> None:
    windows = take_medians(np.full((35, 5), 2.0))
    np.testing.assert_allclose(windows.start, [0, 1, 2])
    np.testing.assert_allclose(windows.end, [0.9, 1.9, 2.9])


def test_a_short_detection_does_not_change_the_median() -> None:
    ranges = np.full((10, 5), 2.0)
    ranges[3:7] = 1.0
    np.testing.assert_array_equal(take_medians(ranges).ranges, np.full((1, 5), 2.0))


def test_a_beam_without_measurements_in_most_scans_is_infinite() -> None:
    ranges = np.full((10, 5), 2.0)
    ranges[1:, 2] = np.nan
    np.testing.assert_array_equal(take_medians(ranges).ranges, [[2, 2, np.inf, 2, 2]])


def test_scans_with_other_beams_are_matched_by_angle() -> None:
    rows = np.tile([1.0, 2.0, 3.0, 4.0, 5.0], (20, 1))
    scans = [
        LaserScan(k / 10, "laser", ANGLES[::-1], row[::-1]) if k % 2 else LaserScan(k / 10, "laser", ANGLES, row)
        for k, row in enumerate(rows)
    ]
    windows = compute_window_medians(AlignedScans(stack_scans(scans)))
    np.testing.assert_array_equal(windows.ranges, rows[:2])
