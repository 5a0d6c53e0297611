"""The joint estimator of a network: poses, clocks and systematic errors of scanners, paths and radii of bodies.

A body is an ellipse whose position and heading follow a spline. Residuals are ranges along the beams, each at its
time of measurement. Given the scanners, bodies are independent, and the equations of a path are banded: each body
is eliminated separately, which leaves a small dense problem over scanners, however long the recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config.settings import BodySettings
from calgraph.estimation.network.ellipse_raycast import (
    RaycastHits,
    raycast_ellipses_by_axis,
    rotate_by_small_angles,
)
from calgraph.estimation.network.leg_equations import linearize_leg
from calgraph.estimation.network.leg_problem import LegObservations, LegPath
from calgraph.estimation.network.path_equations import (
    EARLIER,
    LATER,
    add_stretch,
    compute_smoothness_information,
    compute_stretch,
    evaluate_at,
    index_scans,
    sum_between_knots,
)
from calgraph.estimation.network.problem import (
    BodyObservations,
    BodyPath,
    BodyScans,
    NetworkProblem,
    NetworkState,
    WallConstraint,
)
from calgraph.estimation.network.scan_equations import (
    AZIMUTH_ERRORS,
    RANGE_ERROR,
    SCAN_PARAMETERS,
    ScanEquations,
    sum_over_scans,
)
from calgraph.estimation.network.scanner_unknowns import (
    BEAM_ERRORS,
    CLOCK,
    FIRST_SYSTEMATIC,
    RANGE_BIAS,
    SCANNER_UNKNOWNS,
    compute_prior_covariance,
    compute_scanner_jacobian,
    compute_stretches,
    compute_turns,
    differentiate_by_azimuth_errors,
    linearize_beam_errors,
)
from calgraph.estimation.network.schur import BodyEquations, eliminate_path
from calgraph.geometry import Array, Index, se2
from calgraph.levenberg_marquardt import minimize

# Predicted decrease of the cost (half squared standard deviations) at which the solver stops: no unknown is then
# off by more than 0.2 % of its standard deviation.
_TOLERANCE = 1e-6
# Least radius, m: steps must not make an ellipse degenerate. Bodies are several times larger.
_MIN_RADIUS = 0.02
# Information (1/rad²) that makes headings invertible of bodies that rest: 1000 rad.
_HEADING_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class NetworkEquations:
    """Normal equations at a state."""

    cost: float
    bodies: tuple[BodyEquations, ...]
    H: Array
    """(US, US) of walls and priors, without bodies; the U unknowns of each scanner in turn."""
    g: Array
    """(US,)."""
    unknowns: Index
    """Columns of what is estimated: neither the root's pose and clock, nor what is exact."""
    regularizer: Array
    """(US,) zero-gradient information of poses; everything else has a prior."""

    def eliminate_bodies(self, damping: float = 0.0) -> tuple[Array, Array, list[Array]]:
        """Schur complement of all bodies.

        Returns:
            Matrix and gradient over the unknowns, and each body's back substitution.
        """
        H, g = self.H * (1 + damping * np.eye(len(self.H))), self.g.copy()
        back_substitutions = []
        for body in self.bodies:
            body_H, body_g, K = eliminate_path(body, damping)
            H[np.ix_(body.columns, body.columns)] += body_H
            g[body.columns] += body_g
            back_substitutions.append(K)
        H[np.diag_indices(len(H))] += self.regularizer
        return H[np.ix_(self.unknowns, self.unknowns)], g[self.unknowns], back_substitutions

    def solve(self, damping: float) -> tuple[tuple[Array, list[Array]], float]:
        """Steps (US,) of scanners and of each body, and their predicted decrease of the cost."""
        H, g, back_substitutions = self.eliminate_bodies(damping)
        step = np.zeros(len(self.H))
        step[self.unknowns] = -np.linalg.solve(H, g)
        body_steps = []
        decrease = damping * np.diagonal(self.H) @ step**2 - self.g @ step
        for body, K in zip(self.bodies, back_substitutions, strict=True):
            scanner_step = step[body.columns]
            body_steps.append(-(K[:, :-1] @ scanner_step + K[:, -1]))
            decrease += damping * body.scaled_norm(body_steps[-1], scanner_step)
            decrease -= body.slope(body_steps[-1], scanner_step)
        return (step, body_steps), 0.5 * float(decrease)


