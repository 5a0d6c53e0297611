"""Odometry of one LiDAR: each sweep is registered to flat cells of recent ones, point to plane.

Source: Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", 2023, for the prediction by constant velocity,
the adaptive gate and the correction of motion within sweeps; Yuan et al., "Efficient and probabilistic adaptive
voxel mapping for accurate online LiDAR odometry", 2022, for planes in voxels and their uncertainty; Gelfand et
al., "Geometrically stable sampling for the ICP algorithm", 2003, for points that determine the motion.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calgraph.drive.sweeps import Sweep
from calgraph.geometry import Array, Index, se_n
from calgraph.surfaces.flat_cells import (
    CellLimits,
    CellMoments,
    FlatCells,
    fit_flat_cells,
    merge_moments,
    sum_moments,
)
from calgraph.surfaces.trajectory import Track

# Cells hold 20 or more points of a room at 10 m, and are smaller than most furniture; planes need more points than
# lines, of at least two rings. With 0.06 m of noise a normal within 0.1 rad needs more than 0.05 m.
_LIMITS = {2: CellLimits(0.3, 4, 0.05), 3: CellLimits(1.0, 6, 0.05)}
# Standard deviation of points from a flat cell, m: range noise, doors in walls, and drift over the recent sweeps.
_MAX_THICKNESS = 0.1
# A new key sweep is taken after this motion, m and rad, and this many of the last ones are the map.
_KEY_DISTANCE, _KEY_ANGLE, _KEY_TIME, _KEY_SWEEPS = 0.3, 0.17, 0.5, 50
# Standard deviation of points of LiDARs in space, m, that neighbours on a surface have in common, besides twice
# the thickness of its cell and what its normal leaves open; 0.05 m is worse where few points determine the motion.
_NOISE = 0.03
# Share of chance in the choice of points: surfaces that are not yet in the map determine nothing.
_RANDOM_SHARE = 0.3
# Gauss–Newton ends where a step is below a tenth of a millimetre.
_LEAST_STEP = 1e-4
# Accelerations of wheeled robots and cars, m/s² and rad/s²: the prior of a motion is the last one.
_ACCELERATION, _TURN_ACCELERATION = 3.0, 6.0
# Scales of the robust weight in each Gauss–Newton step, m (Geman–McClure): from the error of a prediction in a
# curve to range noise with what walls deviate from planes.
_ROBUST_SCALES = (0.5, 0.36, 0.26, 0.19, 0.14, *[0.1] * 8)
_FINAL_SCALES = (0.2, 0.14, *[0.1] * 8)
# Turns (rad) and distances ahead (m) from a prediction at which scans in the plane are compared with the surfaces:
# what accelerations add within 0.2 s, in steps that a robust scale of 0.5 m covers at 10 m. Points that decide.
_SEARCHED_TURNS, _SEARCHED_DISTANCES, _SEARCHED_POINTS = np.linspace(-0.3, 0.3, 13), (-0.15, 0.0, 0.15), 90


@dataclass(frozen=True, eq=False)
class OdometryTrack(Track):
    """A trajectory by odometry."""

    stddev: Array
    """(N,) that the points of each sweep alone leave the position along its least certain direction, m."""


def track_sensor(sweeps: Sequence[Sweep], points: int, rng: np.random.Generator) -> OdometryTrack:
    """The trajectory of a sensor at the times of its sweeps, in a world that begins in its first pose.

    Args:
        sweeps: in order of time.
        points: of each sweep that are registered, drawn at random, those more often that determine the motion.
        rng: for them.
    """
    n = sweeps[0].points.shape[1]
    limits = _LIMITS[n]
    poses = [np.eye(n + 1)]
    key_moments: deque[CellMoments] = deque(maxlen=_KEY_SWEEPS)
    velocity = np.zeros(n + (n - 1) * n // 2)
    stddev, surfaces, last_key = [0.0], None, None
    for k, sweep in enumerate(sweeps):
        if surfaces is not None:
            duration = sweep.time - sweeps[k - 1].time
            predicted = poses[-1] @ _motion(velocity, duration)
            some = _select(sweep, points, predicted, velocity, surfaces, rng)
            pose, velocity, information = _register(some, poses[-1], predicted, duration, surfaces)
            poses.append(pose)
            # This information bounds the standard deviation at 10 m.
            least = information + np.diag(np.repeat([1e-2, 1.0], [n, len(information) - n]))
            stddev.append(float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(least)[:n, :n])[-1])))
        if last_key is None or _is_far(last_key[1], poses[-1]) or sweep.time - last_key[0] > _KEY_TIME:
            last_key = sweep.time, poses[-1]
            key_moments.append(sum_moments(_to_world(sweep, poses[-1], velocity), limits.cell))
            surfaces = fit_flat_cells(merge_moments(key_moments), limits, _MAX_THICKNESS)
    return OdometryTrack(np.array([sweep.time for sweep in sweeps]), np.array(poses), np.array(stddev))


def _select(
    sweep: Sweep, count: int, pose: Array, velocity: Array, surfaces: FlatCells, rng: np.random.Generator
) -> Sweep:
    """At most ``count`` points, drawn by how much each determines: a sensor may measure floor at nine of ten."""
    total = len(sweep.points)
    if total <= count:
        return sweep
    world = _to_world(sweep, pose, velocity)
    index = surfaces.find(world)
    hit = index >= 0
    J = _jacobian(world[hit], pose, surfaces.normals[index[hit]])
    share = np.full(total, _RANDOM_SHARE / total)
    leverage = np.einsum("ij,jk,ik->i", J, np.linalg.inv(J.T @ J + 1e-3 * np.eye(J.shape[1])), J)
    share[hit] += (1 - _RANDOM_SHARE) * leverage / max(float(leverage.sum()), 1e-9)
    # The largest of Gumbel variables with these offsets are a sample without replacement.
    order = np.argpartition(-np.log(share) - rng.gumbel(size=total), count)
    return sweep.select(np.sort(order[:count]))


def _jacobian(world: Array, pose: Array, normals: Array) -> Array:
    """(N, n + d) derivatives of the distances of points (N, n) from surfaces by the pose."""
    arm = world - se_n.translation(pose)
    return np.concatenate([normals, np.einsum("ni,nij->nj", normals, se_n.rotation_jacobian(arm))], axis=1)


def _motion(velocity: Array, durations: Array | float) -> Array:
    """Motions (..., n+1, n+1) at a velocity in the moving frame, (n + d,), during durations, s."""
    n = 2 if len(velocity) == 3 else 3
    tangent = velocity * np.asarray(durations)[..., None]
    return se_n.pose(se_n.exp(tangent[..., n:]), tangent[..., :n])


def _to_world(sweep: Sweep, pose: Array, velocity: Array) -> Array:
    """The points (N, n) with the sensor's motion within the sweep, in the world."""
    T = pose @ _motion(velocity, sweep.times - sweep.time)
    return np.asarray((se_n.rotation(T) @ sweep.points[:, :, None])[..., 0] + se_n.translation(T))


