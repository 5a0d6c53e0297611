"""Centre of an object from its points in one scan: the centroid, and the fit of an ellipse of known radii."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, People
from calgraph.geometry import Array
from calgraph.network.tracking.clusters import Clusters

# Mean of a visible half before the centre, in radii: of a start value.
_MEAN_DEPTH = 0.7
# Steps smaller than this, m and rad, end the iterations.
_CONVERGED = 5e-4
# Information that regularises unobservable directions, 1/m² and 1/rad²: the orientation of a circle, or the pose
# of an ellipse through two points. It is negligible where anything is observed.
_REGULARIZATION = 1e-3


@dataclass(frozen=True, eq=False)
class PointGroups:
    """The points of many objects, each measured from the origin."""

    points: Array
    """(C, N, 2) m; zero where unused."""
    used: NDArray[np.bool_]
    """(C, N)."""
    spacing: Array
    """(C,) angle between neighbouring beams, rad."""
    clipped: NDArray[np.bool_]
    """(C,) whether a part of the object is hidden."""

    @property
    def centroids(self) -> Array:
        """(C, 2) centres of mass, m."""
        return np.asarray(self.points.sum(axis=1) / self.used.sum(axis=1)[:, None])


@dataclass(frozen=True, eq=False)
class EllipseFits:
    """Ellipses fitted to objects."""

    centers: Array
    """(C, 2) m; NaN where a fit failed."""
    covariances: Array
    """(C, 2, 2) m², scaled by the reduced χ² where that exceeds 1; NaN where a fit failed."""
    reduced_chi2: Array
    """(C,) mean square of the residuals over the variance of the noise."""


@dataclass(frozen=True, eq=False)
class OrientationPrior:
    """Prior of the orientation of objects."""

    angle: Array
    """(C,) direction of the axis of the first radius, rad."""
    sigma: Array
    """(C,) standard deviation, rad; infinite where the orientation is unknown."""


# Maximum number of Gauss–Newton steps of a fit: from its start value it converges in a few, and short arcs rarely
# do.
_MAX_STEPS = 8
# Huber threshold in standard deviations of a point: arms, and beams at the object's edge, lie beyond it.
_HUBER_SIGMAS = 2.5
# Minimum standard deviation of the outline's symmetry, m: bodies are not symmetric to less than a millimetre.
_MIN_EDGE_SIGMA = 1e-3
# Maximum change of the orientation in a step, rad (17°): a short arc barely constrains it, and a full step from a
# poor start may flip it.
_MAX_TURN = 0.3


def fit_ellipses(
    groups: PointGroups, radii: tuple[float, float], prior: OrientationPrior, sigma: float
) -> EllipseFits:
    """Fits centre and orientation of ellipses with fixed radii.

    Minimises the distances of the points from their ellipse over the centre, the orientation and the points'
    phases on the ellipse; the phases are eliminated, so that only the residuals along the normals remain. Two more
    terms constrain the fit of few beams: the prior of the orientation, and, unless a part of the object is hidden,
    the symmetry of the outline about the direction to the centre (to half a beam).

    Args:
        groups: points of one object each, at least two.
        radii: of the ellipse, m; equal ones make a circle.
        prior: of the orientation; also its start value.
        sigma: noise of a point, m.
    """
    # Coordinates, then points, then objects, over which NumPy's loops are to run: they are the most by far.
    pose = np.stack([*_initial_centers(groups, radii, prior).T, prior.angle])
    points, used = groups.points.T.copy(), groups.used.T.copy()
    bearing = np.arctan2(points[1], points[0])
    start = _turn(-pose[2], points - pose[:2, None])
    phases = np.arctan2(start[1] / radii[1], start[0] / radii[0])
    weights = used.astype(np.float64)

    def linearize() -> tuple[Array, Array, Array, Array, Array]:
        outline = np.stack([radii[0] * np.cos(phases), radii[1] * np.sin(phases)])
        return outline, *_linearize(pose, outline, points, radii)

    def take_step() -> float:
        """The largest change of a pose."""
        outline, residual, J, tangents, off = linearize()
        np.divide(used, np.maximum(1.0, np.abs(residual) / (_HUBER_SIGMAS * sigma)), out=weights)
        H, g = _normal_equations(groups, bearing, pose, prior, residual, J, weights, sigma, _MIN_EDGE_SIGMA)
        step = np.linalg.solve(H, g.T[..., None])[..., 0].T
        # A short arc barely constrains the orientation: a full step from a poor start may flip it.
        step[2] = np.clip(step[2], -_MAX_TURN, _MAX_TURN)
        step[:2] /= np.maximum(1.0, np.hypot(*step[:2]) / max(radii))
        np.add(pose, step, out=pose)
        arm = _turn(pose[2], outline)
        moved = off - step[:2, None] - step[2] * np.stack([-arm[1], arm[0]])
        along = _dot(moved, tangents) / np.maximum(_dot(tangents, tangents), 1e-12)
        np.add(phases, np.clip(along, -0.5, 0.5), out=phases)
        return float(np.abs(step).max(initial=0.0))

    for _ in range(_MAX_STEPS):
        if take_step() < _CONVERGED:
            break
    _, residual, J, _, _ = linearize()
    H, _ = _normal_equations(groups, bearing, pose, prior, residual, J, weights, sigma, _MIN_EDGE_SIGMA)
    freedom = np.maximum(groups.used.sum(axis=1) - 2, 1)
    reduced_chi2 = (weights * residual**2).sum(axis=0) / (sigma**2 * freedom)
    covariance = np.linalg.inv(H)[:, :2, :2] * np.maximum(reduced_chi2, 1.0)[:, None, None]
    centers, covariances = _discard_implausible(groups, pose[:2].T, covariance, max(radii))
    return EllipseFits(centers, covariances, reduced_chi2)


def _initial_centers(groups: PointGroups, radii: tuple[float, float], prior: OrientationPrior) -> Array:
    """Centres (C, 2) behind the points, by the depth of the ellipse along the line of sight."""
    means = groups.centroids
    distance = np.linalg.norm(means, axis=-1, keepdims=True)
    sight = means / np.maximum(distance, 1e-9)
    turned = np.arctan2(sight[:, 1], sight[:, 0]) - prior.angle
    depth = np.hypot(radii[0] * np.cos(turned), radii[1] * np.sin(turned))
    return np.asarray(means + _MEAN_DEPTH * depth[:, None] * sight)


def _turn(angle: Array, vectors: Array) -> Array:
    """Vectors (2, N, C) turned by angles (C,), rad."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vectors[0] - s * vectors[1], s * vectors[0] + c * vectors[1]])


