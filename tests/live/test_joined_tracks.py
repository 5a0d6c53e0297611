"""Tracks of intervals of a recording, joined and selected."""

from dataclasses import replace

import numpy as np
import pytest

from calgraph.errors import Rejected
from calgraph.live.tracked_intervals import TrackedInterval, join_tracks, select_intervals
from calgraph.network.tracking.clusters import Foreground
from calgraph.network.tracking.track import ScannerBump, ScannerTracks, Track
from calgraph.result import CaptureRow

MAX_GAP = 0.5


def track(start: float, period: int) -> Track:
    times = start + np.arange(3) / 10
    return Track(times, np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((3, 2, 2)), period)


def tracked(start: float, end: float, background: int = 5, bumps: tuple[ScannerBump, ...] = ()) -> ScannerTracks:
    """Two tracks in two periods, two beams in three scans."""
    beams = Foreground(
        np.array([0, 2]), np.array([4, 5]), np.zeros(2), np.ones(2), start + np.array([0.1, 0.3]),
        np.zeros(2, dtype=np.bool_), np.full(3, 0.01),
    )  # fmt: skip
    return ScannerTracks(
        (track(start, 0), track(start + 1, 1)),
        np.zeros((background, 2)),
        0.01,
        np.array([[start, end]]),
        bumps,
        foreground=beams,
    )


def join(*parts: ScannerTracks | Rejected) -> ScannerTracks:
    found = join_tracks([{"a": one} for one in parts], MAX_GAP)["a"]
    assert isinstance(found, ScannerTracks)
    return found


def test_one_interval_stays_as_it_is() -> None:
    only = tracked(0, 10)
    joined = join(only)
    assert all(getattr(joined, name) is value for name, value in vars(only).items())


def test_tracks_and_their_periods_follow_each_other() -> None:
    joined = join(tracked(0, 10), tracked(10.1, 20))
    assert [one.period for one in joined.tracks] == [0, 1, 2, 3]
    assert [one.times[0] for one in joined.tracks] == pytest.approx([0, 1, 10.1, 11.1])


def test_what_is_tracked_twice_is_of_the_earlier_interval() -> None:
    joined = join(tracked(0, 10.5), tracked(10.4, 20))
    assert [one.times[0] for one in joined.tracks] == pytest.approx([0, 1, 10.6, 11.4])
    np.testing.assert_allclose(joined.coverage, [[0, 20]])  # type: ignore[arg-type]
    assert joined.foreground is not None
    assert joined.foreground.times.tolist() == pytest.approx([0.1, 0.3, 10.7])


def test_beams_are_of_successive_scans() -> None:
    beams = join(tracked(0, 10), tracked(10.1, 20)).foreground
    assert beams is not None
    assert beams.scan.tolist() == [0, 2, 3, 5]
    assert len(beams.spacing) == 6
    assert beams.times.tolist() == pytest.approx([0.1, 0.3, 10.2, 10.4])


def test_a_scanner_measures_without_a_break_where_intervals_meet() -> None:
    joined = join(tracked(0, 10), tracked(10.1, 20), tracked(40, 50))
    assert joined.coverage is not None
    np.testing.assert_allclose(joined.coverage, [[0, 20], [40, 50]])


def test_the_background_is_that_of_the_longest_interval() -> None:
    assert len(join(tracked(0, 10, 7), tracked(10, 15, 9)).background) == 7


def test_intervals_without_tracks_are_left_out() -> None:
    assert len(join(Rejected("nobody"), tracked(10, 20), Rejected("nobody")).tracks) == 2


def test_the_last_reason_counts_where_no_interval_has_tracks() -> None:
    found = join_tracks([{"a": Rejected("first")}, {"a": Rejected("last")}], MAX_GAP)["a"]
    assert found == Rejected("last")


BUMP = ScannerBump((12.0, 13.0), 0.1, 0.0, 0.01, 0.01)


def test_what_is_from_before_a_bump_is_dropped() -> None:
    after = replace(tracked(10, 20, bumps=(BUMP,)), interval=(13.0, np.inf))
    joined = join(tracked(0, 10), after, tracked(20.1, 30))
    assert [one.times[0] for one in joined.tracks] == pytest.approx([10, 11, 20.1, 21.1])
    assert joined.bumps == (BUMP,)
    assert joined.interval == (13.0, np.inf)


def test_an_interval_used_up_to_its_bump_is_dropped_once_there_are_later_ones() -> None:
    before = replace(tracked(10, 20, bumps=(BUMP,)), interval=(-np.inf, 12.0))
    assert [one.times[0] for one in join(before).tracks] == pytest.approx([10, 11])
    joined = join(before, tracked(20, 30))
    assert [one.times[0] for one in joined.tracks] == pytest.approx([20, 21])
    assert joined.bumps == (BUMP,)


def intervals(*positions: int) -> list[TrackedInterval]:
    def make(k: int, count: int) -> TrackedInterval:
        one = Track(np.arange(count) / 10, np.zeros((count, 2)), np.zeros((count, 2)), np.zeros((count, 2, 2)), 0)
        return TrackedInterval(100.0 + 10 * k, 110.0 + 10 * k, {"a": replace(tracked(0, 10), tracks=(one,))})

    return [make(k, count) for k, count in enumerate(positions)]


def row(sensor: str, start: float, end: float, *, used: bool = True) -> CaptureRow:
    return CaptureRow(0, start, end, sensor, used, "")


def test_intervals_are_kept_up_to_the_number_of_positions() -> None:
    few = intervals(500, 500, 500)
    assert select_intervals(few, [row("a", 0, 1)], 100.0, 2000) == tuple(few)


def test_the_interval_that_a_scanner_depends_on_is_kept() -> None:
    many = intervals(900, 900, 900)
    rows = [row("a", 0, 30), row("b", 1, 4), row("b", 21, 22)]
    # b was shared for 3 s in the first, and not in the second.
    assert select_intervals(many, rows, 100.0, 2000) == (many[0], many[2])


def test_tracks_of_a_scanner_that_shares_none_count() -> None:
    many = intervals(900, 900, 900)
    rows = [row("a", 0, 30), row("b", 13, 14, used=False), row("b", 25, 26, used=False)]
    assert select_intervals(many, rows, 100.0, 2000) == (many[1], many[2])


def test_tracks_that_others_lack_do_not_count_for_a_scanner_that_shares_some() -> None:
    many = intervals(900, 900, 900)
    rows = [row("a", 0, 30), row("b", 13, 14), row("b", 5, 9, used=False), row("b", 25, 26)]
    assert select_intervals(many, rows, 100.0, 2000) == (many[1], many[2])


def test_an_interval_that_is_too_large_is_kept() -> None:
    assert len(select_intervals(intervals(5000), [], 100.0, 2000)) == 1
