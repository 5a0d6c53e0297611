"""Sweeps from messages: which points remain, and their times."""

import numpy as np
from numpy.testing import assert_allclose

from calgraph.drive.sweeps import Sweep, read_sweep, smooth_times, thin_sweep
from calgraph.sensors import LaserScan, PointCloud


def test_a_scan_keeps_points_within_range_with_the_times_of_their_beams() -> None:
    ranges = np.array([2.0, np.nan, 0.4, 90.0, np.inf, 3.0, 0.6])
    sweep = read_sweep(LaserScan(100.0, "laser", np.zeros(7), ranges, time_increment=0.01), 2)
    assert_allclose(sweep.points, [[2.0, 0.0], [3.0, 0.0], [0.6, 0.0]])
    assert_allclose(sweep.times, [100.0, 100.05, 100.06])
    assert sweep.time == 100.03


def test_a_cloud_has_the_times_of_its_points() -> None:
    points = np.array([[1.0, 2, 3], [0.1, 0.2, 0.3], [4, 5, 6]])
    sweep = read_sweep(PointCloud(7.0, "lidar", points, times=np.array([-0.1, 0.3, 0.1])), 3)
    assert_allclose(sweep.points, points[[0, 2]])
    assert_allclose(sweep.times, [6.9, 7.1])
    assert sweep.time == 7.0


def test_a_cloud_without_times_is_of_its_stamp() -> None:
    sweep = read_sweep(PointCloud(7.0, "lidar", np.array([[1.0, 2, 3], [4, 5, 6]])), 3)
    assert_allclose(sweep.times, 7.0)


def test_a_scan_without_any_range_is_an_empty_sweep() -> None:
    sweep = read_sweep(LaserScan(5.0, "laser", np.zeros(3), np.full(3, np.nan)), 2)
    assert sweep.points.shape == (0, 2)
    assert sweep.time == 5.0


def test_thinned_sweeps_have_at_most_a_number_of_points(rng: np.random.Generator) -> None:
    times = np.arange(50.0)
    whole = Sweep(25.0, np.stack([times, 2 * times], axis=1), times, np.stack([times] * 3, axis=1))
    few, many = thin_sweep(whole.select(np.arange(10)), 10, rng), thin_sweep(whole, 10, rng)
    assert_allclose(few.times, np.arange(10))
    assert len(many.points) == 10
    assert np.all(np.diff(many.times) > 0)
    assert_allclose(many.timing[:, 2], many.times)
    assert_allclose(many.points, np.stack([many.times, 2 * many.times], axis=1))
    assert many.time == 25.0


def test_scans_without_times_have_the_numbers_of_their_beams() -> None:
    ranges = np.array([2.0, np.inf, 3.0, 4.0, 5.0])
    sweep = read_sweep(LaserScan(5.0, "laser", np.zeros(5), ranges), 2)
    assert_allclose(sweep.timing, [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.75, 1.0, 0.0], [1.0, 0.0, 0.0]])
    stated = read_sweep(LaserScan(5.0, "laser", np.zeros(5), ranges, time_increment=0.01), 2)
    assert_allclose(stated.timing, 0)


def test_sweeps_are_of_smoothed_stamps_and_their_timing_is_in_seconds() -> None:
    stamps = np.arange(100.0) / 5
    stamps[50] += 0.02
    angles, ranges = np.zeros(3), np.full(3, 2.0)
    sweeps = smooth_times([read_sweep(LaserScan(t, "laser", angles, ranges), 2) for t in stamps], stamps)
    assert_allclose(sweeps[50].times, 10.0, atol=1e-3)
    assert abs(sweeps[50].time - 10.0) < 1e-3
    # With all of the irregularity, the stamp is as it was.
    assert_allclose(sweeps[50].times + sweeps[50].timing[:, 2], 10.02)
    assert_allclose(sweeps[50].timing[:, :2], [[0.0, 0.0], [0.1, 0.2], [0.2, 0.0]])
