"""Relative poses of two stationary scanners and their information, from simulated tracks of people."""

import time
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy.signal import lfilter

from calgraph.config import People, RangeNoise
from calgraph.config.settings import CenterFeature, TrackingSettings
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2
from calgraph.network.pairs import hypothesis_evidence
from calgraph.network.pairs.hypothesis_evidence import (
    PoseHypothesis,
    _count_by_chance,
    build_hypothesis,
    is_credible,
    select_distinct,
    subsample_pairs,
)
from calgraph.network.pairs.scanner_pair import ScannerPairEstimate, estimate_scanner_pairs
from calgraph.network.pairs.synchronized_tracks import TrackSamples, pair_samples
from calgraph.network.pairs.track_registration import NuisancePrior, TrackRegistration
from calgraph.network.track_recording import select_center_estimator
from calgraph.network.tracking.track import ScannerTracks, Track
from calgraph.network.tracking.track_scanner import track_scanner
from calgraph.recording import open_recording
from calgraph.sensors import LaserScan
from track_pairs import T_A_B, estimate_scanner_pair, observe_walks, walk_along_curve

STEP = 0.04  # s, of the simulated truth
SIGMA = 0.04  # m, of a smoothed position
MEMORY = 0.4  # s, correlation time of a smoother's errors
NO_BACKGROUND = np.zeros((0, 2))
Walk = tuple[Array, Array]
"""Positions and velocities (N, 2) in the world at multiples of STEP."""


def wander(rng: np.random.Generator, seconds: float = 60.0, size: float = 8.0, speed: float = 1.2) -> Walk:
    """A person who walks about in a room, turning at random."""
    n = int(seconds / STEP)
    heading, turning, x = rng.uniform(-np.pi, np.pi), 0.0, rng.uniform(-size / 2, size / 2, 2)
    positions, velocities = np.empty((n, 2)), np.empty((n, 2))
    for i, push in enumerate(rng.normal(size=n)):
        turning += 0.8 * np.sqrt(STEP) * push - STEP * turning
        if max(abs(x)) > size / 2:
            inward = np.arctan2(-x[1], -x[0]) - heading
            heading += 2 * STEP * ((inward + np.pi) % (2 * np.pi) - np.pi)
        heading += STEP * turning
        velocities[i] = speed * np.array([np.cos(heading), np.sin(heading)])
        x = x + STEP * velocities[i]
        positions[i] = x
    return positions, velocities


def straight(start: tuple[float, float], end: tuple[float, float], seconds: float) -> Walk:
    """There and back on one straight line, once."""
    n = int(seconds / STEP)
    v = (np.array(end) - np.array(start)) / (seconds / 2)
    t = np.arange(n)[:, None] * STEP
    back = t > seconds / 2
    return np.where(back, np.array(end) - v * (t - seconds / 2), np.array(start) + v * t), np.where(back, -v, v)


def observe(
    walks: list[Walk],
    T_world_sensor: Array,
    rng: np.random.Generator,
    *,
    rate: float = 12.5,
    reach: float = 8.0,
    cut: float = 2.0,
    late: float = 0.0,
    near: float = 0.0,
    sigma: float = SIGMA,
    background: Array = NO_BACKGROUND,
) -> ScannerTracks:
    """What a scanner with a view of 270° makes of people: errors that last, dropouts, tracks cut in pieces.

    Stamps are ``late`` by so many seconds, and people look ``near`` by so many metres.
    """
    tracks = []
    T = se2.inverse(T_world_sensor)
    for x, v in walks:
        truth = np.arange(len(x)) * STEP
        t = np.arange(rng.uniform(0, 1 / rate), truth[-1], 1 / rate)
        p = se2.apply(T, np.column_stack([np.interp(t, truth, x[:, k]) for k in (0, 1)]))
        u = np.column_stack([np.interp(t, truth, v[:, k]) for k in (0, 1)]) @ T[:2, :2].T
        keep = np.exp(-1 / rate / MEMORY)
        noise = rng.normal(size=p.shape) * sigma
        noise[1:] *= np.sqrt(1 - keep**2)
        p = p + lfilter([1], [1, -keep], noise, axis=0)
        p = p * (1 - near / np.linalg.norm(p, axis=1, keepdims=True))
        visible = (np.hypot(*p.T) < reach) & (np.abs(np.arctan2(p[:, 1], p[:, 0])) < np.radians(135))
        detected = np.flatnonzero(visible & (rng.random(len(t)) > 0.02))
        piece = np.cumsum(rng.random(len(t)) < 1 / (rate * cut))
        breaks = (np.diff(detected) > 5) | (np.diff(piece[detected]) > 0)
        for k in np.split(detected, np.flatnonzero(breaks) + 1):
            if len(k) >= 4:
                S = np.broadcast_to(sigma**2 * np.eye(2), (len(k), 2, 2))
                tracks.append(Track(t[k] + late, p[k], u[k], S, period=int(piece[k[0]])))
    return ScannerTracks(tuple(tracks), background, 0.01)


