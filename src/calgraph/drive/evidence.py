"""What the report of a drive shows: the trajectory, points on surfaces with their residuals, and the start."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.drive.measurements import DrivePart
from calgraph.drive.start import MotionStart
from calgraph.drive.states import SensorState
from calgraph.drive.surface_points import CELL_LIMITS
from calgraph.errors import Rejected
from calgraph.geometry import Array, Index, se2, se3, se_n, so3
from calgraph.result.pictures import DrivePath, DriveStart, DriveView, Pictures
from calgraph.surfaces.flat_cells import fit_flat_cells, sum_moments
from calgraph.surfaces.trajectory import SplineTrajectory

# Points of each sensor that are kept: of 100 cells, 40 each.
_MAX_POINTS = 4000
# Distance within which points are of a surface, m, and its thickness: those of the last step of the adjustment.
_GATE, _MAX_THICKNESS = 0.09, 0.03
# Time between kept poses, s: linear in between, they are right to 0.3 mm at 1 m/s².
_PATH_STEP = 0.05
# Cosine of the angle between normal and vertical above which a surface is a floor or a ceiling: 30 degrees.
_LEVEL = 0.87
# Height of the lowest sensors above the floor, m.
_NEAR = 0.3


def collect_pictures(
    names: Sequence[str],
    starts: Mapping[str, MotionStart | Rejected],
    parts: Sequence[DrivePart],
    states: Sequence[SensorState],
) -> Pictures:
    """The pictures of the joint solution.

    Args:
        names: of the sensors that were adjusted, the root first.
        starts: by sensor but the root.
        parts: of the drive, with their trajectories as adjusted.
        states: of the sensors, as adjusted.
    """
    origin = parts[0].trajectory.start
    views, paths = [], []
    for number, part in enumerate(parts):
        placed = _place_points(part, states)
        times, poses = _sample_path(part.trajectory)
        R = _find_level(part.trajectory, placed)
        turn = se3.pose(R, np.zeros(3))
        paths.append(DrivePath(times - origin, turn @ poses))
        for k, name in enumerate(names):
            own = np.flatnonzero(placed.sensor == k)
            own = own[:: len(own) * len(parts) // _MAX_POINTS + 1]
            if len(own):
                views.append(
                    DriveView(
                        name, number, placed.times[own] - origin, placed.points[own].astype(np.float32),
                        (placed.normals[own] @ R.T).astype(np.float32), placed.residuals[own], placed.shared[own],
                    )
                )  # fmt: skip
    kept = [
        DriveStart(name, _lift(start.T_root_sensor), start.clock_offset)
        for name, start in starts.items()
        if name in names and isinstance(start, MotionStart)
    ]
    return Pictures(drive_views=tuple(views), drive_paths=tuple(paths), drive_starts=tuple(kept))


@dataclass(frozen=True, eq=False)
class _Placed:
    """Points of a part that are on surfaces, in space."""

    sensor: Index
    """(N,)."""
    times: Array
    """(N,) by the root's clock, s."""
    points: Array
    """(N, 3) in the sensor's frame, m."""
    world: Array
    """(N, 3) m."""
    normals: Array
    """(N, 3) of their surfaces, away from the sensor."""
    residuals: Array
    """(N,) m."""
    shared: NDArray[np.bool_]
    """(N,)."""


def _place_points(part: DrivePart, states: Sequence[SensorState]) -> _Placed:
    """The points of all sensors with their surfaces, by the joint solution."""
    at = [_place_sensor(measured.points, measured.times, part.trajectory, state)
          for measured, state in zip(part.points, states, strict=True)]  # fmt: skip
    sensor = np.repeat(np.arange(len(at)), [len(times) for times, *_ in at])
    times, points, world, beams = (np.concatenate(column) for column in zip(*at, strict=True))
    limits = CELL_LIMITS[world.shape[1]]
    surfaces = fit_flat_cells(
        sum_moments(world, limits.cell), limits.cell,
        max_thickness=_MAX_THICKNESS, min_extent=limits.min_extent, min_count=limits.min_count,
    )  # fmt: skip
    cell = surfaces.find(world)
    hit = np.flatnonzero(cell >= 0)
    normals = surfaces.normals[cell[hit]]
    normals = normals * np.where(np.einsum("ni,ni->n", normals, beams[hit]) < 0, -1.0, 1.0)[:, None]
    residuals = np.einsum("ni,ni->n", normals, world[hit] - surfaces.center[cell[hit]])
    near = np.abs(residuals) < _GATE
    hit, normals, residuals = hit[near], normals[near], residuals[near]
    measured = np.zeros((len(surfaces.keys), len(at)), dtype=np.bool_)
    measured[cell[hit], sensor[hit]] = True
    return _Placed(
        sensor[hit], times[hit], _raise(points[hit]), _raise(world[hit]), _raise(normals), residuals,
        measured.sum(axis=1)[cell[hit]] > 1,
    )  # fmt: skip


