"""The pairs that are registered in networks of many scanners."""

from itertools import combinations

import numpy as np
import pytest

from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.network.pairs.candidate_pairs import (
    Ends,
    select_implied_pairs,
    select_pairs_between_parts,
    select_separated_pairs,
    select_similar_pairs,
)
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, estimate_scanner_pairs
from calgraph.network.pairs.synchronized_tracks import TrackSamples
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.parallel.engine import Processes
from track_pairs import gather_samples

PLACES = np.array([[0.0, 0.0], [6.0, 0.0], [12.0, 0.0], [18.0, 0.0]])
"""Of scanners along a corridor."""


def pose_of(place: Array) -> Array:
    return se2.pose(0.3 * place[0], place)


def observe_corridor(reach: float, off: float = 0.0) -> list[TrackSamples]:
    """One person who walks along the corridor at 1.2 m/s, as far as each scanner reaches."""
    t = np.arange(250) * 0.1
    x = np.column_stack([1.2 * t - 5, 0.5 * np.sin(t)])
    observed = []
    for place in PLACES:
        near = np.flatnonzero(np.linalg.norm(x - place, axis=1) < reach)
        in_sensor = se2.apply(se2.inverse(pose_of(place)), x[near] + off)
        one = gather_samples([(in_sensor, np.zeros_like(in_sensor))], 0.02)
        observed.append(TrackSamples(near, one.trajectory, one.positions, one.velocities, one.covariances))
    return observed


def relative(a: int, b: int) -> Array:
    return np.asarray(se2.inverse(pose_of(PLACES[a])) @ pose_of(PLACES[b]))


def test_each_scanner_has_its_most_similar_partners() -> None:
    similarity = np.array([[0, 9, 5, 1], [9, 0, 6, 2], [5, 6, 0, 3], [1, 2, 3, 0]], dtype=float)
    assert select_similar_pairs(similarity, 1) == {(0, 1), (1, 2), (2, 3)}
    assert select_similar_pairs(similarity, 3) == set(combinations(range(4), 2))


def test_a_scanner_without_similar_tracks_has_partners_too() -> None:
    assert select_similar_pairs(np.zeros((3, 3)), 1) == {(0, 1), (0, 2)}


def test_pairs_with_a_common_neighbour_and_common_tracks_are_implied() -> None:
    poses = {ends: relative(*ends) for ends in ((0, 1), (1, 2), (2, 3))}
    implied = select_implied_pairs(observe_corridor(7.0), poses, poses, poses)
    assert implied == {(0, 2), (1, 3)}  # within 12 m both see the middle; (0, 3) has no common neighbour


def test_pairs_whose_views_do_not_overlap_are_not_implied() -> None:
    poses = {ends: relative(*ends) for ends in ((0, 1), (1, 2), (2, 3))}
    # 0 and 2 both see 0.8 m of the way, for 0.7 s.
    assert not select_implied_pairs(observe_corridor(6.4), poses, poses, poses)


def test_implied_pairs_survive_an_error_of_the_poses_below_the_radius() -> None:
    poses = {ends: relative(*ends) for ends in ((0, 1), (1, 2))}
    for shift, expected in ((0.8, {(0, 2)}), (1.2, set())):
        wrong = {**poses, (1, 2): se2.retract(poses[1, 2], np.array([0.0, shift, 0.0]))}
        assert select_implied_pairs(observe_corridor(7.0), wrong, wrong, wrong) == expected


def test_only_new_poses_imply_pairs() -> None:
    poses = {ends: relative(*ends) for ends in ((0, 1), (1, 2), (2, 3))}
    samples = observe_corridor(7.0)
    assert select_implied_pairs(samples, poses, [(2, 3)], poses) == {(1, 3)}
    assert select_implied_pairs(samples, poses, poses, {*poses, (0, 2)}) == {(1, 3)}


