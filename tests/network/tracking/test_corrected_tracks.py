"""Tracks with times of another clock, and in the frame of a scanner mounted the other way up."""

import numpy as np

from calgraph.config import People, RangeNoise
from calgraph.config.settings import TrackingSettings
from calgraph.network.tracking.track import ScannerTracks, correct_tracks
from calgraph.network.tracking.track_scanner import track_scanner
from walking_scenes import World, walk_in_circle


def tracked() -> ScannerTracks:
    found = track_scanner(
        World((walk_in_circle(1.5, (4.0, 1.0)),)).simulate_scans(8.0, 0),
        People(kind="people"),
        RangeNoise(),
        settings=TrackingSettings(),
    )
    assert isinstance(found, ScannerTracks)
    return found


def test_a_clock_is_subtracted_from_all_times() -> None:
    before = tracked()
    after = correct_tracks(before, clock_offset=0.25)
    for one, other in zip(after.tracks, before.tracks, strict=True):
        np.testing.assert_allclose(other.times - one.times, 0.25, atol=1e-6)
        np.testing.assert_allclose(other.hits.times - one.hits.times, 0.25, atol=1e-6)
        np.testing.assert_array_equal(one.positions, other.positions)
    assert after.coverage is not None
    assert before.coverage is not None
    np.testing.assert_allclose(before.coverage - after.coverage, 0.25, atol=1e-6)


def test_mirrored_tracks_are_those_of_mirrored_scans() -> None:
    """Everything has the opposite y, and static points stay in order of angle."""
    before = tracked()
    after = correct_tracks(before, inverted=True)
    signs = [1, -1]
    for one, other in zip(after.tracks, before.tracks, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions * signs)
        np.testing.assert_array_equal(one.velocities, other.velocities * signs)
        np.testing.assert_array_equal(one.hits.points, other.hits.points * signs)
        np.testing.assert_array_equal(one.covariances, other.covariances * np.outer(signs, signs))
    angle = np.arctan2(after.background[:, 1], after.background[:, 0])
    assert np.all(np.diff(angle[np.isfinite(angle)]) >= 0)


def test_mirroring_twice_changes_nothing() -> None:
    before = tracked()
    after = correct_tracks(correct_tracks(before, inverted=True), inverted=True)
    np.testing.assert_array_equal(after.background, before.background)
    np.testing.assert_array_equal(after.tracks[0].positions, before.tracks[0].positions)
