"""Normal equations of a body that is an ellipse whose position and heading follow a spline.

Residuals are ranges along the beams, each at its time of measurement.
"""

from dataclasses import dataclass, replace

import numpy as np

from calgraph.geometry import Array
from calgraph.network.joint.path_equations import (
    add_scans,
    add_stretch,
    compute_smoothness_information,
    compute_stretch,
    evaluate_at,
    index_scans,
)
from calgraph.network.joint.problem import BodyObservations, BodyPath, BodyScans, NetworkProblem, NetworkState
from calgraph.network.joint.scan_equations import (
    AZIMUTH_ERRORS,
    RANGE_ERROR,
    SCAN_PARAMETERS,
    ScanEquations,
    ScanTerms,
    sum_over_scans,
)
from calgraph.network.joint.scanner_unknowns import (
    RANGE_BIAS,
    SCANNER_UNKNOWNS,
    compute_scanner_jacobian,
    compute_stretches,
    compute_turns,
    differentiate_by_azimuth_errors,
    list_columns,
)
from calgraph.network.joint.schur import BodyEquations


@dataclass(frozen=True, eq=False)
class RaycastHits:
    """Intersections of N beams with an ellipse each."""

    ranges: Array
    """(N,) m; NaN where a beam misses its ellipse."""
    cos_incidence: Array
    """(N,) cosines of the angles between beams and outline normals, 0..1; NaN likewise."""
    jacobian: Array
    """(N, 5) of the ranges by the ellipse's position (2, m) and heading (rad) in the beams' frame, and its radii
    (2, m); predicted measurements have more columns."""


def raycast_ellipses(origin: Array, direction: Array, centre: Array, heading: Array, radii: Array) -> RaycastHits:
    """Intersects each beam with its ellipse; all in one frame.

    Args:
        origin: (N, 2) of the beams, m; or (2,) of all of them.
        direction: (N, 2) unit vectors.
        centre: (N, 2) of the ellipses, m.
        heading: (N,) direction of their second radius, rad.
        radii: (N, 2) across and along the heading, m; or (2,) of all of them.
    """
    axis = np.stack([np.cos(heading), np.sin(heading)])
    return raycast_ellipses_by_axis(origin, direction, centre, axis, radii)