def _dot(a: Array, b: Array) -> Array:
    """Scalar products (...) of vectors (2, ...)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1])


def _linearize(
    pose: Array, outline: Array, points: Array, radii: tuple[float, float]
) -> tuple[Array, Array, Array, Array]:
    """Residuals (N, C) along the normals, their rows (3, N, C) of J, tangents and offsets (2, N, C).

    ``outline`` are the points (2, N, C) of the ellipses along their own axes.
    """
    arm = _turn(pose[2], outline)
    ratio = radii[1] / radii[0]
    tangents = _turn(pose[2], np.stack([-outline[1] / ratio, outline[0] * ratio]))
    normals = np.stack([tangents[1], -tangents[0]]) / np.maximum(np.sqrt(_dot(tangents, tangents)), 1e-12)
    turning = arm[0] * normals[1] - arm[1] * normals[0]
    off = points - arm - pose[:2, None]
    return _dot(normals, off), np.stack([*normals, turning]), tangents, off


def _normal_equations(
    groups: PointGroups,
    bearing: Array,
    pose: Array,
    prior: OrientationPrior,
    residual: Array,
    J: Array,
    weights: Array,
    sigma: float,
    min_edge_sigma: float,
) -> tuple[Array, Array]:
    """Information (C, 3, 3) and gradient (3, C) of all terms, for a step of centre and orientation."""
    weighted = weights / sigma**2 * J
    H = np.empty((pose.shape[1], 3, 3))
    for i in range(3):
        H[:, i, i:] = H[:, i:, i] = (weighted[i] * J[i:]).sum(axis=1).T
    g = (weighted * residual).sum(axis=1)
    off, across, information = _symmetry_residual(groups, bearing, pose, min_edge_sigma)
    H[:, :2, :2] += (information * across[:, None] * across).transpose(2, 0, 1)
    g[:2] += information * off * across
    prior_information = 1 / prior.sigma**2
    # An ellipse has period π in its orientation.
    turn = (prior.angle - pose[2] + np.pi / 2) % np.pi - np.pi / 2
    H[:, 2, 2] += prior_information
    g[2] += prior_information * turn
    return H + _REGULARIZATION * np.eye(3), g


def _symmetry_residual(
    groups: PointGroups, bearing: Array, pose: Array, min_sigma: float
) -> tuple[Array, Array, Array]:
    """Lateral offset (C,) of the outline's middle from the centre, m; its direction (2, C); its information."""
    ahead = np.arctan2(pose[1], pose[0])
    turned = bearing - ahead
    turned -= 2 * np.pi * np.rint(turned / (2 * np.pi))
    left = np.where(groups.used.T, turned, -np.inf).max(axis=0)
    right = np.where(groups.used.T, turned, np.inf).min(axis=0)
    distance = np.hypot(pose[0], pose[1])
    across = np.stack([-np.sin(ahead), np.cos(ahead)])
    # Each edge is uniform within one beam spacing: the variance of the mean of both is 1/24 of its square.
    sigma = np.maximum(distance * groups.spacing / np.sqrt(24), min_sigma)
    return distance * (left + right) / 2, across, np.where(groups.clipped, 0.0, 1 / sigma**2)


