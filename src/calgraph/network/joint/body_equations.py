"""Normal equations of one body over its path, its shape, and the scanners that measured it.

Residuals are ranges along the beams, each at its time of measurement. All that depends on the kind of body is in
:class:`BodyObservations`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.path_equations import (
    add_scans,
    add_stretch,
    compute_smoothness_information,
    compute_stretch,
    evaluate_at,
    index_scans,
)
from calgraph.network.joint.problem import (
    BodyHits,
    BodyObservations,
    BodyPath,
    BodyScans,
    NetworkProblem,
    NetworkState,
    PlacedBeams,
)
from calgraph.network.joint.scan_equations import TUKEY_LIMIT, ScanEquations, ScanTerms, TukeyLoss, sum_over_scans
from calgraph.network.joint.scanner_unknowns import (
    RANGE_BIAS,
    SCANNER_UNKNOWNS,
    compute_scanner_jacobian,
    compute_stretches,
    compute_turns,
    differentiate_by_azimuth_errors,
    rotate_by_small_angles,
)
from calgraph.network.joint.schur import BodyEquations
from calgraph.parallel.mapped_arrays import ArrayMemory

# Whitened residual of a beam that misses its body during the iteration: the cost of a certain outlier, with zero
# derivative.
_MISSED_RESIDUAL = 4.0


@dataclass(frozen=True, eq=False)
class PredictedBeams:
    """One scanner's N beams on a body, in V scans, with their residuals at a state."""

    scans: BodyScans
    scan: Index
    """(N,) index of each beam's scan, ascending."""
    first: Index
    """(V,) the first of the four control points that a scan depends on."""
    weights: Array
    """(V, 4) of these."""
    pose: Array
    """(V, 3) of the body."""
    rate: Array
    """(V, 3) of the pose, 1/s."""
    error: Array
    """(N,) predicted minus measured range, m; NaN where a beam misses the body."""
    residual: Array
    """(N,) the same, whitened, with that of an outlier where a beam misses."""
    sigma: Array
    """(N,) standard deviations of ranges, m."""
    jacobian: Array
    """(P, N) of the residuals by the parameters of :class:`ScanEquations`."""
    hits: BodyHits
    """The hits of exact beams."""

    def sum_over_scans(self) -> ScanEquations:
        """Their normal equations."""
        return sum_over_scans(self.residual, self.jacobian, self.scans.weight, self.scans.first_beam)


