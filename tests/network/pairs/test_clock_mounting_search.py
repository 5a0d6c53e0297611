"""The search for clock offsets and relative mountings of two scanners."""

from collections.abc import Callable

import numpy as np
import pytest

from calgraph.config.settings import ScannerPairSettings
from calgraph.geometry import Array, se2
from calgraph.network.pairs.clock_mounting_search import (
    ClockMountingHypothesis,
    is_firm,
    search_clocks_and_mountings,
    select_searched_pairs,
)
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate
from calgraph.network.pairs.visibility_map import ScannerObservations
from calgraph.network.tracking.track import ScannerTracks, Track, correct_tracks
from track_pairs import estimate_scanner_pair

SETTINGS = ScannerPairSettings()
T_A_B = se2.pose(2.1, np.array([5.0, 1.5]))
STEP = 0.07  # s, between two scans


def wander(rng: np.random.Generator, seconds: float = 40.0) -> Array:
    """Positions (N, 2) of a person who walks in bends, every hundredth of a second."""
    t = np.arange(round(100 * seconds)) / 100 + rng.uniform(0, 100)
    return np.column_stack([3.0 + 1.8 * np.cos(0.5 * t), 1.5 * np.sin(0.7 * t) + 0.3 * np.sin(1.3 * t)])


def on_a_line(_rng: np.random.Generator, seconds: float = 40.0) -> Array:
    """The same of one who walks to and fro on one line, with pauses of different length."""
    t = np.arange(round(100 * seconds)) / 100
    s = np.interp(t, [0, 4, 5, 9, 12, 17, 19, 25, 26, 31, 33, 40], [0, 4, 4, 0.5, 0.5, 5, 5, 1, 1, 4, 4, 0])
    s = np.convolve(np.pad(s, 40, "edge"), np.full(81, 1 / 81), "valid")
    return np.column_stack([3.0 + 0.2 * s, -2.0 + s])


def observe(walks: list[Array], T_world_sensor: Array, rng: np.random.Generator) -> ScannerTracks:
    """One track of each person, with independent errors of 1 cm."""
    tracks = []
    for walk in walks:
        t = np.arange(rng.uniform(0, STEP), len(walk) / 100 - 0.02, STEP)
        k = (100 * t).astype(int)
        x = se2.apply(se2.inverse(T_world_sensor), walk)
        v = 100 * np.gradient(x, axis=0)
        S = np.tile(1e-4 * np.eye(2), (len(k), 1, 1))
        tracks.append(Track(k / 100, x[k] + rng.normal(0, 0.01, (len(k), 2)), v[k], S, 0))
    return ScannerTracks(tuple(tracks), np.zeros((0, 2)), 0.01)


def search(a: ScannerTracks, b: ScannerTracks, rng: np.random.Generator) -> dict[bool, ClockMountingHypothesis]:
    """The best hypothesis by mounting."""
    observations = {"a": ScannerObservations.from_tracks(a), "b": ScannerObservations.from_tracks(b)}
    found = search_clocks_and_mountings([("a", "b")], observations, rng, settings=SETTINGS)
    return {h.mirrored: h for h in sorted(found, key=lambda h: h.evidence)}


@pytest.mark.parametrize("clock", [-1.0, -0.3, -0.28, 0.0, 0.1, 0.3, 0.77])
@pytest.mark.parametrize("inverted", [False, True])
def test_clock_and_mounting_are_found(clock: float, inverted: bool) -> None:
    rng = np.random.default_rng(3)
    walks = [wander(rng), wander(rng)]
    b = correct_tracks(observe(walks, T_A_B, rng), clock_offset=-clock, inverted=inverted)
    found = search(observe(walks, np.eye(3), rng), b, rng)
    best = max(found.values(), key=lambda h: h.evidence)
    assert best.mirrored == inverted
    assert abs(best.clock_offset - clock) < 0.005
    assert best.clock_stddev < 0.01
    assert best.lateral_spread > 0.5
    assert best.reflected_evidence < 0
    if inverted not in found:
        assert found[not inverted].evidence < 0.5 * best.evidence


def test_tracks_on_one_line_fit_mirrored_ones_as_well() -> None:
    rng = np.random.default_rng(0)
    walk = [on_a_line(rng)]
    found = search(observe(walk, np.eye(3), rng), observe(walk, T_A_B, rng), rng)
    assert found[True].evidence > 0.9 * found[False].evidence
    assert all(h.reflected_evidence > 0.9 * h.evidence for h in found.values())


@pytest.mark.parametrize(("walk", "firm"), [(wander, True), (on_a_line, False)])
def test_a_pair_is_firm_if_people_turn(walk: Callable[[np.random.Generator], Array], firm: bool) -> None:
    rng = np.random.default_rng(3)
    walks = [walk(rng)]
    pair = estimate_scanner_pair("a", "b", observe(walks, np.eye(3), rng), observe(walks, T_A_B, rng), rng)
    assert isinstance(pair, ScannerPairEstimate)
    assert is_firm(pair) == firm


def test_a_pair_whose_clocks_differ_by_more_than_the_prior_is_not_firm() -> None:
    rng = np.random.default_rng(1)
    walks = [wander(rng)]
    b = correct_tracks(observe(walks, T_A_B, rng), clock_offset=-0.15)
    pair = estimate_scanner_pair("a", "b", observe(walks, np.eye(3), rng), b, rng)
    assert isinstance(pair, ScannerPairEstimate)
    assert not is_firm(pair)


def test_people_who_were_never_observed_together_have_no_hypothesis() -> None:
    rng = np.random.default_rng(1)
    a, b = observe([wander(rng, 10.0)], np.eye(3), rng), observe([wander(rng, 10.0)], T_A_B, rng)
    assert search(a, correct_tracks(b, clock_offset=-60.0), rng) == {}


def observe_parts(count: int, rng: np.random.Generator) -> dict[str, ScannerObservations]:
    """Scanners k, 4 + k and 8 + k see person k; their clocks and mountings differ."""
    walks = [wander(rng) for _ in range(4)]
    found = {}
    for k in range(count):
        T = se2.pose(rng.uniform(-3, 3), rng.uniform(-9, 9, 2))
        tracks = observe([walks[k % 4]], T, rng)
        corrected = correct_tracks(tracks, clock_offset=-0.45 * (k // 4 - 1), inverted=k // 4 == 2)
        found[f"s{k}"] = ScannerObservations.from_tracks(corrected)
    return found


def test_of_many_scanners_those_of_the_same_people_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.clock_mounting_search._PARTNERS", 2)
    observations = observe_parts(12, np.random.default_rng(1))
    found = select_searched_pairs(observations, np.arange(12), SETTINGS)
    same_person = {(f"s{a}", f"s{b}") for a in range(12) for b in range(a + 1, 12) if a % 4 == b % 4}
    assert set(found) >= same_person
    assert len(found) <= 24  # of 66


def test_of_many_scanners_only_those_of_other_parts_are_searched() -> None:
    observations = observe_parts(12, np.random.default_rng(1))
    part = np.arange(12) // 4
    found = select_searched_pairs(observations, part, SETTINGS)
    assert all(part[int(a[1:])] != part[int(b[1:])] for a, b in found)


def test_of_few_scanners_all_pairs_of_different_parts_are_searched() -> None:
    observations = observe_parts(4, np.random.default_rng(1))
    found = select_searched_pairs(observations, np.array([0, 0, 1, 2]), SETTINGS)
    assert found == [("s0", "s2"), ("s0", "s3"), ("s1", "s2"), ("s1", "s3"), ("s2", "s3")]