def test_pairs_between_parts_are_those_that_were_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    similarity = np.arange(16.0).reshape(4, 4)
    connected: list[Ends] = [(0, 1), (2, 3)]
    assert select_separated_pairs(similarity, connected, [*connected, (0, 3)]) == {
        (0, 2), (1, 2), (1, 3),
    }  # fmt: skip
    assert not select_separated_pairs(similarity, [*connected, (1, 2)], connected)
    monkeypatch.setattr("calgraph.network.pairs.candidate_pairs._PARTNERS_BETWEEN_PARTS", 1)
    assert select_separated_pairs(similarity, connected, connected) == {(0, 3), (1, 3), (1, 2)}


def test_partners_are_doubled_until_some_are_untried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.candidate_pairs._PARTNERS_BETWEEN_PARTS", 2)
    monkeypatch.setattr("calgraph.network.pairs.candidate_pairs._MAX_PARTNERS_BETWEEN_PARTS", 5)
    similarity = np.zeros((40, 40))
    similarity[-1, :-1] = similarity[:-1, -1] = np.arange(1, 40)
    connected: list[Ends] = [(k, k + 1) for k in range(38)]
    tried: set[Ends] = set()
    for first in (37, 35, 34):
        untried = select_separated_pairs(similarity, connected, tried)
        assert untried == {(k, 39) for k in range(first, 39)} - tried
        tried |= untried
    assert not select_separated_pairs(similarity, connected, tried)


def test_a_part_selects_its_most_similar_pairs() -> None:
    similarity = np.zeros((6, 6))
    for k, ends in enumerate([(0, 4), (0, 5), (1, 4), (2, 5), (3, 4), (3, 5)]):
        similarity[ends] = similarity[ends[::-1]] = k + 1
    part = np.array([0, 0, 0, 0, 1, 1])
    everything = {(0, 4), (0, 5), (1, 4), (2, 5), (3, 4), (3, 5)}
    assert select_pairs_between_parts(similarity, part, 6, 100) == everything
    assert select_pairs_between_parts(similarity, part, 6, 2) == {(3, 4), (3, 5)}


def test_a_large_part_selects_few_pairs_with_a_single_scanner() -> None:
    similarity = np.zeros((40, 40))
    similarity[-1, :-1] = similarity[:-1, -1] = np.arange(1, 40)
    part = np.append(np.zeros(39, dtype=np.intp), 1)
    assert select_pairs_between_parts(similarity, part, 3, 100) == {(36, 39), (37, 39), (38, 39)}


def test_pairs_without_any_common_motion_are_not_selected_between_parts() -> None:
    assert not select_pairs_between_parts(np.zeros((3, 3)), np.arange(3), 5, 100)


def observe_hall(rng: np.random.Generator, reach: float = 7.0) -> tuple[dict[str, ScannerTracks], list[Array]]:
    """Twelve scanners along a hall of 44 m, and eight people who wander in it, each in a part of its own."""
    t = np.arange(0, 40, 0.08)
    people = []
    for k in range(8):
        u, v, phase = rng.uniform(0.25, 0.4), rng.uniform(0.4, 0.6), rng.uniform(0, 6, 2)
        x = np.column_stack([5.5 * k + 3 + 4 * np.sin(u * t + phase[0]), 2.5 * np.sin(v * t + phase[1])])
        people.append((x, np.gradient(x, t, axis=0)))
    poses = [se2.pose(rng.uniform(-3, 3), np.array([4.0 * k, 3.0 * (-1) ** k])) for k in range(12)]
    tracked = {}
    for k, T in enumerate(poses):
        tracks = []
        for x, v in people:
            near = np.linalg.norm(x - T[:2, 2], axis=1) < reach
            for part in np.split(np.arange(len(t)), np.flatnonzero(np.diff(near)) + 1):
                if near[part[0]] and len(part) > 15:
                    in_sensor = se2.apply(se2.inverse(T), x[part]) + 0.03 * rng.normal(size=(len(part), 2))
                    S = np.tile(0.03**2 * np.eye(2), (len(part), 1, 1))
                    tracks.append(Track(t[part], in_sensor, v[part] @ T[:2, :2], S, period=0))
        tracked[f"s{k}"] = ScannerTracks(tuple(tracks), np.zeros((0, 2)), 0.01)
    return tracked, poses


