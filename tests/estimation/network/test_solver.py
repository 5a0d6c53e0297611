"""The joint solution of a small network, against SciPy's least squares, dense algebra and answers by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from calgraph.estimation.network.ellipse_raycast import raycast_ellipses
from calgraph.estimation.network.problem import (
    BodyObservations,
    BodyPath,
    NetworkProblem,
    NetworkState,
    WallConstraint,
)
from calgraph.estimation.network.schur import BodyEquations, eliminate_path
from calgraph.estimation.network.solver import (
    compute_network_covariance,
    eliminate_bodies,
    linearize_network,
    optimize_network,
    select_unknowns,
)
from calgraph.estimation.network.splines import Knots, evaluate_spline
from calgraph.geometry import Array, se2
from network_scenes import OFFSET, SIGMA, T_ROOT, glimpses

CLOCK = 0.1
RADII = np.array([0.25, 0.15])
# Ranges are then as they are on the path: what least squares minimises, too.
STILL = np.array([1e-14, 1e-14])


def control(knots: Knots) -> Array:
    """(K, 3) of somebody who walks across and turns a little."""
    t = knots.control_times()
    return np.column_stack([1.5 + 0.8 * t, 1.8 + 0.4 * np.sin(t), 0.3 * np.cos(t)])


def network(
    rng: np.random.Generator, every: float = 0.1, *, faces: bool = False
) -> tuple[NetworkProblem, NetworkState]:
    """Three scanners and one body, and the truth."""
    knots = Knots.spanning(-0.3, 3.3, 0.3)
    motion = BodyPath(control(knots), RADII)
    seen = tuple(glimpses(s, knots, motion, np.arange(0.1 + 0.013 * s, 2.9, every), rng) for s in range(3))
    body = BodyObservations(knots, seen, RADII * 1.1, 0.3 * RADII, faces)
    T_0_1 = se2.retract(T_ROOT[1:2], np.array([[0.01, -0.01, 0.002]]))[0]
    wall = WallConstraint(0, 1, T_0_1, np.diag([1e4, 1e2, 1e5]))
    built = NetworkProblem(3, (body,), (wall,), np.full(3, SIGMA), STILL, CLOCK)
    return built, NetworkState(T_ROOT, OFFSET, (motion,))


def off(state: NetworkState, rng: np.random.Generator, size: float = 1.0) -> NetworkState:
    """The state, wrong by a few centimetres and tens of milliseconds."""
    [motion] = state.paths
    steps = size * rng.normal(0, [0.02, 0.02, 0.01], (3, 3)) * [[0], [1], [1]]
    path = motion.control + size * rng.normal(0, 0.01, motion.control.shape)
    return NetworkState(
        se2.retract(state.T_root_scanner, steps),
        state.clock_offset + size * np.array([0.0, 0.02, -0.02]),
        (BodyPath(path, motion.radii * 1.05),),
    )


def unpacked(x: Array, like: NetworkState) -> NetworkState:
    """A state from the numbers that least squares varies."""
    T = np.concatenate([np.eye(3)[None], se2.retract(T_ROOT[1:], x[:6].reshape(2, 3))])
    path = x[10:].reshape(like.paths[0].control.shape)
    return NetworkState(T, np.concatenate([[0.0], x[6:8]]), (BodyPath(path, x[8:10]),))


def residuals(x: Array, net: NetworkProblem, like: NetworkState) -> Array:
    """All of the problem's residuals, written down once more, beam by beam."""
    state = unpacked(x, like)
    [body], [motion], [wall] = net.bodies, state.paths, net.walls
    found = []
    for seen in body.scans:
        beams = len(seen.ranges) // len(seen.times)
        at = np.repeat(seen.times, beams) - state.clock_offset[seen.scanner]
        pose = evaluate_spline(motion.control, *body.knots.basis_at(at)[:2])
        T = state.T_root_scanner[seen.scanner]
        direction = seen.direction @ T[:2, :2].T
        origin, radii = (np.broadcast_to(v, direction.shape) for v in (T[:2, 2], motion.radii))
        found.append(
            (raycast_ellipses(origin, direction, pose[:, :2], pose[:, 2], radii).ranges - seen.ranges) / SIGMA
        )
    h, path = body.knots.step, motion.control
    found.append((np.diff(path[:, :2], n=2, axis=0) / np.sqrt(h**3 * 0.5)).ravel())
    found.append(np.diff(path[:, 2]) / np.sqrt(h * 5.0))
    found.append((motion.radii - body.radii) / body.radii_sigma)
    found.append(state.clock_offset / CLOCK)
    T_a_b = se2.inverse(state.T_root_scanner[0]) @ state.T_root_scanner[1]
    found.append(np.sqrt(np.diagonal(wall.information)) * se2.difference(T_a_b, wall.T_a_b))
    return np.concatenate(found)


