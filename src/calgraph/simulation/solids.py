"""Shapes, and ray casting against them, for beams and camera rays.

Internally rays are (3, N) arrays: NumPy is several times faster on long rows than on rows of three.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array

# A direction component this small counts as parallel to a face; it keeps divisions finite.
_MIN_COMPONENT = 1e-12
_NEWTON_STEPS = 5
"""Of a ray to a relief: slopes of a few percent converge in four but for grazing rays, which are lost."""
_RELIEF_TOLERANCE = 1e-6
"""Distance from the relief at which a ray has met it, m."""


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


@dataclass(frozen=True)
class SphereShape:
    """A ball centred on its origin."""

    radius: float
    """m."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the shape, m."""
        return self.radius

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along unit rays (3, N) in the shape's frame, infinite where they miss."""
        along = -np.sum(origins * directions, axis=0)
        # Squares of short vectors only: origins are far away compared to the radius.
        square = self.radius**2 - np.sum((origins + along * directions) ** 2, axis=0)
        t = along - np.sqrt(np.maximum(square, 0))
        return np.where((square >= 0) & (t > 0), t, np.inf)


@dataclass(frozen=True)
class FrustumShape:
    """A ramp: a flat top with a slope on each side, on the plane z = 0 of its frame."""

    top: tuple[float, float]
    """Length of the flat top along x and y, m."""
    runs: tuple[float, float]
    """Horizontal length of the slopes along x and y, m."""
    height: float
    """m."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the shape, m."""
        half = np.add(self.top, np.multiply(2, self.runs)) / 2
        return float(np.hypot(np.hypot(*half), self.height))

    @cached_property
    def planes(self) -> tuple[Array, Array]:
        """Outer unit normals (5, 3) and offsets (5,) of the top and the slopes, with n @ x + d = 0."""
        normals, offsets = [[0.0, 0.0, 1.0]], [-self.height]
        for axis in range(2):
            foot = self.top[axis] / 2 + self.runs[axis]
            for sign in (1.0, -1.0):
                normal = np.zeros(3)
                normal[axis], normal[2] = sign * self.height, self.runs[axis]
                length = float(np.linalg.norm(normal))
                normals.append((normal / length).tolist())
                offsets.append(-self.height * foot / length)
        return np.array(normals), np.array(offsets)

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (3, N) from above in the shape's frame, infinite where they miss."""
        normals, offsets = self.planes
        rise = normals @ directions
        t = -(normals @ origins + offsets[:, None]) / _avoid_zero(rise)
        enter = np.where(rise < 0, t, -np.inf).max(axis=0)
        leave = np.where(rise >= 0, t, np.inf).min(axis=0)
        above = origins[2] + enter * directions[2] >= 0
        return np.where((enter <= leave) & (enter > 0) & above, enter, np.inf)

    def height_at(self, xy: Array) -> Array:
        """(N,) height of the surface above z = 0 at (N, 2), 0 outside."""
        normals, offsets = self.planes
        heights = -(xy @ normals[:, :2].T + offsets) / normals[:, 2]
        return np.asarray(np.maximum(heights.min(axis=1), 0.0))


@dataclass(frozen=True, eq=False)
class ReliefShape:
    """A rectangle around its origin whose height over z = 0 is a sum of waves, hit from both sides."""

    width: float
    """Along x, m."""
    height: float
    """Along y, m."""
    amplitudes: Array
    """(M,) m."""
    wave_vectors: Array
    """(M, 2) rad/m."""
    phases: Array
    """(M,) rad."""

    @property
    def bounding_radius(self) -> float:
        """Radius of the sphere around the origin that holds the shape, m."""
        return 0.5 * float(np.hypot(self.width, self.height)) + float(np.abs(self.amplitudes).sum())

    def height_at(self, xy: Array) -> Array:
        """(N,) height of the relief at (N, 2)."""
        return np.asarray(np.sin(xy @ self.wave_vectors.T + self.phases) @ self.amplitudes)

    def gradient_at(self, xy: Array) -> Array:
        """(N, 2) slope of the relief at (N, 2)."""
        rate = np.cos(xy @ self.wave_vectors.T + self.phases)
        return np.asarray((rate * self.amplitudes) @ self.wave_vectors)

    def distance(self, origins: Array, directions: Array) -> Array:
        """Distances (N,) along rays (3, N) in the shape's frame, infinite where they miss (Newton's method)."""
        t = -origins[2] / _avoid_zero(directions[2])
        x, y = (origins[i] + t * directions[i] for i in (0, 1))
        rays = np.flatnonzero((t > 0) & (np.abs(x) <= self.width / 2) & (np.abs(y) <= self.height / 2))
        result = np.full(len(t), np.inf)
        if not len(self.amplitudes):
            result[rays] = t[rays]
            return result
        # Of a camera's rays all begin in one place.
        o, d, t = np.broadcast_to(origins, directions.shape)[:, rays].T, directions[:, rays].T, t[rays]
        for _ in range(_NEWTON_STEPS):
            points = o + t[:, None] * d
            gap = points[:, 2] - self.height_at(points[:, :2])
            closing = d[:, 2] - np.sum(self.gradient_at(points[:, :2]) * d[:, :2], axis=1)
            t = t - gap / np.where(np.abs(closing) < 1e-3, 1e-3, closing)
        points = o + t[:, None] * d
        met = (np.abs(points[:, 2] - self.height_at(points[:, :2])) < _RELIEF_TOLERANCE) & (t > 0)
        met &= (np.abs(points[:, 0]) <= self.width / 2) & (np.abs(points[:, 1]) <= self.height / 2)
        result[rays[met]] = t[met]
        return result


