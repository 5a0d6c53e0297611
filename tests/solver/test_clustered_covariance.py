"""Covariances that are wider where errors of one time, of one place, or of one ring, belong together."""

import numpy as np
from numpy.testing import assert_allclose

from calgraph.geometry import Array, Index
from calgraph.solver.clustered_covariance import ClusteredScores, label_rings, widen_covariance


def clusters(scores: Array, time: Array, place: Array, ring: Index | None = None) -> ClusteredScores:
    """Of points along the x axis, each of a separate ring if none are given."""
    place = np.stack([place, np.zeros(len(place))], axis=1)
    return ClusteredScores(scores, time, place, np.arange(len(scores)) if ring is None else ring)


def test_contributions_of_one_time_add_up_before_they_are_squared() -> None:
    """Four points of 0.5 in two intervals, each of a separate place and ring: 2 (1² + 1²), and 4/3 (4 · 0.5²)."""
    half, time = np.full((4, 1), 0.5), np.array([0.1, 4.9, 5.1, 9.9])
    found = widen_covariance(np.array([[2.0]]), [clusters(half, time, 10 * np.arange(4.0))])
    assert_allclose(found, 2 + 2 * (4 * 2 * (1 + 1) + (4 + 1) * 4 / 3 * 4 * 0.25) * 2)


def test_contributions_of_one_place_add_up_at_any_time() -> None:
    """Two points of one block of 3 m, an hour apart, that cancel: only intervals and rings scatter."""
    scores = np.array([[1.0], [-1.0]])
    found = widen_covariance(np.eye(1), [clusters(scores, np.array([0.0, 3600.0]), np.array([0.1, 2.9]))])
    assert_allclose(found, 1 + (4 + 1) * 2 * (1 + 1))


def test_parts_have_separate_times_and_places() -> None:
    """The same times and places in another part are other ones: 4 clusters of 1. Rings are the same: 2 of 2."""
    one = clusters(np.ones((2, 1)), np.array([0.0, 7.0]), np.array([0.0, 7.0]))
    assert_allclose(widen_covariance(np.eye(1), [one, one]), 1 + 4 * 2 * (4 / 3 * 4) + 2 * (2**2 + 2**2))


def test_errors_that_last_are_within_the_covariance() -> None:
    """A mean of 20 intervals of 50 points, whose errors are the interval's: 20 errors, not 1000, decide."""
    rng = np.random.default_rng(0)
    squared, independent = [], 1 / 1000
    for _ in range(300):
        errors = np.repeat(rng.normal(size=20), 50)[:, None]
        time, place = np.repeat(5.0 * np.arange(20), 50), np.tile(10.0 * np.arange(50), 20)
        part = clusters(errors - errors.mean(), time, place, np.zeros(1000, dtype=np.intp))
        covariance = widen_covariance(np.array([[independent]]), [part])
        squared.append(errors.mean() ** 2 / covariance[0, 0])
    # The scatter is taken fourfold.
    assert 0.2 < np.mean(squared) < 0.3


def test_errors_of_rings_do_not_fall_with_time() -> None:
    """A mean over 16 rings, whose errors last: as uncertain after 40 intervals as after 10."""
    rng = np.random.default_rng(1)
    ring, errors, widths = np.tile(np.arange(16), 50), rng.normal(size=(200, 16)), []
    for intervals in (10, 40):
        time, place = 5.0 * np.floor(np.arange(800.0) * intervals / 800), 10.0 * np.arange(800.0)
        parts = [clusters((one - one.mean())[ring, None], time, place, ring) for one in errors]
        variances = np.array([widen_covariance(np.array([[1 / 800]]), [part])[0, 0] for part in parts])
        assert 0.8 < np.mean(errors.mean(axis=1) ** 2 / variances) < 1.2
        widths.append(np.mean(variances))
    assert widths[1] > 0.95 * widths[0]


def test_rings_of_a_sensor_are_rows_of_elevation() -> None:
    """Those of two sensors differ; scanners in the plane have none, and their points one number."""
    up, level = np.array([[5.0, 0, 0.5], [0, -10, 1]]), np.array([[5.0, 0, 0.4], [0, 5, 0.5]])
    first, second = (label_rings(np.array([0, sensor]), up) for sensor in (0, 1))
    assert first[0] == first[1] == second[0] != second[1]
    assert len(np.unique(label_rings(np.array([0, 0]), level))) == 2
    assert len(np.unique(label_rings(np.array([0, 2]), up[:, :2]))) == 1
    turns, tenths = np.linspace(0, 6, 40), np.radians(0.1 * np.arange(-300, 300)[:, None])
    sweep = np.stack(np.broadcast_arrays(np.cos(turns), np.sin(turns), np.tan(tenths)), axis=-1)
    points = sweep.astype(np.float32).astype(np.float64).reshape(-1, 3)
    rings = label_rings(np.zeros(len(points), dtype=np.intp), points)
    assert np.ptp(rings.reshape(-1, 40), axis=1).max() == 0


def test_without_points_the_covariance_stays() -> None:
    """Of rigs without LiDARs."""
    none = clusters(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    assert_allclose(widen_covariance(np.eye(2), [none]), np.eye(2))
