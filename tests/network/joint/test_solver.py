"""The joint solution of a small network compared with SciPy's least squares and dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from calgraph.geometry import Array, se2
from calgraph.network.joint.body_equations import linearize_scans, predict_scanner
from calgraph.network.joint.ellipses import EllipseObservations, compute_heading_offsets
from calgraph.network.joint.path_equations import add_scans, index_scans
from calgraph.network.joint.problem import BodyPath, NetworkProblem, NetworkState, WallConstraint
from calgraph.network.joint.scanner_unknowns import (
    BEAM_ERRORS,
    CLOCK,
    CLOCK_DRIFT,
    FIRST_SYSTEMATIC,
    SCANNER_UNKNOWNS,
)
from calgraph.network.joint.schur import BodyEquations, compute_back_substitution, eliminate_path
from calgraph.network.joint.solver import (
    NetworkEquations,
    apply_step,
    compute_network_covariance,
    linearize_network,
    optimize_network,
)
from calgraph.network.joint.splines import Knots, evaluate_spline
from network_scenes import (
    DENSITY,
    EXACT,
    OFFSET,
    SETTINGS,
    SIGMA,
    T_ROOT,
    eliminate_densely,
    list_body_equations,
    meet_ellipses,
    simulate_scans,
)

CLOCK_SIGMA = 0.1
RADII = np.array([0.25, 0.15])
# The oracle has no model error.
NO_MODEL_ERROR = np.array([1e-14, 1e-14])
MID_TIME = 1.0
SYSTEMATIC_SIGMA = np.tile([0.02, 0.003, 0.002, 0.002, 0.002, 1e-3], (3, 1))
SYSTEMATIC_SIGMA[0, CLOCK_DRIFT] = 0
"""The root's clock is exact."""
ESTIMATED = np.flatnonzero(SYSTEMATIC_SIGMA)
SCANNERS = 8 + len(ESTIMATED)
"""Number of the unknowns of scanners; radii and path follow."""
SIZE = 3 * SCANNER_UNKNOWNS
"""Columns of all scanners."""
_COLUMNS = np.arange(SIZE).reshape(3, -1)
PACKED_COLUMNS = np.concatenate(
    [_COLUMNS[1:, :CLOCK].ravel(), _COLUMNS[1:, CLOCK], _COLUMNS[:, FIRST_SYSTEMATIC:][SYSTEMATIC_SIGMA > 0]]
)
"""Their columns in the equations: poses, clock offsets, and systematic errors scanner by scanner."""


def control(knots: Knots) -> Array:
    """(K, 3) control points of a person who walks on a slight curve."""
    t = knots.control_times()
    return np.column_stack([1.5 + 0.8 * t, 1.8 + 0.4 * np.sin(t), 0.3 * np.cos(t)])


def build_network(
    rng: np.random.Generator, every: float = 0.1, *, faces: bool = False
) -> tuple[NetworkProblem, NetworkState]:
    """Three scanners and one body, with the true state."""
    knots = Knots.spanning(-0.3, 3.3, 0.3)
    body_path = BodyPath(control(knots), RADII)
    scans = tuple(
        simulate_scans(s, knots, body_path, np.arange(0.1 + 0.013 * s, 2.9, every), rng) for s in range(3)
    )
    body = EllipseObservations(knots, scans, RADII * 1.1, 0.3 * RADII, faces)
    T_0_1 = se2.retract(T_ROOT[1:2], np.array([[0.01, -0.01, 0.002]]))[0]
    by_errors = np.random.default_rng(3).normal(size=(3, 2 * len(BEAM_ERRORS))) * [[1.0], [1.0], [0.2]]
    wall = WallConstraint(0, 1, T_0_1, np.diag([1e4, 1e2, 1e5]), by_errors)
    built = NetworkProblem(
        3, (body,), (wall,), np.full(3, SIGMA), NO_MODEL_ERROR, SYSTEMATIC_SIGMA, MID_TIME, DENSITY, SETTINGS
    )
    return built, NetworkState(T_ROOT, OFFSET, EXACT, (body_path,))


