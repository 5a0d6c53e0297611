"""The average of the scans of one capture."""

import numpy as np
import pytest

from calgraph.config import RangeNoise
from calgraph.geometry import Array
from calgraph.rig.detection.scan_averaging import AveragedScan, average_scans
from calgraph.sensors import LaserScan

NOISE = RangeNoise(range=0.01, angle=0.002)
ANGLES = np.linspace(-0.5, 0.5, 11)
NAN = np.nan


def average(ranges: Array, foreground: Array | None = None, angles: Array = ANGLES) -> AveragedScan:
    scans = [LaserScan(0.0, "laser", angles, row) for row in ranges]
    marked = np.ones(ranges.shape, dtype=bool) if foreground is None else foreground
    averaged = average_scans(scans, NOISE, list(marked))
    assert averaged is not None
    return averaged


def test_ranges_near_the_median_are_averaged() -> None:
    """Within 0.04 m, four standard deviations; noise falls with the number of ranges that are."""
    ranges = np.full((5, 11), 2.0)
    ranges[:, 3] = [2.00, 2.01, 2.02, 2.05, 2.30]
    ranges[:, 4] = [1.90, 2.00, 2.00, 2.00, 2.04]
    scan = average(ranges)
    np.testing.assert_allclose(scan.ranges[[2, 3, 4]], [2.0, 2.02, 2.0])
    np.testing.assert_allclose(scan.sigma_range[[2, 3, 4]], 0.01 / np.sqrt([5, 4, 3]))
    np.testing.assert_allclose(scan.sigma_angle[[2, 3, 4]], 0.002 / np.sqrt([5, 4, 3]))


def test_ranges_of_precise_scanners_are_averaged_within_the_least_thickness() -> None:
    ranges = np.full((3, 11), 2.0)
    ranges[:, 5] = [2.0, 2.0, 2.029]
    scans = [LaserScan(0.0, "laser", ANGLES, row) for row in ranges]
    marked = [np.ones(11, dtype=bool)] * 3
    precise = average_scans(scans, RangeNoise(range=0.001), marked)
    assert precise is not None
    assert precise.ranges[5] == pytest.approx(2.0 + 0.029 / 3)


def test_beams_that_return_in_less_than_half_of_the_scans_are_left_out() -> None:
    ranges = np.full((4, 11), 2.0)
    ranges[:3, 2] = NAN
    ranges[:2, 3] = np.inf
    scan = average(ranges)
    np.testing.assert_allclose(scan.angles, np.delete(ANGLES, 2))
    assert scan.sigma_range[2] == pytest.approx(0.01 / np.sqrt(2))


def test_beams_that_alternate_between_two_depths_are_left_out() -> None:
    ranges = np.full((5, 11), 2.0)
    ranges[:, 7] = [1.0, 2.0, 2.0, 3.0, 4.0]
    ranges[:, 8] = [2.0, 2.0, 2.0, 3.0, 4.0]
    ranges[:4, 9], ranges[4, 9] = [2.0, 2.0, 3.0, 3.0], NAN
    np.testing.assert_allclose(average(ranges).angles, np.delete(ANGLES, [7, 9]))


def test_a_beam_is_foreground_if_it_is_in_most_scans() -> None:
    foreground = np.zeros((4, 11), dtype=bool)
    foreground[:2, 1] = foreground[:3, 2] = foreground[:, 3] = True
    ranges = np.full((4, 11), 2.0)
    # Two of two returns, and one of two.
    ranges[2:, 4] = ranges[2:, 5] = NAN
    foreground[:2, 4] = foreground[0, 5] = True
    assert np.flatnonzero(average(ranges, foreground).foreground).tolist() == [2, 3, 4]


def test_a_full_turn_starts_at_its_largest_jump() -> None:
    angles = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    # A board across the seam, from 2.9 rad to -2.9 rad.
    ranges = np.where(np.abs(angles) > 2.9, 2.0, 5.0)
    scan = average(np.tile(ranges, (2, 1)), angles=angles)
    board = scan.ranges < 3
    assert np.diff(np.flatnonzero(board)).max() == 1
    assert np.all(np.diff(scan.angles) > 0)
    assert scan.angles[board].max() - scan.angles[board].min() == pytest.approx(2 * (np.pi - 2.9), abs=0.02)
    np.testing.assert_allclose(scan.directions[board, 0], -np.cos(scan.angles[board] - np.pi))


def test_less_than_a_full_turn_stays_in_order() -> None:
    angles = np.linspace(-3.0, 3.0, 720)
    scan = average(np.where(np.abs(angles) > 2.9, 2.0, 5.0)[None], angles=angles)
    np.testing.assert_array_equal(scan.angles, angles)


@pytest.mark.parametrize("ranges", [np.full((3, 11), NAN), np.tile([[2.0], [3.0]], 11)])
def test_scans_without_steady_returns_have_no_average(ranges: Array) -> None:
    scans = [LaserScan(0.0, "laser", ANGLES, row) for row in ranges]
    marked = [np.ones(11, dtype=bool)] * len(scans)
    assert average_scans(scans, NOISE, marked) is None
