"""Bodies that are ellipses, such as people at the height of the torso, and cylinders; headings of people who turn.

Where people turn round on the spot, the path does not determine the side, and least squares does not get from one
side to the other; the ranges to the outline do. The best sequence of headings on a grid is found by dynamic
programming. An ellipse has no front: headings are modulo π.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from calgraph.geometry import Array, Index
from calgraph.network.joint.body_batches import BodyBatches
from calgraph.network.joint.path_equations import evaluate_at, index_scans
from calgraph.network.joint.problem import (
    BodyHits,
    BodyObservations,
    BodyPath,
    BodyScans,
    NetworkProblem,
    NetworkState,
    PathPrior,
    PlacedBeams,
)
from calgraph.network.joint.scanner_unknowns import (
    RANGE_BIAS,
    compute_stretches,
    compute_turns,
    rotate_by_small_angles,
)


@dataclass(frozen=True, eq=False)
class RaycastHits:
    """Intersections of N beams with an ellipse each."""

    ranges: Array
    """(N,) m; NaN where a beam misses its ellipse."""
    cos_incidence: Array
    """(N,) cosines of the angles between beams and outline normals, 0..1; NaN likewise."""
    jacobian: Array
    """(N, 5) of the ranges by the ellipse's position (2, m) and heading (rad) in the beams' frame, and its radii
    (2, m)."""


def raycast_ellipses(origin: Array, direction: Array, centre: Array, axis: Array, radii: Array) -> RaycastHits:
    """Intersects each beam with its ellipse; all in one frame.

    The hit ``h``, in the axes of the ellipse and divided by its radii, satisfies ``|h| = 1``: the implicit
    derivative of this equation is that of the range.

    Args:
        origin: (N, 2) of the beams, m; or (2,) of all of them.
        direction: (N, 2) unit vectors.
        centre: (N, 2) of the ellipses, m.
        axis: (2, N) unit vectors along their second radius, the heading.
        radii: (N, 2) across and along the heading, m; or (2,) of all of them.
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


# Information (1/rad²) that makes headings invertible of people who rest: 1000 rad.
_HEADING_RIDGE = 1e-6
# The same of cylinders, whose ranges do not depend on it: 1 rad.
_CYLINDER_HEADING_RIDGE = 1.0
# Spectral density of the turning rate, rad²/s: a standard deviation of 2.2 rad in 1 s, in which people can turn
# round.
TURNING_DENSITY = 5.0
# Beams with a smaller cosine of incidence (87°) count as missing the ellipse during the iteration: the
# derivatives of their range grow beyond all bounds.
_MIN_HIT_COSINE = 0.05
# Minimum cosine of incidence of beams that count, 70°: beyond, errors of a beam's direction exceed those of its
# range (1 mrad at 5 m gives 14 mm), and its width covers more than the outline.
_MIN_FRONTAL_COSINE = 0.35


@dataclass(frozen=True, eq=False)
class EllipseObservations(BodyObservations):
    """All measurements of an ellipse, whose shape is its radii."""

    radii: Array
    """(2,) prior mean across and along its heading, m."""
    radii_sigma: Array
    """(2,) prior standard deviation, m."""
    faces_forward: bool
    """Whether its heading follows its direction of motion, as people's does and a cylinder's does not."""
    has_biases: ClassVar[bool] = False
    radius_count: ClassVar[int] = 2

    @property
    def kind(self) -> Literal["ellipses", "cylinders", "legs"]:
        """Of several of these."""
        return "ellipses" if self.faces_forward else "cylinders"

    @property
    def shape_prior(self) -> tuple[Array, Array]:
        """Mean and information of the radii."""
        return self.radii, self.radii_sigma**-2

    def find_path_prior(self, network: NetworkProblem, path: BodyPath) -> PathPrior:
        """People look along their path; the direction of motion is taken as exact.

        The heading would add hardly any information to the path.
        """
        densities = network.acceleration_density, TURNING_DENSITY
        if not self.faces_forward:
            none = np.zeros(len(path.control))
            return PathPrior(*densities, none, none, (0.0, _CYLINDER_HEADING_RIDGE))
        offset, information = compute_heading_offsets(self, path.control[:, :2], path.control[:, 2:])
        return PathPrior(*densities, offset[:, 0], information, (0.0, _HEADING_RIDGE))

    def raycast(self, path: BodyPath, beams: PlacedBeams) -> BodyHits:
        """Where beams meet the ellipse."""
        scan, pose, rate = beams.scan, beams.pose, beams.rate
        # Components as separate arrays, for speed.
        x, y, _ = pose.T[:, scan] + beams.delay * rate.T[:, scan]
        cos, sin = np.cos(pose[:, 2])[scan], np.sin(pose[:, 2])[scan]
        axis = rotate_by_small_angles(cos, sin, beams.delay * rate[scan, 2])
        hits = raycast_ellipses(beams.origin, beams.direction.T, np.stack([x, y]).T, axis, path.shape)
        jacobian = beams.stretch * hits.jacobian.T
        across = jacobian[1] * beams.direction[0] - jacobian[0] * beams.direction[1]
        return BodyHits(
            hits.ranges,
            jacobian,
            -hits.ranges * across,
            hits.cos_incidence > _MIN_HIT_COSINE,
            hits.cos_incidence > _MIN_FRONTAL_COSINE,
            np.zeros(len(scan)),
        )

    def differentiate_by_scale(self, path: BodyPath) -> Array:
        """The radii."""
        return path.shape


