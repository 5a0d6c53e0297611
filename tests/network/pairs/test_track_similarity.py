"""Similarity of the tracks of two scanners, from samples of people on known paths."""

import numpy as np
import pytest

from calgraph.config.settings import ScannerPairSettings
from calgraph.geometry import Array, se2
from calgraph.network.pairs.synchronized_tracks import TrackSamples
from calgraph.network.pairs.track_similarity import compute_track_similarity
from track_pairs import gather_samples, walk_along_curve

SETTINGS = ScannerPairSettings()
SECONDS = 30.0


def observe(numbers: list[int], T_sensor_world: Array, rng: np.random.Generator, delay: int = 0) -> TrackSamples:
    """People by the numbers of their paths, with 2 cm of noise, by a clock that is behind by some ticks."""
    walks = []
    for number in numbers:
        x, v = walk_along_curve(SECONDS + 5, number)
        x, v = x[delay : delay + round(10 * SECONDS)], v[delay : delay + round(10 * SECONDS)]
        walks.append((se2.apply(T_sensor_world, x) + 0.02 * rng.normal(size=x.shape), v))
    return gather_samples(walks, 0.02)


def somewhere(rng: np.random.Generator) -> Array:
    return se2.pose(rng.uniform(-np.pi, np.pi), rng.uniform(-50, 50, 2))


def test_the_same_people_score_by_their_common_ticks_whatever_the_poses(rng: np.random.Generator) -> None:
    scanners = [observe([0, 1], somewhere(rng), rng) for _ in range(2)]
    similarity = compute_track_similarity(scanners)
    # Two people for 300 ticks each, and a fit far better than the largest RMS distance of 0.3 m.
    assert 600 * np.log(0.3 / 0.07) < similarity[0, 1] < 700 * np.log(0.304 / 0.05)
    np.testing.assert_array_equal(similarity, similarity.T)
    np.testing.assert_array_equal(np.diag(similarity), 0)


def test_other_people_score_far_less(rng: np.random.Generator) -> None:
    scanners = [observe(numbers, somewhere(rng), rng) for numbers in ([0, 1], [0, 1], [2, 5])]
    similarity = compute_track_similarity(scanners)
    assert max(similarity[0, 2], similarity[1, 2]) < 0.4 * similarity[0, 1]


@pytest.mark.parametrize("delay", [1, 3])
def test_clocks_that_differ_by_tenths_of_a_second_cost_little(delay: int, rng: np.random.Generator) -> None:
    scanners = [observe([0, 1], somewhere(rng), rng), observe([0, 1], somewhere(rng), rng, delay)]
    scanners.append(observe([2, 5], somewhere(rng), rng))
    similarity = compute_track_similarity(scanners)
    assert similarity[0, 1] > 2 * similarity[0, 2]


def test_people_at_different_times_score_nothing(rng: np.random.Generator) -> None:
    a = observe([0], somewhere(rng), rng)
    assert compute_track_similarity([a, a.transform(False, 1000)])[0, 1] == 0


def test_a_scanner_without_tracks_scores_nothing(rng: np.random.Generator) -> None:
    a = observe([0], somewhere(rng), rng)
    empty = TrackSamples(a.tick[:0], a.trajectory[:0], a.positions[:0], a.velocities[:0], a.covariances[:0])
    np.testing.assert_array_equal(compute_track_similarity([empty, a]), 0)
    np.testing.assert_array_equal(compute_track_similarity([empty, empty]), 0)


def test_scanners_in_groups_score_as_all_at_once(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanners = [observe([k % 3, 3], somewhere(rng), rng) for k in range(6)]
    at_once = compute_track_similarity(scanners)
    monkeypatch.setattr("calgraph.network.pairs.track_similarity._MAX_COMPARED", 200)
    np.testing.assert_allclose(compute_track_similarity(scanners), at_once, rtol=1e-6)


def test_the_best_alignments_of_a_stretch_select_the_scanners_of_the_same_people(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanners = [observe([k, 12 + k % 2], somewhere(rng), rng) for k in range(12)]
    scanners += [observe([k], somewhere(rng), rng) for k in range(12)]
    # Scanners k and 12 + k saw person k, and five of the first 12 the other person of each of them.
    everything = np.argsort(-compute_track_similarity(scanners)[:12], axis=1)[:, :6]
    monkeypatch.setattr("calgraph.network.pairs.track_similarity._KEPT_ALIGNMENTS", 6)
    nearest = np.argsort(-compute_track_similarity(scanners)[:12], axis=1)[:, :6]
    assert all(12 + k in of_k for k, of_k in enumerate(everything.tolist()))
    assert all(12 + k in of_k for k, of_k in enumerate(nearest.tolist()))


def test_delayed_and_mirrored_tracks_are_similar_where_these_are_compared(rng: np.random.Generator) -> None:
    a, b = observe([0, 1], somewhere(rng), rng), observe([0, 1], somewhere(rng), rng)
    late = [a, b.transform(True, -20)]
    alone = compute_track_similarity(late)[0, 1]
    searched = compute_track_similarity(late, delays=(-20, 0, 20), mirrored=(False, True))
    # 280 of 300 ticks are common.
    assert searched[0, 1] == pytest.approx(compute_track_similarity([a, b])[0, 1], rel=0.15)
    assert alone < 0.5 * searched[0, 1]


def test_pairs_that_are_not_compared_score_nothing(rng: np.random.Generator) -> None:
    scanners = [observe([0, 1], somewhere(rng), rng) for _ in range(4)]
    compared = np.zeros((4, 4), dtype=np.bool_)
    compared[3, 1] = True
    similarity = compute_track_similarity(scanners, compared=compared)
    assert np.argwhere(similarity).tolist() == [[1, 3], [3, 1]]
