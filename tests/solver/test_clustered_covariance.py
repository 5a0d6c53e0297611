"""Covariances that are wider where errors of one time, or of one place, belong together."""

import numpy as np
from numpy.testing import assert_allclose

from calgraph.geometry import Array
from calgraph.solver.clustered_covariance import ClusteredScores, widen_covariance


def clusters(scores: Array, time: Array, place: Array) -> ClusteredScores:
    """Of points along the x axis."""
    return ClusteredScores(scores, time, np.stack([place, np.zeros(len(place))], axis=1))


def test_contributions_of_one_time_add_up_before_they_are_squared() -> None:
    """Four points of 0.5 in two intervals, each at a separate place: 2 (1² + 1²), and 4/3 (4 · 0.5²)."""
    half, time = np.full((4, 1), 0.5), np.array([0.1, 4.9, 5.1, 9.9])
    found = widen_covariance(np.array([[2.0]]), [clusters(half, time, 10 * np.arange(4.0))])
    assert_allclose(found, 2 + 4 * 2 * (2 * (1 + 1) + 4 / 3 * 4 * 0.25) * 2)


def test_contributions_of_one_place_add_up_at_any_time() -> None:
    """Two points of one block of 3 m, an hour apart, that cancel: only the intervals scatter."""
    scores = np.array([[1.0], [-1.0]])
    found = widen_covariance(np.eye(1), [clusters(scores, np.array([0.0, 3600.0]), np.array([0.1, 2.9]))])
    assert_allclose(found, 1 + 4 * 2 * (1 + 1))


def test_parts_have_separate_times_and_places() -> None:
    """The same times and places in another part are other ones: 4 clusters of 1 of each kind."""
    one = clusters(np.ones((2, 1)), np.array([0.0, 7.0]), np.array([0.0, 7.0]))
    assert_allclose(widen_covariance(np.eye(1), [one, one]), 1 + 4 * 2 * (4 / 3 * 4))


def test_errors_that_last_are_within_the_covariance() -> None:
    """A mean of 20 intervals of 50 points, whose errors are the interval's: 20 errors, not 1000, decide."""
    rng = np.random.default_rng(0)
    squared, independent = [], 1 / 1000
    for _ in range(300):
        errors = np.repeat(rng.normal(size=20), 50)[:, None]
        time, place = np.repeat(5.0 * np.arange(20), 50), np.tile(10.0 * np.arange(50), 20)
        covariance = widen_covariance(np.array([[independent]]), [clusters(errors - errors.mean(), time, place)])
        squared.append(errors.mean() ** 2 / covariance[0, 0])
    # The scatter is taken fourfold.
    assert 0.2 < np.mean(squared) < 0.3


def test_without_points_the_covariance_stays() -> None:
    """Of rigs without LiDARs."""
    none = clusters(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    assert_allclose(widen_covariance(np.eye(2), [none]), np.eye(2))
