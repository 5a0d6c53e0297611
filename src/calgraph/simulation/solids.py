"""Ray casting against solids, for beams and camera rays.

Internally rays are (3, N) arrays: NumPy is several times faster on long rows than on rows of three.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

# A direction component this small counts as parallel to a face; it keeps divisions finite.
_MIN_COMPONENT = 1e-12


@dataclass(frozen=True)
class RectangleShape:
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
        """Distances (N,) along rays (3, N) in the shape's frame, infinite where they miss (eqs. 12–14)."""
        t = -origins[2] / _avoid_zero(directions[2])
        x, y = (origins[i] + t * directions[i] for i in (0, 1))
        hit = (t > 0) & (np.abs(x) <= self.width / 2) & (np.abs(y) <= self.height / 2)
        return np.where(hit, t, np.inf)


@dataclass(frozen=True)
class BoxShape:
    """A cuboid centred on its origin; rays from inside hit its walls, so that it also serves as a room."""

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
        """Distances (N,) along rays (3, N) in the shape's frame, infinite where they miss (slab method)."""
        half = 0.5 * np.array([[self.length], [self.width], [self.height]])
        inverse = 1 / _avoid_zero(directions)
        middle = -origins * inverse
        reach = half * np.abs(inverse)
        enter, leave = (middle - reach).max(axis=0), (middle + reach).min(axis=0)
        t = np.where(enter > 0, enter, leave)
        return np.where((enter <= leave) & (t > 0), t, np.inf)


@dataclass(frozen=True)
class CylinderShape:
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
        """Distances (N,) along rays (3, N) in the shape's frame, infinite where they miss."""
        o, d = origins[:2], directions[:2]
        a = np.maximum(np.sum(d * d, axis=0), _MIN_COMPONENT)
        b = np.sum(o * d, axis=0) / a
        discriminant = b * b - (np.sum(o * o, axis=0) - self.radius**2) / a
        root = np.sqrt(np.maximum(discriminant, 0))
        # The solid is the overlap of the endless cylinder and the slab between its caps.
        inverse = 1 / _avoid_zero(directions[2])
        middle, reach = -origins[2] * inverse, self.height / 2 * np.abs(inverse)
        enter, leave = np.maximum(-b - root, middle - reach), np.minimum(-b + root, middle + reach)
        t = np.where(enter > 0, enter, leave)
        return np.where((discriminant >= 0) & (enter <= leave) & (t > 0), t, np.inf)


Shape = RectangleShape | BoxShape | CylinderShape


class CastShape(Protocol):
    """What rays can be cast at."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the shape, m."""

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (3, N) in the shape's frame, infinite where they miss."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape somewhere in the world."""

    shape: CastShape
    T_world_shape: Array
    """(4, 4)."""
    brightness: float = 128.0
    """Mean grey value in camera images, 0 to 255."""


@dataclass(frozen=True, eq=False)
class RayHits:
    """The nearest hit of each ray."""

    ranges: Array
    """(N,) distance along each unit ray, m; infinite where it hit nothing."""
    solid: NDArray[np.int32]
    """(N,) index of the solid hit, -1 for none."""


def cast_rays(solids: Sequence[Solid], origins: Array, directions: Array) -> RayHits:
    """Casts rays and returns the nearest hit of each.

    Args:
        solids: what may be hit.
        origins: (N, 3), or (1, 3) where all rays start at one point, world frame, m.
        directions: (N, 3) unit vectors, world frame.
    """
    count = len(directions)
    ranges = np.full(count, np.inf)
    which = np.full(count, -1, dtype=np.int32)
    if not solids:
        return RayHits(ranges, which)
    o, d = np.ascontiguousarray(origins.T), np.ascontiguousarray(directions.T)
    for index, (solid, near) in enumerate(zip(solids, _rays_near(solids, o, d), strict=True)):
        rays = np.flatnonzero(near)
        if not len(rays):
            continue
        R, t = solid.T_world_shape[:3, :3], solid.T_world_shape[:3, 3:]
        starts = o if o.shape[1] == 1 else o[:, rays]
        # The room is near to all rays; indexing all would only copy them.
        rays_of = d if len(rays) == count else d[:, rays]
        distance = solid.shape.distance(R.T @ (starts - t), R.T @ rays_of)
        closer = distance < ranges[rays]
        ranges[rays[closer]] = distance[closer]
        which[rays[closer]] = index
    return RayHits(ranges, which)


def _rays_near(solids: Sequence[Solid], origins: Array, directions: Array) -> NDArray[np.bool_]:
    """(S, N) whether rays hit the bounding spheres of solids: most solids are hit by few rays."""
    centres = np.stack([solid.T_world_shape[:3, 3] for solid in solids])
    radii = np.array([[solid.shape.bounding_radius] for solid in solids])
    # The ray's length to the point nearest to a centre c is (c - o) · d, its distance there² |c - o|² - length².
    length = centres @ directions - np.sum(origins * directions, axis=0)
    square = np.sum(centres**2, axis=1)[:, None] - 2 * centres @ origins + np.sum(origins**2, axis=0)
    return np.asarray((square - length**2 <= radii**2) & (length > -radii))


def _avoid_zero(values: Array) -> Array:
    return np.where(np.abs(values) < _MIN_COMPONENT, _MIN_COMPONENT, values)