def packed(state: NetworkState) -> Array:
    """The other way round, for scanners near the truth."""
    [motion] = state.paths
    steps = se2.difference(state.T_root_scanner[1:], T_ROOT[1:])
    return np.concatenate([steps.ravel(), state.clock_offset[1:], motion.radii, motion.control.ravel()])


def dense(equations: BodyEquations) -> tuple[Array, Array]:
    """The normal equations of a body with nothing eliminated: path, radii, scanners."""
    count, border = len(equations.band), equations.corner.shape[0]
    H = np.zeros((3 * count + border,) * 2)
    for k in range(count):
        for apart in range(min(4, count - k)):
            rows, columns = slice(3 * k, 3 * k + 3), slice(3 * (k + apart), 3 * (k + apart) + 3)
            H[rows, columns] = equations.band[k, apart]
            H[columns, rows] = equations.band[k, apart].T
    H[: 3 * count, 3 * count :] = equations.border.reshape(3 * count, border)
    H[3 * count :, : 3 * count] = H[: 3 * count, 3 * count :].T
    H[3 * count :, 3 * count :] = equations.corner
    return H, np.concatenate([equations.gradient.ravel(), equations.corner_gradient])


def settled(net: NetworkProblem, state: NetworkState) -> NetworkState:
    """Solved until nothing moves."""
    for _ in range(40):
        state, _ = optimize_network(net, state, iterations=10)
    return state


