"""The joint estimator of a network: poses, clocks and systematic errors of scanners, paths and radii of bodies.

Given the scanners, bodies are independent, and the equations of a path are banded: each body
is eliminated separately, which leaves a small problem over scanners, however long the recording.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se2
from calgraph.network.joint.body_batches import BodyBatches, KeptValues
from calgraph.network.joint.body_equations import linearize_body
from calgraph.network.joint.planar_poses import NearCovariances
from calgraph.network.joint.problem import BodyObservations, BodyPath, NetworkProblem, NetworkState, WallConstraint
from calgraph.network.joint.scanner_matrix import NearInverse, ScannerMatrix, ScannerOrder
from calgraph.network.joint.scanner_unknowns import (
    BEAM_ERRORS,
    CLOCK,
    FIRST_SYSTEMATIC,
    SCANNER_UNKNOWNS,
    compute_prior_information,
    linearize_beam_errors,
    list_columns,
)
from calgraph.network.joint.schur import BodyEquations, eliminate_path, substitute_back
from calgraph.network.pairs.scanner_pair import CLOCK_SIGMA
from calgraph.solver.levenberg_marquardt import minimize

# Predicted decrease of the cost (half squared standard deviations) at which the solver stops: no unknown is then
# off by more than 0.2 % of its standard deviation.
_TOLERANCE = 1e-6
# Least radius, m: steps must not make an ellipse degenerate. Bodies are several times larger.
_MIN_RADIUS = 0.02


@dataclass(frozen=True, eq=False)
class NetworkEquations:
    """Normal equations at a state."""

    cost: float
    network: NetworkProblem
    state: NetworkState
    batches: BodyBatches
    """The bodies."""
    body_equations: KeptValues
    """:class:`BodyEquations` of each body."""
    H: ScannerMatrix
    """Of walls and priors, without bodies."""
    g: Array
    """(US,) of these."""
    estimated: NDArray[np.bool_]
    """(US,) neither the root's pose and clock, nor what is exact."""
    regularizer: Array
    """(US,) zero-gradient information of poses; everything else has a prior."""

    @property
    def unknowns(self) -> Index:
        """Columns of what is estimated."""
        return np.flatnonzero(self.estimated)

    @property
    def scanners(self) -> list[Index]:
        """Those that measured each body."""
        return [np.array([scans.scanner for scans in body.scans], dtype=np.intp) for body in self.network.bodies]

    @property
    def columns(self) -> list[Index]:
        """Of the scanners that measured each body, in the equations of all scanners."""
        return [list_columns(scanners.tolist()) for scanners in self.scanners]

    def map(self, function: Callable[..., Any], *others: Any) -> list[Any]:
        """Calls a function for each body with the network, the state, the body, its path and its equations."""
        return self.batches.map(function, self.network, self.state, self.body_equations, *others)

    def eliminate_bodies(self, damping: float = 0.0) -> tuple[ScannerMatrix, Array]:
        """Schur complement of all bodies: matrix and gradient (US,); what is not estimated is fixed."""
        H, g = self.H.add_diagonal(damping * self.H.diagonal), self.g.copy()
        eliminate = partial(eliminate_path, damping=damping)
        reduced = self.batches.map_values(eliminate, self.body_equations)
        for scanners, columns, (body_H, body_g) in zip(self.scanners, self.columns, reduced, strict=True):
            H.add(scanners, body_H)
            g[columns] += body_g
        return H.add_diagonal(self.regularizer).fix(~self.estimated), np.where(self.estimated, g, 0.0)

    def solve(self, damping: float) -> tuple[tuple[Array, list[Array]], float]:
        """Steps (US,) of scanners and of each body, and their predicted decrease of the cost."""
        H, g = self.eliminate_bodies(damping)
        step = -H.factor().solve(g)
        decrease = damping * self.H.diagonal @ step**2 - self.g @ step
        follow, of_scanners = partial(_follow_scanners, damping=damping), [step[one] for one in self.columns]
        followed = self.batches.map_values(follow, self.body_equations, of_scanners)
        decrease += sum(of_body for _, of_body in followed)
        return (step, [body_step for body_step, _ in followed]), 0.5 * float(decrease)