# Maximum standard deviation of a centre, over the largest radius: beyond it the points show only that the object
# is there.
_MAX_CENTER_SIGMA = 1.0
# Maximum distance of a centre from the centroid, over the largest radius: a point on the outline is one radius
# away at most.
_MAX_CENTER_DISTANCE = 2.0
# Maximum distance of a centre in front of the centroid, over the largest radius: the visible side is nearer than
# the centre, up to noise.
_MAX_CENTER_LEAD = 0.2


def _discard_implausible(
    groups: PointGroups, centers: Array, covariances: Array, radius: float
) -> tuple[Array, Array]:
    """Replaces fits by NaN whose centre is not near the points and behind them."""
    means = groups.centroids
    sight = means / np.maximum(np.linalg.norm(means, axis=-1, keepdims=True), 1e-9)
    off = centers - means
    implausible = ~np.isfinite(covariances).all(axis=(1, 2)) | ~np.isfinite(centers).all(axis=1)
    # An uncertainty as large as the object carries no information.
    implausible |= np.trace(covariances, axis1=1, axis2=2) > (_MAX_CENTER_SIGMA * radius) ** 2
    implausible |= (np.linalg.norm(off, axis=-1) > _MAX_CENTER_DISTANCE * radius) | (
        (off * sight).sum(axis=-1) < -_MAX_CENTER_LEAD * radius
    )
    return np.where(implausible[:, None], np.nan, centers), np.where(
        implausible[:, None, None], np.nan, covariances
    )


# Objects are fitted in batches of similar size, so that padding stays small.
_BATCH = 2048


@dataclass(frozen=True, eq=False)
class MeasuredCenters:
    """Measured centres of objects."""

    positions: Array
    """(C, 2) sensor frame, m; NaN where there is none."""
    noise: Array
    """(C, 2, 2) covariance of the error that is independent from scan to scan, m²."""
    bias: Array
    """(C, 2, 2) covariance of the error common to successive scans, which smoothing does not reduce, m²."""


