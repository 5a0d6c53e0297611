"""What the report of a drive shows: the trajectory, points on surfaces with their residuals, and the start."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calgraph.drive.measurements import DrivePart
from calgraph.drive.start import MotionStart
from calgraph.drive.states import SensorPoints, SensorState
from calgraph.drive.surface_points import CELL_LIMITS
from calgraph.errors import Rejected
from calgraph.geometry import Array, se2, se3, se_n, so3
from calgraph.result.pictures import DrivePath, DriveStart, DriveView, Pictures
from calgraph.surfaces.flat_cells import fit_flat_cells, sum_moments
from calgraph.surfaces.placed_points import place_points
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
        path, found = _sample_path(part.trajectory), _find_surfaces(part, names, states, number)
        R = _find_level(part.trajectory, path, found, dict(zip(names, states, strict=True)))
        paths.append(DrivePath(path.times - origin, se3.pose(R, np.zeros(3)) @ path.T_world_root))
        for view in found:
            kept = slice(None, None, len(view.times) * len(parts) // _MAX_POINTS + 1)
            views.append(
                DriveView(
                    view.sensor, number, view.times[kept] - origin, view.points[kept],
                    (view.normals[kept] @ R.T).astype(np.float32), view.residuals[kept], view.shared[kept],
                )
            )  # fmt: skip
    before = [
        DriveStart(name, _lift(start.T_root_sensor), start.clock_offset)
        for name, start in starts.items()
        if name in names and isinstance(start, MotionStart)
    ]
    return Pictures(drive_views=tuple(views), drive_paths=tuple(paths), drive_starts=tuple(before))


def _find_surfaces(
    part: DrivePart, names: Sequence[str], states: Sequence[SensorState], number: int
) -> list[DriveView]:
    """All points that are on surfaces, with absolute times."""
    placed = [
        _place_points(measured, part.trajectory, state)
        for measured, state in zip(part.points, states, strict=True)
    ]
    sensor = np.repeat(np.arange(len(placed)), [len(times) for times, *_ in placed])
    world = np.concatenate([one[2] for one in placed])
    limits = CELL_LIMITS[world.shape[1]]
    surfaces = fit_flat_cells(
        sum_moments(world, limits.cell), limits.cell,
        max_thickness=_MAX_THICKNESS, min_extent=limits.min_extent, min_count=limits.min_count,
    )  # fmt: skip
    cell = surfaces.find(world)
    residual = np.full(len(world), np.inf)
    hit = cell >= 0
    residual[hit] = np.einsum("ni,ni->n", surfaces.normals[cell[hit]], world[hit] - surfaces.center[cell[hit]])
    near = np.abs(residual) < _GATE
    measured_by = np.zeros((len(surfaces.keys), len(placed)), dtype=np.bool_)
    measured_by[cell[near], sensor[near]] = True
    views = []
    for k, (name, (times, points, _, beams)) in enumerate(zip(names, placed, strict=True)):
        own = near[sensor == k]
        cells, normals = cell[sensor == k][own], surfaces.normals[cell[sensor == k][own]]
        away = np.where(np.einsum("ni,ni->n", normals, beams[own]) < 0, -1.0, 1.0)
        if own.any():
            views.append(
                DriveView(
                    name, number, times[own], _raise(points[own]), _raise(normals * away[:, None]),
                    residual[sensor == k][own] * away, measured_by.sum(axis=1)[cells] > 1,
                )
            )  # fmt: skip
    return views


def _place_points(
    measured: SensorPoints, trajectory: SplineTrajectory, state: SensorState
) -> tuple[Array, Array, Array, Array]:
    """Times (N,) by the root's clock, and points (N, n): corrected, in the world, and relative to the sensor."""
    times = state.date(measured)
    inside = (times >= trajectory.start) & (times <= trajectory.end)
    points, times = measured.points[inside], times[inside]
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    points = points * (1 - state.range_scale - state.range_bias / np.maximum(ranges, 1e-9))
    T = trajectory.at(times).poses @ state.T_root_sensor
    turned = np.einsum("nij,nj->ni", se_n.rotation(T), points)
    return times, points, turned + se_n.translation(T), turned


def _sample_path(trajectory: SplineTrajectory) -> DrivePath:
    """The trajectory in its world, with absolute times."""
    times = np.append(np.arange(trajectory.start, trajectory.end - 1e-3, _PATH_STEP), trajectory.end)
    return DrivePath(times, _lift(trajectory.at(times).poses))


def _find_level(
    trajectory: SplineTrajectory, path: DrivePath, views: Sequence[DriveView], states: Mapping[str, SensorState]
) -> Array:
    """The rotation (3, 3) of the world after which z is upwards, and walls run along x and y."""
    R, places = np.eye(3), path.T_world_root[:, :3, 3]
    normals = np.concatenate([np.zeros((0, 3)), *(view.normals for view in views)])
    if trajectory.reference.poses.shape[-1] == 4:
        rates = trajectory.at(path.times).turn_rate
        up = np.linalg.eigh(rates.T @ rates)[1][:, -1]
        upright = normals @ up
        level, sign = np.abs(upright) > _LEVEL, np.mean(path.T_world_root[:, :3, 2] @ up)
        if level.any():
            # The floor is nearer than a ceiling; without one, sensors are mounted upright.
            heights = np.concatenate([
                place_points(view, path, states[view.sensor].T_root_sensor) @ up
                - np.interp(view.times, path.times, places @ up)
                for view in views
            ])[level]  # fmt: skip
            sign = -np.sum(np.sign(heights) / np.maximum(np.abs(heights), _NEAR) ** 2)
            up = np.sign(upright[level]) @ normals[level]
        R = _rotate_to_z(up / np.linalg.norm(up) * (1.0 if sign >= 0 else -1.0))
    x, y, _ = (normals[np.abs(normals @ R[2]) < 1 - _LEVEL] @ R.T).T
    # Walls at right angles have one direction times four.
    yaw = np.angle(np.sum(np.exp(4j * np.arctan2(y, x)))) / 4
    extent = np.ptp(places @ R.T @ so3.exp(np.array([0, 0, yaw])), axis=0)
    yaw += np.pi / 2 * (extent[1] > extent[0])
    return np.asarray(so3.exp(np.array([0, 0, -yaw])) @ R)


def _rotate_to_z(axis: Array) -> Array:
    """The smallest rotation (3, 3) that turns a unit vector (3,) to z."""
    normal = np.cross(axis, [0.0, 0.0, 1.0])
    size = float(np.linalg.norm(normal))
    if size < 1e-9:
        return np.diag([1.0, np.sign(axis[2]), np.sign(axis[2])])
    return np.asarray(so3.exp(normal / size * np.arctan2(size, axis[2])))


def _lift(T: Array) -> Array:
    """Poses (..., 4, 4) of poses in the plane or in space."""
    return se2.to_se3(T) if T.shape[-1] == 3 else T


def _raise(vectors: Array) -> NDArray[np.float32]:
    """(N, 3) of vectors in the plane or in space."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1]))).astype(np.float32)