def linearize_network(network: NetworkProblem, state: NetworkState) -> NetworkEquations:
    """The normal equations at a state."""
    size = SCANNER_UNKNOWNS * network.count
    H, g, cost = np.zeros((size, size)), np.zeros(size), 0.0
    bodies = []
    for body, path in zip(network.bodies, state.paths, strict=True):
        equations, body_cost = _linearize(network, state, body, path)
        bodies.append(equations)
        cost += body_cost
    for wall in network.walls:
        cost += _add_wall(state, wall, H, g)
    if network.prior:
        cost += network.prior.add_to_equations(state.T_root_scanner, H, g)
    estimated = np.ones((network.count, SCANNER_UNKNOWNS), dtype=np.bool_)
    estimated[:, CLOCK], estimated[:, FIRST_SYSTEMATIC:] = network.clock_sigma > 0, network.systematic_sigma > 0
    cost += _add_priors(network, state, estimated, H, g)
    estimated[0, :FIRST_SYSTEMATIC] = False
    regularizer = np.zeros((network.count, SCANNER_UNKNOWNS))
    regularizer[:, :2] = network.settings.position_prior_information
    regularizer[:, 2] = network.settings.rotation_prior_information
    return NetworkEquations(cost, tuple(bodies), H, g, np.flatnonzero(estimated), regularizer.ravel())


def _add_priors(
    network: NetworkProblem, state: NetworkState, estimated: NDArray[np.bool_], H: Array, g: Array
) -> float:
    """Adds the priors of what is estimated (S, U), poses aside, to the equations, in place; returns their cost."""
    size = len(g)
    covariance = np.zeros((size, size))
    columns = np.arange(size).reshape(estimated.shape)
    clocks, systematic = columns[:, CLOCK], columns[:, FIRST_SYSTEMATIC:].ravel()
    covariance[clocks, clocks] = network.clock_sigma**2
    covariance[np.ix_(systematic, systematic)] = compute_prior_covariance(
        network.systematic_sigma, network.settings.common_error_share
    )
    values = np.column_stack([np.zeros((network.count, 3)), state.clock_offset, state.systematic]).ravel()
    with_prior = columns[:, CLOCK:][estimated[:, CLOCK:]]
    information = np.linalg.inv(covariance[np.ix_(with_prior, with_prior)])
    H[np.ix_(with_prior, with_prior)] += information
    gradient = information @ values[with_prior]
    g[with_prior] += gradient
    return 0.5 * float(values[with_prior] @ gradient)


def optimize_network(
    network: NetworkProblem, state: NetworkState, *, iterations: int, tolerance: float = _TOLERANCE
) -> tuple[NetworkState, NetworkEquations]:
    """Minimises the cost over all unknowns.

    Args:
        network: the problem, whose robust weights are constant.
        state: start values.
        iterations: steps at most, rejected ones included.
        tolerance: predicted decrease of the cost, in half squared standard deviations, to stop at.
    """
    minimum = minimize(
        state,
        lambda state, _: linearize_network(network, state),
        lambda state, step: apply_step(state, *step),
        iterations=iterations,
        tolerance=tolerance,
        damping=network.settings.initial_damping,
    )
    return minimum.state, minimum.linearization


def apply_step(state: NetworkState, step: Array, body_steps: Sequence[Array]) -> NetworkState:
    """The state after steps (US,) of scanners, and of each body's path and shape."""
    steps = step.reshape(-1, SCANNER_UNKNOWNS)
    paths = tuple(path.retract(body, _MIN_RADIUS) for path, body in zip(state.paths, body_steps, strict=True))
    return NetworkState(
        se2.retract(state.T_root_scanner, steps[:, :3]),
        state.clock_offset + steps[:, CLOCK],
        state.systematic + steps[:, FIRST_SYSTEMATIC:],
        paths,
    )