@dataclass(frozen=True, eq=False)
class ObjectVelocities:
    """Velocities of the objects, estimated in a first pass over the recording."""

    values: Array
    """(C, 2) m/s."""
    variances: Array
    """(C,) of a velocity's component, m²/s²."""


def target_radii(target: People | Cylinder) -> tuple[float, float]:
    """Radii of the target's outline: across and along the direction of walk, m."""
    if isinstance(target, Cylinder):
        return target.diameter / 2, target.diameter / 2
    return target.axes


def target_width(target: People | Cylinder) -> float:
    """The largest width of the target, m."""
    return 2 * max(target_radii(target))


CenterEstimator = Callable[[Clusters, People | Cylinder, float], MeasuredCenters]
"""From objects, what they are, and the noise of a point (m) to their centres."""


# Distance of the centroid before the centre, over the mean radius: π/4 for a distant circle, less for the broad
# side of an ellipse.
DEPTH = 0.75
# Standard deviation of the centroid across the line of sight, over the mean radius: an oblique ellipse.
_LATERAL_SIGMA = 0.1


def measure_centroids(objects: Clusters, target: People | Cylinder, sigma: float) -> MeasuredCenters:
    """Centroids of the objects' points, whose offset from the centres is a bias.

    Args:
        objects: whose centres are measured.
        target: what they are.
        sigma: noise of a point, m.
    """
    radius = float(np.mean(target_radii(target)))
    bias = radial_covariances(
        objects.centroids, np.full(len(objects), (DEPTH * radius) ** 2), lateral_sigma(objects, radius) ** 2
    )
    # The outermost beams on an object differ from scan to scan: variance of two uniform edges.
    edge = np.linalg.norm(objects.centroids, axis=-1) * objects.spacing / np.sqrt(24)
    noise = radial_covariances(
        objects.centroids,
        sigma**2 / objects.count + (_LATERAL_SIGMA * radius) ** 2,
        sigma**2 / objects.count + edge**2,
    )
    return MeasuredCenters(objects.centroids, noise, bias)


# Relative standard deviation of people's radii in the bias of a centre: clothes and posture change a person's
# radii by as much, and the centre along the line of sight by as much of them.
_PEOPLE_RADIUS_ERROR = 0.06
# Minimum speed with a known heading, m/s: the standard deviation of a velocity above.
_MIN_HEADING_SPEED = 0.2
# Standard deviation of people's shoulders about the normal of their walk: they turn by ± 9° with each step.
_SHOULDER_SIGMA = 0.15
# Standard deviation of a velocity from smoothed centroids, m/s: a centroid moves by 0.1 m on the body within half
# a second of a turn.
_VELOCITY_SIGMA = 0.2
# Standard deviation added to the centre of a partly hidden object, over its mean radius: which part is visible is
# unknown.
_CLIPPED_SIGMA = 0.15
# Lateral part of this bias over the radial one: both edges of the outline constrain the centre laterally.
_LATERAL_BIAS = 0.5


def measure_fixed_ellipses(
    objects: Clusters, target: People | Cylinder, velocities: ObjectVelocities, sigma: float
) -> MeasuredCenters:
    """Centres of ellipses with the target's radii, fitted to the objects' points.

    Args:
        objects: whose centres are measured.
        target: what they are.
        velocities: of the objects; people's shoulders are across their walk.
        sigma: noise of a point, m.
    """
    radii = target_radii(target)
    radius_error = 0.0 if isinstance(target, Cylinder) else _PEOPLE_RADIUS_ERROR
    speed = np.linalg.norm(velocities.values, axis=-1)
    heading = np.arctan2(velocities.values[:, 1], velocities.values[:, 0])
    with np.errstate(divide="ignore"):
        heading_sigma = np.where(
            speed > _MIN_HEADING_SPEED,
            np.hypot(_SHOULDER_SIGMA, np.sqrt(velocities.variances + _VELOCITY_SIGMA**2) / speed),
            np.inf,
        )
    # The first radius of people is that of their shoulders, across the walk.
    prior = OrientationPrior(heading + np.pi / 2, heading_sigma)
    sigma = _estimate_point_sigma(objects, radii, prior, sigma)

    def fit_batch(groups: PointGroups, chosen: NDArray[np.intp]) -> Array:
        fits = fit_ellipses(groups, radii, OrientationPrior(prior.angle[chosen], prior.sigma[chosen]), sigma)
        return np.concatenate([fits.centers, fits.covariances.reshape(-1, 4)], axis=-1)

    result = map_batches(objects, 6, fit_batch)
    radius = float(np.mean(radii))
    occlusion_variance = np.where(objects.clipped, (_CLIPPED_SIGMA * radius) ** 2, 0.0)
    noise = result[:, 2:].reshape(-1, 2, 2) + occlusion_variance[:, None, None] * np.eye(2)
    # Wrong radii shift the centre along the line of sight; laterally the outline's edges constrain it.
    along = np.full(len(objects), (radius_error * radius) ** 2)
    return MeasuredCenters(
        result[:, :2], noise, radial_covariances(objects.centroids, along, _LATERAL_BIAS**2 * along)
    )