@dataclass(frozen=True, eq=False)
class NetworkCovariance:
    """Covariances of scanners' unknowns, in the root's fixed axes; zero where they are not estimated."""

    inverse: NearInverse
    estimated: NDArray[np.bool_]
    """(US,)."""

    def select(self, columns: Index) -> Array:
        """(m, m) of unknowns (m,); NaN between scanners that are not near each other."""
        selected, exact = self.inverse.select(columns), ~self.estimated[columns]
        selected[exact] = selected[:, exact] = 0.0
        return selected

    def select_pairs(self, pairs: Index, unknowns: slice) -> NearCovariances:
        """Some unknowns of each scanner, of pairs (E, 2) of scanners as :class:`NearCovariances` has them."""
        exact = ~self.estimated.reshape(-1, SCANNER_UNKNOWNS)[pairs]
        blocks = np.where(exact[:, 0, :, None] | exact[:, 1, None], 0.0, self.inverse.select_pairs(pairs))
        return NearCovariances(len(self.estimated) // SCANNER_UNKNOWNS, pairs, blocks[:, unknowns, unknowns])


def compute_network_covariance(equations: NetworkEquations) -> NetworkCovariance:
    """Covariances of all pairs of scanners in small networks, and of near ones in others, at the minimum."""
    H, _ = equations.eliminate_bodies()
    return NetworkCovariance(H.factor().invert(), equations.estimated)


# Networks of more scanners state the covariances of those with common bodies or walls only, as the number of
# pairs grows with the square of the scanners. Their tests compare groups of at most this many.
MAX_JOINT_COVARIANCE = 100


def list_known_pairs(network: NetworkProblem) -> Index:
    """(E, 2) pairs of scanners whose covariances a solution states.

    All of a small network; of others, those with common bodies, walls or priors, and each scanner with itself.
    """
    if network.count <= MAX_JOINT_COVARIANCE:
        return np.column_stack(np.triu_indices(network.count))
    own = np.repeat(np.arange(network.count)[:, None], 2, axis=1)
    return np.concatenate([own, list_links(network)])


def _follow_scanners(equations: BodyEquations, scanner_step: Array, damping: float) -> tuple[Array, float]:
    """The step of path and shape after one of the scanners, and twice the predicted decrease of its cost."""
    step = substitute_back(equations, damping, scanner_step)
    return step, equations.predict_decrease(step, scanner_step, damping)


# Information on a scanner's position about the present estimate, 1/m²: a standard deviation of 100 m keeps a
# scanner in place whose beams all have no weight. A single beam has more than 10⁵ times as much.
_POSITION_PRIOR_INFORMATION = 1e-4
# The same of its rotation, 1/rad²: a standard deviation of 3.2 rad, half a turn.
_ROTATION_PRIOR_INFORMATION = 0.1


def linearize_network(
    network: NetworkProblem,
    state: NetworkState,
    batches: BodyBatches | None = None,
    order: ScannerOrder | None = None,
) -> NetworkEquations:
    """The normal equations at a state.

    Args:
        network: the problem.
        state: values of its unknowns.
        batches: its bodies, where they have been placed already.
        order: of its scanners, if it is known already.
    """
    batches = batches or BodyBatches.place(network.bodies)
    H, g = ScannerMatrix.zeros(order or order_scanners(network)), np.zeros(SCANNER_UNKNOWNS * network.count)
    kept = batches.keep(linearize_body, network, state)
    cost = sum(batches.map_values(attrgetter("cost"), kept), 0.0)
    cost += add_walls(state, network.walls, H, g)
    if network.prior:
        cost += network.prior.add_to_equations(state.T_root_scanner, H, g)
    estimated = np.ones((network.count, SCANNER_UNKNOWNS), dtype=np.bool_)
    estimated[:, FIRST_SYSTEMATIC:] = network.systematic_sigma > 0
    H, prior_cost = _add_priors(network, state, H, g)
    estimated[0, :FIRST_SYSTEMATIC] = False
    regularizer = np.zeros((network.count, SCANNER_UNKNOWNS))
    regularizer[:, :2] = _POSITION_PRIOR_INFORMATION
    regularizer[:, 2] = _ROTATION_PRIOR_INFORMATION
    return NetworkEquations(
        cost + prior_cost, network, state, batches, kept, H, g, estimated.ravel(), regularizer.ravel()
    )


def list_links(network: NetworkProblem) -> Index:
    """(E, 2) pairs of scanners with common bodies, walls or priors."""
    groups = [{scans.scanner for scans in body.scans} for body in network.bodies]
    if network.prior:
        groups.append(set(network.prior.nodes.tolist()))
    links = {(wall.a, wall.b) for wall in network.walls}.union(*(combinations(sorted(g), 2) for g in groups))
    return np.array(sorted(links), dtype=np.intp).reshape(-1, 2)


def order_scanners(network: NetworkProblem) -> ScannerOrder:
    """The order of a network's scanners; in small networks, all of them are linked."""
    if network.count <= MAX_JOINT_COVARIANCE:
        return ScannerOrder.complete(network.count, SCANNER_UNKNOWNS)
    return ScannerOrder.from_links(network.count, list_links(network), SCANNER_UNKNOWNS)


def _add_priors(
    network: NetworkProblem, state: NetworkState, H: ScannerMatrix, g: Array
) -> tuple[ScannerMatrix, float]:
    """Adds the priors of what is estimated, poses aside; returns the matrix and the cost, g changes in place."""
    information = np.zeros((network.count, SCANNER_UNKNOWNS))
    information[:, CLOCK] = CLOCK_SIGMA**-2
    information[:, FIRST_SYSTEMATIC:], of_systematic = compute_prior_information(network.systematic_sigma)
    by_scanner = np.zeros((*information.shape, of_systematic.shape[-1]))
    by_scanner[:, FIRST_SYSTEMATIC:] = of_systematic
    common = by_scanner.reshape(len(g), -1)
    values = np.column_stack([np.zeros((network.count, 3)), state.clock_offset, state.systematic]).ravel()
    gradient = information.ravel() * values - common @ (common.T @ values)
    g += gradient
    return replace(H.add_diagonal(information.ravel()), common=common), 0.5 * float(values @ gradient)


# Initial damping of each solution, relative to the diagonal: with few steps, rejected ones are expensive. With
# 1e-5, one of 24 simulated networks, of wrongly stated radii, did not converge.
_INITIAL_DAMPING = 1e-3


def optimize_network(
    network: NetworkProblem,
    state: NetworkState,
    *,
    iterations: int,
    tolerance: float = _TOLERANCE,
    relative_tolerance: float = 0.0,
    damping: float | None = None,
    batches: BodyBatches | None = None,
) -> tuple[NetworkState, NetworkEquations]:
    """Minimises the cost over all unknowns.

    Args:
        network: the problem, whose robust weights are constant.
        state: start values.
        iterations: steps at most, rejected ones included.
        tolerance: predicted decrease of the cost, in half squared standard deviations, to stop at.
        relative_tolerance: the same as a share of the cost.
        damping: initial value, if not the usual one.
        batches: the bodies, where they have been placed already.
    """
    batches, order = batches or BodyBatches.place(network.bodies), order_scanners(network)
    minimum = minimize(
        state,
        lambda state, _: linearize_network(network, state, batches, order),
        lambda state, step: apply_step(network, state, *step),
        iterations=iterations,
        tolerance=tolerance,
        relative_tolerance=relative_tolerance,
        damping=_INITIAL_DAMPING if damping is None else damping,
    )
    return minimum.state, minimum.linearization


def apply_step(
    network: NetworkProblem, state: NetworkState, step: Array, body_steps: Sequence[Array]
) -> NetworkState:
    """The state after steps (US,) of scanners, and of each body's path and shape."""
    steps = step.reshape(-1, SCANNER_UNKNOWNS)
    paths = tuple(_move_path(*one) for one in zip(network.bodies, state.paths, body_steps, strict=True))
    return NetworkState(
        se2.retract(state.T_root_scanner, steps[:, :3]),
        state.clock_offset + steps[:, CLOCK],
        state.systematic + steps[:, FIRST_SYSTEMATIC:],
        paths,
    )


def _move_path(body: BodyObservations, path: BodyPath, step: Array) -> BodyPath:
    """The path after a step (3K + B,) of control points and shape."""
    control, shape = np.split(step, [path.control.size])
    moved = path.shape + shape
    moved[: body.radius_count] = np.maximum(moved[: body.radius_count], _MIN_RADIUS)
    return BodyPath(path.control + control.reshape(-1, 3), moved)


def add_walls(state: NetworkState, walls: Sequence[WallConstraint], H: ScannerMatrix, g: Array) -> float:
    """Adds wall constraints to the equations, in place; returns their cost."""
    if not walls:
        return 0.0
    pairs = np.array([(wall.a, wall.b) for wall in walls], dtype=np.intp)
    information = np.stack([wall.information for wall in walls])
    by_errors = np.stack([wall.by_beam_errors for wall in walls])
    T_a, T_b = state.T_root_scanner[pairs.T]
    errors, by_systematic = linearize_beam_errors(state.systematic[pairs])
    difference = se2.difference(se2.inverse(T_a) @ T_b, np.stack([wall.T_a_b for wall in walls]))
    error = difference[..., None] - by_errors @ errors.reshape(len(walls), -1, 1)
    R_transposed, arm = np.swapaxes(T_a[:, :2, :2], 1, 2), T_b[:, :2, 2] - T_a[:, :2, 2]
    J = np.zeros((len(walls), 3, 2 * SCANNER_UNKNOWNS))
    by_a, by_b = J[..., :SCANNER_UNKNOWNS], J[..., SCANNER_UNKNOWNS:]
    by_b[:, :2, :2], by_b[:, 2, 2] = R_transposed, 1
    by_a[:, :2, :2], by_a[:, 2, 2] = -R_transposed, -1
    across = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    by_a[:, :2, 2] = -(R_transposed @ across[..., None])[..., 0]
    beam_errors = slice(FIRST_SYSTEMATIC, FIRST_SYSTEMATIC + len(BEAM_ERRORS))
    by_errors_of_a, by_errors_of_b = np.split(-by_errors, 2, axis=2)
    by_a[..., beam_errors] = by_errors_of_a @ by_systematic[:, 0]
    by_b[..., beam_errors] = by_errors_of_b @ by_systematic[:, 1]
    J_transposed = np.swapaxes(J, 1, 2)
    blocks, gradients = J_transposed @ information @ J, (J_transposed @ information @ error)[..., 0]
    for pair, block, gradient in zip(pairs.tolist(), blocks, gradients, strict=True):
        H.add(np.array(pair), block)
        g[list_columns(pair)] += gradient
    return 0.5 * float(np.sum(error * (information @ error)))