def perturb(state: NetworkState, rng: np.random.Generator, size: float = 1.0) -> NetworkState:
    """The state with errors of a few centimetres and tens of milliseconds."""
    [body_path] = state.paths
    steps = size * rng.normal(0, [0.02, 0.02, 0.01], (3, 3)) * [[0], [1], [1]]
    path = body_path.control + size * rng.normal(0, 0.01, body_path.control.shape)
    return NetworkState(
        se2.retract(state.T_root_scanner, steps),
        state.clock_offset + size * np.array([0.0, 0.02, -0.02]),
        size * rng.normal(0, 1, SYSTEMATIC_SIGMA.shape) * SYSTEMATIC_SIGMA,
        (BodyPath(path, body_path.shape * 1.05),),
    )


def unpack(x: Array, like: NetworkState) -> NetworkState:
    """A state from the vector of unknowns."""
    T = np.concatenate([np.eye(3)[None], se2.retract(T_ROOT[1:], x[:6].reshape(2, 3))])
    systematic = np.zeros(SYSTEMATIC_SIGMA.shape)
    systematic.flat[ESTIMATED] = x[8:SCANNERS]
    path = BodyPath(x[SCANNERS + 2 :].reshape(like.paths[0].control.shape), x[SCANNERS : SCANNERS + 2])
    return NetworkState(T, np.concatenate([[0.0], x[6:8]]), systematic, (path,))


def mean_stretch(along_x: Array, along_diagonal: Array) -> Array:
    """Of all ranges by a tilt, smooth at zero."""
    return np.sqrt(along_x**2 + along_diagonal**2 + 1e-8) - 1e-4


def residuals(x: Array, net: NetworkProblem, like: NetworkState) -> Array:
    """All residuals of the problem, implemented independently."""
    state = unpack(x, like)
    [body], [body_path], [wall] = net.bodies, state.paths, net.walls
    assert isinstance(body, EllipseObservations)
    found = []
    for scans in body.scans:
        beams = len(scans.ranges) // len(scans.times)
        bias, range_scale, angle_scale, along_x, along_diagonal, drift = state.systematic[scans.scanner]
        stamps = np.repeat(scans.times, beams)
        at = stamps - state.clock_offset[scans.scanner] - drift * (stamps - MID_TIME)
        pose = evaluate_spline(body_path.control, *body.knots.basis_at(at)[:2])
        T = state.T_root_scanner[scans.scanner]
        azimuth = np.arctan2(scans.direction[:, 1], scans.direction[:, 0])
        cos, sin = np.cos(2 * azimuth), np.sin(2 * azimuth)
        angle = (1 + angle_scale) * azimuth + along_x * sin - along_diagonal * cos
        direction = np.column_stack([np.cos(angle), np.sin(angle)]) @ T[:2, :2].T
        origin, radii = (np.broadcast_to(v, direction.shape) for v in (T[:2, 2], body_path.shape))
        true = meet_ellipses(origin, direction, pose[:, :2], pose[:, 2], radii).ranges
        stretch = 1 + range_scale + mean_stretch(along_x, along_diagonal) + along_x * cos + along_diagonal * sin
        found.append((stretch * true + bias - scans.ranges) / SIGMA)
    h, path = body.knots.step, body_path.control
    stretch = 1 + np.mean(state.systematic[:, 1])
    found.append((stretch * np.diff(path[:, :2], n=2, axis=0) / np.sqrt(h**3 * 0.5)).ravel())
    found.append(np.diff(path[:, 2]) / np.sqrt(h * 5.0))
    found.append((body_path.shape - body.radii) / body.radii_sigma)
    found.append(state.clock_offset / CLOCK_SIGMA)
    T_a_b = se2.inverse(state.T_root_scanner[0]) @ state.T_root_scanner[1]
    for kind, common in enumerate([0.5, 0.5, 0.5, 0.0, 0.0, 0.0]):
        sigma = SYSTEMATIC_SIGMA[:, kind]
        errors = (state.systematic[:, kind] / np.where(sigma > 0, sigma, 1))[sigma > 0]
        correlation = (1 - common) * np.eye(len(errors)) + common
        found.append(np.linalg.solve(np.linalg.cholesky(correlation), errors))
    errors = state.systematic[:2, : len(BEAM_ERRORS)].copy()
    errors[:, 1] += mean_stretch(errors[:, 3], errors[:, 4])
    T_0_1 = se2.retract(wall.T_a_b, wall.by_beam_errors @ errors.ravel())
    found.append(np.sqrt(np.diagonal(wall.information)) * se2.difference(T_a_b, T_0_1))
    return np.concatenate(found)