def count_right(found: dict[tuple[str, str], ScannerPairEstimate | Rejected], poses: list[Array]) -> set[str]:
    right = set()
    for (a, b), pair in found.items():
        if isinstance(pair, ScannerPairEstimate):
            off = se2.difference(pair.T_a_b, se2.inverse(poses[int(a[1:])]) @ poses[int(b[1:])])
            if np.hypot(*off[:2]) < 0.5 and abs(off[2]) < np.radians(5):
                right.add(f"{a} {b}")
    return right


def test_candidates_contain_all_right_pairs_of_a_hall(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked, poses = observe_hall(np.random.default_rng(3))
    candidates = estimate_scanner_pairs(tracked, np.random.default_rng(0))
    monkeypatch.setattr("calgraph.network.pairs.scanner_pair.MAX_EXHAUSTIVE", 12)
    exhaustive = estimate_scanner_pairs(tracked, np.random.default_rng(0))
    assert len(exhaustive) == 66
    assert len(candidates) < 50
    assert len(count_right(exhaustive, poses)) > 20
    assert count_right(exhaustive, poses) <= count_right(candidates, poses)


def test_further_pairs_are_tried_where_matches_may_be_by_chance(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked, _ = observe_hall(np.random.default_rng(3))
    usual = estimate_scanner_pairs(tracked, np.random.default_rng(0))
    monkeypatch.setattr(PoseHypothesis, "may_be_by_chance", lambda *_: True)
    assert len(estimate_scanner_pairs(tracked, np.random.default_rng(0))) > len(usual)


def test_candidates_do_not_depend_on_the_number_of_processes() -> None:
    tracked, _ = observe_hall(np.random.default_rng(4))
    done: list[float] = []
    one = estimate_scanner_pairs(tracked, np.random.default_rng(0), progress=done.append)
    two = estimate_scanner_pairs(tracked, np.random.default_rng(0), engine=Processes(2))
    assert list(one) == list(two) == sorted(one, key=lambda ends: [int(name[1:]) for name in ends])
    for ends, pair in one.items():
        other = two[ends]
        assert isinstance(pair, ScannerPairEstimate) == isinstance(other, ScannerPairEstimate)
        if isinstance(pair, ScannerPairEstimate) and isinstance(other, ScannerPairEstimate):
            np.testing.assert_array_equal(pair.T_a_b, other.T_a_b)
    assert done == sorted(done)
    assert done[-1] == 1


def test_unclear_poses_imply_pairs_of_scanners_without_failures_only(monkeypatch: pytest.MonkeyPatch) -> None:
    tracked, poses = observe_hall(np.random.default_rng(3))

    def find(clear_evidence: float, max_unclear_tries: int) -> tuple[int, int]:
        monkeypatch.setattr("calgraph.network.pairs.scanner_pair._PARTNERS", 2)
        monkeypatch.setattr("calgraph.network.pairs.scanner_pair._CLEAR_EVIDENCE", clear_evidence)
        monkeypatch.setattr("calgraph.network.pairs.scanner_pair._MAX_UNCLEAR_TRIES", max_unclear_tries)
        found = estimate_scanner_pairs(tracked, np.random.default_rng(0))
        return len(found), len(count_right(found, poses))

    registered, right = find(clear_evidence=1e9, max_unclear_tries=100)
    assert find(clear_evidence=1e9, max_unclear_tries=1)[0] < registered
    # Clear poses imply pairs whatever other pairs a scanner has tried.
    assert find(clear_evidence=1e-9, max_unclear_tries=1) == (registered, right)
