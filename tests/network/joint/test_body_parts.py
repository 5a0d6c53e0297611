"""Cutting of bodies into parts."""

import numpy as np
import pytest

from calgraph.network.joint.track_association import BodyTracks, cut_bodies
from calgraph.network.tracking.track import Hits, Track


@pytest.fixture(autouse=True)
def cut_into_short_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts last at most 10 s, or a half of it from three scanners on."""
    monkeypatch.setattr("calgraph.network.joint.track_association._MAX_DURATION", 10.0)
    monkeypatch.setattr("calgraph.network.joint.track_association._MIN_SCANNERS", 3)


def track(begin: float, end: float) -> Track:
    times = np.arange(begin, end, 0.1)
    zeros = np.zeros((len(times), 2))
    hits = Hits(np.repeat(zeros, 2, axis=0), np.repeat(times, 2), np.repeat(np.arange(len(times)), 2))
    return Track(times, zeros, zeros, np.zeros((len(times), 2, 2)), 0, hits)


def body(*tracks: Track) -> BodyTracks:
    times = np.concatenate([one.times for one in tracks])
    return BodyTracks(tuple(enumerate(tracks)), float(times.min()), float(times.max()))


def test_parts_have_equal_durations_and_every_scan_once() -> None:
    parts = cut_bodies([body(*[track(0.0, 25.0)] * 3)])
    assert [part.end - part.start for part in parts] == pytest.approx([8.3] * 3, abs=0.11)
    np.testing.assert_allclose(np.concatenate([part.tracks[1][1].times for part in parts]), track(0.0, 25.0).times)


def test_beams_stay_with_their_scans() -> None:
    for part in cut_bodies([body(*[track(0.0, 25.0)] * 3)]):
        one = part.tracks[0][1]
        np.testing.assert_array_equal(one.hits.times, one.times[one.hits.time_index])


def test_a_part_that_one_scanner_measured_is_left_out() -> None:
    parts = cut_bodies([body(track(0.0, 30.0), track(0.0, 9.0), track(21.0, 30.0))])
    assert [len(part.by_scanner()) for part in parts] == [2, 2]


def test_bodies_of_few_scanners_stay_whole() -> None:
    whole = body(track(0.0, 30.0), track(0.0, 30.0))
    assert cut_bodies([whole]) == [whole]