Shape = RectangleShape | BoxShape | CylinderShape | SphereShape | FrustumShape | ReliefShape


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
class Surface:
    """A shape in the surroundings of scanners, or on a moving body."""

    shape: Shape
    T_world_shape: Array
    """(4, 4); from the body's frame on a body."""
    reflectivity: float = 0.5
    """0 (black) to 1 (white)."""
    glass: bool = False
    """Whether most beams pass through it."""

    @property
    def brightness(self) -> float:
        """Mean grey value in camera images, 0 to 255."""
        return 40 + 180 * self.reflectivity


@dataclass(frozen=True, eq=False)
class RayHits:
    """The nearest hit of each ray."""

    ranges: Array
    """(N,) distance along each unit ray, m; infinite where it hit nothing."""
    solid: NDArray[np.int32]
    """(N,) index of the solid hit, -1 for none."""


def cast_rays(solids: Sequence[Solid | Surface], origins: Array, directions: Array) -> RayHits:
    """Casts rays and returns the nearest hit of each.

    Args:
        solids: what may be hit.
        origins: (N, 3), or (1, 3) where all rays start at one point, world frame, m.
        directions: (N, 3) unit vectors, world frame.
    """
    count = len(directions)
    ranges = np.full(count, np.inf)
    which = np.full(count, -1, dtype=np.int32)
    o, d = np.ascontiguousarray(origins.T), np.ascontiguousarray(directions.T)
    along, square = np.sum(o * d, axis=0), np.sum(o * o, axis=0)
    for index, solid in enumerate(solids):
        # Most solids are hit by few rays: only those that hit its bounding sphere are cast. The length of a ray to
        # the point nearest to a centre c is (c - o) · d, and its distance there² |c - o|² - length².
        c, radius = solid.T_world_shape[:3, 3], solid.shape.bounding_radius
        length = c @ d - along
        rays = np.flatnonzero((square - 2 * (c @ o) + c @ c - length**2 <= radius**2) & (length > -radius))
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


def _avoid_zero(values: Array) -> Array:
    return np.where(np.abs(values) < _MIN_COMPONENT, _MIN_COMPONENT, values)


def surface_normals(shape: Shape, points: Array) -> Array:
    """Unit normals (N, 3), of either side, at points (N, 3) on a shape, all in its frame."""
    if isinstance(shape, SphereShape):
        return points / shape.radius
    if isinstance(shape, BoxShape):
        half = 0.5 * np.array([shape.length, shape.width, shape.height])
        return np.asarray(np.eye(3)[np.argmax(np.abs(points) / half, axis=1)])
    if isinstance(shape, FrustumShape):
        normals, offsets = shape.planes
        return np.asarray(normals[np.argmax(points @ normals.T + offsets, axis=1)])
    if isinstance(shape, CylinderShape):
        on_side = np.abs(points[:, 2]) < shape.height / 2 - 1e-6
        outward = points * [1.0, 1.0, 0.0] / shape.radius
        return np.where(on_side[:, None], outward, [0.0, 0.0, 1.0])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    if isinstance(shape, ReliefShape) and len(shape.amplitudes):
        normals[:, :2] = -shape.gradient_at(points[:, :2])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals
