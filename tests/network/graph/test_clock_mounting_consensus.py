"""Clocks and mountings of a network from those of its pairs."""

from itertools import combinations

import numpy as np
import pytest

from calgraph.config.settings import ScannerPairSettings
from calgraph.network.graph.clock_mounting_consensus import (
    ClockMountingSolution,
    average_clocks,
    resolve_clocks_and_mountings,
)
from calgraph.network.pairs.clock_mounting_search import ClockMountingHypothesis

NAMES = ("a", "b", "c", "d", "e")


def pair(
    a: str,
    b: str,
    *,
    mirrored: bool = False,
    clock: float = 0.0,
    evidence: float = 400.0,
    stddev: float = 0.001,
    reflected: float = 0.0,
    spread: float = 1.0,
) -> ClockMountingHypothesis:
    return ClockMountingHypothesis(a, b, mirrored, clock, stddev, evidence, reflected, spread)


def resolve(hypotheses: list[ClockMountingHypothesis], stated: tuple[str, ...] = ()) -> ClockMountingSolution:
    return resolve_clocks_and_mountings("a", NAMES, hypotheses, stated, settings=ScannerPairSettings())


def all_pairs(inverted: str, clocks: dict[str, float]) -> list[ClockMountingHypothesis]:
    return [
        pair(i, j, mirrored=(i in inverted) != (j in inverted), clock=clocks.get(j, 0.0) - clocks.get(i, 0.0))
        for i, j in combinations(NAMES, 2)
    ]


def test_consistent_pairs_give_all_mountings_and_clocks() -> None:
    clocks = {"b": 0.3, "c": -0.2, "e": 0.7}
    found = resolve(all_pairs("bd", clocks))
    assert found.inverted == {"b", "d"}
    for name in NAMES:
        assert found.clock_offset[name] == pytest.approx(clocks.get(name, 0.0), abs=1e-9)
    assert (found.ambiguous, found.contradicted, found.distant_clocks) == ((), (), {})
    assert (found.refused, found.on_a_line) == ((), ())


def test_the_root_is_the_reference_of_mountings_and_clocks() -> None:
    """Where all others differ from the root, all others are inverted."""
    found = resolve([pair("a", "b", mirrored=True), pair("b", "c"), pair("c", "d"), pair("d", "e")])
    assert found.inverted == {"b", "c", "d", "e"}
    assert found.clock_offset["a"] == 0.0


def test_cycles_outvote_a_wrong_pair() -> None:
    """One pair with a wrong mounting and a wrong clock among ten, with as much evidence as the others."""
    pairs = [h for h in all_pairs("c", {"c": 0.3}) if (h.sensor_a, h.sensor_b) != ("a", "b")]
    found = resolve([*pairs, pair("a", "b", mirrored=True, clock=0.9)])
    assert found.inverted == {"c"}
    assert found.clock_offset["b"] == pytest.approx(0.0, abs=2e-3)
    assert found.clock_offset["c"] == pytest.approx(0.3, abs=2e-3)


def test_of_both_mountings_of_a_pair_the_better_one_counts() -> None:
    found = resolve([pair("a", "b", evidence=120.0), pair("a", "b", mirrored=True, evidence=500.0, clock=0.2)])
    assert found.inverted == {"b"}
    assert found.clock_offset["b"] == pytest.approx(0.2)
    assert found.ambiguous == ()


def test_mountings_that_fit_nearly_alike_are_ambiguous() -> None:
    found = resolve(
        [pair("a", "b", evidence=500.0), pair("a", "b", mirrored=True, evidence=480.0), pair("b", "c")]
    )
    assert found.ambiguous == ("b", "c")
    assert found.inverted == frozenset()


def test_an_ambiguous_scanner_is_mounted_as_the_root() -> None:
    """Tracks on one line fit best mirrored, and nearly as well reflected at that line."""
    found = resolve([pair("a", "b", mirrored=True, evidence=145.0, reflected=130.0)])
    assert found.inverted == frozenset()
    assert found.ambiguous == ("b",)


def test_what_fits_reflected_as_well_is_no_evidence_for_a_mounting() -> None:
    """A pair on one line against one of less evidence in which people turn."""
    on_a_line = pair("a", "b", mirrored=True, evidence=300.0, reflected=290.0)
    found = resolve([on_a_line, pair("c", "b", evidence=200.0), pair("a", "c")])
    assert found.inverted == frozenset()
    assert found.ambiguous == ()


def test_another_pair_settles_an_ambiguous_mounting() -> None:
    both = [pair("a", "b", evidence=500.0), pair("a", "b", mirrored=True, evidence=510.0)]
    assert resolve([*both, pair("a", "c"), pair("b", "c")]).ambiguous == ()


def test_a_stated_mounting_is_kept_and_its_contradiction_is_named() -> None:
    found = resolve([pair("a", "b", mirrored=True), pair("b", "c")], ("b",))
    assert found.inverted == frozenset()
    assert found.contradicted == ("b",)


def test_chance_has_no_evidence() -> None:
    found = resolve([pair("a", "b", mirrored=True, evidence=40.0, clock=0.5)])
    assert found.inverted == frozenset()
    assert found.clock_offset["b"] == 0.0


def test_clocks_beyond_the_search_are_named() -> None:
    assert resolve([pair("a", "b", clock=1.2)]).distant_clocks == {"b": pytest.approx(1.2)}


def test_clocks_are_corrected_where_they_differ_significantly() -> None:
    """Offsets of 0.17 s with standard deviations of 0.06 and 0.03 s."""
    assert resolve([pair("a", "b", clock=0.17, stddev=0.06)]).clock_offset["b"] == 0.0
    assert resolve([pair("a", "b", clock=0.17, stddev=0.03)]).clock_offset["b"] == pytest.approx(0.17)


