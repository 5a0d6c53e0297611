"""Counts of matches that are expected of two scanners, and of matches by chance."""

import numpy as np
import pytest

from calgraph.geometry import Array
from calgraph.network.pairs.hypothesis_evidence import (
    _count_by_chance,
    count_expected,
    select_distinct,
    subsample_pairs,
)
from calgraph.network.pairs.synchronized_tracks import TrackSamples, pair_samples
from calgraph.network.pairs.track_registration import TrackRegistration

HERE, FAR = (0.0, 0.0), (5.0, 0.0)
SAME_POSE = np.eye(3)


def samples(ticks: list[int], positions: list[tuple[float, float]]) -> TrackSamples:
    """One person's positions with a standard deviation of 3 cm."""
    n = len(ticks)
    return TrackSamples(
        np.array(ticks), np.zeros(n, np.intp), np.array(positions), np.zeros((n, 2)),
        np.tile(0.03**2 * np.eye(2), (n, 1, 1)),
    )  # fmt: skip


def expected(a: TrackSamples, b: TrackSamples) -> float:
    return count_expected(SAME_POSE, pair_samples(a, b), a, b)


def test_matches_are_expected_from_the_first_to_the_last_detection_of_the_other() -> None:
    """Of 20 samples of a, the 10 at ticks 5 to 14."""
    a, b = samples(list(range(20)), [HERE] * 20), samples([5, 9, 14], [HERE] * 3)
    assert expected(a, b) == 10


@pytest.mark.parametrize(("distance", "count"), [(0.39, 10), (0.41, 2)])
def test_matches_are_expected_near_three_detections_of_the_other(distance: float, count: int) -> None:
    """With the third out of reach, those of b remain that have all of a's next to them."""
    a = samples(list(range(10)), [HERE] * 10)
    b = samples([0, 4, 9], [HERE, HERE, (distance, 0.0)])
    assert expected(a, b) == count


def test_one_match_is_expected_at_least() -> None:
    ticks = list(range(10))
    assert expected(samples(ticks, [HERE] * 10), samples(ticks, [FAR] * 10)) == 1


def test_each_of_a_few_samples_is_looked_up() -> None:
    """Every second sample of a is where b detects people: half of them are expected, and match by chance."""
    a, b = samples(list(range(20)), [HERE, FAR] * 10), samples([0, 10, 19], [HERE] * 3)
    assert expected(a, b) == 10
    pairs = pair_samples(a, b)
    fit = TrackRegistration(SAME_POSE, np.zeros(3), np.arange(len(pairs)), 0.07)
    # At each tick of b there is one sample in reach.
    assert _count_by_chance(fit, pairs, b) == pytest.approx(10 * (1 - np.exp(-1)))


@pytest.mark.parametrize("wanted", [40, 100])
def test_few_pairs_are_all_kept(wanted: int) -> None:
    walk = samples(list(range(40)), [HERE] * 40)
    assert len(subsample_pairs(pair_samples(walk, walk), wanted)) == 40


def poses(x: list[float], degrees: list[float]) -> Array:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.tile(np.eye(3), (len(x), 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1], T[:, 0, 2] = c, -s, s, c, x
    return T


@pytest.mark.parametrize(
    ("x", "degrees", "kept"), [(0.4, 7.0, [0]), (0.6, 7.0, [0, 1]), (0.4, 9.0, [0, 1]), (0.5, 0.0, [0, 1])]
)
def test_poses_are_distinct_by_position_or_angle(x: float, degrees: float, kept: list[int]) -> None:
    found = select_distinct(poses([0.0, x], [0.0, degrees]), np.array([0.1, 0.2]), 5, 0.5, np.radians(8))
    assert found == kept
