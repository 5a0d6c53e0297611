"""Scans and clouds from arrays: ranges that are refused, points, and durations."""

import numpy as np
import pytest

from calgraph import InputError, LaserScan, PointCloud


@pytest.mark.parametrize("nothing", [0.0, -1.0])
def test_a_range_of_zero_or_less_is_refused_with_its_beam(nothing: float) -> None:
    with pytest.raises(InputError, match=r"beam 2 has a range of -?\d m; .* must be NaN"):
        LaserScan(5.0, "laser", np.zeros(3), np.array([1.0, 2.0, nothing]))


def test_beams_without_a_measurement_are_not_valid() -> None:
    scan = LaserScan(5.0, "laser", np.zeros(4), np.array([1.0, np.nan, np.inf, -np.inf]))
    assert scan.valid.tolist() == [True, False, False, False]


@pytest.mark.parametrize(("beams", "increment", "duration"), [(5, 0.01, 0.04), (5, -0.01, 0.04), (0, 0.01, 0.0)])
def test_duration_is_from_the_first_to_the_last_beam(beams: int, increment: float, duration: float) -> None:
    scan = LaserScan(5.0, "laser", np.zeros(beams), np.ones(beams), increment)
    assert scan.duration == pytest.approx(duration)


def test_points_are_counter_clockwise_from_x() -> None:
    scan = LaserScan(5.0, "laser", np.radians(np.array([0.0, 90, -90])), np.array([1.0, 2.0, np.inf]))
    expected = np.array([[1, 0, 0], [0, 2, 0], [np.nan, np.nan, np.nan]])
    np.testing.assert_allclose(scan.points, expected, atol=1e-15)


def test_duration_of_a_cloud_is_the_span_of_its_times() -> None:
    points = np.ones((3, 3))
    assert PointCloud(5.0, "lidar", points, times=np.array([0.02, 0.1, 0.05])).duration == pytest.approx(0.08)
    assert PointCloud(5.0, "lidar", points).duration == 0.0
