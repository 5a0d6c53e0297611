"""Periods with the same visible objects."""

import numpy as np
from numpy.typing import NDArray

from calgraph.tracking.periods import Piece, cut_into_periods


def pieces(*seen: NDArray[np.intp]) -> tuple[Piece, ...]:
    """Periods of objects that are each seen in the given scans, ten a second."""
    scan = np.concatenate(seen)
    ends = np.cumsum([len(s) for s in seen])
    identities = np.split(np.arange(len(scan)), ends[:-1])
    return cut_into_periods(identities, scan, np.asarray(0.1 * scan, dtype=np.float64))


def test_one_object_all_the_time_is_one_period() -> None:
    result = pieces(np.arange(20))
    assert [(p.period, len(p.members)) for p in result] == [(0, 20)]


def test_a_second_object_cuts_the_first() -> None:
    result = pieces(np.arange(20), np.arange(5, 12))
    assert [(p.period, len(p.members)) for p in result] == [(0, 5), (1, 7), (1, 7), (2, 8)]


def test_one_that_vanishes_and_reappears_starts_periods() -> None:
    result = pieces(np.arange(20), np.concatenate([np.arange(6), np.arange(14, 20)]))
    assert [(p.period, len(p.members)) for p in result] == [(0, 6), (0, 6), (1, 8), (2, 6), (2, 6)]


def test_a_missed_scan_is_no_change() -> None:
    result = pieces(np.delete(np.arange(20), [7, 8]), np.arange(20))
    assert {p.period for p in result} == {0}


def test_nobody_is_no_period() -> None:
    assert cut_into_periods([], np.empty(0, dtype=np.intp), np.empty(0)) == ()