def predict_beams(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> Iterator[PredictedBeams]:
    """The beams of each scanner on a body, predicted at a state."""
    return (predict_scanner(network, state, body, path, k) for k in range(len(body.scans)))


def predict_scanner(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath, k: int
) -> PredictedBeams:
    """The beams of the k-th scanner of a body."""
    scans = body.scans[k]
    first, weights, pose, rate = evaluate_at(network, state, body, path, scans)
    scan, T, systematic = index_scans(scans), state.T_root_scanner[scans.scanner], state.systematic[scans.scanner]
    direction = T[:2, :2] @ scans.direction.T
    turn = compute_turns(systematic, scans.azimuth, scans.double_azimuth)
    if turn.any():
        direction = rotate_by_small_angles(direction[0], direction[1], turn)
    stretch = compute_stretches(systematic, scans.double_azimuth)
    hits = body.raycast(path, PlacedBeams(T[:2, 2], direction, scan, scans.beam_delay, stretch, pose, rate))
    bias = float(path.shape[len(hits.jacobian) - 3 + k]) if body.has_biases else 0.0
    error = stretch * hits.ranges + systematic[RANGE_BIAS] + bias - scans.ranges
    by_azimuth_errors = differentiate_by_azimuth_errors(systematic, scans, hits.ranges, hits.by_turn)
    jacobian = np.concatenate([hits.jacobian, np.ones((1, len(scan))), by_azimuth_errors])
    sigma = np.hypot(network.range_sigma[scans.scanner], hits.edge_sigma)
    residual = np.where(hits.hit, error / sigma, _MISSED_RESIDUAL)
    whitened = np.where(hits.hit, jacobian / sigma, 0.0)
    return PredictedBeams(scans, scan, first, weights, pose, rate, error, residual, sigma, whitened, hits)


def update_weights(
    network: NetworkProblem, state: NetworkState, batches: BodyBatches, near_side_factor: float = 1.0
) -> tuple[NetworkProblem, BodyBatches]:
    """The network with robust weights of beams at a state, and its bodies; the factor is that of the weights."""
    compute_weights = partial(_compute_weights, near_side_factor=near_side_factor)
    memory, bodies = ArrayMemory(network.settings.max_kept_bytes), list[BodyObservations]()
    for part in batches.divide():
        weights = memory.limit(part.map(compute_weights, network, state))
        for body, of_scanners in zip(network.bodies[len(bodies) :], weights, strict=False):
            scans = (replace(one, weight=weight) for one, weight in zip(body.scans, of_scanners, strict=True))
            bodies.append(replace(body, scans=tuple(scans)))
    return replace(network, bodies=tuple(bodies)), BodyBatches.place(bodies, batches.engine)


def _compute_weights(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath, near_side_factor: float
) -> list[Array]:
    """Weights (N,) of each scanner's beams on a body."""
    loss = TukeyLoss(TUKEY_LIMIT)
    return [
        loss.compute_weights(beams.residual, beams.hits.frontal, near_side_factor)
        for beams in predict_beams(network, state, body, path)
    ]


def linearize_scans(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath, k: int
) -> ScanTerms:
    """The equations of the scans of a body's k-th scanner."""
    beams, lengths = predict_scanner(network, state, body, path, k), body.differentiate_by_scale(path)
    equations, own = beams.sum_over_scans(), np.arange(len(lengths))
    if body.has_biases:  # that of the scanner is the error of all its ranges
        own = np.append(own, len(lengths) + k)
    else:
        equations = equations.marginalize_model_error(network.model_error_variance[[0, 0, 1]])
    G = compute_scanner_jacobian(network, state, beams.scans, lengths, beams.pose, beams.rate)
    return ScanTerms(k, beams.first, beams.weights, equations, G, slice(3, 3 + len(own)), own)


def linearize_body(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> BodyEquations:
    """The equations of a body."""
    mean, information = body.shape_prior
    equations = BodyEquations.zeros(body.knots.count, len(mean), SCANNER_UNKNOWNS * len(body.scans))
    cost = _add_path_prior(equations, network, state, body, path)
    deviation, own = path.shape - mean, np.arange(len(mean))
    equations.corner[own, own] += information
    equations.corner_gradient[own] += information * deviation
    cost += 0.5 * float(information @ deviation**2)
    cost += add_scans(equations, (linearize_scans(network, state, body, path, k) for k in range(len(body.scans))))
    return replace(equations, cost=cost)


def _add_path_prior(
    equations: BodyEquations, network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> float:
    """Adds the smoothness of a path and the prior of its headings, in place; returns their cost.

    Accelerations are those in measured lengths, ``stretch`` times the true ones.
    """
    band, gradient, prior = equations.band, equations.gradient, body.find_path_prior(network, path)
    control, step, stretch = path.control, body.knots.step, compute_stretch(state, body)
    smooth = stretch**2 * compute_smoothness_information(step, prior.acceleration_density)
    bend = control[:-2, :2] - 2 * control[1:-1, :2] + control[2:, :2]
    for i in range(3):
        gradient[i : len(control) - 2 + i, :2] += smooth[i, 0] * bend
        for j in range(i, 3):
            band[i : len(control) - 2 + i, j - i, [0, 1], [0, 1]] += smooth[i, j]
    add_stretch(equations, control[:, :2], gradient[:, :2], stretch, len(body.scans))
    steady = 1 / (step * prior.turning_density)
    turn = np.diff(control[:, 2])
    gradient[:-1, 2] -= steady * turn
    gradient[1:, 2] += steady * turn
    band[:-1, 0, 2, 2] += steady
    band[1:, 0, 2, 2] += steady
    band[:-1, 1, 2, 2] -= steady
    of_positions, of_headings = prior.ridge
    gradient[:, 2] += prior.heading_information * prior.heading_offset
    band[:, 0, 2, 2] += prior.heading_information + of_headings
    band[:, 0, [0, 1], [0, 1]] += of_positions
    squares = smooth[0, 0] * np.sum(bend**2) + steady * (turn @ turn)
    return 0.5 * float(squares + prior.heading_information @ prior.heading_offset**2)
