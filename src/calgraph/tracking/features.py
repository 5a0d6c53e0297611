"""Where the centre of an object is, by its points in one scan: three ways, of rising effort and accuracy."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calgraph.config import Cylinder, People
from calgraph.geometry import Array, ellipse
from calgraph.tracking.clusters import Clusters
from calgraph.tracking.ellipse_fit import Groups, Prior, fit_centres

Feature = Literal["com", "ellipse", "nls"]

# The mean of the beams on an ellipse lies this part of its radius before its centre (π/4 for a far scanner).
_BEFORE = 0.75
# How far it strays sideways where a part of the object is hidden, as a part of the radius; and otherwise.
_CLIPPED, _WHOLE = 0.5, 0.1
# How well people's shoulders are across their walk, rad, and how well their centres of mass tell the walk, m/s;
# slower ones than this, m/s, tell nothing.
_SHOULDERS = 0.15
_DRIFT = 0.2
_STROLLING = 0.2
# How far people's radii are off, as a part of themselves: a fit to many beams is biased by as much.
_BODIES = 0.06
# What a hidden side adds to the noise of a fit, as a part of the radius: which part is seen is guessed.
_GUESSED = 0.15
# A free ellipse is believed if its radii are within this factor of the target's.
_CREDIBLE = (0.3, 2.0)
# Objects are fitted in portions of like size, so that padding stays small.
_PORTION = 2048
# So many of the best seen objects, of so many beams at least, tell how well an ellipse fits at all.
_SAMPLE = 200
_TELLING = 8


@dataclass(frozen=True, eq=False)
class Centres:
    """Measured centres of objects."""

    positions: Array
    """(C, 2) sensor frame, m; NaN where there is none."""
    noise: Array
    """(C, 2, 2) covariance of what differs from scan to scan, m²."""
    bias: Array
    """(C, 2, 2) scale, squared, of an error that stays from scan to scan, which no smoothing removes, m²."""


@dataclass(frozen=True, eq=False)
class Walks:
    """How the objects move, as a first pass over the recording saw them."""

    velocities: Array
    """(C, 2) m/s."""
    variances: Array
    """(C,) of a velocity's component, m²/s²."""


def radii_of(target: People | Cylinder) -> tuple[float, float]:
    """Radii of the target's outline: across its walk and along it, m."""
    if isinstance(target, Cylinder):
        return target.diameter / 2, target.diameter / 2
    return target.axes


def width_of(target: People | Cylinder) -> float:
    """The largest width of the target, m."""
    return 2 * max(radii_of(target))


def centres(feature: Feature, found: Clusters, target: People | Cylinder, walks: Walks, sigma: float) -> Centres:
    """Measures the centres of objects.

    Args:
        feature: ``com``, the centre of mass of the points; ``ellipse``, the centre of Fitzgibbon's ellipse, or the
            centre of mass put back by the target's radius where that is not credible; ``nls``, the centre of an
            ellipse with the target's radii.
        found: the objects.
        target: what they are.
        walks: how they move; tells which way people turn their shoulders.
        sigma: noise of a point, m.
    """
    if feature == "com":
        return _center_of_mass(found, radii_of(target), sigma)
    if feature == "ellipse":
        return _direct(found, radii_of(target), sigma)
    return _fixed(found, radii_of(target), walks, sigma, 0.0 if isinstance(target, Cylinder) else _BODIES)


def _center_of_mass(found: Clusters, radii: tuple[float, float], sigma: float) -> Centres:
    radius = float(np.mean(radii))
    bias = _oriented(found.means, np.full(len(found), (_BEFORE * radius) ** 2), _sideways(found, radius) ** 2)
    # Which beams just hit an object differs from scan to scan: the variance of uniform edges.
    edge = np.linalg.norm(found.means, axis=-1) * found.spacing / np.sqrt(24)
    noise = _oriented(
        found.means, sigma**2 / found.count + (_WHOLE * radius) ** 2, sigma**2 / found.count + edge**2
    )
    return Centres(found.means, noise, bias)


