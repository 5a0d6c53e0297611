"""Registration of simultaneous tracks: pose, clock offset, depths, correlation time, and weight of evidence."""

from dataclasses import replace

import numpy as np
import pytest

import track_pairs
from calgraph.geometry import Array, invert_2x2, se2
from calgraph.network.pairs.hypothesis_evidence import PoseHypothesis, propose_poses
from calgraph.network.pairs.synchronized_tracks import (
    SimultaneousPairs,
    TrackSamples,
    pair_samples,
    resample_tracks,
    to_ticks,
)
from calgraph.network.pairs.track_registration import (
    _MAX_LAG,
    _MIN_LAG_SHARE,
    _MIN_MODEL_ERROR,
    MAX_MODEL_ERROR,
    NuisancePrior,
    TrackRegistration,
    _associate,
    _mahalanobis2,
    compute_pose_costs,
    compute_registration_covariance,
    estimate_correlation_time,
    register_tracks,
    rigid_motion_covariance,
)
from calgraph.network.tracking.track import ScannerTracks, Track

NEAR_POSE = se2.retract(track_pairs.T_A_B, np.array([0.05, -0.04, 0.02]))
T_A_B = se2.pose(0.7, np.array([1.5, -0.8]))
PRIOR = NuisancePrior(0.01, 0.03)
TIGHT = NuisancePrior(1e-6, 1e-6)


def position(t: Array) -> Array:
    """A figure of eight of 4 by 2 m, frame a."""
    return np.column_stack([3 + 2 * np.sin(0.5 * t), 2 + np.sin(t)])


def velocity(t: Array) -> Array:
    return np.column_stack([np.cos(0.5 * t), np.cos(t)])


def samples(
    T_a_s: Array, ticks: Array, delay: float = 0.0, near: float = 0.0, sigma: float = 0.01
) -> TrackSamples:
    """Of a scanner whose clock is ahead by ``delay`` s, and that tracks people ``near`` m before their centres."""
    t = ticks * 0.1 - delay
    T = se2.inverse(T_a_s)
    x, v = se2.apply(T, position(t)), velocity(t) @ T[:2, :2].T
    x = x * (1 - near / np.linalg.norm(x, axis=1, keepdims=True))
    S = np.tile(sigma**2 * np.eye(2), (len(t), 1, 1))
    return TrackSamples(ticks.astype(np.intp), np.zeros(len(t), np.intp), x, v, S)


def simultaneous(delay: float = 0.0, near: float = 0.0, count: int = 300) -> SimultaneousPairs:
    ticks = np.arange(float(count))
    return pair_samples(samples(np.eye(3), ticks, 0.0, near), samples(T_A_B, ticks, delay, near))


def test_registration_finds_the_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.track_registration._STEPS", 6)
    start = se2.retract(T_A_B, np.array([0.1, -0.05, 0.05]))
    fit = register_tracks(start, simultaneous(), 0.15, PRIOR)
    assert fit is not None
    np.testing.assert_allclose(se2.difference(fit.T_a_b, T_A_B), 0, atol=1e-6)
    assert len(fit.matches) == 300
    assert fit.model_error == _MIN_MODEL_ERROR


def test_registration_estimates_the_clock_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.track_registration._STEPS", 10)
    fit = register_tracks(T_A_B, simultaneous(delay=0.02), 0.15, PRIOR)
    assert fit is not None
    assert fit.nuisance[0] == pytest.approx(0.02, rel=0.05)
    assert np.linalg.norm(fit.T_a_b[:2, 2] - T_A_B[:2, 2]) < 0.002


