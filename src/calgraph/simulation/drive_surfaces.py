"""What beams of a driving robot hit: shapes beyond those of :mod:`calgraph.simulation.solids`, moving bodies.

Rays are (3, N) arrays as in that module.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calgraph.geometry import Array, se3, so3
from calgraph.simulation.solids import BoxShape, CylinderShape, RectangleShape

_MIN_COMPONENT = 1e-12
_NEWTON_STEPS = 5
"""Of a ray to a relief: slopes of a few percent converge in four but for grazing rays, which are lost."""
_RELIEF_TOLERANCE = 1e-6
"""Distance from the relief at which a ray has met it, m."""


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
        t = -(normals @ origins + offsets[:, None]) / np.where(np.abs(rise) < _MIN_COMPONENT, _MIN_COMPONENT, rise)
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
        down = np.where(np.abs(directions[2]) < _MIN_COMPONENT, _MIN_COMPONENT, directions[2])
        t = -origins[2] / down
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


@dataclass(frozen=True, eq=False)
class Surface:
    """A shape somewhere in the surroundings, or on a moving body."""

    shape: Shape
    T_world_shape: Array
    """(4, 4); from the body's frame on a body."""
    reflectivity: float = 0.5
    """0 (black) to 1 (white)."""
    glass: bool = False
    """Whether most beams pass through it."""


@dataclass(frozen=True, eq=False)
class MovingBody:
    """Surfaces that move together, upright."""

    surfaces: tuple[Surface, ...]
    """In the body's frame: x ahead, z up, origin on the ground."""
    times: Array
    """(K,) s from the start of the recording."""
    positions: Array
    """(K, 3) of the origin, linear in between, m."""
    yaws: Array
    """(K,) continuous, linear in between, rad."""

    @cached_property
    def bounds(self) -> Surface:
        """A sphere in the body's frame that holds the body."""
        places = np.array([surface.T_world_shape[:3, 3] for surface in self.surfaces])
        centre = places.mean(axis=0)
        reach = [surface.shape.bounding_radius for surface in self.surfaces]
        radius = float((np.linalg.norm(places - centre, axis=1) + reach).max())
        return Surface(SphereShape(radius), se3.pose(np.eye(3), centre))

    def poses(self, times: Array) -> Array:
        """(N, 4, 4) from its frame to the world."""
        yaw = np.interp(times, self.times, self.yaws)
        place = np.stack([np.interp(times, self.times, column) for column in self.positions.T], axis=-1)
        return se3.pose(so3.exp(yaw[:, None] * np.array([0.0, 0.0, 1.0])), place)


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