def compute_network_covariance(equations: NetworkEquations) -> Array:
    """Covariance (US, US) of scanners' unknowns, in the root's fixed axes; zero where they are not estimated."""
    H, _, _ = equations.eliminate_bodies()
    unknowns = equations.unknowns
    covariance = np.zeros_like(equations.H)
    covariance[np.ix_(unknowns, unknowns)] = np.linalg.inv(H)
    return covariance


def _linearize(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> tuple[BodyEquations, float]:
    """One body's equations and its cost."""
    if isinstance(body, LegObservations) and isinstance(path, LegPath):
        return linearize_leg(network, state, body, path)
    return _linearize_body(network, state, body, path)


def _linearize_body(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> tuple[BodyEquations, float]:
    """The equations of an ellipse and its cost."""
    count, size = body.knots.count, 2 + SCANNER_UNKNOWNS * len(body.scans)
    scanners = np.array([scans.scanner for scans in body.scans], dtype=np.intp)
    stretch = compute_stretch(state, body)
    band, gradient, cost = _linearize_path_prior(network, body, path, stretch)
    parts = border, corner, corner_gradient = np.zeros((count, 3, size)), np.zeros((size, size)), np.zeros(size)
    add_stretch(parts, path.control[:, :2], gradient[:, :2], stretch, len(scanners))
    radii_information = body.radii_sigma**-2
    corner[[0, 1], [0, 1]] += radii_information
    corner_gradient[:2] += radii_information * (path.radii - body.radii)
    cost += 0.5 * float(radii_information @ (path.radii - body.radii) ** 2)
    pairs, singles = np.zeros((10, count - 3, 9)), np.zeros((4, count - 3, 9))
    for k, scans in enumerate(body.scans):
        first, weights, pose, rate = evaluate_at(network, state, body, path, scans)
        equations = build_scan_equations(network, state, path, scans, pose, rate).marginalize_model_error(
            network.model_error_variance[[0, 0, 1]]
        )
        A, b = equations.information, equations.gradient
        cost += float(equations.cost.sum())
        G = compute_scanner_jacobian(network, state, scans, path.radii, pose, rate)
        AG = A @ G
        columns = slice(2 + SCANNER_UNKNOWNS * k, 2 + SCANNER_UNKNOWNS * (k + 1))
        flat = G.reshape(-1, SCANNER_UNKNOWNS)
        corner[columns, columns] += flat.T @ AG.reshape(-1, SCANNER_UNKNOWNS)
        corner[:2, :2] += A[:, 3:5, 3:5].sum(axis=0)
        mixed = AG[:, 3:5].sum(axis=0)
        corner[:2, columns] += mixed
        corner[columns, :2] += mixed.T
        corner_gradient[columns] += flat.T @ b.ravel()
        corner_gradient[:2] += b[:, 3:5].sum(axis=0)
        # A scan depends on the four control points about it: terms of each of them, and of each pair.
        by_radii, by_scanner = A[:, :3, 3:5].reshape(-1, 6), AG[:, :3].reshape(len(b), -1)
        terms = np.concatenate([b[:, :3], by_radii, by_scanner], axis=1)
        # A scanner sees a body on a part of its path only.
        begin, end = first[0], first[-1] + 1
        sums = sum_between_knots(first - begin, weights, terms, end - begin + 3)
        singles[:, begin:end] += sums[..., :9]
        for i in range(4):
            border[begin + i : end + i, :, columns] += sums[i, :, 9:].reshape(-1, 3, SCANNER_UNKNOWNS)
        pairs[:, begin:end] += sum_between_knots(
            first - begin, weights[:, EARLIER] * weights[:, LATER], A[:, :3, :3].reshape(-1, 9), end - begin + 3
        )
    for i in range(4):
        gradient[i : count - 3 + i] += singles[i, :, :3]
        border[i : count - 3 + i, :, :2] += singles[i, :, 3:].reshape(-1, 3, 2)
    for earlier, later, block in zip(EARLIER, LATER, pairs, strict=True):
        band[earlier : count - 3 + earlier, later - earlier] += block.reshape(-1, 3, 3)
    scanner_columns = (SCANNER_UNKNOWNS * scanners[:, None] + np.arange(SCANNER_UNKNOWNS)).ravel()
    return BodyEquations(band, gradient, border, corner, corner_gradient, scanner_columns), cost


def raycast_body(state: NetworkState, path: BodyPath, scans: BodyScans, pose: Array, rate: Array) -> RaycastHits:
    """Predicted measurements of a body with the given pose and rate (V, 3) at the scans' times.

    Their Jacobian (N, P) is by the parameters of :class:`ScanEquations`.
    """
    scan = index_scans(scans)
    T = state.T_root_scanner[scans.scanner]
    # Components as separate arrays, for speed.
    x, y, _ = pose.T[:, scan] + scans.beam_delay * rate.T[:, scan]
    cos, sin = np.cos(pose[:, 2])[scan], np.sin(pose[:, 2])[scan]
    axis = rotate_by_small_angles(cos, sin, scans.beam_delay * rate[scan, 2])
    direction = T[:2, :2] @ scans.direction.T
    systematic = state.systematic[scans.scanner]
    turn = compute_turns(systematic, scans.azimuth, scans.double_azimuth)
    if turn.any():
        direction = rotate_by_small_angles(direction[0], direction[1], turn)
    hits = raycast_ellipses_by_axis(T[:2, 2], direction.T, np.stack([x, y]).T, axis, path.radii)
    jacobian, stretch = np.empty((SCAN_PARAMETERS, len(scan))), compute_stretches(systematic, scans.double_azimuth)
    jacobian[:RANGE_ERROR], jacobian[RANGE_ERROR] = stretch * hits.jacobian.T, 1
    across = jacobian[1] * direction[0] - jacobian[0] * direction[1]
    jacobian[AZIMUTH_ERRORS] = differentiate_by_azimuth_errors(
        systematic, scans, hits.ranges, -hits.ranges * across
    )
    ranges = stretch * hits.ranges + systematic[RANGE_BIAS]
    return RaycastHits(ranges, hits.cos_incidence, jacobian.T)


def compute_residuals(network: NetworkProblem, scans: BodyScans, hits: RaycastHits) -> tuple[Array, Array]:
    """Whitened residuals (N,) of beams, and their derivatives as those of the hits."""
    sigma = network.range_sigma[scans.scanner]
    hit = hits.cos_incidence > network.settings.beams.min_hit_cosine
    residual = np.where(hit, (hits.ranges - scans.ranges) / sigma, network.settings.beams.missed_residual)
    return residual, np.where(hit[:, None], hits.jacobian / sigma, 0.0)


def build_scan_equations(
    network: NetworkProblem, state: NetworkState, path: BodyPath, scans: BodyScans, pose: Array, rate: Array
) -> ScanEquations:
    """Equations of the scans of a body with the given pose and rate (V, 3) at the scans' times."""
    residual, jacobian = compute_residuals(network, scans, raycast_body(state, path, scans, pose, rate))
    return sum_over_scans(residual, jacobian, scans.weight, scans.first_beam)


def _linearize_path_prior(
    network: NetworkProblem, body: BodyObservations, path: BodyPath, stretch: float
) -> tuple[Array, Array, float]:
    """Smoothness of the path, and people's heading along it: band, gradient and cost.

    Accelerations are those in measured lengths, ``stretch`` times the true ones.
    """
    control, step = path.control, body.knots.step
    band, gradient = np.zeros((len(control), 4, 3, 3)), np.zeros_like(control)
    smooth = stretch**2 * compute_smoothness_information(step, network.acceleration_density)
    steady = 1 / (step * network.settings.body.turning_density)
    bend = control[:-2, :2] - 2 * control[1:-1, :2] + control[2:, :2]
    for i in range(3):
        gradient[i : len(control) - 2 + i, :2] += smooth[i, 0] * bend
        for j in range(i, 3):
            band[i : len(control) - 2 + i, j - i, [0, 1], [0, 1]] += smooth[i, j]
    turn = np.diff(control[:, 2])
    gradient[:-1, 2] -= steady * turn
    gradient[1:, 2] += steady * turn
    band[:-1, 0, 2, 2] += steady
    band[1:, 0, 2, 2] += steady
    band[:-1, 1, 2, 2] -= steady
    cost = 0.5 * (smooth[0, 0] * float(np.sum(bend**2)) + steady * float(turn @ turn))
    if not body.faces_forward:
        band[:, 0, 2, 2] += 1.0
        return band, gradient, cost
    # The direction of motion is taken as exact: the heading would add hardly any information to the path.
    offset, weight = compute_heading_offsets(body, control[:, :2], control[:, 2:], network.settings.body)
    gradient[:, 2] += weight * offset[:, 0]
    band[:, 0, 2, 2] += weight + _HEADING_RIDGE
    return band, gradient, cost + 0.5 * float(weight @ offset[:, 0] ** 2)


def compute_heading_offsets(
    body: BodyObservations, positions: Array, headings: Array, settings: BodySettings
) -> tuple[Array, Array]:
    """Angles between headings and the direction of motion, with the weights of their prior.

    Args:
        body: whose path it is.
        positions: (K, 2) control points of the path, m.
        headings: (K, G) or (G,) at the control points, rad.
        settings: of the prior.

    Returns:
        Angles (K, G), modulo π because an ellipse has no front, and weights (K,), 1/rad²; zero where people stand.
    """
    velocity = np.gradient(positions, body.knots.step, axis=0)
    walking = np.linalg.norm(velocity, axis=1) > settings.min_walking_speed
    offset = headings - np.arctan2(velocity[:, 1], velocity[:, 0])[:, None]
    return (offset + np.pi / 2) % np.pi - np.pi / 2, walking / settings.heading_sigma**2


def _add_wall(state: NetworkState, wall: WallConstraint, H: Array, g: Array) -> float:
    """Adds a wall constraint to the equations, in place; returns its cost."""
    T_a, T_b = state.T_root_scanner[wall.a], state.T_root_scanner[wall.b]
    errors, by_systematic = linearize_beam_errors(state.systematic[[wall.a, wall.b]])
    error = se2.difference(se2.inverse(T_a) @ T_b, wall.T_a_b) - wall.by_beam_errors @ errors.ravel()
    R, arm = T_a[:2, :2], T_b[:2, 2] - T_a[:2, 2]
    by_a, by_b = np.zeros((2, 3, SCANNER_UNKNOWNS))
    by_b[:2, :2], by_b[2, 2] = R.T, 1
    by_a[:2, :2], by_a[2, 2] = -R.T, -1
    by_a[:2, 2] = -R.T @ np.array([-arm[1], arm[0]])
    beam_errors = slice(FIRST_SYSTEMATIC, FIRST_SYSTEMATIC + len(BEAM_ERRORS))
    by_errors_of_a, by_errors_of_b = np.split(-wall.by_beam_errors, 2, axis=1) @ by_systematic
    by_a[:, beam_errors], by_b[:, beam_errors] = by_errors_of_a, by_errors_of_b
    J = np.concatenate([by_a, by_b], axis=1)
    columns = (SCANNER_UNKNOWNS * np.array([[wall.a], [wall.b]]) + np.arange(SCANNER_UNKNOWNS)).ravel()
    H[np.ix_(columns, columns)] += J.T @ wall.information @ J
    g[columns] += J.T @ wall.information @ error
    return 0.5 * float(error @ wall.information @ error)