def test_registration_estimates_depths(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.track_registration._STEPS", 10)
    fit = register_tracks(T_A_B, simultaneous(near=0.05), 0.15, NuisancePrior(0.01, 0.2))
    assert fit is not None
    np.testing.assert_allclose(fit.nuisance[1:], 0.05, rtol=0.1)
    assert np.linalg.norm(fit.T_a_b[:2, 2] - T_A_B[:2, 2]) < 0.005


def test_model_error_is_what_covariances_do_not_explain(rng: np.random.Generator) -> None:
    # 5 cm of noise in either scanner, of which tracks state 1 cm.
    ticks = np.arange(2000.0)
    a, b = samples(np.eye(3), ticks), samples(T_A_B, ticks)
    a, b = (replace(s, positions=s.positions + rng.normal(0, 0.05, s.positions.shape)) for s in (a, b))
    fit = register_tracks(T_A_B, pair_samples(a, b), 0.15, PRIOR)
    assert fit is not None
    assert fit.model_error == pytest.approx(np.sqrt(2 * (0.05**2 - 0.01**2)), rel=0.05)


def test_too_few_matches_have_no_registration() -> None:
    assert register_tracks(T_A_B, simultaneous(count=3), 0.15, PRIOR) is None
    assert register_tracks(T_A_B, simultaneous(count=4), 0.15, PRIOR) is not None


def test_information_of_independent_errors_is_that_of_least_squares(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calgraph.network.pairs.track_registration._STEPS", 6)
    monkeypatch.setattr("calgraph.network.pairs.track_registration._SYSTEMATIC_STDDEV", 1e-6)
    monkeypatch.setattr("calgraph.network.pairs.track_registration._MIN_MODEL_ERROR", 1e-6)
    # Noise of 2 cm in a, known clocks and depths: x and y are means of matches that are correlated over 0.5 s.
    ticks = np.arange(3000.0)
    a, b = samples(np.eye(3), ticks, sigma=0.02), samples(T_A_B, ticks, sigma=1e-6)
    a = replace(a, positions=a.positions + rng.normal(0, 0.02, a.positions.shape))
    pairs = pair_samples(a, b)
    fit = register_tracks(T_A_B, pairs, 0.15, TIGHT)
    assert fit is not None
    covariance = compute_registration_covariance(fit, pairs, TIGHT)[:3, :3]
    arm = a.positions - T_A_B[:2, 2]
    J = np.zeros((len(ticks), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1
    J[:, :, 2] = np.column_stack([-arm[:, 1], arm[:, 0]])
    expected = 5 * 0.02**2 * np.linalg.inv(np.einsum("pki,pkj->ij", J, J))
    np.testing.assert_allclose(covariance, expected, rtol=0.15, atol=0.05 * expected.max())


def test_squared_mahalanobis_distances(rng: np.random.Generator) -> None:
    A, r = rng.normal(size=(7, 2, 2)), rng.normal(size=(7, 2))
    S = A @ np.swapaxes(A, 1, 2)
    W = invert_2x2(S)
    np.testing.assert_allclose(W, np.linalg.inv(S))
    np.testing.assert_allclose(_mahalanobis2(r, W), np.einsum("pi,pij,pj->p", r, W, r))


def test_distant_matches_have_the_weight_of_the_cauchy_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.track_registration._STEPS", 1)
    # A fifth of the positions is 0.3 m off: weights are 1 / (1 + d2 / 6) with d2 of the given model error.
    pairs = simultaneous(count=1000)
    b = replace(pairs.b, positions=pairs.b.positions.copy())
    b.positions[::5] += np.array([0.3, 0.0]) @ T_A_B[:2, :2]
    fit = register_tracks(T_A_B, pair_samples(pairs.a, b), 0.15, TIGHT)
    assert fit is not None
    weight = 1 / (1 + 0.09 / (0.15**2 + 2 * 0.01**2) / 6)
    expected = [-0.3 * 0.2 * weight / (0.8 + 0.2 * weight), 0.0, 0.0]
    np.testing.assert_allclose(se2.difference(fit.T_a_b, T_A_B), expected, atol=2e-3)


def test_combinations_of_trajectories_have_different_numbers() -> None:
    ticks = np.zeros(2, np.intp)
    covariances = np.tile(np.eye(2), (2, 1, 1))
    two = TrackSamples(ticks, np.arange(2), np.ones((2, 2)), np.ones((2, 2)), covariances)
    assert len(set(pair_samples(two, two).trajectories.tolist())) == 4


def test_costs_are_truncated_squared_distances_over_the_gate() -> None:
    pairs = simultaneous()
    poses = np.array([T_A_B, se2.retract(T_A_B, np.array([0.1, 0, 0])), se2.retract(T_A_B, np.array([9.0, 0, 0]))])
    variance = 2 * 0.01**2 + 0.15**2
    np.testing.assert_allclose(
        compute_pose_costs(poses, pairs, 0.15), [0, 0.01 / (9.21 * variance), 1], atol=1e-12
    )


@pytest.mark.parametrize(("correlation", "expected"), [(0.0, 1.0), (0.8, 9.0)])
@pytest.mark.parametrize("step", [1, 4])
def test_correlation_time_of_an_autoregressive_process(correlation: float, expected: float, step: int) -> None:
    # Integrated autocorrelation time of an AR(1) process: (1 + c) / (1 - c).
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(20_000, 2))
    r = np.zeros_like(noise)
    for k in range(1, len(r)):
        r[k] = correlation * r[k - 1] + noise[k]
    ticks = step * np.tile(np.arange(2000), 10)
    found = estimate_correlation_time(r, np.repeat(np.arange(10), 2000), ticks, _MIN_LAG_SHARE, _MAX_LAG)
    assert found == pytest.approx(expected, rel=0.2)


def test_correlation_time_does_not_reach_across_series() -> None:
    # Every series is constant: correlated within, independent of the others.
    r = np.repeat(np.random.default_rng(3).normal(size=(400, 2)), 2, axis=0)
    found = estimate_correlation_time(
        r, np.repeat(np.arange(400), 2), np.tile([0, 1], 400), _MIN_LAG_SHARE, _MAX_LAG
    )
    assert found == pytest.approx(3.0, rel=0.1)


def test_covariance_of_a_rigid_motion_about_a_centre() -> None:
    # A turn by phi about (2, 0) moves the origin by -2 phi along y.
    C = rigid_motion_covariance(np.eye(3), np.array([2.0, 0.0]), 0.01, 0.1)
    np.testing.assert_allclose(C, [[1e-4, 0, 0], [0, 1e-4 + 0.04, -0.02], [0, -0.02, 0.01]], atol=1e-15)


@pytest.mark.parametrize(
    ("share", "error", "expected"), [(1.0, 0.0, 270.805), (0.5, 0.0, 135.403), (1.0, 0.15, 0.0)]
)
def test_weight_of_evidence_is_a_log_likelihood_ratio(share: float, error: float, expected: float) -> None:
    h = PoseHypothesis(np.eye(3), np.eye(3), 100, 0.0, share, 0.1, error, uses_background=False)
    found = h.weight_of_evidence()
    assert found == pytest.approx(expected, abs=0.3)
    assert h.observations * h.matched_share == 100 * share


def test_the_first_proposal_is_the_pose() -> None:
    poses = propose_poses(simultaneous(), np.random.default_rng(0))
    np.testing.assert_allclose(se2.difference(poses[0], T_A_B), 0, atol=1e-9)


def test_proposals_are_limited_to_the_best_and_a_random_selection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.hypothesis_evidence.MAX_RMS", 1.0)
    ticks = np.arange(300.0)
    several = [replace(samples(np.eye(3), ticks + 37 * k), tick=ticks.astype(np.intp)) for k in range(6)]
    merged = TrackSamples(
        np.tile(ticks.astype(np.intp), 6), np.repeat(np.arange(6), 300),
        np.concatenate([s.positions for s in several]), np.concatenate([s.velocities for s in several]),
        np.concatenate([s.covariances for s in several]),
    )  # fmt: skip
    order = np.argsort(merged.tick, kind="stable")
    names = ("tick", "trajectory", "positions", "velocities", "covariances")
    merged = replace(merged, **{name: getattr(merged, name)[order] for name in names})
    pairs = pair_samples(merged, merged)
    everything = propose_poses(pairs, np.random.default_rng(0))
    limited = propose_poses(pairs, np.random.default_rng(0), max_count=20)
    assert len(everything) > 40
    np.testing.assert_allclose(se2.difference(everything[0], np.eye(3)), 0, atol=1e-9)
    assert len(limited) == 20
    np.testing.assert_array_equal(limited[:10], everything[:10])


@pytest.mark.parametrize(("extent", "usable"), [(0.14, False), (0.16, True)])
def test_short_trajectories_propose_no_pose(extent: float, usable: bool) -> None:
    # On a straight line of uniform positions the standard deviation is length / sqrt(12).
    ticks = np.arange(20)
    x = np.column_stack([np.linspace(0, extent * np.sqrt(12), 20), np.zeros(20)])
    S = np.tile(1e-4 * np.eye(2), (20, 1, 1))
    line = TrackSamples(ticks, np.zeros(20, np.intp), x + np.array([2, 0]), np.ones((20, 2)), S)
    assert (len(propose_poses(pair_samples(line, line), np.random.default_rng(0))) > 0) == usable


def track(times: Array, sigma: float = 0.01, period: int = 0) -> Track:
    S = np.tile(sigma**2 * np.eye(2), (len(times), 1, 1))
    return Track(times, position(times), velocity(times), S, period=period)


def test_tracks_are_interpolated_at_the_ticks() -> None:
    tracked = ScannerTracks((track(np.arange(0.03, 6.0, 0.08)),), np.zeros((0, 2)), 0.01)
    found = resample_tracks(tracked)
    assert found.tick.tolist() == list(range(1, 60))
    np.testing.assert_allclose(found.positions, position(found.times), atol=1e-6)
    np.testing.assert_allclose(found.velocities, velocity(found.times), atol=1e-3)
    np.testing.assert_allclose(np.sqrt(found.covariances[:, 0, 0]), 0.01, rtol=0.02)
    np.testing.assert_allclose(found.covariances[:, 0, 1], 0, atol=1e-12)


def test_acceleration_adds_variance_in_the_middle_of_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("calgraph.network.pairs.synchronized_tracks._ACCELERATION", 1.0)
    # h = 0.4 s: a * (u (1 - u) h)^2 with u = 0.5 is 1 cm for 1 m/s^2.
    one = track(np.array([0.0, 0.4, 0.8]))
    one = replace(one, covariances=one.covariances * np.array([1.0, 5.0, 9.0])[:, None, None])
    tracked = ScannerTracks((one,), np.zeros((0, 2)), 0.01)
    found = resample_tracks(tracked)
    assert found.tick.tolist() == list(range(9))
    # Linear between the neighbours, 1, 5 and 9 times 1 cm^2, plus (4 u (1 - u))^4 cm^2.
    expected = [1, 2 + 0.75**4, 3 + 1, 4 + 0.75**4, 5, 6 + 0.75**4, 7 + 1, 8 + 0.75**4, 9]
    np.testing.assert_allclose(found.covariances[:, 0, 0], 1e-4 * np.array(expected), rtol=1e-9)


@pytest.mark.parametrize(("gap", "bridged"), [(0.45, True), (0.55, False)])
def test_long_gaps_are_not_interpolated(gap: float, bridged: bool) -> None:
    times = np.concatenate([np.arange(0, 1.01, 0.1), 1.0 + gap + np.arange(0, 1.01, 0.1)])
    found = resample_tracks(ScannerTracks((track(times),), np.zeros((0, 2)), 0.01))
    assert (12 in found.tick.tolist()) == bridged


@pytest.mark.parametrize(("gap", "trajectories"), [(0.3, 1), (0.7, 1), (0.9, 2)])
def test_tracks_of_successive_periods_are_joined(gap: float, trajectories: int) -> None:
    tracks = track(np.arange(0, 2.01, 0.1)), track(2.0 + gap + np.arange(0, 2.01, 0.1), period=1)
    found = resample_tracks(ScannerTracks(tracks, np.zeros((0, 2)), 0.01))
    assert len(np.unique(found.trajectory)) == trajectories


def test_tracks_at_other_places_are_not_joined() -> None:
    first, second = track(np.arange(0, 2.01, 0.1)), track(2.3 + np.arange(0, 2.01, 0.1), period=1)
    apart = replace(second, positions=second.positions + np.array([0.6, 0.0]))
    found = resample_tracks(ScannerTracks((first, apart), np.zeros((0, 2)), 0.01))
    assert len(np.unique(found.trajectory)) == 2


def test_durations_are_rounded_to_ticks() -> None:
    assert [to_ticks(s) for s in (0.6, 2.0, 8.0, 0.04)] == [6, 20, 80, 0]


def register_walks(pairs: SimultaneousPairs, prior: NuisancePrior = PRIOR) -> TrackRegistration:
    fit = register_tracks(NEAR_POSE, pairs, MAX_MODEL_ERROR, prior)
    assert fit is not None
    return fit


def test_matches_are_mutual_nearest_neighbours(rng: np.random.Generator) -> None:
    """Two people in 10 s are 100 samples each, and 400 pairs of simultaneous samples: the right ones match."""
    pairs = track_pairs.observe_walks(
        [track_pairs.walk_along_curve(10.0, number) for number in (0, 1)], rng, sigma=0.01
    )
    fit = register_walks(pairs)
    same = pairs.a.trajectory[pairs.row_a[fit.matches]] == pairs.b.trajectory[pairs.row_b[fit.matches]]
    assert same.mean() > 0.98
    assert len(fit.matches) > 196


@pytest.mark.parametrize("sigma", [0.03, 0.1])
def test_model_error_is_what_the_covariances_do_not_explain(
    rng: np.random.Generator, sigma: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both scanners' noise, less the variance 2 x 0.01² m² that the tracks state."""
    monkeypatch.setattr("calgraph.network.pairs.track_registration.MAX_MODEL_ERROR", 0.5)
    pairs = track_pairs.observe_walks(
        [track_pairs.walk_along_curve(100.0)], rng, sigma=sigma / np.sqrt(2), stated_sigma=0.01
    )
    expected = np.sqrt(sigma**2 - 2 * 0.01**2)
    assert register_walks(pairs).model_error == pytest.approx(expected, rel=0.1)


def test_model_error_is_limited(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    walks = [track_pairs.walk_along_curve(100.0)]
    assert register_walks(track_pairs.observe_walks(walks, rng)).model_error == 0.005
    monkeypatch.setattr("calgraph.network.pairs.track_registration.GATE", 50.0)
    assert register_walks(track_pairs.observe_walks(walks, rng, sigma=0.2)).model_error == 0.15


def test_a_cost_takes_the_nearest_of_simultaneous_samples(rng: np.random.Generator) -> None:
    pairs = track_pairs.observe_walks([track_pairs.walk_along_curve(10.0, number) for number in range(3)], rng)
    assert compute_pose_costs(track_pairs.T_A_B[None], pairs, 0.15) == pytest.approx([0.0], abs=1e-9)


def test_registration_information_matches_the_scatter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean of a chi-squared with three degrees of freedom: white noise, and nuisances drawn from their priors."""
    monkeypatch.setattr("calgraph.network.pairs.track_registration._SYSTEMATIC_STDDEV", 1e-6)
    monkeypatch.setattr("calgraph.network.pairs.track_registration._MIN_CORRELATION_TIME", 0.1)
    monkeypatch.setattr("calgraph.network.pairs.track_registration._MIN_MODEL_ERROR", 0.001)
    monkeypatch.setattr("calgraph.network.pairs.track_registration._CAUCHY_SCALE2", 1e6)
    monkeypatch.setattr("calgraph.network.pairs.track_registration.GATE", 50.0)
    squared = []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        clock_offset, *depths = rng.normal(size=3) * [0.01, 0.03, 0.03]
        pairs = track_pairs.observe_walks(
            [track_pairs.walk_along_curve(20.0)], rng, sigma=0.01, stated_sigma=0.01, clock_offset=clock_offset,
            depths=(depths[0], depths[1]),
        )  # fmt: skip
        fit = register_walks(pairs)
        d = se2.difference(fit.T_a_b, track_pairs.T_A_B)
        squared.append(float(d @ np.linalg.solve(compute_registration_covariance(fit, pairs, PRIOR)[:3, :3], d)))
    assert np.mean(squared) == pytest.approx(3.0, abs=0.6)  # 3 standard deviations


def test_systematic_errors_bound_the_information(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of exact tracks with wide extent: 8 mm of either coordinate of their centre, and 8 mm over the extent."""
    monkeypatch.setattr("calgraph.network.pairs.track_registration._MIN_MODEL_ERROR", 1e-4)
    pairs = track_pairs.observe_walks([track_pairs.walk_along_curve(100.0)], rng, stated_sigma=1e-4)
    fit = register_walks(pairs, TIGHT)
    covariance = compute_registration_covariance(fit, pairs, TIGHT)[:3, :3]
    x = pairs.x_a[fit.matches]
    center, extent = x.mean(axis=0), np.sqrt(np.sum(np.var(x, axis=0)))
    assert np.sqrt(covariance[2, 2]) == pytest.approx(0.008 / extent, rel=0.01)
    to_center = np.eye(3)
    to_center[:2, 2] = track_pairs.T_A_B[1, 2] - center[1], center[0] - track_pairs.T_A_B[0, 2]
    at_center = to_center @ covariance @ to_center.T
    np.testing.assert_allclose(np.sqrt(np.diag(at_center)[:2]), 0.008, rtol=0.01)


def test_alternating_residuals_have_a_correlation_time_of_one_step() -> None:
    r: Array = np.tile([1.0, -1.0], 100)[:, None]
    assert estimate_correlation_time(r, np.zeros(200, dtype=np.intp), np.arange(200), 0.1, 100) == 1.0


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_priors_of_clock_and_depths_bound_the_information_of_a_straight_walk(
    rng: np.random.Generator, speed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Along the walk 10 ms of clock offset are not distinct from 10 ms times the speed."""
    monkeypatch.setattr("calgraph.network.pairs.track_registration._MIN_MODEL_ERROR", 1e-4)
    y = np.linspace(-2, 2, 81)
    walk = np.column_stack([np.full(81, 4.0), y]), np.tile([0.0, speed], (81, 1))
    pairs = track_pairs.observe_walks([walk], rng, stated_sigma=1e-4)
    prior = NuisancePrior(0.01, 1e-6)
    fit = register_walks(pairs, prior)
    covariance = compute_registration_covariance(fit, pairs, prior)[:3, :3]
    at_walk = np.eye(3)
    at_walk[1, 2] = 4.0 - track_pairs.T_A_B[0, 2]
    assert np.sqrt((at_walk @ covariance @ at_walk.T)[1, 1]) == pytest.approx(
        np.hypot(0.01 * speed, 0.008), rel=0.02
    )


def test_a_track_of_one_position_has_no_samples() -> None:
    x = np.array([[1.0, 2.0]])
    single = Track(np.array([0.5]), x, x, np.eye(2)[None], period=0)
    found = resample_tracks(ScannerTracks((single,), np.zeros((0, 2)), 0.01))
    shapes = [found.tick.shape, found.positions.shape, found.velocities.shape, found.covariances.shape]
    assert shapes == [(0,), (0, 2), (0, 2), (0, 2, 2)]


@pytest.mark.parametrize("turning", [0, 1])
def test_joined_tracks_continue_with_the_velocities_at_the_gap(turning: int) -> None:
    """At 1 m/s along x before and after a gap of 0.7 s; at 3 m/s along -x at the other end of a track."""
    along = np.column_stack([np.arange(0, 2.71, 0.1), np.zeros(28)])
    tracks = []
    for k, rows in enumerate((slice(0, 11), slice(17, 28))):
        v = np.tile([1.0, 0.0], (11, 1))
        if k == turning:
            v[-k] = [-3.0, 0.0]
        tracks.append(Track(along[rows, 0], along[rows], v, np.tile(1e-4 * np.eye(2), (11, 1, 1)), period=k))
    found = resample_tracks(ScannerTracks(tuple(tracks), np.zeros((0, 2)), 0.01))
    assert len(np.unique(found.trajectory)) == 1


def test_of_two_tracks_one_continues_another() -> None:
    """Two tracks begin where one could lead: the nearer one continues it, the other is a new trajectory."""
    first, near = track(np.arange(0, 2.01, 0.1)), track(2.3 + np.arange(0, 2.01, 0.1), period=1)
    beside = replace(near, positions=near.positions + np.array([0.2, 0.0]))
    found = resample_tracks(ScannerTracks((first, beside, near), np.zeros((0, 2)), 0.01))
    at_end = found.positions[found.tick == 40]
    joined = found.trajectory[found.tick == 40][np.argmin(np.abs(at_end - position(np.array([4.0]))).sum(axis=1))]
    assert set(found.trajectory[found.tick == 10].tolist()) == {int(joined)}
    assert len(np.unique(found.trajectory)) == 2


@pytest.mark.parametrize(("before", "after"), [(3.0, 0.0), (0.0, 3.0)])
def test_a_track_is_predicted_with_the_mean_velocity_over_the_gap(before: float, after: float) -> None:
    """A gap of 0.7 s at a mean of 1.5 m/s, between tracks at rest or at 3 m/s along x."""
    times, tracks = np.arange(0, 1.01, 0.1), []
    for k, speed in enumerate((before, after)):
        x = np.column_stack([(times - 1) * speed if k == 0 else 1.05 + times * speed, np.zeros(11)])
        v = np.tile([speed, 0.0], (11, 1))
        tracks.append(Track(times + 1.7 * k, x, v, np.tile(1e-4 * np.eye(2), (11, 1, 1)), period=k))
    found = resample_tracks(ScannerTracks(tuple(tracks), np.zeros((0, 2)), 0.01))
    assert len(np.unique(found.trajectory)) == 1


def samples_at_one_tick(x: list[float], covariances: list[Array]) -> TrackSamples:
    """Samples on the x axis."""
    n = len(x)
    zeros = np.zeros(n, dtype=np.intp)
    return TrackSamples(
        zeros, np.arange(n), np.column_stack([x, np.zeros(n)]), np.zeros((n, 2)), np.array(covariances)
    )


def test_the_nearest_neighbour_is_that_of_least_standard_deviations() -> None:
    """0.10 m with a variance of 1e-4 m², or 0.14 m with 0.04 m²; 0.0025 m² of model error add to both."""
    a = samples_at_one_tick([2.0], [1e-9 * np.eye(2)])
    b = samples_at_one_tick([2.1, 2.14], [1e-4 * np.eye(2), 0.04 * np.eye(2)])
    pairs = pair_samples(a, b)
    rows, d2 = _associate(np.eye(3), np.zeros(3), pairs, 0.05)
    assert pairs.row_b[rows].tolist() == [1]
    np.testing.assert_allclose(d2, [0.14**2 / 0.0425], rtol=1e-6)


def test_matches_along_the_larger_variance_are_within_the_gate() -> None:
    """2.5 standard deviations of 0.2 m along x; across, 1 mm: 3.5 of the mean variance."""
    a = samples_at_one_tick([2.0], [1e-9 * np.eye(2)])
    pairs = pair_samples(a, samples_at_one_tick([2.5], [np.diag([0.04, 1e-6])]))
    assert len(_associate(np.eye(3), np.zeros(3), pairs, 1e-3)[0]) == 1


def test_the_prior_is_of_clock_and_depths_and_not_of_the_pose() -> None:
    prior = NuisancePrior(0.02, 0.1, clock_mean=0.3)
    np.testing.assert_allclose(prior.information, [0, 0, 0, 2500, 100, 100])
    np.testing.assert_array_equal(prior.mean, [0, 0, 0, 0.3, 0, 0])


def test_a_clock_that_is_not_observable_keeps_its_prior(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One person on a straight line at a steady speed: an offset of the clock is one of the pose."""
    monkeypatch.setattr("calgraph.network.pairs.track_registration._MIN_MODEL_ERROR", 1e-4)
    monkeypatch.setattr("calgraph.network.pairs.track_registration._STEPS", 6)
    y = np.linspace(-2, 2, 81)
    walk = np.column_stack([np.full(81, 4.0), y]), np.tile([0.0, 0.5], (81, 1))
    pairs = track_pairs.observe_walks([walk], rng, stated_sigma=1e-4)
    prior = NuisancePrior(0.05, 1e-6, clock_mean=0.02)
    fit = register_walks(pairs, prior)
    covariance = compute_registration_covariance(fit, pairs, prior)
    assert fit.nuisance[0] == pytest.approx(0.02, abs=1e-3)
    assert np.sqrt(covariance[3, 3]) == pytest.approx(0.05, rel=0.01)


def test_a_track_of_one_position_adds_no_samples_to_those_of_others() -> None:
    t = np.arange(0.0, 3.0, 0.07)
    walk = Track(t, position(t), velocity(t), np.linspace(0.01, 0.02, len(t))[:, None, None] * np.eye(2), 0)
    one = Track(np.array([-50.0]), np.ones((1, 2)), np.zeros((1, 2)), np.eye(2)[None], 1)
    alone = resample_tracks(ScannerTracks((walk,), np.zeros((0, 2)), 0.01))
    both = resample_tracks(ScannerTracks((walk, one), np.zeros((0, 2)), 0.01))
    for name in ("tick", "positions", "velocities", "covariances"):
        np.testing.assert_array_equal(getattr(both, name), getattr(alone, name))
