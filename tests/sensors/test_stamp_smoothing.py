"""Smoothed stamps: of periods that vary slowly, and not across jumps."""

import numpy as np
from numpy.testing import assert_allclose

from calgraph.sensors.stamp_smoothing import smooth_stamps


def test_rounded_stamps_are_smoothed_where_scans_were_lost() -> None:
    number = np.delete(np.arange(300.0), [40, 41, 90, 200])
    true = 1_700_000_000.0 + 0.2133 * number
    late = true.copy()
    late[[20, 150]] += 0.05
    stamps = np.floor(late * 100) / 100
    period, smooth = smooth_stamps(stamps)
    assert abs(period - 0.2133) < 0.0005
    error = smooth - true - np.median(smooth - true)
    assert np.std(stamps - late) > 0.0025
    assert np.std(error) < 0.0008
    assert np.abs(error).max() < 0.004


def test_jumps_of_a_clock_are_not_smoothed() -> None:
    stamps = 0.1 * np.arange(200.0)
    stamps[100:] += 0.04
    assert_allclose(smooth_stamps(stamps)[1], stamps, atol=1e-6)


def test_few_stamps_remain() -> None:
    assert_allclose(smooth_stamps(np.array([0.0, 0.11, 0.2]))[1], [0, 0.11, 0.2])
