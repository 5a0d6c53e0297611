"""The background model of a 2-D scanner, and scans matched by the angles of their beams."""

import numpy as np

from calgraph.sensors import ScanBackground, align_ranges
from calgraph.sensors.scan_background import find_nearest_beams

NAN = np.nan


def test_limits_lie_before_the_background_and_reach_to_neighbouring_beams() -> None:
    depths = np.array([4.0, 4.0, 4.0, 2.0, 4.0, 4.0, NAN])
    background = ScanBackground.from_depths(np.arange(7.0), depths, np.full(7, 0.1))
    np.testing.assert_allclose(background.min_ranges, [3.9, 3.9, 1.9, 1.9, 1.9, 3.9, 3.9])


def test_beams_without_a_background_next_to_them_have_no_limit() -> None:
    background = ScanBackground.from_depths(np.arange(4.0), np.array([3.0, NAN, NAN, NAN]), np.zeros(4))
    np.testing.assert_array_equal(background.min_ranges, [3.0, 3.0, np.inf, np.inf])


def test_each_beam_has_its_own_margin() -> None:
    background = ScanBackground.from_depths(np.arange(4.0), np.full(4, 3.0), np.array([0.1, 0.1, 0.1, 0.5]))
    np.testing.assert_allclose(background.min_ranges, [2.9, 2.9, 2.5, 2.5])


def test_scans_with_the_same_beams_are_taken_as_they_are() -> None:
    ranges = np.array([[1.0, np.inf, 3.0], [NAN, 5.0, 6.0]])
    np.testing.assert_array_equal(align_ranges(np.arange(3.0), np.arange(3.0), ranges), [[1, NAN, 3], [NAN, 5, 6]])


def test_beams_are_assigned_to_the_nearest_angle() -> None:
    aligned = align_ranges(np.arange(5.0), np.array([3.4, 0.6, -2.0, 9.0]), np.array([[1.0, 2.0, 3.0, 4.0]]))
    np.testing.assert_array_equal(aligned, [[3, 2, NAN, 1, 4]])


def test_of_two_beams_at_one_angle_the_last_with_a_range_counts() -> None:
    aligned = align_ranges(np.arange(2.0), np.array([0.1, -0.1, 0.2]), np.array([[1.0, 2.0, NAN]]))
    np.testing.assert_array_equal(aligned, [[2, NAN]])


def test_halfway_between_two_angles_the_lower_one_is_taken() -> None:
    aligned = align_ranges(np.arange(3.0), np.array([0.5]), np.array([[7.0]]))
    np.testing.assert_array_equal(aligned, [[7, NAN, NAN]])


def test_the_nearest_beam_is_found_for_any_angle() -> None:
    wanted = np.array([-9.0, 0.4, 0.6, 1.0, 9.0])
    assert find_nearest_beams(np.array([0.0, 1.0, 3.0]), wanted).tolist() == [0, 0, 1, 1, 2]
    assert find_nearest_beams(np.array([2.0]), wanted).tolist() == [0] * 5