def raycast_ellipses_by_axis(
    origin: Array, direction: Array, centre: Array, axis: Array, radii: Array
) -> RaycastHits:
    """As :func:`raycast_ellipses`, with headings given as unit vectors (2, N).

    The hit ``h``, in the axes of the ellipse and divided by its radii, satisfies ``|h| = 1``: the implicit
    derivative of this equation is that of the range.
    """
    c, s = axis
    (x, y), (dx, dy), (radius_across, radius_along) = (origin - centre).T, direction.T, radii.T
    # Beam origins and directions across (u) and along (v) the heading, in units of the radii.
    u, du = (c * y - s * x) / radius_across, (c * dy - s * dx) / radius_across
    v, dv = (c * x + s * y) / radius_along, (c * dx + s * dy) / radius_along
    square, half = du * du + dv * dv, u * du + v * dv
    with np.errstate(invalid="ignore"):
        ranges = (-half - np.sqrt(half * half - square * (u * u + v * v - 1))) / square
    u, v = u + ranges * du, v + ranges * dv
    normal = np.stack([c * v / radius_along - s * u / radius_across, s * v / radius_along + c * u / radius_across])
    slope = normal[0] * dx + normal[1] * dy
    by_heading = (x + ranges * dx) * normal[1] - (y + ranges * dy) * normal[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        jacobian = np.stack([*normal, by_heading, u * u / radius_across, v * v / radius_along]) / slope
        cos_incidence = -slope / np.sqrt(normal[0] ** 2 + normal[1] ** 2)
    return RaycastHits(ranges, cos_incidence, jacobian.T)


def rotate_by_small_angles(c: Array, s: Array, angle: Array) -> Array:
    """Rotates unit vectors with components ``c`` and ``s`` (N,) by small angles (N,), rad: (2, N).

    A body turns by less than 0.1 rad within a scan, where the Taylor series is exact to 2e-9. It is much faster
    than sines and cosines of every beam's angle.
    """
    square = angle * angle
    cos, sin = 1 - square / 2 + square * square / 24, angle * (1 - square / 6 + square * square / 120)
    return np.stack([c * cos - s * sin, s * cos + c * sin])


# Information (1/rad²) that makes headings invertible of bodies that rest: 1000 rad.
_HEADING_RIDGE = 1e-6


def linearize_body(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath
) -> BodyEquations:
    """The equations of an ellipse."""
    count, size = body.knots.count, 2 + SCANNER_UNKNOWNS * len(body.scans)
    stretch = compute_stretch(state, body)
    band, gradient, cost = _linearize_path_prior(network, body, path, stretch)
    parts = border, corner, corner_gradient = np.zeros((count, 3, size)), np.zeros((size, size)), np.zeros(size)
    add_stretch(parts, path.control[:, :2], gradient[:, :2], stretch, len(body.scans))
    radii_information = body.radii_sigma**-2
    corner[[0, 1], [0, 1]] += radii_information
    corner_gradient[:2] += radii_information * (path.radii - body.radii)
    cost += 0.5 * float(radii_information @ (path.radii - body.radii) ** 2)
    columns = list_columns([scans.scanner for scans in body.scans])
    equations = BodyEquations(band, gradient, border, corner, corner_gradient, columns)
    cost += add_scans(
        equations, (linearize_ellipse_scans(network, state, body, path, k) for k in range(len(body.scans)))
    )
    return replace(equations, cost=cost)


def linearize_ellipse_scans(
    network: NetworkProblem, state: NetworkState, body: BodyObservations, path: BodyPath, k: int
) -> ScanTerms:
    """The equations of the scans of an ellipse's k-th scanner; its shape has two radii."""
    scans = body.scans[k]
    first, weights, pose, rate = evaluate_at(network, state, body, path, scans)
    equations = build_scan_equations(network, state, path, scans, pose, rate).marginalize_model_error(
        network.model_error_variance[[0, 0, 1]]
    )
    G = compute_scanner_jacobian(network, state, scans, path.radii, pose, rate)
    return ScanTerms(k, first, weights, equations, G, slice(3, 5), np.array([0, 1]))


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


# Beams with a smaller cosine of incidence (87°) count as missing the ellipse during the iteration: the
# derivatives of their range grow beyond all bounds.
_MIN_HIT_COSINE = 0.05
# Whitened residual of a beam that misses the ellipse during the iteration: the cost of a certain outlier, with
# zero derivative.
_MISSED_RESIDUAL = 4.0


def compute_residuals(network: NetworkProblem, scans: BodyScans, hits: RaycastHits) -> tuple[Array, Array]:
    """Whitened residuals (N,) of beams, and their derivatives as those of the hits."""
    sigma = network.range_sigma[scans.scanner]
    hit = hits.cos_incidence > _MIN_HIT_COSINE
    residual = np.where(hit, (hits.ranges - scans.ranges) / sigma, _MISSED_RESIDUAL)
    return residual, np.where(hit[:, None], hits.jacobian / sigma, 0.0)


def build_scan_equations(
    network: NetworkProblem, state: NetworkState, path: BodyPath, scans: BodyScans, pose: Array, rate: Array
) -> ScanEquations:
    """Equations of the scans of a body with the given pose and rate (V, 3) at the scans' times."""
    residual, jacobian = compute_residuals(network, scans, raycast_body(state, path, scans, pose, rate))
    return sum_over_scans(residual, jacobian, scans.weight, scans.first_beam)


# Spectral density of the turning rate, rad²/s: a standard deviation of 2.2 rad in 1 s, in which people can turn
# round.
TURNING_DENSITY = 5.0


def _linearize_path_prior(
    network: NetworkProblem, body: BodyObservations, path: BodyPath, stretch: float
) -> tuple[Array, Array, float]:
    """Smoothness of the path, and people's heading along it: band, gradient and cost.

    Accelerations are those in measured lengths, ``stretch`` times the true ones.
    """
    control, step = path.control, body.knots.step
    band, gradient = np.zeros((len(control), 4, 3, 3)), np.zeros_like(control)
    smooth = stretch**2 * compute_smoothness_information(step, network.acceleration_density)
    steady = 1 / (step * TURNING_DENSITY)
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
    offset, weight = compute_heading_offsets(body, control[:, :2], control[:, 2:])
    gradient[:, 2] += weight * offset[:, 0]
    band[:, 0, 2, 2] += weight + _HEADING_RIDGE
    return band, gradient, cost + 0.5 * float(weight @ offset[:, 0] ** 2)


# Speed above which the direction of motion determines people's heading, m/s: slower ones shuffle sideways or turn
# on the spot; a walk has 1 to 1.5 m/s.
MIN_WALKING_SPEED = 0.5
# Standard deviation of people's heading about their direction of motion, rad: shoulders turn by about 17° with
# each step.
_HEADING_SIGMA = 0.3


def compute_heading_offsets(body: BodyObservations, positions: Array, headings: Array) -> tuple[Array, Array]:
    """Angles between headings and the direction of motion, with the weights of their prior.

    Args:
        body: whose path it is.
        positions: (K, 2) control points of the path, m.
        headings: (K, G) or (G,) at the control points, rad.

    Returns:
        Angles (K, G), modulo π because an ellipse has no front, and weights (K,), 1/rad²; zero where people stand.
    """
    velocity = np.gradient(positions, body.knots.step, axis=0)
    walking = np.linalg.norm(velocity, axis=1) > MIN_WALKING_SPEED
    offset = headings - np.arctan2(velocity[:, 1], velocity[:, 0])[:, None]
    return (offset + np.pi / 2) % np.pi - np.pi / 2, walking / _HEADING_SIGMA**2
