"""Normal equations of one leg over its path, its shape, a bias of each scanner's ranges, and the scanners.

The outline of a leg differs from the model in a way that depends on the side from which a scanner measures it. The
bias of each scanner and leg stands for that; the elimination of the leg marginalises it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array
from calgraph.network.joint.ellipse_equations import rotate_by_small_angles
from calgraph.network.joint.leg_problem import HARMONICS, LegObservations, LegPath, compute_shape_prior
from calgraph.network.joint.path_equations import (
    add_scans,
    add_stretch,
    compute_smoothness_information,
    compute_stretch,
    evaluate_at,
    index_scans,
)
from calgraph.network.joint.problem import BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.scan_equations import (
    AZIMUTH_ERRORS,
    RANGE_ERROR,
    SCAN_PARAMETERS,
    ScanTerms,
    sum_over_scans,
)
from calgraph.network.joint.scanner_unknowns import (
    FIRST_SYSTEMATIC,
    RANGE_BIAS,
    RANGE_SCALE,
    SCANNER_UNKNOWNS,
    compute_scan_stretches,
    compute_scanner_jacobian,
    compute_stretches,
    compute_turns,
    differentiate_by_azimuth_errors,
    list_columns,
)
from calgraph.network.joint.schur import BodyEquations

# Scale r₀ of the amplitudes of the ellipse, m: it makes them comparable with those of harmonics.
_SCALE = 0.065


@dataclass(frozen=True, eq=False)
class LegHits:
    """Predicted ranges of N beams to legs."""

    ranges: Array
    """(N,) m."""
    slope: Array
    """(N,) derivative of the range by the beam's offset from the centre: the effect of lateral errors."""
    jacobian: Array
    """(N, 3 + B) of the ranges by position (2, m) and heading (rad) of the leg in the beams' frame, and by the
    B parameters of its shape, m."""


def raycast_legs(
    origin: Array,
    direction: Array,
    center: Array,
    heading: Array,
    shape: Array,
    harmonics: Sequence[int],
    max_edge_ratio: float,
) -> LegHits:
    """Predicts the range of each beam to its leg; all in one frame.

    Args:
        origin: (2,) of the beams, m.
        direction: (N, 2) unit vectors.
        center: (N, 2) of the leg, m.
        heading: (N,) rad.
        shape: (B,) radius r, amplitudes a and b of the ellipse, and the amplitude of each harmonic, m.
        harmonics: their orders.
        max_edge_ratio: offset over radius from which the outline is continued linearly.
    """
    radius, a, b = shape[:3]
    c, s = np.cos(2 * heading), np.sin(2 * heading)
    A, B = (a * c - b * s) / _SCALE, (a * s + b * c) / _SCALE
    q, d = (center - origin).T, direction.T
    scaled = _scale(A, B, d)
    length = np.hypot(*scaled)
    u = scaled / length
    n = np.stack([-u[1], u[0]])
    along, e = _dot(q_scaled := _scale(A, B, q), u), _dot(q_scaled, n)
    x = e / radius
    inside = np.clip(x, -max_edge_ratio, max_edge_ratio)
    cos = np.sqrt(1 - inside * inside)
    depth_slope = -inside / cos
    depth = cos + depth_slope * (x - inside)
    angle = np.arctan2(u[1], u[0]) + np.pi + np.arcsin(inside) - heading
    deviation, by_angle, by_harmonics = np.zeros_like(x), np.zeros_like(x), []
    for k, amplitude in zip(harmonics, shape[3:], strict=True):
        c_k = np.cos(k * angle)
        deviation += amplitude * c_k
        by_angle -= k * amplitude * np.sin(k * angle)
        by_harmonics.append(-c_k / cos)
    by_e = -depth_slope - np.where(x == inside, (by_angle + deviation * x / cos) / (cos**2 * radius), 0.0)
    ranges = along - radius * depth - deviation / cos
    by_q = u + n * by_e
    by_turn = e - along * by_e - by_angle / cos

    def by_matrix(q_change: Array, d_change: Array) -> Array:
        """Derivative by an entry of S, which changes the scaled centre and direction as given."""
        turn = _dot(n, d_change) / length
        return np.asarray((_dot(by_q, q_change) + turn * by_turn - ranges * _dot(u, d_change) / length) / length)

    by_A = by_matrix(np.stack([-q[0], q[1]]), np.stack([-d[0], d[1]]))
    by_B = by_matrix(-q[::-1], -d[::-1])
    by_center = _scale(A, B, by_q) / length
    jacobian = [
        *by_center,
        2 * (A * by_B - B * by_A) + by_angle / (cos * length),
        (-depth - x * by_e) / length,
        (c * by_A + s * by_B) / _SCALE,
        (c * by_B - s * by_A) / _SCALE,
        *(column / length for column in by_harmonics),
    ]
    return LegHits(ranges / length, by_e, np.stack(jacobian, axis=1))


