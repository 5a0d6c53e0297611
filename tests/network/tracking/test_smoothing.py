"""Smoothing of many segments, and the estimate of unmodelled noise."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.config.settings import TrackingSettings
from calgraph.network.tracking.features import MeasuredCenters
from calgraph.network.tracking.smoothing import add_unmodeled_noise, smooth_segments

TIMES = np.arange(300) / 15.0
WHOLE = [np.arange(300)]
SETTINGS = TrackingSettings()


def walk(rng: np.random.Generator, scatter: float, stated: float = 0.02) -> MeasuredCenters:
    """A straight walk whose centres scatter by one standard deviation and state another, m."""
    positions = np.stack([TIMES, 0.5 * TIMES], axis=1) + rng.normal(0, scatter, (300, 2))
    return MeasuredCenters(positions, np.tile(stated**2 * np.eye(2), (300, 1, 1)), np.zeros((300, 2, 2)))


def test_segments_are_smoothed_independently(rng: np.random.Generator) -> None:
    measured = walk(rng, 0.02)
    pieces: list[NDArray[np.intp]] = [np.arange(100), np.arange(100, 120), np.arange(120, 300)]
    together = smooth_segments(pieces, TIMES, measured, SETTINGS)
    for piece, smoothed in zip(pieces, together, strict=True):
        np.testing.assert_allclose(
            smoothed.mean, smooth_segments([piece], TIMES, measured, SETTINGS)[0].mean, atol=1e-9
        )


def test_smoothing_reduces_the_error(rng: np.random.Generator) -> None:
    smoothed = smooth_segments(WHOLE, TIMES, walk(rng, 0.05, 0.05), SETTINGS)[0]
    off = smoothed.mean[:, :2] - np.stack([TIMES, 0.5 * TIMES], axis=1)[smoothed.members]
    assert np.sqrt((off**2).mean()) < 0.025


def test_missing_centres_are_left_out(rng: np.random.Generator) -> None:
    measured = walk(rng, 0.02)
    measured.positions[50:60] = np.nan
    members = smooth_segments(WHOLE, TIMES, measured, SETTINGS)[0].members
    np.testing.assert_array_equal(members, np.delete(np.arange(300), np.arange(50, 60)))


def test_a_segment_without_any_centre_is_empty(rng: np.random.Generator) -> None:
    measured = walk(rng, 0.02)
    measured.positions[:50] = np.nan
    assert [len(s.members) for s in smooth_segments([np.arange(50)], TIMES, measured, SETTINGS)] == [0]


def test_correctly_stated_noise_is_not_inflated(rng: np.random.Generator) -> None:
    extra = add_unmodeled_noise(WHOLE, TIMES, walk(rng, 0.02), SETTINGS).noise[:, 0, 0] - 0.02**2
    assert np.sqrt(extra.max()) < 0.01


def test_unmodelled_noise_is_estimated(rng: np.random.Generator) -> None:
    noise = add_unmodeled_noise(WHOLE, TIMES, walk(rng, 0.08), SETTINGS).noise
    assert np.sqrt(noise[0, 0, 0]) == pytest.approx(0.08, rel=0.15)


def test_half_of_the_unmodelled_variance_is_bias(rng: np.random.Generator) -> None:
    measured = walk(rng, 0.08)
    found = add_unmodeled_noise(WHOLE, TIMES, measured, SETTINGS)
    np.testing.assert_allclose(found.bias - measured.bias, 0.5 * (found.noise - measured.noise), atol=1e-12)