def _direct(found: Clusters, radii: tuple[float, float], sigma: float) -> Centres:
    shapes = _in_portions(found, 5, lambda groups, _: ellipse.fit_direct(groups.points, groups.used))
    with np.errstate(invalid="ignore"):
        credible = (shapes[:, 4] > _CREDIBLE[0] * min(radii)) & (shapes[:, 3] < _CREDIBLE[1] * max(radii))
        credible &= np.linalg.norm(shapes[:, :2] - found.means, axis=-1) < _CREDIBLE[1] * max(radii)
    plain = _center_of_mass(found, radii, sigma)
    radius = float(np.mean(radii))
    sight = found.means / np.maximum(np.linalg.norm(found.means, axis=-1, keepdims=True), 1e-9)
    positions = np.where(credible[:, None], shapes[:, :2], found.means + _BEFORE * radius * sight)
    # The free radii trade against the centre along the line of sight; how much, residuals do not tell.
    across = sigma**2 / found.count + _sideways(found, radius) ** 2
    free = _oriented(found.means, np.full(len(found), (0.5 * radius) ** 2), across)
    put_back = _oriented(found.means, np.full(len(found), (0.25 * radius) ** 2), _sideways(found, radius) ** 2)
    noise = np.where(credible[:, None, None], free, plain.noise)
    return Centres(positions, noise, np.where(credible[:, None, None], 0.0, put_back))


def _fixed(found: Clusters, radii: tuple[float, float], walks: Walks, sigma: float, unlike: float) -> Centres:
    speed = np.linalg.norm(walks.velocities, axis=-1)
    heading = np.arctan2(walks.velocities[:, 1], walks.velocities[:, 0])
    with np.errstate(divide="ignore"):
        known = np.where(
            speed > _STROLLING, np.hypot(_SHOULDERS, np.sqrt(walks.variances + _DRIFT**2) / speed), np.inf
        )
    # The first radius of people is that of their shoulders, across the walk.
    prior = Prior(heading + np.pi / 2, known)
    sigma = _sigma_on_target(found, radii, prior, sigma)

    def fitted(groups: Groups, chosen: NDArray[np.intp]) -> Array:
        fits = fit_centres(groups, radii, Prior(prior.angle[chosen], prior.sigma[chosen]), sigma)
        return np.concatenate([fits.centres, fits.covariances.reshape(-1, 4)], axis=-1)

    result = _in_portions(found, 6, fitted)
    radius = float(np.mean(radii))
    guessed = np.where(found.clipped, (_GUESSED * radius) ** 2, 0.0)
    noise = result[:, 2:].reshape(-1, 2, 2) + guessed[:, None, None] * np.eye(2)
    # Wrong radii shift the centre along the line of sight; sideways the outline's edges hold it.
    along = np.full(len(found), (unlike * radius) ** 2)
    return Centres(result[:, :2], noise, _oriented(found.means, along, along / 4))


def _sigma_on_target(found: Clusters, radii: tuple[float, float], prior: Prior, sigma: float) -> float:
    """Noise of a point on the target: of the range, and of the target's not being quite an ellipse, m.

    Single objects of few beams cannot tell it; the best seen ones together do.
    """
    best = np.argsort(found.count, kind="stable")[-_SAMPLE:]
    best = best[found.count[best] >= _TELLING]
    if not len(best):
        return sigma
    fits = fit_centres(_padded(found, best), radii, Prior(prior.angle[best], prior.sigma[best]), sigma)
    return float(sigma * np.sqrt(max(1.0, np.median(fits.excess))))


def _sideways(found: Clusters, radius: float) -> Array:
    return np.where(found.clipped, _CLIPPED * radius, _WHOLE * radius)


def _oriented(points: Array, along: Array, across: Array) -> Array:
    """Covariances (C, 2, 2) with the given variances along and across the lines of sight to points (C, 2)."""
    sight = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    side = np.stack([-sight[:, 1], sight[:, 0]], axis=-1)
    return np.asarray(
        along[:, None, None] * sight[:, :, None] * sight[:, None, :]
        + across[:, None, None] * side[:, :, None] * side[:, None, :]
    )


def _in_portions(found: Clusters, columns: int, measure: Callable[[Groups, NDArray[np.intp]], Array]) -> Array:
    """Calls ``measure`` with portions of the objects and their indices; its rows (., columns), in order."""
    result = np.full((len(found), columns), np.nan)
    by_size = np.argsort(found.count, kind="stable")
    for low in range(0, len(found), _PORTION):
        chosen = by_size[low : low + _PORTION]
        result[chosen] = measure(_padded(found, chosen), chosen)
    return result


def _padded(found: Clusters, chosen: NDArray[np.intp]) -> Groups:
    column = np.arange(found.count[chosen].max())
    used = column < found.count[chosen, None]
    index = np.where(used, found.first[chosen, None] + column, 0)
    points = np.where(used[..., None], found.points[index], 0.0)
    return Groups(points, used, found.spacing[chosen], found.clipped[chosen])
