"""Tracks of some of the time."""

import numpy as np

from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import Hits, ScannerTracks, Track

TIMES = np.arange(5.0)
HITS = Hits(
    np.arange(20.0).reshape(10, 2), np.repeat(TIMES, 2) + np.tile([-0.1, 0.1], 5), np.repeat(np.arange(5), 2)
)
TRACK = Track(TIMES, np.column_stack([TIMES, TIMES]), np.ones((5, 2)), np.tile(np.eye(2), (5, 1, 1)), 0, HITS)
BEAMS = Foreground(
    np.arange(5), np.arange(5), np.zeros(5), np.ones(5), TIMES, np.zeros(5, dtype=np.bool_), np.zeros(5)
)
TRACKS = ScannerTracks(
    (TRACK,), np.zeros((0, 2)), 0.01, coverage=np.array([[0.0, 1.0], [2.0, 4.0]]), foreground=BEAMS
)
PART = TRACKS.select((1.5, 3.0))


def test_positions_are_selected_by_time() -> None:
    np.testing.assert_array_equal(PART.tracks[0].times, [2, 3])
    np.testing.assert_array_equal(PART.tracks[0].positions[:, 0], [2, 3])
    assert PART.interval == (1.5, 3.0)


def test_beams_stay_with_their_positions() -> None:
    np.testing.assert_array_equal(PART.tracks[0].hits.time_index, [0, 0, 1, 1])
    np.testing.assert_array_equal(PART.tracks[0].hits.points, HITS.points[4:8])


def test_coverage_and_foreground_are_cut() -> None:
    assert PART.coverage is not None
    assert PART.foreground is not None
    np.testing.assert_array_equal(PART.coverage, [[2.0, 3.0]])
    np.testing.assert_array_equal(PART.foreground.times, [2, 3])


def test_tracks_outside_of_the_interval_are_dropped() -> None:
    assert TRACKS.select((10.0, 20.0)).tracks == ()


def test_an_infinite_interval_keeps_everything() -> None:
    whole = TRACKS.select((-np.inf, np.inf))
    np.testing.assert_array_equal(whole.tracks[0].times, TIMES)
    np.testing.assert_array_equal(whole.coverage, TRACKS.coverage)