def pack(state: NetworkState) -> Array:
    """The inverse of :func:`unpack`, for scanners near the truth."""
    [body_path] = state.paths
    steps = se2.difference(state.T_root_scanner[1:], T_ROOT[1:])
    systematic = state.systematic.ravel()[ESTIMATED]
    return np.concatenate(
        [steps.ravel(), state.clock_offset[1:], systematic, body_path.shape, body_path.control.ravel()]
    )


def build_dense_equations(equations: BodyEquations) -> tuple[Array, Array]:
    """The dense normal equations of a body: path, radii, scanners."""
    count, border = len(equations.band), equations.corner.shape[0]
    H = np.zeros((3 * count + border,) * 2)
    for k in range(count):
        for offset in range(min(4, count - k)):
            rows, columns = slice(3 * k, 3 * k + 3), slice(3 * (k + offset), 3 * (k + offset) + 3)
            H[rows, columns] = equations.band[k, offset]
            H[columns, rows] = equations.band[k, offset].T
    H[: 3 * count, 3 * count :] = equations.border.reshape(3 * count, border)
    H[3 * count :, : 3 * count] = H[: 3 * count, 3 * count :].T
    H[3 * count :, 3 * count :] = equations.corner
    return H, np.concatenate([equations.gradient.ravel(), equations.corner_gradient])


def converge(net: NetworkProblem, state: NetworkState) -> NetworkState:
    """The solution to numerical accuracy."""
    return optimize_network(net, state, iterations=400, tolerance=1e-14)[0]