def test_uncertain_clocks_have_little_weight() -> None:
    """Of two ways to c, the uncertain one changes its clock by its share of the information."""
    found = resolve([pair("a", "b"), pair("b", "c", clock=0.1), pair("a", "c", clock=0.16, stddev=0.05)])
    assert found.clock_offset["c"] == pytest.approx(0.1, abs=2e-3)
    assert np.isfinite(list(found.clock_offset.values())).all()


def test_a_clock_that_another_pair_contradicts_is_refused() -> None:
    """Whatever its evidence; the pair that agrees with the root's clock decides."""
    delayed = pair("a", "b", clock=0.4, evidence=900.0)
    found = resolve([delayed, pair("a", "c"), pair("b", "c", evidence=130.0)])
    assert found.clock_offset["b"] == 0.0
    assert found.refused == (delayed,)


def test_a_cycle_confirms_a_clock_against_one_pair() -> None:
    agreeing = [pair("a", "b", clock=0.4), pair("b", "c", clock=-0.4), pair("a", "c")]
    found = resolve([*agreeing, pair("a", "d"), pair("b", "d", evidence=600.0)])
    assert found.clock_offset["b"] == pytest.approx(0.4, abs=2e-3)
    assert found.refused == ()


@pytest.mark.parametrize(
    ("pairs", "confirmed"),
    [
        ([pair("a", "b", clock=0.4, evidence=200.0, spread=0.4)], True),
        ([pair("a", "b", clock=0.4, evidence=140.0, spread=0.4)], False),
        ([pair("a", "b", clock=0.4, evidence=200.0), pair("a", "b", evidence=150.0)], False),
        ([pair("a", "b", clock=0.4, evidence=200.0), pair("a", "b", evidence=130.0)], True),
        ([pair("a", "b", clock=0.4, evidence=200.0), pair("a", "b", clock=0.35, evidence=190.0)], True),
    ],
)
def test_a_pair_alone_has_to_be_firm(pairs: list[ClockMountingHypothesis], confirmed: bool) -> None:
    """Evidence of 150, and no other offset with 0.7 of it."""
    found = resolve(pairs)
    assert found.on_a_line == ()
    assert found.clock_offset["b"] == (pytest.approx(0.4) if confirmed else 0.0)
    assert found.refused == (() if confirmed else (pairs[0],))


def test_clocks_behind_a_refused_one_are_refused_with_it() -> None:
    """b follows a with a delay that c contradicts; d is with b."""
    found = resolve(
        [
            pair("a", "b", clock=0.4, evidence=900.0),
            pair("b", "d", evidence=500.0),
            pair("a", "c"),
            pair("c", "d", evidence=130.0),
        ]
    )
    assert found.clock_offset == dict.fromkeys(NAMES, 0.0)


def test_offsets_within_the_prior_of_clocks_are_left_to_the_estimators() -> None:
    found = resolve([pair("a", "b", clock=0.08, spread=0.1)])
    assert found.clock_offset["b"] == 0.0
    assert found.refused == ()


def test_clocks_of_agreeing_pairs_are_averaged_with_their_deviations() -> None:
    """Least squares of three pairs, each with a standard deviation of 12 ms, of which 5 ms are noise."""
    pairs = [pair(*ends, clock=clock, stddev=np.sqrt(0.012**2 - 0.005**2)) for ends, clock in (
        ("ab", 0.030), ("bc", -0.010), ("ac", 0.023))]  # fmt: skip
    clocks = average_clocks(("a", "b", "c"), pairs)
    np.testing.assert_array_equal(clocks[0], np.nan)
    np.testing.assert_allclose(clocks[1:, 0], [0.031, 0.022], atol=2e-4)
    np.testing.assert_allclose(clocks[1:, 1], 0.012 * np.sqrt(2 / 3), rtol=0.02)


def test_a_scanner_without_clock_offsets_has_no_clock() -> None:
    pairs = [pair("a", "b", clock=0.03), pair("b", "c", stddev=np.inf)]
    clocks = average_clocks(("a", "b", "c"), pairs)
    np.testing.assert_array_equal(np.isnan(clocks).all(axis=1), [True, False, True])


def test_a_clock_that_rests_on_people_on_one_line_is_named() -> None:
    """Unless another pair confirms it."""
    delayed = pair("a", "b", clock=0.4, spread=0.2)
    found = resolve([delayed])
    assert found.clock_offset["b"] == pytest.approx(0.4)
    assert found.on_a_line == (delayed,)
    assert resolve([delayed, pair("a", "c"), pair("b", "c", clock=-0.4)]).on_a_line == ()
    assert resolve([pair("a", "b", spread=0.2)]).on_a_line == ()


def test_pairs_that_disagree_enlarge_the_deviations_of_clocks() -> None:
    """A cycle that misses by 60 ms: each pair by 20 ms, of which 12 ms are expected, on one degree of freedom."""
    stddev = np.sqrt(0.012**2 - 0.005**2)
    pass

    def deviation(misclosure: float) -> float:
        pairs = [pair("a", "b", clock=misclosure, stddev=stddev), pair("b", "c", stddev=stddev),
                 pair("a", "c", stddev=stddev)]  # fmt: skip
        return float(average_clocks(("a", "b", "c"), pairs)[1, 1])

    assert deviation(0.01) == pytest.approx(deviation(0.0), rel=0.2)
    assert deviation(0.06) > 2.5 * deviation(0.0)