def _place_sensor(
    points: Array, times: Array, trajectory: SplineTrajectory, state: SensorState
) -> tuple[Array, Array, Array, Array]:
    """Times (N,) by the root's clock, and points (N, n): corrected, in the world, and relative to the sensor."""
    times = times - state.clock_offset
    inside = (times >= trajectory.start) & (times <= trajectory.end)
    points, times = points[inside], times[inside]
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    points = points * (1 - state.range_scale - state.range_bias / np.maximum(ranges, 1e-9))
    T = trajectory.at(times).poses @ state.T_root_sensor
    turned = np.einsum("nij,nj->ni", se_n.rotation(T), points)
    return times, points, turned + se_n.translation(T), turned


def _sample_path(trajectory: SplineTrajectory) -> tuple[Array, Array]:
    """Times (K,), s, and poses (K, 4, 4) of the root."""
    times = np.append(np.arange(trajectory.start, trajectory.end - 1e-3, _PATH_STEP), trajectory.end)
    return times, _lift(trajectory.at(times).poses)


def _find_level(trajectory: SplineTrajectory, placed: _Placed) -> Array:
    """The rotation (3, 3) of the world that lets the robot turn about z, and walls run along x and y."""
    times, poses = _sample_path(trajectory)
    R = np.eye(3)
    if trajectory.reference.poses.shape[-1] == 4:
        rates = trajectory.at(times).turn_rate
        up = np.linalg.eigh(rates.T @ rates)[1][:, -1]
        height = (placed.world - _interpolate(placed.times, times, se_n.translation(poses))) @ up
        upright = placed.normals @ up
        level = np.abs(upright) > _LEVEL
        sign = np.mean(poses[:, :3, 2] @ up)
        if level.any():
            # The floor is nearer than a ceiling; without one, sensors are mounted upright.
            sign = -np.sum(np.sign(height[level]) / np.maximum(np.abs(height[level]), _NEAR) ** 2)
            up = np.sign(upright[level]) @ placed.normals[level]
        R = _rotate_to_z(up / np.linalg.norm(up) * (1.0 if sign >= 0 else -1.0))
    x, y, _ = (placed.normals[np.abs(placed.normals @ R[2]) < 1 - _LEVEL] @ R.T).T
    # Walls at right angles have one direction times four.
    yaw = np.angle(np.sum(np.exp(4j * np.arctan2(y, x)))) / 4
    turned = se_n.translation(poses) @ R.T @ so3.exp(np.array([0, 0, yaw]))
    extent = np.ptp(turned, axis=0)
    yaw += np.pi / 2 * (extent[1] > extent[0])
    return np.asarray(so3.exp(np.array([0, 0, -yaw])) @ R)


def _rotate_to_z(axis: Array) -> Array:
    """The smallest rotation (3, 3) that turns a unit vector (3,) to z."""
    normal = np.cross(axis, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(normal))
    if size < 1e-9:
        return np.diag([1.0, np.sign(axis[2]), np.sign(axis[2])])
    return np.asarray(so3.exp(normal / size * np.arctan2(size, axis[2])))


def _interpolate(times: Array, at: Array, values: Array) -> Array:
    """(N, 3) of values (K, 3) at times (K,)."""
    return np.stack([np.interp(times, at, column) for column in values.T], axis=1)


def _lift(T: Array) -> Array:
    """Poses (..., 4, 4) of poses in the plane or in space."""
    return se2.to_se3(T) if T.shape[-1] == 3 else T


def _raise(vectors: Array) -> Array:
    """(N, 3) of vectors in the plane or in space."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
