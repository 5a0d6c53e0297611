"""Points of a drive on flat patches of its surroundings: which are on which, and their linearization."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.drive.measurements import DrivePart
from calgraph.geometry import Array, Index, se_n
from calgraph.surfaces.flat_cells import FlatCells
from calgraph.surfaces.sensor_states import BESIDE_POSE, TIMING, SensorState
from calgraph.surfaces.surface_points import (
    THICKNESS_PER_GATE,
    SurfacePoints,
    differentiate_patches,
    fit_surfaces,
    meet_surfaces,
)
from calgraph.surfaces.trajectory import SplinePoses

# Time for which a sensor measures a cell from one place, s: a robot moves by the size of a cell. On 15 minutes of
# real scans of an office, 0.5 to 4 s give median errors of 7.4 to 8.9 mm, 0.2 s 10.3, and one view in all 9.9.
_VIEW_DURATION = 1.0


@dataclass(frozen=True, eq=False)
class Association:
    """Which points of a part are on which surfaces."""

    surfaces: FlatCells
    cell: Sequence[Index]
    """By sensor, (N,): the surface of each of its points, -1 for none."""


def associate_points(part: DrivePart, states: Sequence[SensorState], gate: float) -> Association:
    """Finds surfaces at the present states, and the points within a distance of them, m.

    A cell is flat if the points of each view are. Cells in which sensors do not agree remain surfaces: without
    them, poses with which sensors measure nothing in common would fit best.
    """
    used = [select_inside(part, k, state) for k, state in enumerate(states)]
    at = place_points(part, states, used)
    maps = ~np.array([one.flat for one in part.points])[at.sensor]
    view = _number_views(part, at.time) * len(used) + at.sensor
    surfaces = fit_surfaces(at.world[maps], view[maps], gate * THICKNESS_PER_GATE)
    index = surfaces.find(at.world)
    distance = np.einsum("ni,ni->n", at.world - surfaces.center[index], surfaces.normals[index])
    index[np.abs(distance) >= gate] = -1
    cells = [np.full(len(one), -1) for one in used]
    for k, (cell, inside) in enumerate(zip(cells, used, strict=True)):
        cell[inside] = index[at.sensor == k]
    return Association(surfaces, cells)


def locate_points(part: DrivePart, states: Sequence[SensorState]) -> list[tuple[Array, Index]]:
    """By sensor, its points (N, n) in the world, m, and the views (N,) in which they were measured."""
    at = place_points(part, states, [select_inside(part, k, state) for k, state in enumerate(states)])
    view = _number_views(part, at.time)
    return [(at.world[at.sensor == k], view[at.sensor == k]) for k in range(len(states))]


def linearize_points(part: DrivePart, states: Sequence[SensorState], association: Association) -> SurfacePoints:
    """The residuals of the points of a part that are on surfaces; see :func:`meet_surfaces`."""
    used = _select_used(part, states, association)
    cell, surfaces = (
        np.concatenate([of[one] for of, one in zip(association.cell, used, strict=True)]),
        association.surfaces,
    )
    measured = place_points(part, states, used)
    residual, incidence, beyond = meet_surfaces(
        measured.world, -measured.by_sensor[:, :, 1 - BESIDE_POSE], surfaces, cell
    )
    at = place_points(part, states, used, beyond)
    normals, by_turn = surfaces.normals[cell], se_n.rotation_jacobian(at.arm)
    turn = np.einsum("ni,nij,njk->nk", normals, by_turn, at.root.rotation_jacobian)
    by_pose = np.concatenate([normals, turn], axis=1)
    return SurfacePoints(
        at.sensor,
        cell,
        at.time,
        _number_views(part, at.time),
        residual,
        differentiate_patches(at.world, incidence, surfaces, cell),
        at.root.first,
        (at.root.basis[:, :, None] * by_pose[:, None, :]).reshape(len(cell), 4 * by_pose.shape[1]),
        np.einsum("ni,nij->nj", normals, at.by_sensor),
    )


def collect_points(part: DrivePart, states: Sequence[SensorState], association: Association) -> Array:
    """The points (N, n) of :func:`linearize_points`, sensor by sensor, in the frames of these, m."""
    used = _select_used(part, states, association)
    return np.concatenate([one.points[some] for one, some in zip(part.points, used, strict=True)])


def _select_used(
    part: DrivePart, states: Sequence[SensorState], association: Association
) -> list[NDArray[np.bool_]]:
    """By sensor, (N,) which of its points are on surfaces."""
    return [select_inside(part, k, state) & (association.cell[k] >= 0) for k, state in enumerate(states)]


def _number_views(part: DrivePart, times: Array) -> Index:
    """(N,) number of the interval of each time by the root's clock."""
    return np.floor((times - part.trajectory.start) / _VIEW_DURATION).astype(np.intp)


def select_inside(part: DrivePart, k: int, state: SensorState) -> NDArray[np.bool_]:
    """(N,) which points of sensor k were measured during the trajectory."""
    times = state.date(part.points[k])
    return np.asarray((times >= part.trajectory.start) & (times <= part.trajectory.end))


@dataclass(frozen=True, eq=False)
class PlacedPoints:
    """N points in the world, with derivatives."""

    sensor: Index
    """(N,)."""
    world: Array
    """(N, n) m."""
    time: Array
    """(N,) by the root's clock, s."""
    root: SplinePoses
    """Of the root at these times."""
    arm: Array
    """(N, n) from the origin of the root, along the world's axes, m."""
    by_sensor: Array
    """(N, n, n + d + 6) of the place in the world."""


def place_points(
    part: DrivePart, states: Sequence[SensorState], used: Sequence[NDArray[np.bool_]], beyond: Array | float = 0.0
) -> PlacedPoints:
    """Some points of each sensor in the world, sensor by sensor.

    Args:
        part: of the drive.
        states: of the sensors.
        used: (N,) by sensor, which points; all within the trajectory.
        beyond: (N,) by which they are moved along their beams, m.
    """
    counts = [int(one.sum()) for one in used]
    ahead = np.split(np.broadcast_to(beyond, sum(counts)), np.cumsum(counts)[:-1])
    each = list(zip(part.points, states, used, strict=True))
    placed = [state.place(one.points[some], on) for (one, state, some), on in zip(each, ahead, strict=True)]
    x_root, by_sensor = (np.concatenate(some) for some in zip(*placed, strict=True))
    time = np.concatenate([state.date(one)[some] for one, state, some in each])
    timing = np.concatenate([np.broadcast_to(one.timing, (len(some), TIMING))[some] for one, _, some in each])
    root = part.trajectory.at(time)
    R = se_n.rotation(root.poses)
    arm, by_sensor = np.einsum("nij,nj->ni", R, x_root), R @ by_sensor
    by_time = root.velocity + np.einsum("nij,nj->ni", se_n.rotation_jacobian(arm), root.turn_rate)
    by_sensor[:, :, -BESIDE_POSE] = -by_time
    by_sensor[:, :, -TIMING:] = by_time[:, :, None] * timing[:, None, :]
    sensor = np.repeat(np.arange(len(counts)), counts)
    return PlacedPoints(sensor, arm + se_n.translation(root.poses), time, root, arm, by_sensor)