@pytest.mark.slow
def test_the_solution_equals_that_of_scipy(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    found = pack(converge(net, perturb(truth, rng)))
    oracle = least_squares(
        residuals,
        pack(truth),
        args=(net, truth),
        method="lm",
        jac="3-point",
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
    ).x
    np.testing.assert_allclose(found[: SCANNERS + 2], oracle[: SCANNERS + 2], atol=2e-6)


def test_the_cost_is_half_the_sum_of_squared_residuals(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    state = perturb(truth, rng, 0.1)
    assert linearize_network(net, state).cost == pytest.approx(
        0.5 * np.sum(residuals(pack(state), net, truth) ** 2)
    )


def test_the_gradient_equals_finite_differences_of_the_cost(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    truth = replace(truth, systematic=perturb(truth, rng).systematic)
    equations = linearize_network(net, truth)
    [body] = list_body_equations(equations)
    _, gradient = build_dense_equations(body)
    gradient[-SIZE:] += equations.g
    x, step = pack(truth), 1e-6
    numeric = [
        (np.sum(residuals(x + d, net, truth) ** 2) - np.sum(residuals(x - d, net, truth) ** 2)) / (4 * step)
        for d in step * np.eye(len(x))
    ]
    ordered = [gradient[-SIZE:][PACKED_COLUMNS], gradient[-SIZE - 2 : -SIZE], gradient[: -SIZE - 2]]
    np.testing.assert_allclose(np.concatenate(ordered), numeric, rtol=2e-4, atol=2e-2)


@pytest.mark.parametrize("faces", [True, False])
@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_elimination_equals_the_dense_schur_complement(
    faces: bool, damping: float, rng: np.random.Generator
) -> None:
    net, truth = build_network(rng, faces=faces)
    net = replace(net, model_error_variance=np.array([1e-4, 1e-3]))
    [equations] = list_body_equations(linearize_network(net, truth))
    H, _ = build_dense_equations(equations)
    inner = len(H) - SIZE
    H *= 1 + damping * np.eye(len(H))
    schur = H[inner:, inner:] - H[inner:, :inner] @ np.linalg.solve(H[:inner, :inner], H[:inner, inner:])
    np.testing.assert_allclose(eliminate_path(equations, damping)[0], schur, rtol=1e-6, atol=1e-6 * schur.max())


def test_back_substitution_equals_the_dense_solution(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    [equations] = list_body_equations(linearize_network(net, perturb(truth, rng)))
    H, g = build_dense_equations(equations)
    scanners = rng.normal(0, 0.01, SIZE)
    inner = len(H) - SIZE
    expected = -np.linalg.solve(H[:inner, :inner], g[:inner] + H[:inner, inner:] @ scanners)
    K = compute_back_substitution(equations)
    np.testing.assert_allclose(-(K[:, :-1] @ scanners + K[:, -1]), expected, atol=1e-8)


def test_scanners_that_a_body_follows_have_the_dense_congruence(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    [equations] = list_body_equations(linearize_network(net, perturb(truth, rng)))
    H, g = build_dense_equations(equations)
    substitution = rng.normal(size=(len(H) - SIZE, SIZE))
    steps = np.concatenate([-substitution, np.eye(SIZE)])
    information, gradient = equations.follow(substitution)
    scale = np.abs(steps).T @ np.abs(H) @ np.abs(steps)
    np.testing.assert_allclose(information / scale, steps.T @ H @ steps / scale, atol=1e-12)
    np.testing.assert_allclose(gradient, steps.T @ g, rtol=1e-9)


def test_terms_of_all_scans_are_the_sum_of_those_of_intervals(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    [body], [path] = net.bodies, truth.paths
    [whole] = list_body_equations(linearize_network(net, truth))
    shape = len(whole.band), whole.shape_count, len(whole.corner) - whole.shape_count
    at_once, in_parts = BodyEquations.zeros(*shape), BodyEquations.zeros(*shape)
    for k in range(len(body.scans)):
        terms = linearize_scans(net, truth, body, path, k)
        add_scans(at_once, [terms])
        middle = len(terms.first) // 3
        for scans in (slice(middle), slice(middle, None)):
            begin, end = terms.first[scans][0], terms.first[scans][-1] + 4
            part = BodyEquations.zeros(end - begin, *shape[1:])
            add_scans(part, [terms.select(scans)], begin)
            for name in ("band", "gradient", "border"):
                getattr(in_parts, name)[begin:end] += getattr(part, name)
            for name in ("corner", "corner_gradient"):
                array = getattr(in_parts, name)
                array += getattr(part, name)
    for name in ("band", "gradient", "border", "corner", "corner_gradient"):
        expected = getattr(at_once, name)
        np.testing.assert_allclose(getattr(in_parts, name), expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("damping", [1e-6, 1.0, 100.0])
def test_the_predicted_decrease_is_that_of_the_cost(damping: float, rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    state, equations = optimize_network(net, perturb(truth, rng), iterations=10)
    # Near the minimum, where the quadratic model is accurate.
    away = np.zeros((net.count, SCANNER_UNKNOWNS))
    away[1:, : CLOCK + 1] = 1e-3
    state = apply_step(net, state, away.ravel(), [np.zeros(size) for size in body_sizes(equations)])
    equations = linearize_network(net, state)
    step, predicted = equations.solve(damping)
    decrease = equations.cost - linearize_network(net, apply_step(net, state, *step)).cost
    assert decrease == pytest.approx(predicted, rel=0.05)


def body_sizes(equations: NetworkEquations) -> list[int]:
    """Numbers of unknowns of path and radii."""
    return [3 * len(body.band) + 2 for body in list_body_equations(equations)]


def test_the_covariance_equals_the_dense_inverse(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    J = least_squares(residuals, pack(truth), args=(net, truth), max_nfev=1).jac
    expected = np.diagonal(np.linalg.inv(J.T @ J))[:SCANNERS]
    covariance = compute_network_covariance(linearize_network(net, truth)).select(np.arange(SIZE))
    assert covariance.shape == (SIZE, SIZE)
    found = np.diagonal(covariance)[PACKED_COLUMNS]
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(expected), rtol=0.02)


def test_model_error_increases_the_covariance(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    net = replace(net, systematic_sigma=EXACT)
    swaying = replace(net, model_error_variance=np.array([0.01**2, 0.05**2]))
    strict, loose = (
        np.trace(compute_network_covariance(linearize_network(n, truth)).select(SCANNER_UNKNOWNS + np.arange(2)))
        for n in (net, swaying)
    )
    assert loose > 1.5 * strict


def test_beams_without_weight_have_no_effect(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    [body] = net.bodies
    outliers = body.scans[1].ranges.copy()
    outliers[:20] += 0.5
    weight = np.ones(len(outliers))
    weight[:20] = 0
    costs = []
    for ranges in (body.scans[1].ranges, outliers):
        changed_scans = replace(body.scans[1], ranges=ranges, weight=weight)
        changed = replace(body, scans=(body.scans[0], changed_scans, body.scans[2]))
        costs.append(linearize_network(replace(net, bodies=(changed,)), truth).cost)
    assert costs[0] == pytest.approx(costs[1])


def test_a_scanner_without_weights_stays_with_a_large_covariance(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    [body] = net.bodies
    unused = replace(body.scans[2], weight=np.zeros(len(body.scans[2].ranges)))
    changed = replace(net, bodies=(replace(body, scans=(*body.scans[:2], unused)),))
    state, system = optimize_network(changed, truth, iterations=10)
    np.testing.assert_allclose(state.T_root_scanner[2], truth.T_root_scanner[2], atol=1e-9)
    assert np.sqrt(np.diagonal(compute_network_covariance(system).select(_COLUMNS[2, :2]))).min() > 50


def test_exact_parameters_are_not_unknowns(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    exact = replace(net, systematic_sigma=EXACT)
    unknowns = _COLUMNS[1:, : CLOCK + 1].ravel().tolist()
    assert linearize_network(exact, truth).unknowns.tolist() == unknowns


def test_the_root_does_not_move(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    state, _ = optimize_network(net, perturb(truth, rng), iterations=10)
    np.testing.assert_allclose(state.T_root_scanner[0], np.eye(3), atol=1e-15)


def test_walls_alone_determine_a_scanner_without_bodies(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    [wall] = net.walls
    walls = (replace(wall, information=np.diag([1e4, 1e4, 1e6])),)
    alone = replace(net, count=2, bodies=(), walls=walls, systematic_sigma=EXACT[:2])
    start = NetworkState(truth.T_root_scanner[:2], np.zeros(2), EXACT[:2], ())
    state, system = optimize_network(alone, start, iterations=10, tolerance=1e-14)
    error = se2.difference(state.T_root_scanner[1], wall.T_a_b)
    assert (np.abs(error).max() < 1e-9, len(list_body_equations(system))) == (True, 0)


def test_the_heading_of_a_cylinder_has_no_effect(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    [body] = net.bodies
    assert isinstance(body, EllipseObservations)
    cylinder = replace(body, radii=np.full(2, 0.2), radii_sigma=np.full(2, 1e-7))
    body_path = replace(truth.paths[0], shape=np.full(2, 0.2))
    state = replace(truth, paths=(body_path,))
    H = eliminate_densely(linearize_network(replace(net, bodies=(cylinder,)), state))
    turned = replace(body_path, control=body_path.control + np.array([0, 0, 1.0]))
    turned_state = replace(state, paths=(turned,))
    other = eliminate_densely(linearize_network(replace(net, bodies=(cylinder,)), turned_state))
    np.testing.assert_allclose(H, other, atol=1e-6 * H.max())


def test_beams_hit_the_body_where_it_is_at_their_time(rng: np.random.Generator) -> None:
    # Position and heading change at constant rates, which splines and first-order motion within a scan reproduce.
    knots = Knots.spanning(0.0, 2.0, 0.2)
    t = knots.control_times()
    body_path = BodyPath(np.column_stack([2.0 + 1.2 * t, 2.0 - 0.5 * t, 0.4 + 2.0 * t]), RADII)
    scans = simulate_scans(1, knots, body_path, np.arange(0.1, 1.9, 0.1), rng)
    delay = rng.uniform(-0.03, 0.03, len(scans.ranges))
    body = EllipseObservations(knots, (replace(scans, beam_delay=delay),), RADII, 0.3 * RADII, False)
    state = NetworkState(T_ROOT, OFFSET, EXACT, (body_path,))
    net, _ = build_network(rng)
    beams = predict_scanner(net, state, body, body_path, 0)
    at = scans.times[index_scans(scans)] - OFFSET[1] + delay
    exact = np.column_stack([2.0 + 1.2 * at, 2.0 - 0.5 * at, 0.4 + 2.0 * at])
    direction = scans.direction @ T_ROOT[1, :2, :2].T
    expected = meet_ellipses(T_ROOT[1, :2, 2], direction, exact[:, :2], exact[:, 2], RADII).ranges
    assert np.isfinite(expected).sum() > 100
    np.testing.assert_allclose(scans.ranges + beams.error, expected, atol=1e-6)


def test_headings_are_compared_with_the_direction_of_motion_modulo_pi() -> None:
    knots = Knots.spanning(0.0, 1.0, 0.2)
    t = knots.control_times()
    body = EllipseObservations(knots, (), RADII, 0.3 * RADII, True)
    walking = np.column_stack([np.cos(0.7) * t, np.sin(0.7) * t])
    offset, weight = compute_heading_offsets(body, walking, np.array([0.9, 0.5 + np.pi]))
    np.testing.assert_allclose(offset, np.tile([0.2, -0.2], (knots.count, 1)))
    np.testing.assert_allclose(weight, 1 / 0.3**2)
    _, weight = compute_heading_offsets(body, 0.4 * walking, np.zeros(1))
    np.testing.assert_array_equal(weight, 0.0)


def test_the_gradient_by_headings_includes_the_direction_of_motion(rng: np.random.Generator) -> None:
    net, truth = build_network(rng, faces=True)
    [path] = truth.paths

    def linearize(turn: float) -> NetworkEquations:
        control = (
            path.control + np.array([0.0, 0.0, 0.2]) + turn * np.eye(len(path.control))[5][:, None] * [0, 0, 1]
        )
        return linearize_network(net, replace(truth, paths=(replace(path, control=control),)))

    numeric = (linearize(1e-6).cost - linearize(-1e-6).cost) / 2e-6
    assert list_body_equations(linearize(0.0))[0].gradient[5, 2] == pytest.approx(numeric, rel=1e-4)


def test_missed_beams_cost_as_stated_and_do_not_pull(rng: np.random.Generator) -> None:
    # Beams past a circle, at 2° from its tangent, and through its centre.
    net, truth = build_network(rng)
    [body], [path] = net.bodies, truth.paths
    at, scans = np.array([2.0, 0.0]), body.scans[0]
    still = replace(path, control=np.tile([*at, 0.0], (len(path.control), 1)), shape=np.full(2, 0.2))
    angles = np.arcsin(np.array([0.2001, 0.1999, 0.0]) / 2.0)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    one = replace(
        scans,
        times=scans.times[:1],
        first_beam=scans.first_beam[:1],
        direction=directions,
        ranges=np.ones(3),
        beam_delay=np.zeros(3),
        weight=np.ones(3),
    )
    beams = predict_scanner(net, truth, replace(body, scans=(one,)), still, 0)
    np.testing.assert_allclose(beams.residual, [4.0, 4.0, 0.8 / SIGMA])
    np.testing.assert_array_equal(beams.jacobian[:, :2], 0.0)
    np.testing.assert_allclose(beams.jacobian[0, 2], 1 / SIGMA)


def test_radii_stay_above_two_centimetres(rng: np.random.Generator) -> None:
    net, truth = build_network(rng)
    body_step = np.zeros(3 * net.bodies[0].knots.count + 2)
    body_step[-2:] = -0.2
    [path] = apply_step(net, truth, np.zeros(SIZE), [body_step]).paths
    np.testing.assert_allclose(path.shape, [0.05, 0.02])
