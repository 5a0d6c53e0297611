"""The floor below a path, as points of the surroundings show it."""

import numpy as np
from scipy.spatial import cKDTree

from calgraph.geometry import Array, se_n
from calgraph.surfaces.flat_cells import FlatCells, fit_flat_cells, sum_moments
from calgraph.surfaces.surface_points import CELL_LIMITS

# Cells in which floors are recognised, as in the adjustment, and their thickness with waves, m.
_LIMITS, _THICKNESS = CELL_LIMITS[3], 0.03
# Edge of the cells whose means are its places, m.
_FINE = 0.3
# Root of the sum of squared turns of steps below which turns do not show what is level, rad.
_LITTLE_TURN = 0.2
# Angle from the axis of turning within which normals are of floors: ramps have up to 10 degrees, rad.
_MAX_SLOPE = 0.25
# Distance from the vehicle within which the floor is that below it (standard deviation), m, and the least sum of
# weights of cells in there: three decide a plane.
_NEAR, _MIN_NEAR, _MIN_SPREAD = 0.6, 4.0, 0.3
# Distance from the path within which level cells are compared, m.
_BESIDE = 4.0
# Distance from the plane of a cell of the floor beyond which points are of what stands on it, m: with waves, the
# floor itself is within three standard deviations of 0.02 m.
_ABOVE = 0.05
# Heights of places over a plane beyond which these are not of it, m (Geman–McClure), and steps of the fit: ramps.
_ROUGH, _STEPS = 0.03, 4
# Of the floor's height below the root, between the lowest and the highest place of a slope, m.
_FLOOR_BAND = 0.15


def measure_level(points: Array, poses: Array, up: Array, places: Array) -> Array:
    """The floor in the frame of the root, (K - 1, 6) by step: its upward normal at one place, and a point of it.

    Args:
        points: (N, 3) of a part's surroundings, m.
        poses: (K, 4, 4) of the root in their world, along its path.
        up: (3,) roughly upward in the frame of the root.
        places: (2, 3) in the frame of the root, m: the point is below the second.

    Returns:
        NaN where no floor is known there.
    """
    # In coordinates in which z is up.
    axes = axes_from(_find_vertical(points, poses, up))
    points, R = points @ axes, axes.T @ mean_rotations(poses)
    root = (se_n.translation(poses[1:]) + se_n.translation(poses[:-1])) / 2 @ axes
    level = np.full((len(root), 6), np.nan)
    floor = _select_floor(points, root)
    if len(floor) < _LIMITS.min_count:
        return level
    cells = sum_moments(floor, _FINE).mean
    at = root[:, None] + np.einsum("kij,pj->kpi", R, places)
    (upward, _), (_, below) = (_fit_planes(cells, at[:, p]) for p in (0, 1))
    level[:, :3] = np.einsum("kji,kj->ki", R, upward)
    level[:, 3:] = np.einsum("kji,kj->ki", R, below - root)
    return level


def _fit_planes(cells: Array, at: Array) -> tuple[Array, Array]:
    """Upward normals (K, 3), and points (K, 3) below places (K, 3), of the planes of cells (M, 3) near these."""
    near = cKDTree(at[:, :2]).sparse_distance_matrix(cKDTree(cells[:, :2]), 3 * _NEAR, output_type="ndarray")
    k, offset = near["i"], cells[near["j"]] - at[near["i"]]
    weight = np.exp(-0.5 * (near["v"] / _NEAR) ** 2)
    design = np.column_stack([np.ones(len(k)), offset])
    robust: Array = np.ones(len(k))
    plane = np.full((len(at), 3), np.nan)
    for _ in range(_STEPS):
        products = [[np.bincount(k, weight * robust * a * b, len(at)) for a in design.T] for b in design.T]
        moments = np.moveaxis(np.array(products), 2, 0)
        N, right = moments[:, :3, :3], moments[:, :3, 3:]
        # Where cells are on one side only, their slopes are not extrapolated.
        enough = (N[:, 0, 0] > _MIN_NEAR) & (np.linalg.eigvalsh(N)[:, 0] > _MIN_SPREAD)
        plane = np.full((len(at), 3), np.nan)
        plane[enough] = np.linalg.solve(N[enough], right[enough])[..., 0]
        off = np.nan_to_num(offset[:, 2] - np.einsum("ni,ni->n", design[:, :3], plane[k]))
        robust = (1 + (off / _ROUGH) ** 2) ** -2.0
    upward = np.column_stack([-plane[:, 1:], np.ones(len(plane))])
    below = np.column_stack([at[:, :2], at[:, 2] + plane[:, 0]])
    return upward / np.linalg.norm(upward, axis=1, keepdims=True), below


def _find_vertical(points: Array, poses: Array, up: Array) -> Array:
    """(3,) in the world: the normal of most level surfaces, as the turns of a vehicle show what is level."""
    R = se_n.rotation(poses)
    turns = se_n.log(R[1:] @ se_n.transpose(R[:-1]))
    mean = (R @ up).mean(axis=0)
    # A vehicle that hardly turns leans as much about other axes: it is as level as its root.
    moments = turns.T @ turns + _LITTLE_TURN**2 * np.outer(mean, mean)
    axis = np.linalg.eigh(moments)[1][:, -1]
    axis = axis * np.sign(axis @ mean)
    normals = _fit_cells(points).normals
    normals = normals * np.sign(normals @ axis)[:, None]
    level = normals[normals @ axis > np.cos(_MAX_SLOPE)]
    if len(level):
        axis = np.median(level, axis=0)
    return np.asarray(axis / np.linalg.norm(axis), dtype=np.float64)


def _fit_cells(points: Array) -> FlatCells:
    return fit_flat_cells(sum_moments(points, _LIMITS.cell), _LIMITS, _THICKNESS)


def _select_floor(points: Array, place: Array) -> Array:
    """(F, 3) those of points (N, 3) that are of the floor: the lowest of many level cells below a path (K, 3)."""
    cells = _fit_cells(points)
    path = place[::5]
    distance = np.linalg.norm(cells.center[:, None, :2] - path[None, :, :2], axis=2)
    below = path[np.argmin(distance, axis=1), 2] - cells.center[:, 2]
    level = np.abs(cells.normals[:, 2]) > np.cos(_MAX_SLOPE)
    candidate = level & (below > 0) & (distance.min(axis=1, initial=np.inf) < _BESIDE)
    if not candidate.any():
        return np.zeros((0, 3))
    # Heights below the path, in which the floor of a slope is one.
    heights = np.sort(below[candidate])
    support = (np.abs(heights[:, None] - heights) < _FLOOR_BAND).sum(axis=1)
    height = heights[np.flatnonzero(support >= 0.5 * support.max())[-1]]
    height = np.median(heights[np.abs(heights - height) < _FLOOR_BAND])
    index = cells.find(points)
    of_floor = candidate & (np.abs(below - height) < _FLOOR_BAND)
    above = np.abs(np.einsum("ni,ni->n", points - cells.center[index], cells.normals[index]))
    return np.asarray(points[(index >= 0) & of_floor[index] & (above < _ABOVE)])


def axes_from(z: Array) -> Array:
    """(3, 3) a rotation whose third column is a unit vector."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def mean_rotations(poses: Array) -> Array:
    """(K - 1, 3, 3) of the middles of steps."""
    R = se_n.rotation(poses)
    half = se_n.exp(0.5 * se_n.log(R[1:] @ se_n.transpose(R[:-1])))
    return np.asarray(half @ R[:-1])
