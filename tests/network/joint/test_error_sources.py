"""The covariance of a network as a sum over the sources of its errors, against responses of linear solutions."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from calgraph.geometry import Array, diagonal_blocks, se2
from calgraph.network.joint import error_sources
from calgraph.network.joint.body_equations import predict_scanner
from calgraph.network.joint.ellipses import EllipseObservations
from calgraph.network.joint.error_sources import EARLIER, compute_error_budget, split_covariance
from calgraph.network.joint.estimate import NetworkSolution
from calgraph.network.joint.legs import LegObservations
from calgraph.network.joint.planar_poses import ScannerPrior, lift_covariance
from calgraph.network.joint.problem import BodyPath, BodyScans, NetworkProblem, NetworkState, WallConstraint
from calgraph.network.joint.scanner_unknowns import FIRST_SYSTEMATIC
from calgraph.network.joint.solver import (
    NetworkEquations,
    compute_network_covariance,
    linearize_network,
    list_known_pairs,
)
from calgraph.network.joint.splines import Knots
from calgraph.result.budget import ErrorSource
from calgraph.result.sensor_pose import stddev_along_axes
from leg_scenes import build_network as build_legs
from network_scenes import DENSITY, EXACT, OFFSET, SETTINGS, SIGMA, T_ROOT, simulate_scans

NAMES = ("west", "north", "east")
T_ROOT_SENSOR = list(se2.to_se3(T_ROOT))
SYSTEMATIC_SIGMA = np.tile([0.02, 0.003, 0.002, 0.002, 0.002, 1e-3], (3, 1)) * [[1.0], [0.7], [1.5]]
SYSTEMATIC_SIGMA[0, -1] = 0


@pytest.fixture(scope="module")
def ellipses() -> NetworkEquations:
    """A person whose path and shape are not exactly known, a wall, and earlier poses."""
    rng = np.random.default_rng(0)
    knots = Knots.spanning(-0.3, 3.3, 0.3)
    t = knots.control_times()
    path = BodyPath(
        np.column_stack([1.5 + 0.8 * t, 1.8 + 0.4 * np.sin(t), 0.3 * np.cos(t)]), np.array([0.25, 0.15])
    )
    scans = tuple(simulate_scans(s, knots, path, np.arange(0.1 + 0.013 * s, 2.9, 0.2), rng) for s in range(3))
    body = EllipseObservations(knots, scans, 1.1 * path.shape, 0.3 * path.shape, faces_forward=True)
    wall = WallConstraint(0, 1, T_ROOT[1], np.diag([1e4, 1e2, 1e5]), rng.normal(size=(3, 10)))
    prior = ScannerPrior(np.array([2]), T_ROOT[2:], np.diag([1e3, 1e4, 1e4]))
    problem = NetworkProblem(
        3, (body,), (wall,), np.array([1.0, 2.0, 1.5]) * SIGMA, np.array([0.01, 0.05]) ** 2, SYSTEMATIC_SIGMA, 1.0,
        DENSITY, SETTINGS, prior,
    )  # fmt: skip
    systematic = rng.normal(0, 1, EXACT.shape) * SYSTEMATIC_SIGMA
    return linearize_network(problem, NetworkState(T_ROOT, OFFSET, systematic, (path,)))


@pytest.fixture(scope="module")
def legs() -> NetworkEquations:
    problem, state = build_legs()
    return linearize_network(replace(problem, systematic_sigma=SYSTEMATIC_SIGMA), state)


@pytest.fixture(params=["ellipses", "legs"])
def solved(request: pytest.FixtureRequest) -> NetworkEquations:
    found = request.getfixturevalue(request.param)
    assert isinstance(found, NetworkEquations)
    return found


def covariance_of(equations: NetworkEquations) -> Array:
    """(9, 9) of the poses."""
    pairs = list_known_pairs(equations.network)
    return compute_network_covariance(equations).select_pairs(pairs, slice(3)).expand()


def split(equations: NetworkEquations) -> dict[ErrorSource, Array]:
    return {source: part.expand() for source, part in split_covariance(equations, NAMES).items()}


def relative_difference(found: Array, expected: Array) -> float:
    """Largest difference of covariances, over the expected standard deviations."""
    stddev = np.sqrt(np.diag(expected))
    stddev[stddev == 0] = 1.0
    return float(np.max(np.abs(found - expected) / stddev / stddev[:, None]))


def respond(equations: NetworkEquations, changed: Iterable[NetworkProblem], size: float) -> Array:
    """(9, n) by how much the poses change with data of n changed problems, over the size of a change."""
    H, g = equations.eliminate_bodies()
    gradients = [linearize_network(one, equations.state).eliminate_bodies()[1] - g for one in changed]
    steps = -H.factor().solve(np.column_stack(gradients)) / size
    return steps.reshape(3, -1, len(gradients))[:, :3].reshape(9, -1)


def shift_ranges(network: NetworkProblem, scanner: int, shift: float, body: int | None = None) -> NetworkProblem:
    """The problem with all ranges of a scanner longer, on one body or on all."""

    def change(index: int, scans: BodyScans) -> BodyScans:
        selected = scans.scanner == scanner and body in (None, index)
        return replace(scans, ranges=scans.ranges + shift) if selected else scans

    bodies = [
        replace(one, scans=tuple(change(b, scans) for scans in one.scans)) for b, one in enumerate(network.bodies)
    ]
    return replace(network, bodies=tuple(bodies))


def shift_beam(network: NetworkProblem, b: int, k: int, beam: int, shift: float) -> NetworkProblem:
    bodies, scans = list(network.bodies), list(network.bodies[b].scans)
    ranges = scans[k].ranges.copy()
    ranges[beam] += shift
    scans[k] = replace(scans[k], ranges=ranges)
    bodies[b] = replace(bodies[b], scans=tuple(scans))
    return replace(network, bodies=tuple(bodies))


def test_sources_add_up_to_the_covariance_of_all_poses(solved: NetworkEquations) -> None:
    covariance = covariance_of(solved)
    assert relative_difference(np.sum(list(split(solved).values()), axis=0), covariance) < 1e-9


def test_no_source_has_a_negative_variance(solved: NetworkEquations) -> None:
    for source, part in split(solved).items():
        assert np.linalg.eigvalsh(part)[0] > -1e-9 * np.trace(part) - 1e-18, source


def test_range_bias_acts_as_ranges_that_are_longer(legs: NetworkEquations) -> None:
    """Half of the variance is that of a bias which all scanners have in common."""
    longer = [shift_ranges(legs.network, s, 1e-5) for s in range(3)]
    response, parts = respond(legs, longer, 1e-5), split(legs)
    sigma = SYSTEMATIC_SIGMA[:, 0]
    for s, name in enumerate(NAMES):
        own = 0.5 * sigma[s] ** 2 * np.outer(response[:, s], response[:, s])
        found = parts[ErrorSource("range bias", name)]
        assert relative_difference(found, own) < 1e-4
    common = 0.5 * np.outer(response @ sigma, response @ sigma)
    assert relative_difference(parts[ErrorSource("range bias")], common) < 1e-4


@pytest.mark.slow
def test_noise_is_that_of_independent_ranges(solved: NetworkEquations) -> None:
    """The model error of a body in a scan, and the slope at the edge of a leg, are the same in both."""
    bodies = solved.network.bodies
    beams = [(b, beam) for b, body in enumerate(bodies) for beam in range(len(body.scans[1].ranges))]
    response = respond(solved, (shift_beam(solved.network, b, 1, beam, 1e-6) for b, beam in beams), 1e-6)
    sigma = [_find_sigma(solved, b, 1)[beam] for b, beam in beams]
    expected = (response * np.square(sigma)) @ response.T
    assert relative_difference(split(solved)[ErrorSource("noise", "north")], expected) < 1e-4


def _find_sigma(equations: NetworkEquations, b: int, s: int) -> Array:
    network, state = equations.network, equations.state
    return predict_scanner(network, state, network.bodies[b], state.paths[b], s).sigma


def test_biases_of_legs_act_as_ranges_that_are_longer(legs: NetworkEquations) -> None:
    parts = split(legs)
    body = legs.network.bodies[0]
    assert isinstance(body, LegObservations)
    for s, name in enumerate(NAMES):
        response = respond(legs, [shift_ranges(legs.network, s, 1e-6, b) for b in range(2)], 1e-6)
        expected = body.bias_variance * response @ response.T
        assert relative_difference(parts[ErrorSource("body model", name)], expected) < 1e-4


def test_body_shapes_act_as_other_stated_radii(ellipses: NetworkEquations) -> None:
    [body] = ellipses.network.bodies
    assert isinstance(body, EllipseObservations)
    changed = [replace(body, radii=body.radii + 1e-5 * unit) for unit in np.eye(2)]
    response = respond(ellipses, [replace(ellipses.network, bodies=(one,)) for one in changed], 1e-5)
    expected = (response * body.radii_sigma**2) @ response.T
    found = split(ellipses)[ErrorSource("body shapes")]
    assert relative_difference(found, expected) < 1e-6


def test_an_earlier_calibration_acts_as_other_poses(ellipses: NetworkEquations) -> None:
    prior = ellipses.network.prior
    assert prior is not None
    moved = [
        replace(prior, T_root_scanner=se2.retract(prior.T_root_scanner, 1e-6 * unit[None])) for unit in np.eye(3)
    ]
    response = respond(ellipses, [replace(ellipses.network, prior=one) for one in moved], 1e-6)
    expected = response @ np.linalg.inv(prior.information) @ response.T
    assert relative_difference(split(ellipses)[EARLIER], expected) < 1e-4


def test_walls_act_as_other_registrations(ellipses: NetworkEquations) -> None:
    [wall] = ellipses.network.walls
    moved = [replace(wall, T_a_b=se2.retract(wall.T_a_b[None], 1e-6 * unit[None])[0]) for unit in np.eye(3)]
    response = respond(ellipses, [replace(ellipses.network, walls=(one,)) for one in moved], 1e-6)
    expected = response @ np.linalg.inv(wall.information) @ response.T
    found = split(ellipses)[ErrorSource("walls")]
    assert relative_difference(found, expected) < 1e-4


def build_solution(equations: NetworkEquations) -> NetworkSolution:
    """With variances that the tests of the model make larger."""
    pairs = list_known_pairs(equations.network)
    covariance = compute_network_covariance(equations).select_pairs(pairs, slice(FIRST_SYSTEMATIC))
    joint = NetworkSolution(T_ROOT, OFFSET, covariance, equations).scale_covariance(1.5, "scatter of parts")
    return joint.scale_covariance(np.array([1.0, 1.2, 2.0]), "correlated beams")


def test_a_budget_adds_up_to_what_is_published(ellipses: NetworkEquations) -> None:
    joint = build_solution(ellipses)
    budget = compute_error_budget(joint, NAMES, T_ROOT_SENSOR)
    assert budget is not None
    assert budget.covariance is not None
    published = lift_covariance(joint.pose_covariance)
    total = budget.covariance.sum(axis=0)
    np.testing.assert_array_equal(np.isnan(total), np.isnan(published))
    measured = ~np.isnan(np.diag(published))
    total, published = (one[np.ix_(measured, measured)] for one in (total, published))
    assert relative_difference(total, published) < 1e-9


def test_what_is_added_after_the_solution_are_sources(ellipses: NetworkEquations) -> None:
    budget = compute_error_budget(build_solution(ellipses), NAMES, T_ROOT_SENSOR)
    assert budget is not None
    share = dict(zip(budget.sources, budget.shares(2)[:, 0], strict=True))
    assert share[ErrorSource("scatter of parts")] == pytest.approx(0.5 / 3)
    assert share[ErrorSource("correlated beams")] == pytest.approx(1.5 / 3)


def test_a_budget_is_along_the_axes_of_scanners_and_zero_where_nothing_was_measured(
    ellipses: NetworkEquations,
) -> None:
    joint = build_solution(ellipses)
    budget = compute_error_budget(joint, NAMES, T_ROOT_SENSOR)
    assert budget is not None
    found = np.sqrt(np.sum(budget.stddev**2, axis=0))
    blocks = np.nan_to_num(diagonal_blocks(lift_covariance(joint.pose_covariance), 6))
    np.testing.assert_allclose(
        found, [stddev_along_axes(*one) for one in zip(T_ROOT_SENSOR, blocks, strict=True)], rtol=1e-9
    )


def test_large_networks_have_sources_of_all_scanners_and_no_covariances_between_them(
    ellipses: NetworkEquations, monkeypatch: pytest.MonkeyPatch
) -> None:
    joint = build_solution(ellipses)
    small = compute_error_budget(joint, NAMES, T_ROOT_SENSOR)
    monkeypatch.setattr(error_sources, "MAX_JOINT_COVARIANCE", 2)
    monkeypatch.setattr(error_sources, "_MAX_SEPARATE", 2)
    large = compute_error_budget(joint, NAMES, T_ROOT_SENSOR)
    assert small is not None
    assert large is not None
    assert large.covariance is None
    assert all(not source.of for source in large.sources)
    for source, stddev in zip(large.sources, large.stddev, strict=True):
        same = [k for k, one in enumerate(small.sources) if one.kind == source.kind]
        np.testing.assert_allclose(stddev**2, np.sum(small.stddev[same] ** 2, axis=0), rtol=1e-7, atol=1e-20)
