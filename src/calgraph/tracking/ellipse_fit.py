"""Ellipses of known radii through the points of one side of an object (lrf-network, eqs. 3 and 4).

All objects of a recording are fitted side by side: groups of points are padded to the largest one's size.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, ellipse

_ITERATIONS = 8
# Steps smaller than this, m and rad, end the iterations.
_CONVERGED = 5e-4
# Residuals beyond this many standard deviations count less: arms, and beams that hit the edge of the object.
_OUTLYING = 2.5
# Two points do not hold place and orientation, and at the ends of a diameter not even the place; nor does a circle
# have an orientation. So much information, 1/m² and 1/rad², keeps them where they are: as good as none.
_FAINT = 1e-3


@dataclass(frozen=True, eq=False)
class Groups:
    """The points of many objects, each seen from the origin."""

    points: Array
    """(C, N, 2) m; zero where unused."""
    used: NDArray[np.bool_]
    """(C, N)."""
    spacing: Array
    """(C,) angle between neighbouring beams, rad."""
    clipped: NDArray[np.bool_]
    """(C,) whether a part of the object is hidden."""

    @property
    def means(self) -> Array:
        """(C, 2) centres of mass, m."""
        return np.asarray(self.points.sum(axis=1) / self.used.sum(axis=1)[:, None])


@dataclass(frozen=True, eq=False)
class Fits:
    """Ellipses fitted to objects."""

    centres: Array
    """(C, 2) m; NaN where a fit failed."""
    covariances: Array
    """(C, 2, 2) m²; where residuals are larger than the noise, these grow with them; NaN where a fit failed."""
    excess: Array
    """(C,) mean square of the residuals over that of the noise."""


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known about the orientation of objects beforehand."""

    angle: Array
    """(C,) direction of the axis of the first radius, rad."""
    sigma: Array
    """(C,) its standard deviation, rad; infinite where it is unknown."""


def fit_centres(groups: Groups, radii: tuple[float, float], prior: Prior, sigma: float) -> Fits:
    """Fits centre and orientation of ellipses with fixed radii.

    Minimises the distances of the points from their ellipse over the centre, the orientation and the points'
    phases on the ellipse; the phases are eliminated, so that only the residuals along the normals remain. Two more
    terms make the fit of few beams definite: the prior of the orientation, and, unless a part of the object is
    hidden, that an ellipse's outline lies evenly to both sides of the direction to its centre (to half a beam).

    Args:
        groups: points of one object each, at least two.
        radii: of the ellipse, m; equal ones make a circle.
        prior: orientation beforehand; start value too.
        sigma: noise of a point, m.
    """
    fixed = np.broadcast_to(radii, (len(groups.points), 2))
    shape = np.concatenate([_start(groups, radii, prior), prior.angle[:, None], fixed], axis=-1)
    phases = _phases(shape, groups.points)
    weights = groups.used.astype(float)
    for _ in range(_ITERATIONS):
        residual, J, tangents, off = _linearised(shape, phases, groups.points)
        weights = groups.used / np.maximum(1.0, np.abs(residual) / (_OUTLYING * sigma))
        H, g = _normal_equations(groups, shape, prior, residual, J, weights, sigma)
        step = np.asarray(np.linalg.solve(H, g[..., None])[..., 0])
        # A short arc barely holds the orientation: full steps from a poor start may turn it over.
        step[:, 2] = np.clip(step[:, 2], -0.3, 0.3)
        step[:, :2] /= np.maximum(1.0, np.linalg.norm(step[:, :2], axis=-1, keepdims=True) / max(radii))
        shape[:, :3] += step
        moved = off - _displacement(shape, phases, step)
        along = (moved * tangents).sum(axis=-1) / np.maximum((tangents**2).sum(axis=-1), 1e-12)
        phases = phases + np.clip(along, -0.5, 0.5)
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            break
    residual, J, _, _ = _linearised(shape, phases, groups.points)
    H, _ = _normal_equations(groups, shape, prior, residual, J, weights, sigma)
    freedom = np.maximum(groups.used.sum(axis=1) - 2, 1)
    excess = (weights * residual**2).sum(axis=1) / (sigma**2 * freedom)
    covariance = np.linalg.inv(H)[:, :2, :2] * np.maximum(excess, 1.0)[:, None, None]
    centres, covariances = _only_plausible(groups, shape[:, :2], covariance, max(radii))
    return Fits(centres, covariances, excess)


def _start(groups: Groups, radii: tuple[float, float], prior: Prior) -> Array:
    """Centres (C, 2) behind the points, by as much as the ellipse is deep in the direction of sight."""
    means = groups.means
    distance = np.linalg.norm(means, axis=-1, keepdims=True)
    sight = means / np.maximum(distance, 1e-9)
    turned = np.arctan2(sight[:, 1], sight[:, 0]) - prior.angle
    depth = np.hypot(radii[0] * np.cos(turned), radii[1] * np.sin(turned))
    # The mean of a visible half lies about 0.7 radii before the centre.
    return np.asarray(means + 0.7 * depth[:, None] * sight)