def _scale(A: Array, B: Array, vectors: Array) -> Array:
    """Vectors (2, N) in scaled coordinates."""
    x, y = vectors
    return np.stack([x - A * x - B * y, y - B * x + A * y])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1])


# Zero-gradient information (1/m², 1/rad²) that keeps control points without measurements invertible: 30 m, 10 rad.
_POSITION_RIDGE, _HEADING_RIDGE = 1e-3, 1e-2


# Offset of a beam from the centre, over the radius, beyond which the outline is continued linearly: its slope is
# infinite at the edge. Edges determine the radius, so these beams count.
_MAX_EDGE_RATIO = 0.92


def raycast_leg(state: NetworkState, path: LegPath, scans: BodyScans, pose: Array, rate: Array) -> LegHits:
    """Predicted measurements of a leg with the given pose and rate (V, 3) at the scans' times, without its bias.

    Their Jacobian has the columns of :class:`LegHits`, an error of all ranges (m), the angle scale, and the
    stretches.
    """
    scan = index_scans(scans)
    T = state.T_root_scanner[scans.scanner]
    x, y, heading = pose.T[:, scan] + scans.beam_delay * rate.T[:, scan]
    direction = T[:2, :2] @ scans.direction.T
    systematic = state.systematic[scans.scanner]
    turn = compute_turns(systematic, scans.azimuth, scans.double_azimuth)
    direction = rotate_by_small_angles(direction[0], direction[1], turn)
    hits = raycast_legs(
        T[:2, 2], direction.T, np.stack([x, y], axis=1), heading, path.shape, HARMONICS, _MAX_EDGE_RATIO
    )
    stretch = compute_stretches(systematic, scans.double_azimuth)
    jacobian = stretch[:, None] * hits.jacobian
    # A rotation of the beam acts like the opposite one of the leg about the scanner.
    by_rotation = (y - T[1, 2]) * jacobian[:, 0] - (x - T[0, 2]) * jacobian[:, 1] - jacobian[:, 2]
    by_azimuth_errors = differentiate_by_azimuth_errors(systematic, scans, hits.ranges, by_rotation)
    return replace(
        hits,
        ranges=stretch * hits.ranges + systematic[RANGE_BIAS],
        jacobian=np.column_stack([jacobian, np.ones(len(scan)), by_azimuth_errors.T]),
    )


# Standard deviation of the outline across a beam, m; times the slope of the range, it adds to the noise. Folds of
# trousers and the width of beams (0.2° are 14 mm at 4 m) move edges. Over eight simulated recordings, 4 mm gave a
# NEES of 2.2, 8 mm 1.4 and 12 mm 1.05, at the same error of 1.8 mm.
_EDGE_SIGMA = 0.01


def compute_leg_residuals(
    network: NetworkProblem, scans: BodyScans, hits: LegHits, bias: float
) -> tuple[Array, Array]:
    """Whitened residuals (N,), and their standard deviations (N,), m: ranges are less certain near the edges."""
    sigma = np.hypot(network.range_sigma[scans.scanner], _EDGE_SIGMA * hits.slope)
    return (hits.ranges + bias - scans.ranges) / sigma, sigma


def linearize_leg_scans(
    network: NetworkProblem, state: NetworkState, leg: LegObservations, path: LegPath, k: int
) -> ScanTerms:
    """The equations of the scans of a leg's k-th scanner; the error of all its ranges is its bias."""
    scans, shapes = leg.scans[k], len(path.shape)
    first, weights, pose, rate = evaluate_at(network, state, leg, path, scans)
    hits = raycast_leg(state, path, scans, pose, rate)
    residual, sigma = compute_leg_residuals(network, scans, hits, float(path.bias[k]))
    G = _compute_scanner_jacobian(network, state, path, scans, pose, rate)
    equations = sum_over_scans(residual, hits.jacobian / sigma[:, None], scans.weight, scans.first_beam)
    shape_columns = np.concatenate([np.arange(shapes), [shapes + k]])
    return ScanTerms(k, first, weights, equations, G, slice(3, 4 + shapes), shape_columns)


