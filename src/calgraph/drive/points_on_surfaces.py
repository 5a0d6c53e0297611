"""Points of a drive on flat patches of its surroundings: which are on which, and their linearization."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from calgraph.drive.measurements import DrivePart
from calgraph.drive.states import BESIDE_POSE, TIMING, SensorState
from calgraph.geometry import Array, Index, measure_lengths, se_n
from calgraph.surfaces.flat_cells import FlatCells
from calgraph.surfaces.surface_points import THICKNESS_PER_GATE, SurfacePoints, fit_surfaces

# Time for which a sensor measures a cell from one place, s: a robot moves by the size of a cell. On 15 minutes of
# real scans of an office, 0.5 to 4 s give median errors of 7.4 to 8.9 mm, 0.2 s 10.3, and one view in all 9.9.
_VIEW_DURATION = 1.0
# Least cosine of incidence by which it is found where a beam meets a surface: it is metres away at less.
_MIN_INCIDENCE = 0.05


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
    at = _evaluate_all(part, states, used)
    counts = [int(one.sum()) for one in used]
    sensor = np.repeat(np.arange(len(used)), counts)
    maps = ~np.array([one.flat for one in part.points])[sensor]
    view = _number_views(part, at.time) * len(used) + sensor
    surfaces = fit_surfaces(at.world[maps], view[maps], gate * THICKNESS_PER_GATE)
    index = surfaces.find(at.world)
    distance = np.einsum("ni,ni->n", at.world - surfaces.center[index], surfaces.normals[index])
    index[np.abs(distance) >= gate] = -1
    cells = [np.full(len(one), -1) for one in used]
    for cell, inside, found in zip(cells, used, np.split(index, np.cumsum(counts)[:-1]), strict=True):
        cell[inside] = found
    return Association(surfaces, cells)


def locate_points(part: DrivePart, k: int, state: SensorState) -> tuple[Array, Index]:
    """The points (N, n) of sensor k in the world, m, and the views (N,) in which they were measured."""
    at = _evaluate(part, k, state, select_inside(part, k, state))
    return at.world, _number_views(part, at.time)


def linearize_points(part: DrivePart, states: Sequence[SensorState], association: Association) -> SurfacePoints:
    """The residuals of the points of a part that are on surfaces.

    Derivatives are those of the places where beams meet surfaces: the noise of a range moves a point away from
    its surface and, at oblique incidence, along it. At measured places both belong together, so that floors seem
    to fall away from the sensor, as ranges that are too long make them.
    """
    used = [select_inside(part, k, state) & (association.cell[k] >= 0) for k, state in enumerate(states)]
    cells = np.concatenate([cell[one] for cell, one in zip(association.cell, used, strict=True)])
    counts = [int(one.sum()) for one in used]
    center, axes = association.surfaces.center[cells], association.surfaces.axes[cells]
    normals = axes[:, :, 0]
    measured = _evaluate_all(part, states, used)
    residual = np.einsum("ni,ni->n", normals, measured.world - center)
    slant = -np.einsum("ni,ni->n", normals, measured.by_sensor[:, :, 1 - BESIDE_POSE])
    incidence = np.abs(slant)
    beyond = -residual / np.copysign(np.maximum(incidence, _MIN_INCIDENCE), slant)
    at = _evaluate_all(part, states, used, np.split(beyond, np.cumsum(counts)[:-1]))
    place = np.einsum("ni,nij->nj", at.world - center, axes[:, :, 1:])
    by_turn = se_n.rotation_jacobian(at.position_arm)
    turn = np.einsum("ni,nij,njk->nk", normals, by_turn, at.rotation_jacobian)
    by_pose = np.concatenate([normals, turn], axis=1)
    return SurfacePoints(
        np.repeat(np.arange(len(used)), counts),
        cells,
        at.time,
        _number_views(part, at.time),
        residual,
        np.column_stack([np.ones(len(cells)), place / association.surfaces.extent[cells], incidence]),
        at.first,
        (at.basis[:, :, None] * by_pose[:, None, :]).reshape(len(cells), 4 * by_pose.shape[1]),
        np.einsum("ni,nij->nj", normals, at.by_sensor),
    )


def _evaluate_all(
    part: DrivePart,
    states: Sequence[SensorState],
    used: Sequence[NDArray[np.bool_]],
    beyond: Sequence[Array | float] = (),
) -> "_Evaluated":
    """:func:`_evaluate` of all sensors, joined."""
    each = zip(states, used, beyond or [0.0] * len(states), strict=True)
    at = [_evaluate(part, k, *one) for k, one in enumerate(each)]
    return _Evaluated(*(np.concatenate([getattr(one, field.name) for one in at]) for field in fields(_Evaluated)))


def _number_views(part: DrivePart, times: Array) -> Index:
    """(N,) number of the interval of each time by the root's clock."""
    return np.floor((times - part.trajectory.start) / _VIEW_DURATION).astype(np.intp)


def select_inside(part: DrivePart, k: int, state: SensorState) -> NDArray[np.bool_]:
    """(N,) which points of sensor k were measured during the trajectory."""
    times = state.date(part.points[k])
    return np.asarray((times >= part.trajectory.start) & (times <= part.trajectory.end))


@dataclass(frozen=True, eq=False)
class _Evaluated:
    """Points of one sensor in the world, with derivatives."""

    world: Array
    """(N, n) m."""
    time: Array
    """(N,) by the root's clock, s."""
    first: Index
    """(N,) first control point."""
    basis: Array
    """(N, 4) weights of control points."""
    position_arm: Array
    """(N, n) from the origin of the root, along the world's axes, m."""
    rotation_jacobian: Array
    """(N, d, d) of :class:`SplinePoses`."""
    by_sensor: Array
    """(N, n, n + d + 6) of the place in the world."""


def _evaluate(
    part: DrivePart, k: int, state: SensorState, used: NDArray[np.bool_], beyond: Array | float = 0.0
) -> _Evaluated:
    """Some points of sensor k (N,), all within the trajectory, moved along their beams by lengths (N,), m."""
    measured, trajectory = part.points[k], part.trajectory
    p, times = measured.points[used], state.date(measured)[used]
    ranges = measure_lengths(p) if p.shape[1] == 3 else np.hypot(*p.T)
    direction = p / ranges[:, None]
    ranges = ranges + beyond
    p = direction * (ranges * (1 - state.range_scale) - state.range_bias)[:, None]
    at = trajectory.at(times)
    T = state.T_root_sensor
    R_world, R_sensor = se_n.rotation(at.poses), se_n.rotation(T)
    turned = p @ R_sensor.T
    x_root = turned + se_n.translation(T)
    arm = np.einsum("nij,nj->ni", R_world, x_root)
    beam = np.einsum("nij,nj->ni", R_world, direction @ R_sensor.T)
    spin = np.einsum("nij,nj->ni", se_n.rotation_jacobian(arm), at.turn_rate)
    by_time = (at.velocity + spin)[:, :, None]
    timing = np.broadcast_to(measured.timing, (len(used), TIMING))[used]
    by_sensor = np.concatenate(
        [
            R_world,
            R_world @ se_n.rotation_jacobian(turned),
            -by_time,
            -beam[:, :, None],
            -(ranges[:, None] * beam)[:, :, None],
            by_time * timing[:, None, :],
        ],
        axis=2,
    )
    return _Evaluated(
        arm + se_n.translation(at.poses), times, at.first, at.basis, arm, at.rotation_jacobian, by_sensor
    )