def test_the_solution_is_that_of_least_squares(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    found = packed(settled(net, off(truth, rng)))
    oracle = least_squares(
        residuals,
        packed(truth),
        args=(net, truth),
        method="lm",
        jac="3-point",
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
    ).x
    np.testing.assert_allclose(found[:10], oracle[:10], atol=1e-6)


def test_the_cost_is_that_of_least_squares(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    state = off(truth, rng, 0.1)
    assert linearize_network(net, state).cost == pytest.approx(
        0.5 * np.sum(residuals(packed(state), net, truth) ** 2)
    )


def test_the_gradient_is_that_of_the_cost(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    [equations] = linearize_network(net, truth).bodies
    _, gradient = dense(equations)
    x, step = packed(truth), 1e-6
    numeric = [
        (np.sum(residuals(x + d, net, truth) ** 2) - np.sum(residuals(x - d, net, truth) ** 2)) / (4 * step)
        for d in step * np.eye(len(x))[8:]
    ]
    own = np.concatenate([gradient[-14:-12], gradient[:-14]])
    np.testing.assert_allclose(own, numeric, rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("faces", [True, False])
def test_elimination_leaves_the_schur_complement(faces: bool, rng: np.random.Generator) -> None:
    net, truth = network(rng, faces=faces)
    net = replace(net, model_error_variance=np.array([1e-4, 1e-3]))
    [equations] = linearize_network(net, truth).bodies
    H, _ = dense(equations)
    inner = len(H) - 12
    schur = H[inner:, inner:] - H[inner:, :inner] @ np.linalg.solve(H[:inner, :inner], H[:inner, inner:])
    np.testing.assert_allclose(eliminate_path(equations, 0.0)[0], schur, rtol=1e-6, atol=1e-6 * schur.max())


def test_the_step_of_a_path_is_that_of_the_dense_equations(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    [equations] = linearize_network(net, off(truth, rng)).bodies
    H, g = dense(equations)
    scanners = rng.normal(0, 0.01, 12)
    inner = len(H) - 12
    expected = -np.linalg.solve(H[:inner, :inner], g[:inner] + H[:inner, inner:] @ scanners)
    K = eliminate_path(equations, 0.0)[2]
    np.testing.assert_allclose(-(K[:, :-1] @ scanners + K[:, -1]), expected, atol=1e-8)


def test_the_covariance_is_the_inverse_of_the_least_squares_problem(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    J = least_squares(residuals, packed(truth), args=(net, truth), max_nfev=1).jac
    inverse = np.linalg.inv(J.T @ J)[:8, :8]
    order = [0, 1, 2, 6, 3, 4, 5, 7]
    found = compute_network_covariance(net, linearize_network(net, truth))[4:, 4:]
    np.testing.assert_allclose(np.sqrt(np.diagonal(found)), np.sqrt(np.diagonal(inverse)[order]), rtol=0.02)


def test_a_body_that_sways_says_less(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    swaying = replace(net, model_error_variance=np.array([0.01**2, 0.05**2]))
    strict, loose = (
        np.trace(compute_network_covariance(n, linearize_network(n, truth))[4:6, 4:6]) for n in (net, swaying)
    )
    assert loose > 1.5 * strict


def test_beams_that_do_not_count_change_nothing(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    [body] = net.bodies
    wild = body.scans[1].ranges.copy()
    wild[:20] += 0.5
    weight = np.ones(len(wild))
    weight[:20] = 0
    costs = []
    for ranges in (body.scans[1].ranges, wild):
        own = replace(body.scans[1], ranges=ranges, weight=weight)
        changed = replace(body, scans=(body.scans[0], own, body.scans[2]))
        costs.append(linearize_network(replace(net, bodies=(changed,)), truth).cost)
    assert costs[0] == pytest.approx(costs[1])


def test_a_scanner_of_which_no_beam_counts_stays_and_is_not_sure(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    [body] = net.bodies
    mute = replace(body.scans[2], weight=np.zeros(len(body.scans[2].ranges)))
    changed = replace(net, bodies=(replace(body, scans=(*body.scans[:2], mute)),))
    state, system = optimize_network(changed, truth)
    np.testing.assert_allclose(state.T_root_scanner[2], truth.T_root_scanner[2], atol=1e-9)
    assert np.sqrt(np.diagonal(compute_network_covariance(changed, system))[8:10]).min() > 50


def test_known_clocks_stay_as_they_are(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    state, _ = optimize_network(replace(net, clock_sigma=0.0), off(truth, rng))
    np.testing.assert_array_equal(state.clock_offset, off(truth, rng).clock_offset)


def test_known_clocks_are_not_among_the_unknowns(rng: np.random.Generator) -> None:
    net, _ = network(rng)
    assert select_unknowns(replace(net, clock_sigma=0.0)).tolist() == [4, 5, 6, 8, 9, 10]


def test_the_root_does_not_move(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    state, _ = optimize_network(net, off(truth, rng))
    np.testing.assert_allclose(state.T_root_scanner[0], np.eye(3), atol=1e-15)


def test_walls_alone_hold_a_scanner_that_saw_nobody(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    [wall] = net.walls
    alone = replace(net, count=2, bodies=(), walls=(replace(wall, information=np.diag([1e4, 1e4, 1e6])),))
    state, system = optimize_network(alone, NetworkState(truth.T_root_scanner[:2], np.zeros(2), ()))
    off_by = se2.difference(state.T_root_scanner[1], wall.T_a_b)
    assert (np.abs(off_by).max() < 1e-9, len(system.bodies)) == (True, 0)


def test_a_cylinder_has_no_heading_to_be_wrong_about(rng: np.random.Generator) -> None:
    net, truth = network(rng)
    [body] = net.bodies
    round_ = replace(body, radii=np.full(2, 0.2), radii_sigma=np.full(2, 1e-7))
    motion = replace(truth.paths[0], radii=np.full(2, 0.2))
    state = replace(truth, paths=(motion,))
    H, _, _ = eliminate_bodies(net, linearize_network(replace(net, bodies=(round_,)), state))
    turned = replace(motion, control=motion.control + np.array([0, 0, 1.0]))
    other, _, _ = eliminate_bodies(
        net, linearize_network(replace(net, bodies=(round_,)), replace(state, paths=(turned,)))
    )
    np.testing.assert_allclose(H, other, atol=1e-6 * H.max())
