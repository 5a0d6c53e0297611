"""What the report of a drive shows: the trajectory, points on surfaces with their residuals, and the start."""

from collections.abc import Mapping, Sequence

import numpy as np

from calgraph.drive.adjustment import Adjustment
from calgraph.drive.points_on_surfaces import Association, linearize_points, select_inside
from calgraph.drive.start import MotionStart
from calgraph.errors import Rejected
from calgraph.geometry import Array, plane, se2, se3, se_n, so3
from calgraph.result.pictures import DrivePath, DriveStart, DriveView, Pictures
from calgraph.surfaces.sensor_states import BESIDE_POSE
from calgraph.surfaces.surface_points import SurfacePoints
from calgraph.surfaces.trajectory import SplineTrajectory

# Points of each sensor that are kept: of 100 cells, 40 each.
_MAX_POINTS = 4000
# Time between kept poses, s: linear in between, they are right to 0.3 mm at 1 m/s².
_PATH_STEP = 0.05
# Cosine of the angle between normal and vertical above which a surface is a floor or a ceiling: 30 degrees.
_LEVEL = 0.87
# Height of the lowest sensors above the floor, m.
_NEAR = 0.3


def collect_pictures(
    names: Sequence[str], starts: Mapping[str, MotionStart | Rejected], adjusted: Adjustment, root: int = 0
) -> Pictures:
    """The pictures of the joint solution, with times from the start of the trajectory.

    Args:
        names: of the sensors that were adjusted.
        starts: by sensor but the root.
        adjusted: the joint solution.
        root: number of the sensor whose path is shown.
    """
    origin, T_lead_root = adjusted.parts[0].trajectory.start, adjusted.states[root].T_root_sensor
    views: list[DriveView] = []
    paths = []
    for number, (part, association) in enumerate(zip(adjusted.parts, adjusted.associations, strict=True)):
        spline, at = part.trajectory, linearize_points(part, adjusted.states, association)
        times = np.append(np.arange(spline.start, spline.end - 1e-3, _PATH_STEP), spline.end)
        R = _find_level(spline, times, association, at)
        T_world_root = se2.to_se3(spline.at(times).poses @ T_lead_root)
        paths.append(DrivePath(times - origin, se3.pose(R, np.zeros(3)) @ T_world_root))
        # Surfaces have moved since points were taken to be on them.
        counts = np.maximum(np.bincount(at.surface), 1)
        residual = at.residual - (np.bincount(at.surface, at.residual) / counts)[at.surface]
        # The derivative by the bias of ranges: normals point away from the sensor.
        away = np.where(at.by_sensor[:, 1 - BESIDE_POSE] > 0, -1.0, 1.0)
        normals = _raise(association.surfaces.normals)[at.surface] @ R.T * away[:, None]
        measured_by = np.zeros((len(association.surfaces.keys), len(names)), dtype=np.bool_)
        measured_by[at.surface, at.sensor] = True
        shared = measured_by.sum(axis=1)[at.surface] > 1
        for k, name in enumerate(names):
            own = np.flatnonzero(at.sensor == k)
            thinned = slice(None, None, len(own) * len(adjusted.parts) // _MAX_POINTS + 1)
            shown = own[thinned]
            if len(shown):
                state = adjusted.states[k]
                on_surfaces = select_inside(part, k, state) & (association.cell[k] >= 0)
                points = _raise(state.correct(part.points[k].points[on_surfaces][thinned]))
                views.append(
                    DriveView(
                        name, number, at.time[shown] - origin, points.astype(np.float32),
                        normals[shown].astype(np.float32), residual[shown] * away[shown], shared[shown],
                    )
                )  # fmt: skip
    before = [
        DriveStart(name, se2.to_se3(start.T_root_sensor), start.clock_offset)
        for name, start in starts.items()
        if name in names and isinstance(start, MotionStart)
    ]
    return Pictures(drive_views=tuple(views), drive_paths=tuple(paths), drive_starts=tuple(before))


def _find_level(spline: SplineTrajectory, times: Array, association: Association, at: SurfacePoints) -> Array:
    """The rotation (3, 3) of the world after which z is upwards, and walls run along x and y.

    Of a trajectory at times (K,), s, and of its points on surfaces.
    """
    R, normals = np.eye(3), _raise(association.surfaces.normals)[at.surface]
    poses = se2.to_se3(spline.at(times).poses)
    if spline.reference.poses.shape[-1] == 4:
        rates = spline.at(times).turn_rate
        up = np.linalg.eigh(rates.T @ rates)[1][:, -1]
        upright = normals @ up
        level, sign = np.abs(upright) > _LEVEL, np.mean(poses[:, :3, 2] @ up)
        if level.any():
            # The floor is nearer than a ceiling; without one, sensors are mounted upright.
            center = association.surfaces.center[at.surface[level]]
            heights = (center - se_n.translation(spline.at(at.time[level]).poses)) @ up
            sign = -np.sum(np.sign(heights) / np.maximum(np.abs(heights), _NEAR) ** 2)
            up = np.sign(upright[level]) @ normals[level]
        up = up / np.linalg.norm(up) * (1.0 if sign >= 0 else -1.0)
        R = np.column_stack([plane.tangent_basis(up), up]).T
    x, y, _ = (normals[np.abs(normals @ R[2]) < 1 - _LEVEL] @ R.T).T
    # Walls at right angles have one direction times four.
    yaw = np.angle(np.sum(np.exp(4j * np.arctan2(y, x)))) / 4
    extent = np.ptp(poses[:, :3, 3] @ R.T @ so3.exp(np.array([0, 0, yaw])), axis=0)
    yaw += np.pi / 2 * (extent[1] > extent[0])
    return np.asarray(so3.exp(np.array([0, 0, -yaw])) @ R)


def _raise(vectors: Array) -> Array:
    """(N, 3) of vectors in the plane or in space."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
