"""Findings about clocks that differ and scanners that are mounted upside-down."""

from calgraph.config.settings import ClockMountingSettings
from calgraph.network.graph.clock_mounting_consensus import ClockMountingSolution
from calgraph.network.pairs.clock_mounting_search import ClockMountingHypothesis
from calgraph.network.scanner_pairs import report_clocks_and_mountings


def test_a_clock_found_from_people_on_one_line_makes_its_scanners_weak() -> None:
    on_a_line = ClockMountingHypothesis("root", "late", False, 0.4, 0.001, 400.0, 0.0, 0.2)
    solution = ClockMountingSolution({"late": 0.4}, frozenset(), (), (), {}, (), (on_a_line,))
    corrected, unsure = report_clocks_and_mountings("root", solution, {"late": 0.4}, ClockMountingSettings())
    assert (corrected.sensors, unsure.sensors) == ((), ("late",))
    assert "the clock offset of root and late, +0.40 s, rests on people" in unsure.text