def _register(
    sweep: Sweep, before: Array, predicted: Array, duration: float, surfaces: FlatCells
) -> tuple[Array, Array, Array]:
    """The pose of a sweep, the velocity that leads to it from that before, and the information of its points."""
    starts = [(predicted, _ROBUST_SCALES)]
    if predicted.shape[-1] == 3:
        starts.append((_search(sweep, before, predicted, duration, surfaces), _FINAL_SCALES))
    solutions = [
        _minimize(sweep, before, start, predicted, duration, surfaces, scales) for start, scales in starts
    ]
    return min(solutions, key=lambda one: one[3])[:3]


def _search(sweep: Sweep, before: Array, predicted: Array, duration: float, surfaces: FlatCells) -> Array:
    """The most likely of the poses around a prediction, in the plane, where a scan meets few surfaces."""
    turn, ahead = np.meshgrid(_SEARCHED_TURNS, _SEARCHED_DISTANCES)
    zero = np.zeros(turn.size)
    candidates = predicted @ se_n.pose(se_n.exp(turn.reshape(-1, 1)), np.stack([ahead.ravel(), zero], axis=1))
    some = sweep.select(np.arange(0, len(sweep.points), max(len(sweep.points) // _SEARCHED_POINTS, 1)))
    local = _to_world(some, np.eye(3), _velocity(before, predicted, duration))
    world = se_n.apply(candidates, local)
    cost = _robust_cost(world.reshape(-1, 2), surfaces, _ROBUST_SCALES[0]).reshape(len(candidates), -1).sum(axis=1)
    prior = 0.5 * (turn.ravel() / (0.5 * _TURN_ACCELERATION * duration**2)) ** 2
    return np.asarray(candidates[np.argmin(cost * len(sweep.points) / max(len(local), 1) + prior)])


def _robust_cost(world: Array, surfaces: FlatCells, scale: float) -> Array:
    """(N,) half the robust squared distance of each point from its surface; 1/2 without one (Geman–McClure)."""
    index = surfaces.find_near(world, surfaces.cell)
    cost = np.full(len(world), 0.5)
    hit = index >= 0
    cells = index[hit]
    r = np.einsum("ij,ij->i", surfaces.normals[cells], world[hit] - surfaces.center[cells]) / scale
    cost[hit] = 0.5 * r**2 / (1 + r**2)
    return cost


def _minimize(
    sweep: Sweep,
    before: Array,
    pose: Array,
    predicted: Array,
    duration: float,
    surfaces: FlatCells,
    scales: Sequence[float],
) -> tuple[Array, Array, Array, float]:
    """The pose of a sweep by Gauss–Newton from ``pose``; velocity, information of the points, and cost."""
    n = predicted.shape[-1] - 1
    d = n * (n - 1) // 2
    stddev = np.repeat([0.5 * _ACCELERATION * duration**2, 0.5 * _TURN_ACCELERATION * duration**2], [n, d])
    for scale in scales:
        world = _to_world(sweep, pose, _velocity(before, pose, duration))
        index = surfaces.find_near(world, surfaces.cell)
        hit = index >= 0
        x, cells = world[hit], index[hit]
        normals = surfaces.normals[cells]
        r = np.einsum("ij,ij->i", normals, x - surfaces.center[cells])
        variance = np.square(scale) if n == 2 else _variance(x, cells, surfaces)
        weights = (1 + (r / scale) ** 2) ** -2 / variance
        J = _jacobian(x, pose, normals)
        information = (J * weights[:, None]).T @ J
        H = information + np.diag(stddev**-2)
        g = J.T @ (weights * r) + se_n.difference(pose, predicted) / stddev**2
        step = -np.linalg.solve(H, g)
        pose = se_n.retract(pose, step)
        if scale == scales[-1] and np.abs(step).max() < _LEAST_STEP:
            break
    velocity = _velocity(before, pose, duration)
    cost = _robust_cost(_to_world(sweep, pose, velocity), surfaces, scales[-1]).sum()
    cost += 0.5 * np.sum((se_n.difference(pose, predicted) / stddev) ** 2)
    return pose, velocity, information, float(cost)


def _variance(points: Array, cells: Index, surfaces: FlatCells) -> Array:
    """(N,) squared errors of the distances of points (N, 3) from the planes of cells, which are uncertain."""
    along = np.einsum("nij,ni->nj", surfaces.axes[cells, :, 1:], points - surfaces.center[cells])
    lever = np.sum((along / surfaces.extent[cells]) ** 2, axis=1)
    return np.asarray(_NOISE**2 + surfaces.thickness[cells] ** 2 * (4 + lever))


def _velocity(before: Array, pose: Array, duration: float) -> Array:
    """(n + d,) in the moving frame."""
    return se_n.difference(se_n.inverse(before) @ pose, np.eye(len(pose))) / max(duration, 1e-3)


def _is_far(key: Array, pose: Array) -> bool:
    moved = se_n.inverse(key) @ pose
    distance = np.linalg.norm(se_n.translation(moved))
    return bool(distance > _KEY_DISTANCE or se_n.rotation_angle(se_n.rotation(moved)) > _KEY_ANGLE)
