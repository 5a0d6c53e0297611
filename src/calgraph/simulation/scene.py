"""A world of solids that beams and camera rays can be cast against."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

# A direction component this small counts as parallel to a face; it keeps divisions finite.
_PARALLEL = 1e-12


@dataclass(frozen=True)
class Sheet:
    """A thin rectangle in its plane z = 0, hit from both sides."""

    width: float
    """Along x, m."""
    height: float
    """Along y, m."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the shape, m."""
        return 0.5 * float(np.hypot(self.width, self.height))

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (N, 3) in the shape's frame, infinite where they miss (eqs. 12–14)."""
        t = -origins[:, 2] / _away_from_zero(directions[:, 2])
        x, y = (origins[:, i] + t * directions[:, i] for i in (0, 1))
        hit = (t > 0) & (np.abs(x) <= self.width / 2) & (np.abs(y) <= self.height / 2)
        return np.where(hit, t, np.inf)


@dataclass(frozen=True)
class Box:
    """A cuboid centred on its origin; from inside, its walls are seen, so that it also serves as a room."""

    length: float
    """Along x, m."""
    width: float
    """Along y, m."""
    height: float
    """Along z, m."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the shape, m."""
        return 0.5 * float(np.linalg.norm([self.length, self.width, self.height]))

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (N, 3) in the shape's frame, infinite where they miss (slab method)."""
        half = 0.5 * np.array([self.length, self.width, self.height])
        inverse = 1 / _away_from_zero(directions)
        middle = -origins * inverse
        reach = half * np.abs(inverse)
        enter, leave = (middle - reach).max(axis=1), (middle + reach).min(axis=1)
        t = np.where(enter > 0, enter, leave)
        return np.where((enter <= leave) & (t > 0), t, np.inf)


@dataclass(frozen=True)
class Cylinder:
    """A closed cylinder centred on its origin, with its axis along z."""

    radius: float
    """m."""
    height: float
    """Along z, m."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the shape, m."""
        return float(np.hypot(self.radius, self.height / 2))

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (N, 3) in the shape's frame, infinite where they miss."""
        o, d = origins[:, :2], directions[:, :2]
        a = np.maximum(np.sum(d * d, axis=1), _PARALLEL)
        b = np.sum(o * d, axis=1) / a
        discriminant = b * b - (np.sum(o * o, axis=1) - self.radius**2) / a
        root = np.sqrt(np.maximum(discriminant, 0))
        # The solid is the overlap of the endless cylinder and the slab between its caps.
        inverse = 1 / _away_from_zero(directions[:, 2])
        middle, reach = -origins[:, 2] * inverse, self.height / 2 * np.abs(inverse)
        enter, leave = np.maximum(-b - root, middle - reach), np.minimum(-b + root, middle + reach)
        t = np.where(enter > 0, enter, leave)
        return np.where((discriminant >= 0) & (enter <= leave) & (t > 0), t, np.inf)


Shape = Sheet | Box | Cylinder


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape somewhere in the world."""

    shape: Shape
    T_world_shape: Array
    """(4, 4)."""
    brightness: float = 128.0
    """Mean grey value in camera images, 0 to 255."""


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays ended."""

    ranges: Array
    """(N,) distance along each unit ray, m; infinite where it hit nothing."""
    solid: NDArray[np.int32]
    """(N,) index of the solid hit, -1 for none."""


def cast(solids: Sequence[Solid], origins: Array, directions: Array) -> Hits:
    """The nearest hit of each ray.

    Args:
        solids: what may be hit.
        origins: (N, 3) or (3,), world frame, m.
        directions: (N, 3) unit vectors, world frame.

    """
    ranges = np.full(len(directions), np.inf)
    which = np.full(len(directions), -1, dtype=np.int32)
    for index, solid in enumerate(solids):
        rays = _near(solid, origins, directions)
        if not len(rays):
            continue
        R, t = solid.T_world_shape[:3, :3], solid.T_world_shape[:3, 3]
        local = np.broadcast_to((origins - t) @ R, directions.shape)[rays]
        distance = solid.shape.distance(local, directions[rays] @ R)
        closer = distance < ranges[rays]
        ranges[rays[closer]] = distance[closer]
        which[rays[closer]] = index
    return Hits(ranges, which)


def _near(solid: Solid, origins: Array, directions: Array) -> NDArray[np.intp]:
    """Indices of the rays that meet the solid's bounding sphere: most solids are met by few rays."""
    to_centre = solid.T_world_shape[:3, 3] - origins
    along = directions @ to_centre if to_centre.ndim == 1 else np.sum(directions * to_centre, axis=1)
    radius = solid.shape.bounding_radius
    aside = np.sum(to_centre * to_centre, axis=-1) - along * along
    return np.flatnonzero((aside <= radius**2) & (along > -radius))


def _away_from_zero(values: Array) -> Array:
    return np.where(np.abs(values) < _PARALLEL, _PARALLEL, values)
