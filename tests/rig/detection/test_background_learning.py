"""Foreground of scans against the background of their scanner."""

import numpy as np
import pytest

from calgraph.errors import InputError
from calgraph.geometry import Array
from calgraph.rig.detection.background_learning import learn_scan_background
from calgraph.sensors import LaserScan

ANGLES = np.linspace(-1, 1, 201)


def scan(ranges: Array | float, rng: np.random.Generator, noise: float = 0.02) -> LaserScan:
    return LaserScan(
        0.0, "laser", ANGLES, np.broadcast_to(ranges, ANGLES.shape) + rng.normal(0, noise, len(ANGLES))
    )


def test_a_nearer_beam_is_foreground(rng: np.random.Generator) -> None:
    background = learn_scan_background([scan(4.0, rng) for _ in range(40)])
    ranges = np.where(np.abs(ANGLES) < 0.2, 2.0, 4.0)
    assert np.array_equal(background.foreground(scan(ranges, rng)), np.abs(ANGLES) < 0.2)


def test_noise_is_not_foreground(rng: np.random.Generator) -> None:
    background = learn_scan_background([scan(4.0, rng) for _ in range(40)])
    share = np.mean([background.foreground(scan(4.0, rng)).mean() for _ in range(50)])
    assert share < 0.002


def test_the_margin_grows_with_the_noise(rng: np.random.Generator) -> None:
    background = learn_scan_background([scan(4.0, rng, 0.05) for _ in range(40)])
    share = np.mean([background.foreground(scan(4.0, rng, 0.05)).mean() for _ in range(50)])
    assert share < 0.005


def test_a_beam_alternating_between_two_depths_is_background_at_both_and_between(rng: np.random.Generator) -> None:
    def flicker() -> LaserScan:
        edge = np.abs(ANGLES - 0.3) < 0.002
        return scan(np.where(edge, rng.choice([2.0, 5.0, rng.uniform(2, 5)]), 5.0), rng)

    background = learn_scan_background([flicker() for _ in range(60)])
    assert not any(background.foreground(flicker())[130] for _ in range(60))
    assert background.foreground(scan(1.5, rng)).sum() == 201


def test_returns_without_a_background_are_foreground(rng: np.random.Generator) -> None:
    open_sky = np.where(ANGLES > 0, np.inf, 4.0)
    background = learn_scan_background([scan(open_sky, rng) for _ in range(20)])
    assert background.foreground(scan(3.0, rng)).sum() == 201


def test_missing_returns_are_not_foreground(rng: np.random.Generator) -> None:
    background = learn_scan_background([scan(4.0, rng) for _ in range(20)])
    nothing = LaserScan(0.0, "laser", ANGLES, np.where(ANGLES > 0, np.nan, np.inf))
    assert background.foreground(nothing).tolist() == 201 * [False]


def test_a_single_stray_return_does_not_become_background(rng: np.random.Generator) -> None:
    dusty = [scan(4.0, rng) for _ in range(39)] + [scan(1.0, rng)]
    assert learn_scan_background(dusty).foreground(scan(2.0, rng)).sum() == 201


def test_scans_with_other_beams_are_matched_by_angle(rng: np.random.Generator) -> None:
    background = learn_scan_background([scan(4.0, rng) for _ in range(20)])
    half = LaserScan(0.0, "laser", ANGLES[::-2], np.where(ANGLES[::-2] > 0.5, 2.0, 4.0))
    assert np.array_equal(background.foreground(half), ANGLES[::-2] > 0.5)


def test_an_empty_scan_window_is_named() -> None:
    with pytest.raises(InputError, match=r"capture\.background"):
        learn_scan_background([LaserScan(0.0, "laser", ANGLES, np.full(len(ANGLES), np.inf))])