# Objects with the most beams whose residuals determine the noise of a point: that of the range and of the ellipse
# model, to 1 / sqrt(400) = 5 %.
_MISFIT_OBJECTS = 200
# Minimum number of beams on such an object: an ellipse with three unknowns leaves five degrees of freedom.
_MISFIT_MIN_BEAMS = 8


def _estimate_point_sigma(
    objects: Clusters, radii: tuple[float, float], prior: OrientationPrior, sigma: float
) -> float:
    """Standard deviation of a point on the target: range noise and misfit of the ellipse model, m.

    A single object of few beams does not determine it; those with the most beams do jointly.
    """
    best = np.argsort(objects.count, kind="stable")[-_MISFIT_OBJECTS:]
    best = best[objects.count[best] >= _MISFIT_MIN_BEAMS]
    if not len(best):
        return sigma
    fits = fit_ellipses(
        _pad_groups(objects, best), radii, OrientationPrior(prior.angle[best], prior.sigma[best]), sigma
    )
    return float(sigma * np.sqrt(max(1.0, np.median(fits.reduced_chi2))))


# Standard deviation of the centroid of a partly hidden object across the line of sight, over the mean radius: half
# of the object is missing.
_CLIPPED_LATERAL_SIGMA = 0.5


def lateral_sigma(objects: Clusters, radius: float) -> Array:
    """(C,) standard deviation of centroids across the line of sight, m."""
    ratio = np.where(objects.clipped, _CLIPPED_LATERAL_SIGMA, _LATERAL_SIGMA)
    return ratio * radius


def radial_covariances(points: Array, along: Array, across: Array) -> Array:
    """Covariances (C, 2, 2) with the given variances along and across the lines of sight to points (C, 2)."""
    sight = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    side = np.stack([-sight[:, 1], sight[:, 0]], axis=-1)
    return np.asarray(
        along[:, None, None] * sight[:, :, None] * sight[:, None, :]
        + across[:, None, None] * side[:, :, None] * side[:, None, :]
    )


def map_batches(
    objects: Clusters, columns: int, measure: Callable[[PointGroups, NDArray[np.intp]], Array]
) -> Array:
    """Calls ``measure`` with batches of the objects and their indices; its rows (., columns), in order."""
    result = np.full((len(objects), columns), np.nan)
    by_size = np.argsort(objects.count, kind="stable")
    for low in range(0, len(objects), _BATCH):
        chosen = by_size[low : low + _BATCH]
        result[chosen] = measure(_pad_groups(objects, chosen), chosen)
    return result


def _pad_groups(objects: Clusters, chosen: NDArray[np.intp]) -> PointGroups:
    column = np.arange(objects.count[chosen].max())
    used = column < objects.count[chosen, None]
    index = np.where(used, objects.first[chosen, None] + column, 0)
    points = np.where(used[..., None], objects.points[index], 0.0)
    return PointGroups(points, used, objects.spacing[chosen], objects.clipped[chosen])