def somewhere(rng: np.random.Generator, size: float = 10.0) -> Array:
    """A pose in the room that looks at its middle."""
    x = rng.uniform(-size / 2, size / 2, 2)
    return se2.pose(np.arctan2(-x[1], -x[0]) + rng.normal() * 0.3, x)


def estimate(
    rng: np.random.Generator, walks: list[Walk], A: Array, B: Array, *, late: float = 0.0
) -> ScannerPairEstimate | Rejected:
    return estimate_scanner_pair("a", "b", observe(walks, A, rng), observe(walks, B, rng, late=late), rng)


def error(pair: ScannerPairEstimate | Rejected, T: Array) -> tuple[float, float]:
    """Metres and degrees of the best hypothesis."""
    assert isinstance(pair, ScannerPairEstimate), pair
    d = se2.difference(pair.T_a_b, T)
    return float(np.hypot(d[0], d[1])), float(np.degrees(abs(d[2])))


@pytest.mark.parametrize("people", [1, 2, 4])
@pytest.mark.parametrize("seed", range(6))
def test_the_right_hypothesis_comes_first(people: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    walks = [wander(rng) for _ in range(people)]
    A, B = somewhere(rng), somewhere(rng)
    assert error(estimate(rng, walks, A, B), se2.inverse(A) @ B) < (0.1, 1.0)


def test_a_crowd_of_twelve_is_associated() -> None:
    rng = np.random.default_rng(3)
    walks = [wander(rng) for _ in range(12)]
    A, B = somewhere(rng), somewhere(rng)
    assert error(estimate(rng, walks, A, B), se2.inverse(A) @ B) < (0.05, 0.5)


def test_a_crowd_tracked_for_three_seconds_is_associated() -> None:
    rng = np.random.default_rng(4)
    walks = [wander(rng, seconds=3) for _ in range(30)]
    A, B = somewhere(rng, 4.0), somewhere(rng, 4.0)
    assert error(estimate(rng, walks, A, B), se2.inverse(A) @ B) < (0.1, 1.0)


def test_scanners_that_tracked_different_people_for_seconds_are_rarely_accepted() -> None:
    # Short trajectories of people at similar speeds can be superimposed.
    found = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        one, other = wander(rng, seconds=6), wander(rng, seconds=6, speed=rng.uniform(1.1, 1.3))
        a, b = (observe([walk], somewhere(rng), rng, cut=20.0, sigma=0.02) for walk in (one, other))
        found += isinstance(estimate_scanner_pair("a", "b", a, b, rng), ScannerPairEstimate)
    # At most 5 %, of which this is 99 % of the binomial distribution; it was 35 by numbers of positions alone.
    assert found <= 7


def test_two_people_who_cross_repeatedly_are_associated(rng: np.random.Generator) -> None:
    walks = [straight((-3, 0.1), (3, 0.3), 12), straight((0.2, -3), (0.1, 3), 12)]
    A, B = se2.pose(0.7, np.array([-3.0, -3.0])), se2.pose(2.4, np.array([4.0, -3.0]))
    assert error(estimate(rng, walks, A, B), se2.inverse(A) @ B) < (0.1, 1.0)


def test_a_pair_with_little_overlap_is_found(rng: np.random.Generator) -> None:
    walks = [wander(rng, size=12.0) for _ in range(3)]
    A, B = se2.pose(np.pi, np.array([-1.0, 0.0])), se2.pose(0.0, np.array([0.0, 1.0]))
    assert error(estimate(rng, walks, A, B), se2.inverse(A) @ B) < (0.15, 2.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_scanner_with_half_of_all_tracks_occluded_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    walks = [wander(rng, size=6.0) for _ in range(2)]
    A, B = somewhere(rng, 6.0), somewhere(rng, 6.0)
    observed = observe(walks, B, rng, background=room(B, rng))
    some = tuple(track for track in observed.tracks if rng.random() < 0.5)
    pair = estimate_scanner_pair("a", "b", observe(walks, A, rng), replace(observed, tracks=some), rng)
    assert isinstance(pair, ScannerPairEstimate), pair
    assert 0.25 < pair.hypotheses[0].matched_share < 0.8
    assert error(pair, se2.inverse(A) @ B)[0] < 0.1


def test_clocks_may_differ_by_thirty_milliseconds(rng: np.random.Generator) -> None:
    walks = [wander(rng) for _ in range(2)]
    A, B = somewhere(rng), somewhere(rng)
    assert error(estimate(rng, walks, A, B, late=0.03), se2.inverse(A) @ B)[0] < 0.03


@pytest.mark.parametrize(("late", "near"), [(0.09, 0.0), (0.0, 0.07)])
@pytest.mark.parametrize("seed", range(3))
def test_track_covariances_may_be_smaller_than_systematic_errors(late: float, near: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = somewhere(rng), somewhere(rng)
    fast = [wander(rng, speed=2.5)]
    a = observe(fast, A, rng, sigma=0.003, near=near)
    b = observe(fast, B, rng, sigma=0.003, late=late, near=near)
    metres, degrees = error(estimate_scanner_pair("a", "b", a, b, rng, icp=False), se2.inverse(A) @ B)
    assert metres < 0.05
    assert degrees < 0.5


def test_information_is_consistent_with_the_errors() -> None:
    squared = []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        walks = [wander(rng, seconds=40)]
        A, B = somewhere(rng, 6.0), somewhere(rng, 6.0)
        a, b = (observe(walks, T, rng, near=rng.normal() * 0.03, late=rng.normal() * 0.01) for T in (A, B))
        pair = estimate_scanner_pair("a", "b", a, b, rng)
        assert isinstance(pair, ScannerPairEstimate), pair
        d = se2.difference(pair.T_a_b, se2.inverse(A) @ B)
        squared.append(float(d @ pair.hypotheses[0].information @ d))
    # 3 if it were exact; people show more systematic errors than these, which the information allows for.
    assert 1.0 < np.mean(squared) < 4.5


def test_a_short_straight_walk_leaves_the_angle_less_certain_than_a_wide_one() -> None:
    def stddev_of_angle(length: float) -> float:
        rng = np.random.default_rng(5)
        walks = [straight((-length / 2, 0), (length / 2, 0), 20)]
        pair = estimate(rng, walks, se2.pose(np.pi / 2, np.array([0.0, -3])), se2.pose(0, np.array([-4.0, 0])))
        assert isinstance(pair, ScannerPairEstimate), pair
        return float(np.sqrt(np.linalg.inv(pair.hypotheses[0].information)[2, 2]))

    assert stddev_of_angle(1.5) > 2 * stddev_of_angle(6.0)


def test_tracks_at_different_times_are_rejected(rng: np.random.Generator) -> None:
    walks = [wander(rng, seconds=20)]
    a, b = observe(walks, np.eye(3), rng), observe(walks, np.eye(3), rng, late=100.0)
    assert estimate_scanner_pair("a", "b", a, b, rng) == Rejected(
        "both tracked people at the same time for 0.0 s, 2.0 s are needed"
    )


def test_people_at_rest_are_rejected(rng: np.random.Generator) -> None:
    still = (np.ones((500, 2)), np.zeros((500, 2)))
    a, b = observe([still], np.eye(3), rng), observe([still], np.eye(3), rng)
    found = estimate_scanner_pair("a", "b", a, b, rng)
    assert isinstance(found, Rejected)
    assert found.reason == "no trajectory of one has the shape of one of the other, or all are too short"


def test_a_scanner_without_tracks_is_rejected(rng: np.random.Generator) -> None:
    empty = ScannerTracks((), NO_BACKGROUND, 0.01)
    found = estimate_scanner_pair("a", "b", empty, empty, rng)
    assert found == Rejected("both tracked people at the same time for 0.0 s, 2.0 s are needed")


def test_walls_improve_the_pose_from_tracks(rng: np.random.Generator) -> None:
    walks = [wander(rng, seconds=15, size=3.0)]
    A, B = se2.pose(0.3, np.array([-2.0, -1.0])), se2.pose(2.5, np.array([2.0, -1.5]))
    a, b = (observe(walks, T, rng, background=room(T, rng)) for T in (A, B))
    with_walls = estimate_scanner_pair("a", "b", a, b, np.random.default_rng(1))
    assert error(with_walls, se2.inverse(A) @ B) < (0.01, 0.2)
    assert isinstance(with_walls, ScannerPairEstimate)
    assert with_walls.hypotheses[0].uses_background
    without = estimate_scanner_pair("a", "b", a, b, np.random.default_rng(1), icp=False)
    assert isinstance(without, ScannerPairEstimate)
    assert not without.hypotheses[0].uses_background


def test_walls_are_matched_unless_they_are_not_wanted(rng: np.random.Generator) -> None:
    walks = [wander(rng, seconds=15, size=3.0)]
    poses = se2.pose(0.3, np.array([-2.0, -1.0])), se2.pose(2.5, np.array([2.0, -1.5]))
    a, b = (observe(walks, T, rng, background=room(T, rng)) for T in poses)
    usual = estimate_scanner_pairs({"a": a, "b": b}, np.random.default_rng(1))["a", "b"]
    without = estimate_scanner_pairs({"a": a, "b": b}, np.random.default_rng(1), icp=False)["a", "b"]
    assert isinstance(usual, ScannerPairEstimate)
    assert isinstance(without, ScannerPairEstimate)
    assert usual.hypotheses[0].uses_background
    assert not without.hypotheses[0].uses_background


def room(T_world_sensor: Array, rng: np.random.Generator) -> Array:
    """A room of 9 by 7 m, at every half degree."""
    bearing = np.radians(np.arange(-135, 135, 0.5))
    heading = bearing + se2.angle(T_world_sensor)
    d = np.column_stack([np.cos(heading), np.sin(heading)])
    half = np.where(d > 0, 1, -1) * np.array([4.5, 3.5])
    r = np.min((half - T_world_sensor[:2, 2]) / d, axis=1) + rng.normal(size=len(d)) * 0.01
    return np.asarray(np.column_stack([np.cos(bearing), np.sin(bearing)]) * r[:, None])


def test_six_scanners_of_a_minute_take_two_seconds() -> None:
    rng = np.random.default_rng(8)
    walks = [wander(rng) for _ in range(3)]
    scanners = {f"s{i}": observe(walks, somewhere(rng), rng) for i in range(6)}
    begin = time.process_time()
    pairs = estimate_scanner_pairs(scanners, rng)
    assert len(pairs) == 15
    assert time.process_time() - begin < 4  # twice the aim, for busy machines


@pytest.mark.parametrize("feature", get_args(CenterFeature))
def test_a_real_pair_is_within_ten_centimetres_of_the_measured_pose(
    data_dir: Path, feature: CenterFeature, rng: np.random.Generator
) -> None:
    """One person walks by for six seconds; the only walls that both see are parallel to x."""
    scans: dict[str, list[LaserScan]] = {"/front_scan": [], "/rear_scan": []}
    with open_recording(data_dir / "two-static-2d-lidars-moving-object" / "scans_demo.bag") as recording:
        for record in recording.records(list(scans)):
            message = record.decode()
            assert isinstance(message, LaserScan)
            scans[record.topic].append(message)
    tracked = []
    for of_one in scans.values():
        tracks = track_scanner(
            of_one,
            People(kind="people"),
            RangeNoise(),
            centers=select_center_estimator(feature),
            settings=TrackingSettings(),
        )
        assert isinstance(tracks, ScannerTracks)
        tracked.append(tracks)
    found = estimate_scanner_pair("front", "rear", tracked[0], tracked[1], rng)
    assert error(found, se2.pose(np.pi, np.array([-0.474, 0.006]))) < (0.1, 1.5)


def test_centres_of_mass_nearer_than_true_centres_are_corrected(rng: np.random.Generator) -> None:
    walks = [wander(rng) for _ in range(2)]
    A, B = se2.pose(0.8, np.array([-3.0, -3.0])), se2.pose(2.3, np.array([3.0, -3.0]))
    a, b = (observe(walks, T, rng, near=0.15) for T in (A, B))
    found = estimate_scanner_pair("a", "b", a, b, rng, depth_stddev=0.2)
    assert error(found, se2.inverse(A) @ B) < (0.04, 1.0)


def test_matches_by_chance_are_those_at_other_times() -> None:
    # On a circle of 3 m a sample has a neighbour within R during the share 2 asin(R / 6) / pi of a turn.
    angle = np.arange(0, 10 * np.pi, STEP / 2)
    walk = (
        3 * np.column_stack([np.cos(angle), np.sin(angle)]),
        1.5 * np.column_stack([-np.sin(angle), np.cos(angle)]),
    )
    rng = np.random.default_rng(1)
    A, B = se2.pose(0.0, np.array([-4.5, 0])), se2.pose(np.pi / 2, np.array([0, -4.5]))
    pair = estimate_scanner_pair(
        "a", "b", observe([walk], A, rng, reach=9.0), observe([walk], B, rng, reach=9.0), rng
    )
    assert isinstance(pair, ScannerPairEstimate), pair
    (h,) = pair.hypotheses
    radius = np.sqrt(9.21 * (2 * SIGMA**2 + h.model_error**2))
    share = 1 - np.exp(-2 * np.arcsin(radius / 6) / np.pi)
    assert h.chance_observations == pytest.approx(share * h.observations, rel=0.15)


@pytest.mark.parametrize(
    ("step", "distinct"),
    [
        ((0.29, 0.39, 0.0), False), ((0.31, 0.41, 0.0), True), ((-0.6, 0.0, 0.0), True), ((0.0, 0.6, 0.0), True),
        ((0.0, 0.0, np.radians(7)), False), ((0.0, 0.0, np.radians(9)), True), ((0.3, 0.0, -np.radians(9)), True),
    ],
)  # fmt: skip
def test_hypotheses_are_distinct_beyond_half_a_metre_or_eight_degrees(
    step: tuple[float, float, float], distinct: bool
) -> None:
    best = se2.pose(3.1, np.array([2.0, -1.0]))
    T = np.array([se2.retract(best, np.array(step)), best])
    found = select_distinct(T, np.array([0.4, 0.3]), 5, 0.5, np.radians(8))
    np.testing.assert_array_equal(found, [1, 0] if distinct else [1])


def test_the_distinct_hypotheses_of_least_cost_are_kept() -> None:
    T = se2.pose(np.zeros(4), np.array([[0.0, 0], [1, 0], [2, 0], [3, 0]]))
    found = select_distinct(T, np.array([0.4, 0.1, 0.3, 0.2]), 2, 0.5, np.radians(8))
    np.testing.assert_array_equal(found, [1, 3])


def test_the_radius_of_matches_by_chance_contains_the_model_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The root of the gate times the deviation of a distance: 3 cm from each scanner, 7 cm from models."""
    radii: list[float] = []

    def count_none(x: Array, _T: Array, _samples: object, radius: float) -> Array:
        radii.append(radius)
        return np.zeros(len(x))

    monkeypatch.setattr(hypothesis_evidence, "_count_neighbours", count_none)
    pairs = observe_walks([walk_along_curve(5.0)], np.random.default_rng(0), stated_sigma=0.03)
    fit = TrackRegistration(T_A_B, np.zeros(3), np.arange(len(pairs)), 0.07)
    _count_by_chance(fit, pairs, pairs.b)
    assert radii == pytest.approx([np.sqrt(9.21 * (2 * 0.03**2 + 0.07**2))])


def with_matches(observations: int = 100, chance: float = 0.0, share: float = 1.0) -> PoseHypothesis:
    """With a model error that makes the weight of evidence of 100 matches as large as with the best tracks."""
    return PoseHypothesis(np.eye(3), np.eye(3), observations, chance, share, 0.0, 0.0, uses_background=False)


@pytest.mark.parametrize(("chance", "credible"), [(30.0, True), (40.0, False)])
def test_credible_matches_are_several_times_as_many_as_by_chance(
    chance: float, credible: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """100 matches, of which at most a third may be by chance."""
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence._MIN_CHANCE_RATIO", 3.0)
    assert is_credible(with_matches(chance=chance), 20) == credible


@pytest.mark.parametrize(("observations", "credible"), [(50, True), (49, False)])
def test_credible_matches_last_for_the_least_time(observations: int, credible: bool) -> None:
    assert is_credible(with_matches(observations), 50) == credible


@pytest.mark.parametrize(("share", "credible"), [(0.41, True), (0.39, False)])
def test_credible_matches_are_the_least_share_of_the_expected_ones(
    share: float, credible: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence.MIN_MATCHED_SHARE", 0.4)
    assert is_credible(with_matches(share=share), 20) == credible


@pytest.mark.parametrize(("min_samples", "left"), [(100, 100), (101, 1000)])
def test_pairs_are_subsampled_if_enough_samples_are_left(
    min_samples: int, left: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1000 simultaneous pairs of one person, of which a hundred are wanted."""
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence._MIN_SAMPLES", min_samples)
    walk = TrackSamples(
        np.arange(1000), np.zeros(1000, np.intp), np.zeros((1000, 2)), np.zeros((1000, 2)),
        np.tile(np.eye(2), (1000, 1, 1)),
    )  # fmt: skip
    assert len(subsample_pairs(pair_samples(walk, walk), 100)) == left


@pytest.mark.parametrize(("expected", "share"), [(20.0, 1.0), (160.0, 0.5)])
def test_the_matched_share_is_of_the_expected_matches_and_one_at_most(
    expected: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """80 matches at twice the interval of the ticks."""
    pairs = observe_walks([walk_along_curve(10.0)], np.random.default_rng(0))
    monkeypatch.setattr(hypothesis_evidence, "count_expected", lambda *_: expected)
    monkeypatch.setattr(hypothesis_evidence, "_count_by_chance", lambda *_: 10.0)
    fit = TrackRegistration(T_A_B, np.zeros(3), np.arange(80), 0.07)
    prior = NuisancePrior(0.1, 0.1)
    found = build_hypothesis(fit, pairs, pairs.a, pairs.b, 2 * len(pairs), prior)
    assert found.matched_share == share
    assert (found.observations, found.chance_observations) == (160, 20.0)


def test_a_pair_without_a_credible_pose_states_the_time_that_its_best_pose_matches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two minutes of tracks, of which the coarse stage takes every n-th tick."""
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence.MIN_WEIGHT_OF_EVIDENCE", 1e9)
    rng = np.random.default_rng(3)
    walks = [wander(rng, seconds=120)]
    A, B = somewhere(rng, 6.0), somewhere(rng, 6.0)
    found = estimate_scanner_pair("a", "b", observe(walks, A, rng), observe(walks, B, rng), rng)
    assert isinstance(found, Rejected)
    seconds = float(found.reason.split("the best one matches ")[1].split(" s")[0])
    assert 50 < seconds < 120


def test_a_couple_is_not_matched_crosswise(rng: np.random.Generator) -> None:
    """Scanners on opposite sides detect mostly the nearer one of two who walk side by side, half a metre apart."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        x, v = wander(rng, 40.0, 6.0)
        aside = 0.28 * np.column_stack([-v[:, 1], v[:, 0]]) / np.linalg.norm(v, axis=1, keepdims=True)
        left, right = (x + aside, v), (x - aside, v)
        A, B = se2.pose(0.0, np.array([-5.0, 0.0])), se2.pose(np.pi, np.array([5.0, 0.0]))
        a, b = observe([left, right], A, rng, sigma=0.01), observe([left, right], B, rng, sigma=0.01)
        # Each loses two of three tracks of the person who is farther away.
        found = estimate_scanner_pair("a", "b", keep_nearer(a, rng), keep_nearer(b, rng), rng)
        metres, degrees = error(found, se2.inverse(A) @ B)
        assert metres < 0.15
        assert degrees < 2


def keep_nearer(tracked: ScannerTracks, rng: np.random.Generator) -> ScannerTracks:
    """The scanner's tracks without two of three of those that another one hides."""
    kept = []
    for track in tracked.tracks:
        others = [
            float(np.linalg.norm(other.positions, axis=1).mean())
            for other in tracked.tracks
            if other is not track
            and min(other.times[-1], track.times[-1]) - max(other.times[0], track.times[0]) > 0.5
        ]
        hidden = any(distance < np.linalg.norm(track.positions, axis=1).mean() for distance in others)
        if not hidden or rng.random() < 1 / 3:
            kept.append(track)
    return replace(tracked, tracks=tuple(kept))
