"""The floor of a stationary 3-D LiDAR: the plane below it on which people stand, or vehicles drive.

People are upright: the long axes of what moves are near the vertical, which distinguishes floors from walls. Their
heights over a plane distinguish a floor from ceilings and tables. Where no person walks, what drives extends least
along the vertical, and reaches down to the floor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calgraph.errors import Rejected
from calgraph.geometry import Array, Index, plane, se3
from calgraph.network.space.observations import StaticPoints
from calgraph.network.space.static_directions import MovingPoints, find_rows
from calgraph.solver.connected_parts import label_parts


@dataclass(frozen=True, eq=False)
class Floor:
    """The floor in the frame of its sensor."""

    T_floor_sensor: Array
    """(4, 4) levelled; x, y and yaw are zero."""
    covariance: Array
    """(3, 3) of the errors of roll and pitch, rad, and height, m, along the axes of the floor."""
    points: NDArray[np.bool_]
    """(N,) which static points are of it."""


# Sweeps of which bodies are taken, and the largest gap in a body, m: rings of 2° are 0.42 m apart at 12 m.
_BODY_SWEEPS, _BODY_GAP = 150, 0.5
# Least points and length of a body, m, whose axis counts, its largest length, and least ratio of its variances
# along and across: a body is 1.5 m high and 0.5 m wide.
_BODY_POINTS, _BODY_LENGTH, _BODY_RATIO = 12, (0.8, 2.3), 4.0
_MIN_BODIES = 15
# Largest angle of a floor's normal from the mean axis of bodies, of which sensors above measure heads and fronts.
_MIN_COSINE = float(np.cos(np.radians(35)))
# Static points are thinned to one in each cube of this edge, m, and planes fitted through triples of them.
_CUBE, _TRIPLES = 0.5, 3000
# Distance of points from a plane that they support, m: relief, and 2° of range noise.
_SUPPORT = 0.05
# Least height of a sensor, m; points of bodies that are compared with planes; their least share from below a floor
# to the height of a tall person over it, m, and their least 90 % quantile: people, not their legs only.
_MIN_HEIGHT, _COMPARED = 1.0, 2000
_MIN_STANDING, _STANDING = 0.8, (-0.3, 2.2)
_MIN_TOP = 0.9
# The same of vehicles, up to the roof of a truck; their 5 % quantile is near the floor, far below ceilings.
_DRIVING, _MAX_BOTTOM, _MIN_ROOF = (-0.3, 4.5), 0.7, 0.4
# Least ratio of the variances of moving points along the second axis and along the vertical, and least standard
# deviation along that axis, m: people on one line extend by 0.5 m along the vertical, and less across the line.
_DRIVEN_RATIO, _MIN_SPREAD = 3.0, 1.0
# By how much more static points have to be on a plane below vehicles than on one below persons: in two halls with
# vehicles, floors have 335 to 1012, and planes below what is taken for persons 13 to 78.
_MORE_SUPPORT = 3.0
# Gates of points, m, in steps of the adjustment: from errors of three points to relief and noise.
_GATES = (0.08, 0.06, 0.045, 0.045, 0.045)
# Edge of cells of the floor that count equally, and of blocks whose errors are independent, m; least numbers.
_FLOOR_CELL, _BLOCK, _MIN_CELLS, _MIN_BLOCKS = 1.0, 3.0, 12, 4
# Standard deviation of a block of floor about the plane, m, at least: floors are flat to some millimetres.
_RELIEF = 0.003


def find_floor(
    static: StaticPoints, moving: MovingPoints, range_bias: float, ring_bias: float, rng: np.random.Generator
) -> Floor | Rejected:
    """Finds the floor.

    Args:
        static: what stands still.
        moving: what moves.
        range_bias: standard deviation of the sensor's common range bias, m.
        ring_bias: the same of each ring beside it, m.
        rng: for the triples of points.
    """
    upright = find_upright_bodies(moving)
    start, support = None, 0
    if not isinstance(upright, Rejected):
        axis, bodies = upright
        start, support = _search_plane(static.points, bodies, axis, rng)
    driven = _find_driven_axis(moving)
    if driven is not None:
        # Long sides of vehicles are not upright, and planes to which they are perpendicular have little support.
        found, by_driving = _search_plane(static.points, moving.points, driven, rng, driven=True)
        start = found if by_driving > _MORE_SUPPORT * support else start
    if start is not None:
        return _adjust_floor(static.points, start, range_bias, ring_bias)
    if isinstance(upright, Rejected):
        return upright
    return Rejected("no plane below the sensor is one on which the people whom it measured stand")


def _find_driven_axis(moving: MovingPoints) -> Array | None:
    """The unit axis (3,) along which moving points extend least; None if that may not be the vertical."""
    if len(moving.points) < _COMPARED:
        return None
    values, vectors = np.linalg.eigh(np.cov(moving.points.T))
    return np.asarray(vectors[:, 0]) if values[1] >= max(_DRIVEN_RATIO * values[0], _MIN_SPREAD**2) else None


def find_upright_bodies(moving: MovingPoints) -> tuple[Array, Array] | Rejected:
    """The unit axis (3,) along which most moving bodies are long, of any sign, and the points (P, 3) of these."""
    bounds = np.flatnonzero(np.diff(moving.sweep, prepend=-1, append=-1))
    chosen = np.unique(np.linspace(0, max(len(bounds) - 2, 0), _BODY_SWEEPS).astype(np.intp))
    axes, bodies = [], []
    for k in chosen[: len(bounds) - 1]:
        points = moving.points[bounds[k] : bounds[k + 1]]
        label = label_parts(len(points), cKDTree(points).query_pairs(_BODY_GAP, output_type="ndarray"))
        for body in np.flatnonzero(np.bincount(label) >= _BODY_POINTS):
            of_body = points[label == body]
            values, vectors = np.linalg.eigh(np.cov(of_body.T))
            along = of_body @ vectors[:, 2]
            low, high = _BODY_LENGTH
            if low <= np.ptp(along) <= high and values[2] >= _BODY_RATIO * values[1]:
                axes.append(vectors[:, 2])
                bodies.append(of_body)
    if len(axes) < _MIN_BODIES:
        return Rejected(
            f"people are in {len(axes)} of the compared sweeps only, {_MIN_BODIES} are needed: let people walk in "
            "its view"
        )
    of_bodies: Array = np.array(axes)
    mean = np.linalg.eigh(of_bodies.T @ of_bodies)[1][:, 2]
    # Once more without those that are not upright: edges of doors, and people who bend.
    upright = np.abs(of_bodies @ mean) >= _MIN_COSINE
    axis = np.linalg.eigh(of_bodies[upright].T @ of_bodies[upright])[1][:, 2]
    return axis, np.concatenate([bodies[k] for k in np.flatnonzero(upright)])


def _search_plane(
    static: Array, bodies: Array, axis: Array, rng: np.random.Generator, driven: bool = False
) -> tuple[Array | None, int]:
    """The plane (4,) with the most support of those on which bodies stand, or drive, if any; and its support."""
    cube = np.floor(static / _CUBE).astype(np.int64)
    thinned = static[np.unique(cube, axis=0, return_index=True)[1]]
    if len(thinned) < _MIN_CELLS:
        return None, 0
    a, b, c = thinned[rng.integers(len(thinned), size=(3, _TRIPLES))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 1.0] / length[length > 1.0, None]
    planes = np.column_stack([normal, -np.einsum("ij,ij->i", normal, a[length > 1.0])])
    planes = plane.towards_origin(planes[np.abs(normal @ axis) >= _MIN_COSINE])
    planes = planes[planes[:, 3] >= _MIN_HEIGHT]
    sample = bodies[:: max(1, len(bodies) // _COMPARED)]
    heights = plane.distance(planes, sample)
    low, high = _DRIVING if driven else _STANDING
    standing = np.mean((heights > low) & (heights < high), axis=1) >= _MIN_STANDING
    top = np.quantile(heights[standing], 0.9, axis=1) >= (_MIN_ROOF if driven else _MIN_TOP)
    standing[standing] &= top & (
        np.quantile(heights[standing], 0.05, axis=1) < (_MAX_BOTTOM if driven else np.inf)
    )
    planes = planes[standing]
    if not len(planes):
        return None, 0
    support = np.array([np.sum(np.abs(plane.distance(one, thinned)) < _SUPPORT) for one in planes])
    best = int(np.argmax(support))
    return np.asarray(planes[best]), int(support[best])


def _adjust_floor(points: Array, start: Array, range_bias: float, ring_bias: float) -> Floor | Rejected:
    """The plane by least squares over cells of floor, with standard deviations by blocks of them."""
    T = level(start)
    for gate in _GATES:
        levelled = points @ T[:3, :3].T + T[:3, 3]
        inside = np.abs(levelled[:, 2]) < gate
        floor = levelled[inside]
        _, cell, count = np.unique(
            np.floor(floor[:, :2] / _FLOOR_CELL), axis=0, return_inverse=True, return_counts=True
        )
        share = 1 / count[cell]
        mean = np.stack([np.bincount(cell, share * column) for column in floor.T], axis=1)
        A = np.column_stack([mean[:, :2], np.ones(len(mean))])
        block = np.unique(np.floor(mean[:, :2] / _BLOCK), axis=0, return_inverse=True)[1]
        if len(mean) < _MIN_CELLS or block.max() + 1 < _MIN_BLOCKS:
            return Rejected(f"it measured {len(mean)} m² of floor only: too little to level it")
        gain = np.linalg.solve(A.T @ A, A.T)
        slope_x, slope_y, level_error = gain @ mean[:, 2]
        normal = np.array([-slope_x, -slope_y, 1.0])
        corrected = np.array([*normal, -level_error], dtype=np.float64) / np.linalg.norm(normal)
        T = level(plane.transform(se3.inverse(T), corrected))
    residual = mean[:, 2] - A @ (gain @ mean[:, 2])
    return Floor(
        T, _find_covariance(points[inside], T, gain, residual, (cell, share, block), range_bias, ring_bias), inside
    )


def _find_covariance(
    points: Array,
    T: Array,
    gain: Array,
    residual: Array,
    cells: tuple[Index, Array, Index],
    range_bias: float,
    ring_bias: float,
) -> Array:
    """(3, 3) of roll, pitch and height: from blocks' residuals, and from biases of ranges and rings."""
    cell, share, block = cells
    blocks = block.max() + 1
    influence = np.stack([np.bincount(block, row * residual) for row in gain])
    relief = np.stack([np.bincount(block, row) for row in gain])
    covariance = influence @ influence.T * blocks / (blocks - 3) + _RELIEF**2 * relief @ relief.T
    # By how much a longer range lowers a point.
    lowers = points @ T[2, :3] / np.linalg.norm(points, axis=1)
    weighted = gain[:, cell] * (share * lowers)
    common = weighted.sum(axis=1)
    covariance += range_bias**2 * np.outer(common, common)
    ring = np.unique(find_rows(points), return_inverse=True)[1]
    of_rings = np.stack([np.bincount(ring, row) for row in weighted])
    covariance += ring_bias**2 * of_rings @ of_rings.T
    # A floor that seems to rise along x, or y, pitches or rolls the sensor, and a lower one is farther from it.
    by_plane = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return np.asarray(by_plane @ covariance @ by_plane.T)


def level(floor: Array) -> Array:
    """The pose (4, 4) of a sensor over a floor (4,) in its frame: z is up, x the sensor's as far as level."""
    up = floor[:3]
    ahead = np.eye(3)[find_heading(up)]
    x = ahead - up * (up @ ahead)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = [x, np.cross(up, x), up]
    T[2, 3] = floor[3]
    return T


def find_heading(up: Array) -> int:
    """The axis of a sensor, 0 or 1, that heads along x of its level frame: x, or y if x is near the vertical."""
    return int(abs(up[0]) >= _MAX_UPRIGHT)


# Cosine of the angle between x and the vertical, above which y is the heading (2.6°).
_MAX_UPRIGHT = 0.999
