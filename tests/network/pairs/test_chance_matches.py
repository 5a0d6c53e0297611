"""Evidence that scanners of large networks need, where some match different people by chance."""

import numpy as np
import pytest

from calgraph.network.pairs.clock_mounting_search import ClockMountingHypothesis, may_differ_by_chance
from calgraph.network.pairs.hypothesis_evidence import (
    _EVIDENCE_SCALE,
    MIN_WEIGHT_OF_EVIDENCE,
    PoseHypothesis,
    compute_chance_evidence,
)


def test_few_scanners_need_no_more_than_the_least_evidence() -> None:
    assert compute_chance_evidence(16) == MIN_WEIGHT_OF_EVIDENCE


def test_ten_times_the_scanners_need_as_much_more_as_leaves_one_percent() -> None:
    """Of a hundred times the pairs."""
    more = compute_chance_evidence(1000) - compute_chance_evidence(100)
    assert more == pytest.approx(_EVIDENCE_SCALE * np.log(100), rel=0.01)


@pytest.mark.parametrize(
    ("scanners", "clock_stddev", "walls", "by_chance"),
    [
        (300, 0.04, False, True),
        (300, 0.02, False, False),
        (300, 0.04, True, False),
        (1000, 0.04, True, True),
        (30, 0.04, False, False),
    ],
)
def test_a_straight_walk_may_match_by_chance_in_a_large_network(
    scanners: int, clock_stddev: float, walls: bool, by_chance: bool
) -> None:
    h = PoseHypothesis(
        np.eye(3), np.eye(3), 40, 1.0, 1.0, 0.1, 0.01, uses_background=walls, clock_stddev=clock_stddev
    )
    assert 90 < h.weight_of_evidence() < 100
    assert h.may_be_by_chance(scanners) == by_chance


@pytest.mark.parametrize(
    ("scanners", "evidence", "clock_offset", "clock_stddev", "by_chance"),
    [
        (300, 80.0, 0.0, 0.04, True),
        (300, 80.0, 0.0, 0.02, False),
        (300, 80.0, 0.7, 0.02, True),
        (300, 200.0, 0.7, 0.04, False),
        (16, 80.0, 0.7, 0.04, False),
    ],
)
def test_a_search_of_clocks_needs_more_evidence_in_a_large_network(
    scanners: int, evidence: float, clock_offset: float, clock_stddev: float, by_chance: bool
) -> None:
    h = ClockMountingHypothesis("a", "b", True, clock_offset, clock_stddev, evidence, 0.0, 0.1)
    assert may_differ_by_chance(h, scanners) == by_chance
