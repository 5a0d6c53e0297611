"""Smoothing of many pieces, and the noise that the stated one does not explain."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.tracking.features import Centres
from calgraph.tracking.smoothing import smooth_all, with_unmodelled_noise

TIMES = np.arange(300) / 15.0
WHOLE = [np.arange(300)]
AGILITY = 0.5


def walk(rng: np.random.Generator, scatter: float, stated: float = 0.02) -> Centres:
    """A straight walk whose centres scatter by one standard deviation and state another, m."""
    positions = np.stack([TIMES, 0.5 * TIMES], axis=1) + rng.normal(0, scatter, (300, 2))
    return Centres(positions, np.tile(stated**2 * np.eye(2), (300, 1, 1)), np.zeros((300, 2, 2)))


def test_pieces_are_smoothed_each_by_itself(rng: np.random.Generator) -> None:
    measured = walk(rng, 0.02)
    pieces: list[NDArray[np.intp]] = [np.arange(100), np.arange(100, 120), np.arange(120, 300)]
    together = smooth_all(pieces, TIMES, measured, AGILITY)
    for piece, smoothed in zip(pieces, together, strict=True):
        np.testing.assert_allclose(smoothed.mean, smooth_all([piece], TIMES, measured, AGILITY)[0].mean, atol=1e-9)


def test_smoothing_comes_nearer_to_the_walk(rng: np.random.Generator) -> None:
    smoothed = smooth_all(WHOLE, TIMES, walk(rng, 0.05, 0.05), AGILITY)[0]
    off = smoothed.mean[:, :2] - np.stack([TIMES, 0.5 * TIMES], axis=1)[smoothed.members]
    assert np.sqrt((off**2).mean()) < 0.025


def test_missing_centres_are_left_out(rng: np.random.Generator) -> None:
    measured = walk(rng, 0.02)
    measured.positions[50:60] = np.nan
    members = smooth_all(WHOLE, TIMES, measured, AGILITY)[0].members
    np.testing.assert_array_equal(members, np.delete(np.arange(300), np.arange(50, 60)))


def test_a_piece_without_any_centre_is_empty(rng: np.random.Generator) -> None:
    measured = walk(rng, 0.02)
    measured.positions[:50] = np.nan
    assert [len(s.members) for s in smooth_all([np.arange(50)], TIMES, measured, AGILITY)] == [0]


def test_noise_as_stated_is_left_as_it_is(rng: np.random.Generator) -> None:
    extra = with_unmodelled_noise(WHOLE, TIMES, walk(rng, 0.02), AGILITY).noise[:, 0, 0] - 0.02**2
    assert np.sqrt(extra.max()) < 0.01


def test_more_noise_than_stated_is_found(rng: np.random.Generator) -> None:
    noise = with_unmodelled_noise(WHOLE, TIMES, walk(rng, 0.08), AGILITY).noise
    assert np.sqrt(noise[0, 0, 0]) == pytest.approx(0.08, rel=0.15)
