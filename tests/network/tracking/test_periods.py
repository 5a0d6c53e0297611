"""Periods with the same visible objects."""

import numpy as np
import pytest
from numpy.typing import NDArray

from calgraph.network.tracking.track_scanner import TrackSegment, split_into_periods


def split(*detected: NDArray[np.intp]) -> tuple[TrackSegment, ...]:
    """Periods of objects that are each detected in the given scans, at 10 Hz."""
    scan = np.concatenate(detected)
    ends = np.cumsum([len(s) for s in detected])
    identities = np.split(np.arange(len(scan)), ends[:-1])
    return split_into_periods(identities, scan, np.asarray(0.1 * scan, dtype=np.float64))


def test_one_object_all_the_time_is_one_period() -> None:
    result = split(np.arange(20))
    assert [(p.period, len(p.members)) for p in result] == [(0, 20)]


def test_a_second_object_splits_the_first() -> None:
    result = split(np.arange(20), np.arange(5, 12))
    assert [(p.period, len(p.members)) for p in result] == [(0, 5), (1, 7), (1, 7), (2, 8)]


def test_leaving_and_returning_starts_new_periods() -> None:
    result = split(np.arange(20), np.concatenate([np.arange(6), np.arange(14, 20)]))
    assert [(p.period, len(p.members)) for p in result] == [(0, 6), (0, 6), (1, 8), (2, 6), (2, 6)]


def test_a_missed_scan_starts_no_period() -> None:
    result = split(np.delete(np.arange(20), [7, 8]), np.arange(20))
    assert {p.period for p in result} == {0}


def test_no_objects_give_no_period() -> None:
    assert split_into_periods([], np.empty(0, dtype=np.intp), np.empty(0)) == ()


@pytest.mark.parametrize(("missed", "periods"), [(3, 1), (4, 2)])
def test_an_object_that_is_missed_for_more_than_four_tenths_of_a_second_has_left(
    missed: int, periods: int
) -> None:
    result = split(np.delete(np.arange(20), 8 + np.arange(missed)))
    assert len({segment.period for segment in result}) == periods
