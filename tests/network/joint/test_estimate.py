"""The joint solution of networks: accuracy of poses and clocks, covariances, and cases without data."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from calgraph.config import Cylinder, People
from calgraph.config.settings import NetworkEstimationSettings
from calgraph.geometry import Array, se2
from calgraph.graph.pose_graph import PoseGraph, PoseGraphSolution
from calgraph.network.joint import body_batches
from calgraph.network.joint.ellipses import EllipseObservations
from calgraph.network.joint.estimate import (
    _CYLINDER_RADIUS_SIGMA,
    _PEOPLE_RADII_SIGMA,
    NetworkSolution,
    _build_observations,
    _initialize_path,
    collect_scans,
    select_bridges,
    solve_network,
)
from calgraph.network.joint.problem import BodyPath, BodyScans, NetworkProblem, WallConstraint
from calgraph.network.joint.scanner_unknowns import SYSTEMATIC_ERRORS
from calgraph.network.joint.splines import Knots, evaluate_spline
from calgraph.network.joint.track_association import BodyTracks
from calgraph.network.tracking.track import Hits, ScannerTracks, Track
from calgraph.parallel.engine import Processes
from dense_covariances import relate_all
from network_scenes import DENSITY, OFFSET, SETTINGS, SIGMA, T_ROOT, build_track, meet_ellipses, simulate_scans

PEOPLE, ROUND = People(kind="people", axes=(0.25, 0.15)), Cylinder(kind="cylinder", diameter=0.5)
SECONDS = 12.0
NOTHING = np.zeros((0, 2))
ONE = np.ones(1)


def simulate_walk(radii: tuple[float, float], phase: float) -> tuple[Knots, BodyPath]:
    """A person on a curve between the scanners, facing along the direction of motion."""
    knots = Knots.spanning(-0.5, SECONDS + 0.5, 0.2)
    t = 0.9 * knots.control_times() + phase
    path = np.column_stack([3 + 1.4 * np.sin(t), 2.2 + 0.9 * np.sin(1.5 * t + 0.4)])
    slope = np.column_stack([1.4 * np.cos(t), 1.35 * np.cos(1.5 * t + 0.4)])
    return knots, BodyPath(
        np.column_stack([path, np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))]), np.array(radii)
    )


def add_arms(scans: BodyScans, knots: Knots, path: BodyPath, swing: float, rng: np.random.Generator) -> BodyScans:
    """The scans with arms in front of the torso, which swing by ``swing``, m, forward and back."""
    at = np.repeat(scans.times - OFFSET[scans.scanner], np.diff(scans.first_beam, append=len(scans.ranges)))
    pose = evaluate_spline(path.control, *knots.basis_at(at)[:2])
    ahead = np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
    left = ahead[:, ::-1] * [-1, 1]
    T = T_ROOT[scans.scanner]
    direction, forth = scans.direction @ T[:2, :2].T, swing * np.sin(2 * np.pi * 0.9 * at)[:, None]
    ranges = scans.ranges
    for side in (1, -1):
        arm = pose[:, :2] + side * (path.shape[0] * left + forth * ahead)
        origin, radii = (np.broadcast_to(x, direction.shape) for x in (T[:2, 2], np.array([0.045, 0.06])))
        hit = meet_ellipses(origin, direction, arm, pose[:, 2], radii).ranges
        ranges = np.fmin(ranges, hit + rng.normal(0, SIGMA, len(hit)))
    return replace(scans, ranges=ranges)


def scene(
    seed: int,
    radii: tuple[float, float] = (0.25, 0.15),
    bodies: int = 2,
    scanners: tuple[int, ...] = (0, 1, 2),
    swing: float | None = None,
) -> tuple[list[ScannerTracks], PoseGraphSolution, PoseGraph]:
    """Tracks of scanners, exact pairs, and start poses with errors of 3 cm and half a degree."""
    rng = np.random.default_rng(seed)
    walks = [simulate_walk(radii, 2.0 * k + rng.uniform(0, 6)) for k in range(bodies)]
    tracked = []
    for s in range(3):
        times = np.arange(0.05 + 0.013 * s, SECONDS, 0.08)
        here = walks if s in scanners else []
        scans = [simulate_scans(s, *w, times, rng) for w in here]
        if swing is not None:
            scans = [add_arms(one, *w, swing, rng) for one, w in zip(scans, here, strict=True)]
        tracks = [build_track(one, *w, rng) for one, w in zip(scans, here, strict=True)]
        tracked.append(ScannerTracks(tuple(tracks), NOTHING, SIGMA))
    edges = np.array([[0, 1], [0, 2], [1, 2]])
    T = se2.inverse(T_ROOT[edges[:, 0]]) @ T_ROOT[edges[:, 1]]
    graph = PoseGraph(3, edges, T, np.tile(np.diag([1e4, 1e4, 1e5]), (3, 1, 1)))
    start = se2.retract(T_ROOT, rng.normal(0, [0.03, 0.03, 0.01], (3, 3)) * [[0], [1], [1]])
    return tracked, PoseGraphSolution(start, np.ones(3, dtype=np.bool_)), graph


def shift_hits(track: Track) -> Track:
    """The track with beams that end one metre behind its positions."""
    points = track.hits.points
    beyond = points + points / np.linalg.norm(points, axis=1, keepdims=True)
    return replace(track, hits=replace(track.hits, points=beyond))


def compute_errors(solution: NetworkSolution) -> Array:
    """(2, 3) pose errors of all scanners but the root."""
    return np.asarray(se2.difference(solution.T_root_scanner[1:], T_ROOT[1:]))


@pytest.fixture(scope="module")
def solved() -> list[NetworkSolution]:
    """Solutions of several recordings."""
    return [solve_network(PEOPLE, *scene(seed), settings=NetworkEstimationSettings()) for seed in range(6)]


def test_poses_are_accurate_to_a_few_millimetres(solved: list[NetworkSolution]) -> None:
    rms = np.sqrt(np.mean(np.concatenate([compute_errors(solution) for solution in solved]) ** 2, axis=0))
    # Start poses have errors of 30 mm and 10 mrad.
    assert (rms[:2].max() < 0.0035, rms[2] < 0.001) == (True, True)


def test_clock_offsets_are_accurate_to_two_milliseconds(solved: list[NetworkSolution]) -> None:
    np.testing.assert_allclose([solution.clock_offset for solution in solved], np.tile(OFFSET, (6, 1)), atol=0.002)


def test_covariances_are_consistent_with_the_errors(solved: list[NetworkSolution]) -> None:
    kept = [4, 5, 6, 8, 9, 10]
    squared = [
        compute_errors(solution).ravel()
        @ np.linalg.solve(solution.covariance.expand()[np.ix_(kept, kept)], compute_errors(solution).ravel())
        for solution in solved
    ]
    # 99.9 % of chi squared with 36 degrees of freedom, widened by the uncertainty of noise and model error.
    low, high = chi2.ppf([0.0005, 0.9995], 36)
    assert 0.6 * low < np.sum(squared) < 1.4 * high


def model_error(solution: NetworkSolution) -> float:
    """Standard deviation of the position of bodies in a scan about their smooth path, m."""
    assert solution.solved
    return float(np.sqrt(solution.solved.network.model_error_variance[0]))


def test_exact_bodies_have_a_model_error_below_a_millimetre(solved: list[NetworkSolution]) -> None:
    assert max(map(model_error, solved)) < 0.001


def test_clock_standard_deviations_are_those_of_the_covariance() -> None:
    sigma = np.arange(12.0)
    solution = NetworkSolution(T_ROOT, OFFSET, relate_all(np.diag(sigma**2), 3))
    np.testing.assert_array_equal(solution.clocks[1:], np.column_stack([OFFSET, sigma[3::4]])[1:])
    assert np.isnan(solution.clocks[0]).all()
    np.testing.assert_array_equal(np.diag(solution.pose_covariance), np.square([0, 0, 0, 4, 5, 6, 8, 9, 10]))


@pytest.mark.parametrize("factor", [0.75, 1.3])
def test_radii_other_than_the_prior_mean_do_not_bias_poses(factor: float) -> None:
    radii = (0.25 * factor, 0.15 * factor)
    error = np.concatenate(
        [
            compute_errors(solve_network(PEOPLE, *scene(seed, radii), settings=NetworkEstimationSettings()))
            for seed in range(2)
        ]
    )
    # For the largest people, 3 mm are expected from these beams; 5.5 mm is the 99.9th percentile of eight numbers.
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.0055


def test_swinging_arms_do_not_bias_poses() -> None:
    error = np.concatenate(
        [
            compute_errors(solve_network(PEOPLE, *scene(seed, swing=0.15), settings=NetworkEstimationSettings()))
            for seed in range(3)
        ]
    )
    # Taken for torsos, arms shift scanners by 5 mm; errors without arms are 2 mm.
    assert np.sqrt(np.mean(error[:, :2] ** 2)) < 0.0042


def test_one_cylinder_suffices() -> None:
    error = compute_errors(
        solve_network(ROUND, *scene(1, (0.25, 0.25), bodies=1), settings=NetworkEstimationSettings())
    )
    assert np.abs(error[:, :2]).max() < 0.006


def test_one_person_suffices() -> None:
    error = compute_errors(solve_network(PEOPLE, *scene(2, bodies=1), settings=NetworkEstimationSettings()))
    assert np.abs(error[:, :2]).max() < 0.008


def test_a_scanner_without_tracks_gets_its_pose_from_its_pairs() -> None:
    error = compute_errors(solve_network(PEOPLE, *scene(3, scanners=(0, 1)), settings=NetworkEstimationSettings()))
    assert np.abs(error[1]).max() < 0.01


def test_a_scanner_with_outlier_beams_only_gets_its_pose_from_its_pairs() -> None:
    tracked, averaged, graph = scene(3)
    outliers = replace(tracked[2], tracks=tuple(shift_hits(track) for track in tracked[2].tracks))
    error = compute_errors(
        solve_network(PEOPLE, [*tracked[:2], outliers], averaged, graph, settings=NetworkEstimationSettings())
    )
    assert np.abs(error[1]).max() < 0.01


def test_without_common_bodies_poses_follow_from_pairs() -> None:
    error = compute_errors(solve_network(PEOPLE, *scene(4, scanners=(1,)), settings=NetworkEstimationSettings()))
    assert np.abs(error).max() < 1e-6


def test_the_root_has_no_covariance() -> None:
    solution = solve_network(PEOPLE, *scene(6, bodies=1), settings=NetworkEstimationSettings())
    np.testing.assert_array_equal(solution.covariance.expand()[:4], 0.0)


def test_scans_of_overlapping_tracks_are_sorted_with_their_beams() -> None:
    # Two scans each; the second track begins before the first one ends. Scans have 2, 1, 1 and 2 beams.
    first = Hits(np.array([[3.0, 4.0], [0.0, 2.0], [0.0, 1.0]]), np.array([0.98, 1.02, 1.2]), np.array([0, 0, 1]))
    second = Hits(np.array([[5.0, 0.0], [8.0, 6.0], [0.0, 7.0]]), np.array([1.1, 1.29, 1.31]), np.array([0, 1, 1]))
    positions, covariances = np.zeros((2, 2)), np.zeros((2, 2, 2))
    tracks = [
        Track(np.array(times), positions, positions, covariances, 0, hits)
        for times, hits in (([1.0, 1.2], first), ([1.1, 1.3], second))
    ]
    scans = collect_scans(2, tracks)
    np.testing.assert_array_equal(scans.times, [1.0, 1.1, 1.2, 1.3])
    np.testing.assert_array_equal(scans.first_beam, [0, 2, 3, 4])
    np.testing.assert_allclose(scans.ranges, [5.0, 2.0, 5.0, 1.0, 10.0, 7.0])
    np.testing.assert_allclose(scans.direction[[0, 2, 4]], [[0.6, 0.8], [1.0, 0.0], [0.8, 0.6]])
    np.testing.assert_allclose(scans.beam_delay, [-0.02, 0.02, 0.0, 0.0, -0.01, 0.01], atol=1e-12)


def constraint(a: int, b: int) -> WallConstraint:
    return WallConstraint(a, b, np.eye(3), np.eye(3))


def test_only_edges_between_unconnected_parts_are_bridges() -> None:
    def scans(scanner: int, weight: float) -> BodyScans:
        return BodyScans(scanner, ONE, np.zeros(1, dtype=np.intp), np.ones((1, 2)), ONE, ONE, weight * ONE)

    # Scanners 0 and 1 measured one body, 1 and 2 only outliers on another one; 3 and 4 share walls.
    knots = Knots.spanning(0.0, 1.0, 0.2)
    bodies = tuple(
        EllipseObservations(knots, (scans(a, weight), scans(b, weight)), np.ones(2), np.ones(2), True)
        for a, b, weight in ((0, 1, 1.0), (1, 2, 0.0))
    )
    network = NetworkProblem(
        5, bodies, (), np.ones(5), np.ones(2), np.zeros((5, len(SYSTEMATIC_ERRORS))), 0.0, DENSITY, SETTINGS
    )
    edges = [constraint(*pair) for pair in ((0, 1), (1, 2), (2, 3), (3, 4))]
    bridges = select_bridges(network, [constraint(3, 4)], edges)
    assert [(one.a, one.b) for one in bridges] == [(1, 2), (2, 3)]


def test_a_clock_offset_of_130_ms_is_found() -> None:
    """Of people who keep apart: those of seed 0 walk 0.26 m behind each other, less than the late one is off."""
    tracked, averaged, graph = scene(1)
    late = tuple(
        replace(track, times=track.times + 0.1, hits=replace(track.hits, times=track.hits.times + 0.1))
        for track in tracked[1].tracks
    )
    solution = solve_network(
        PEOPLE,
        [tracked[0], replace(tracked[1], tracks=late), tracked[2]],
        averaged,
        graph,
        settings=NetworkEstimationSettings(),
    )
    np.testing.assert_allclose(solution.clock_offset, OFFSET + np.array([0.0, 0.1, 0.0]), atol=0.003)
    assert np.abs(compute_errors(solution)[:, :2]).max() < 0.008


def test_static_walls_add_information() -> None:
    tracked, averaged, graph = scene(0, bodies=1)
    rng = np.random.default_rng(0)
    x, y = np.linspace(-1, 7, 400), np.linspace(-1, 6, 350)
    walls = np.concatenate(
        [np.column_stack([x, np.full_like(x, k)]) for k in (-1, 6)]
        + [np.column_stack([np.full_like(y, k), y]) for k in (-1, 7)]
    )
    with_walls = [
        replace(one, background=se2.apply(se2.inverse(T), walls) + rng.normal(0, SIGMA, walls.shape))
        for one, T in zip(tracked, T_ROOT, strict=True)
    ]
    alone, both = (
        solve_network(PEOPLE, tracks, averaged, graph, settings=NetworkEstimationSettings())
        for tracks in (tracked, with_walls)
    )
    before, after = (np.sqrt(np.diag(solution.pose_covariance)[3:]) for solution in (alone, both))
    assert (after < 0.985 * before).all()
    assert np.mean(after / before) < 0.95
    assert np.abs(compute_errors(both)).max() < 0.008


def simulate_turning_walk(phase: float) -> tuple[Knots, BodyPath]:
    """A person who walks to and fro along a line, and turns round on the spot at its ends, always to the left."""
    knots = Knots.spanning(-0.5, SECONDS + 0.5, 0.2)
    leg, share = np.divmod((knots.control_times() + phase) / 3, 1)
    turned, walked = np.clip(share / 0.25, 0, 1), np.clip((share - 0.25) / 0.75, 0, 1)
    walked = walked**2 * (3 - 2 * walked)
    along = 1.2 * (2 * np.where(leg % 2 == 0, walked, 1 - walked) - 1)
    heading = phase + np.pi * (leg + turned)
    control = np.column_stack([3 + np.cos(phase) * along, 2.2 + np.sin(phase) * along, heading])
    return knots, BodyPath(control, np.array([0.25, 0.15]))


def test_people_who_turn_on_the_spot_are_ellipses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "simulate_walk", lambda _radii, phase: simulate_turning_walk(phase))
    solution = solve_network(PEOPLE, *scene(1), settings=NetworkEstimationSettings())
    # Turned to the wrong side, they deviate by 10 mm.
    assert model_error(solution) < 0.001
    assert np.abs(compute_errors(solution)[:, :2]).max() < 0.008


def test_the_model_error_is_a_standard_deviation(solved: list[NetworkSolution]) -> None:
    # Simulated bodies are exact ellipses on splines: the estimate is at most a few millimetres.
    assert 0.0005 <= np.median([model_error(solution) for solution in solved]) < 0.003


def build_body(times: Array, positions: Array) -> BodyTracks:
    """A body that the root tracked, at given times (T,) and positions (T, 2)."""
    hits = Hits(positions, times, np.arange(len(times)))
    track = Track(times, positions, np.zeros_like(positions), np.tile(np.eye(2), (len(times), 1, 1)), 0, hits)
    return BodyTracks(((0, track),), float(times[0]), float(times[-1]))


@pytest.mark.parametrize(
    ("target", "sigma"),
    [(PEOPLE, _PEOPLE_RADII_SIGMA * np.array([0.25, 0.15])),
     (ROUND, np.full(2, _CYLINDER_RADIUS_SIGMA))],
)  # fmt: skip
def test_priors_of_radii_are_relative_for_people_and_absolute_for_cylinders(
    target: People | Cylinder, sigma: Array
) -> None:
    body = build_body(np.arange(0.0, 2.0, 0.1), np.ones((20, 2)))
    np.testing.assert_allclose(_build_observations(body, target).radii_sigma, sigma)


def test_the_heading_at_rest_is_that_of_the_motion_before() -> None:
    """Two seconds along y at 1 m/s, then three at rest, with a drift of 1 cm/s along x."""
    times = np.arange(0.0, 5.0, 0.05)
    positions = np.column_stack([2 + 0.01 * times, np.minimum(times, 2.0)])
    path = _initialize_path(build_body(times, positions), PEOPLE, T_ROOT[:1], DENSITY)
    np.testing.assert_allclose(path.control[:, 2], np.pi / 2, atol=0.15)


def test_the_heading_of_a_body_that_never_walks_is_that_of_its_drift() -> None:
    times = np.arange(0.0, 3.0, 0.05)
    positions = np.column_stack([np.full_like(times, 2.0), 3 - 0.01 * times])
    path = _initialize_path(build_body(times, positions), PEOPLE, T_ROOT[:1], DENSITY)
    np.testing.assert_allclose(path.control[:, 2], -np.pi / 2, atol=0.05)


@pytest.mark.slow
def test_the_solution_does_not_depend_on_the_number_of_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_batches, "_BATCH_BEAMS", 1000)
    one, two = (
        solve_network(PEOPLE, *scene(2), engine=Processes(jobs), settings=NetworkEstimationSettings())
        for jobs in (1, 2)
    )
    np.testing.assert_array_equal(one.T_root_scanner, two.T_root_scanner)
    np.testing.assert_array_equal(one.covariance.blocks, two.covariance.blocks)


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_solution_does_not_depend_on_the_memory(jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_batches, "_BATCH_BEAMS", 1000)
    solutions = []
    for settings in (SETTINGS, SETTINGS.model_copy(update={"max_kept_bytes": 0})):
        with Processes(jobs).keep_workers(settings.max_kept_bytes) as engine:
            solutions.append(solve_network(PEOPLE, *scene(2), settings=settings, engine=engine))
    one, other = solutions
    np.testing.assert_array_equal(one.T_root_scanner, other.T_root_scanner)
    np.testing.assert_array_equal(one.covariance.blocks, other.covariance.blocks)


def test_a_large_network_has_no_covariance_of_scanners_without_common_bodies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracked, averaged, graph = scene(2)
    # The first body is of the root and the second scanner, the other one of the root and the third.
    tracked[1], tracked[2] = (replace(tracked[s], tracks=tracked[s].tracks[s - 1 : s]) for s in (1, 2))
    small = solve_network(PEOPLE, tracked, averaged, graph, settings=NetworkEstimationSettings())
    for module in ("joint.solver", "checks.model_assessment"):
        monkeypatch.setattr(f"calgraph.network.{module}.MAX_JOINT_COVARIANCE", 2)
    solution = solve_network(PEOPLE, tracked, averaged, graph, settings=NetworkEstimationSettings())
    found, expected = (one.pose_covariance for one in (solution, small))
    known = np.isfinite(found)
    assert not known[3:6, 6:].any()
    assert known[3:6, 3:6].all()
    assert known[:3].all()
    np.testing.assert_allclose(found[known], expected[known], rtol=1e-9)