def linearize_leg(
    network: NetworkProblem, state: NetworkState, leg: LegObservations, path: LegPath
) -> BodyEquations:
    """A leg's equations; the local unknowns are its shape (B,) and the bias of each scanner (L,)."""
    count, shapes = leg.knots.count, len(path.shape)
    local = shapes + len(leg.scans)
    size = local + SCANNER_UNKNOWNS * len(leg.scans)
    stretch = compute_stretch(state, leg)
    band, gradient, cost = _linearize_leg_path(leg, path, stretch)
    parts = border, corner, corner_gradient = np.zeros((count, 3, size)), np.zeros((size, size)), np.zeros(size)
    add_stretch(parts, path.control[:, :2], gradient[:, :2], stretch, len(leg.scans))
    mean, sigma = compute_shape_prior()
    information = np.concatenate([sigma**-2, np.full(len(leg.scans), 1 / leg.bias_variance)])
    deviation = np.concatenate([path.shape - mean, path.bias])
    corner[np.arange(local), np.arange(local)] = information
    corner_gradient[:local] = information * deviation
    cost += 0.5 * float(information @ deviation**2)
    columns = list_columns([scans.scanner for scans in leg.scans])
    equations = BodyEquations(band, gradient, border, corner, corner_gradient, columns)
    cost += add_scans(
        equations, (linearize_leg_scans(network, state, leg, path, k) for k in range(len(leg.scans)))
    )
    return replace(equations, cost=cost)


def _compute_scanner_jacobian(
    network: NetworkProblem, state: NetworkState, path: LegPath, scans: BodyScans, pose: Array, rate: Array
) -> Array:
    """(V, n, U) of the columns of :func:`raycast_leg` by the scanner's unknowns."""
    bias_row = 3 + len(path.shape)
    rows = [0, 1, 2, *(bias_row + np.arange(1 + len(AZIMUTH_ERRORS)))]
    G = np.zeros((len(pose), len(path.shape) + SCAN_PARAMETERS - 2, SCANNER_UNKNOWNS))
    common = compute_scanner_jacobian(network, state, scans, path.radii, pose, rate)
    G[:, rows] = common[:, [0, 1, 2, RANGE_ERROR, *AZIMUTH_ERRORS]]
    # All lengths of the shape scale with ranges but the amplitudes of the ellipse, which are relative.
    lengths = path.shape.copy()
    lengths[1:3] = 0
    G[:, 3:bias_row, FIRST_SYSTEMATIC + RANGE_SCALE] = lengths / compute_scan_stretches(state, scans)
    return G


# Spectral density of the turning rate of a leg, rad²/s: a standard deviation of 1.4 rad in 1 s.
_TURNING_DENSITY = 2.0


def _linearize_leg_path(leg: LegObservations, path: LegPath, stretch: float) -> tuple[Array, Array, float]:
    """Smoothness of position and heading, and the heading along the walk: band, gradient and cost."""
    control, step = path.control, leg.knots.step
    band, gradient = np.zeros((len(control), 4, 3, 3)), np.zeros_like(control)
    smooth = stretch**2 * compute_smoothness_information(step, leg.acceleration_density)
    bend = control[:-2, :2] - 2 * control[1:-1, :2] + control[2:, :2]
    for i in range(3):
        gradient[i : len(control) - 2 + i, :2] += smooth[i, 0] * bend
        for j in range(i, 3):
            band[i : len(control) - 2 + i, j - i, [0, 1], [0, 1]] += smooth[i, j]
    steady = 1 / (step * _TURNING_DENSITY)
    turn = np.diff(control[:, 2])
    gradient[:-1, 2] -= steady * turn
    gradient[1:, 2] += steady * turn
    band[:-1, 0, 2, 2] += steady
    band[1:, 0, 2, 2] += steady
    band[:-1, 1, 2, 2] -= steady
    offset = control[:, 2] - leg.heading
    gradient[:, 2] += leg.heading_information * offset
    band[:, 0, 2, 2] += leg.heading_information + _HEADING_RIDGE
    band[:, 0, [0, 1], [0, 1]] += _POSITION_RIDGE
    squares = smooth[0, 0] * np.sum(bend**2) + steady * (turn @ turn) + leg.heading_information @ offset**2
    return band, gradient, 0.5 * float(squares)