# Speed above which the direction of motion determines people's heading, m/s: slower ones shuffle sideways or turn
# on the spot; a walk has 1 to 1.5 m/s.
MIN_WALKING_SPEED = 0.5
# Standard deviation of people's heading about their direction of motion, rad: shoulders turn by about 17° with
# each step.
_HEADING_SIGMA = 0.3


def compute_heading_offsets(body: EllipseObservations, positions: Array, headings: Array) -> tuple[Array, Array]:
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


def search_headings(network: NetworkProblem, state: NetworkState, batches: BodyBatches) -> NetworkState:
    """The state with the best headings of people, given their paths' positions and their radii."""
    return replace(state, paths=tuple(batches.map(_search_body, network, state)))


# Headings over a half turn: steps of 10°, of which the half is well below the noise of a heading.
_GRID_SIZE = 18


def _search_body(
    network: NetworkProblem, state: NetworkState, body: EllipseObservations, path: BodyPath
) -> BodyPath:
    if not body.faces_forward:
        return path
    size = _GRID_SIZE
    grid = np.pi * np.arange(size) / size
    cost = np.zeros((body.knots.count, size))
    for scans in body.scans:
        nearest, beam_cost = _compute_beam_costs(network, state, body, path, scans, grid)
        np.add.at(cost, nearest, beam_cost)
    offset, weight = compute_heading_offsets(body, path.control[:, :2], grid)
    cost += 0.5 * weight[:, None] * offset**2
    turning_variance = body.knots.step * TURNING_DENSITY
    best = _find_cheapest_sequence(cost, grid, turning_variance)
    turn = np.diff(grid[best])
    turn = (turn + np.pi / 2) % np.pi - np.pi / 2
    heading = np.concatenate([grid[best[:1]], turn]).cumsum()
    return replace(path, control=np.column_stack([path.control[:, :2], heading]))


# Error of paths at this stage, m; added to the noise of ranges.
_PATH_SIGMA = 0.01
# Weight of a beam: errors of path and outline are common to the beams of a scan, which count as a fifth of
# independent ones.
_BEAM_WEIGHT = 0.2
# Maximum cost of a beam, half squared standard deviations: three of them; beyond, a beam is of arms or of other
# people.
_MAX_BEAM_COST = 4.5


def _compute_beam_costs(
    network: NetworkProblem,
    state: NetworkState,
    body: BodyObservations,
    path: BodyPath,
    scans: BodyScans,
    grid: Array,
) -> tuple[Index, Array]:
    """The control point nearest to each beam with a weight (N,), and the beam's cost (N, G) over the grid."""
    first, weights, pose, rate = evaluate_at(network, state, body, path, scans)
    used = scans.weight > 0
    scan = index_scans(scans)[used]
    nearest = first + 1 + (weights[:, 2] > weights[:, 1])
    centre = pose[scan, :2] + scans.beam_delay[used, None] * rate[scan, :2]
    T = state.T_root_scanner[scans.scanner]
    x, y = T[:2, :2] @ scans.direction[used].T
    systematic, double_azimuth = state.systematic[scans.scanner], scans.double_azimuth[:, used]
    direction = rotate_by_small_angles(x, y, compute_turns(systematic, scans.azimuth[used], double_azimuth)).T
    sigma = np.hypot(network.range_sigma[scans.scanner], _PATH_SIGMA)
    ranges = _raycast_grid(T[:2, 2] - centre, direction, path.shape, grid)
    ranges = compute_stretches(systematic, double_azimuth)[:, None] * ranges + systematic[RANGE_BIAS]
    cost = 0.5 * ((ranges - scans.ranges[used, None]) / sigma) ** 2
    return nearest[scan], _BEAM_WEIGHT * np.fmin(cost, _MAX_BEAM_COST)


def _raycast_grid(start: Array, direction: Array, radii: Array, grid: Array) -> Array:
    """Ranges (N, G) along beams to an ellipse about the origin at all headings, m; NaN where they miss it.

    The squared norm of a vector in units of the radii is ``xᵀ Q x``, with three numbers of ``Q`` for each heading.

    Args:
        start: (N, 2) of the beams, m.
        direction: (N, 2) unit vectors.
        radii: (2,) across and along the heading, m.
        grid: (G,) headings, rad.
    """
    across, along = radii**-2
    c, s = np.cos(grid), np.sin(grid)
    Q = np.stack([across * s**2 + along * c**2, across * c**2 + along * s**2, (along - across) * s * c])

    def product(a: Array, b: Array) -> Array:
        (x, y), (other_x, other_y) = a.T, b.T
        return np.asarray(np.stack([x * other_x, y * other_y, x * other_y + y * other_x], axis=1) @ Q)

    square, half = product(direction, direction), product(start, direction)
    with np.errstate(invalid="ignore"):
        return np.asarray((-half - np.sqrt(half**2 - square * (product(start, start) - 1))) / square)


def _find_cheapest_sequence(cost: Array, grid: Array, turning_variance: float) -> Index:
    """(K,) the grid headings with the least total cost (K, G), including that of turning (Viterbi, 1967).

    The turning from one control point to the next has the given variance, rad².
    """
    turn = (grid[:, None] - grid + np.pi / 2) % np.pi - np.pi / 2
    turning_cost = turn**2 / (2 * turning_variance)
    total, previous = cost[0], np.zeros(cost.shape, dtype=np.intp)
    for k in range(1, len(cost)):
        candidates = total[:, None] + turning_cost
        previous[k] = np.argmin(candidates, axis=0)
        total = candidates.min(axis=0) + cost[k]
    best = np.empty(len(cost), dtype=np.intp)
    best[-1] = np.argmin(total)
    for k in range(len(cost) - 1, 0, -1):
        best[k - 1] = previous[k, best[k]]
    return best