def _phases(shape: Array, points: Array) -> Array:
    """Start values (C, N) of the points' phases, rad: their directions, in a frame where the ellipse is round."""
    off = points - shape[:, None, :2]
    c, s = np.cos(shape[:, 2:3]), np.sin(shape[:, 2:3])
    along, across = c * off[..., 0] + s * off[..., 1], c * off[..., 1] - s * off[..., 0]
    return np.asarray(np.arctan2(across / shape[:, 4:5], along / shape[:, 3:4]))


def _linearised(shape: Array, phases: Array, points: Array) -> tuple[Array, Array, Array, Array]:
    """Residuals (C, N) along the normals, their rows (C, N, 3) of J, tangents and offsets (C, N, 2)."""
    on = ellipse.points(shape, phases)
    c, s = np.cos(shape[:, 2:3]), np.sin(shape[:, 2:3])
    along, across = -shape[:, 3:4] * np.sin(phases), shape[:, 4:5] * np.cos(phases)
    tangents = np.stack([c * along - s * across, s * along + c * across], axis=-1)
    length = np.maximum(np.linalg.norm(tangents, axis=-1, keepdims=True), 1e-12)
    normals = np.stack([tangents[..., 1], -tangents[..., 0]], axis=-1) / length
    arm = on - shape[:, None, :2]
    turning = -arm[..., 1] * normals[..., 0] + arm[..., 0] * normals[..., 1]
    off = points - on
    J = np.concatenate([normals, turning[..., None]], axis=-1)
    return (normals * off).sum(axis=-1), J, tangents, off


def _displacement(shape: Array, phases: Array, step: Array) -> Array:
    """How far (C, N, 2) points at fixed phases move with a step (C, 3) of centre and orientation."""
    arm = ellipse.points(shape, phases) - shape[:, None, :2]
    return step[:, None, :2] + step[:, 2, None, None] * np.stack([-arm[..., 1], arm[..., 0]], axis=-1)


def _normal_equations(
    groups: Groups, shape: Array, prior: Prior, residual: Array, J: Array, weights: Array, sigma: float
) -> tuple[Array, Array]:
    """Information (C, 3, 3) and gradient (C, 3) of all terms, for a step of centre and orientation."""
    weighted = (weights / sigma**2)[..., None] * J
    H = np.swapaxes(weighted, -1, -2) @ J
    g = (weighted * residual[..., None]).sum(axis=1)
    off, across, information = _evenness(groups, shape)
    H[:, :2, :2] += information[:, None, None] * across[:, :, None] * across[:, None, :]
    g[:, :2] += (information * off)[:, None] * across
    known = 1 / prior.sigma**2
    # Half a turn of an ellipse is no turn.
    turn = (prior.angle - shape[:, 2] + np.pi / 2) % np.pi - np.pi / 2
    H[:, 2, 2] += known
    g[:, 2] += known * turn
    return H + _FAINT * np.eye(3), g


def _evenness(groups: Groups, shape: Array) -> tuple[Array, Array, Array]:
    """How far (C,) the middle of the outline lies beside the centre, m, which way (C, 2), and how sure (C,)."""
    bearing = np.arctan2(groups.points[..., 1], groups.points[..., 0])
    ahead = np.arctan2(shape[:, 1], shape[:, 0])
    turned = (bearing - ahead[:, None] + np.pi) % (2 * np.pi) - np.pi
    left = np.where(groups.used, turned, -np.inf).max(axis=1)
    right = np.where(groups.used, turned, np.inf).min(axis=1)
    distance = np.linalg.norm(shape[:, :2], axis=-1)
    across = np.stack([-np.sin(ahead), np.cos(ahead)], axis=-1)
    # Either edge is uniform within one beam spacing: the variance of their mean is 1/24 of its square.
    sigma = np.maximum(distance * groups.spacing / np.sqrt(24), 1e-3)
    return distance * (left + right) / 2, across, np.where(groups.clipped, 0.0, 1 / sigma**2)


def _only_plausible(groups: Groups, centres: Array, covariances: Array, radius: float) -> tuple[Array, Array]:
    """The same with NaN where the centre is not near the points, on the far side of them."""
    means = groups.means
    sight = means / np.maximum(np.linalg.norm(means, axis=-1, keepdims=True), 1e-9)
    off = centres - means
    bad = ~np.isfinite(covariances).all(axis=(1, 2)) | ~np.isfinite(centres).all(axis=1)
    # As good as nothing: such a centre may be anywhere on the object.
    bad |= np.trace(covariances, axis1=1, axis2=2) > radius**2
    bad |= (np.linalg.norm(off, axis=-1) > 2 * radius) | ((off * sight).sum(axis=-1) < -0.2 * radius)
    return np.where(bad[:, None], np.nan, centres), np.where(bad[:, None, None], np.nan, covariances)
