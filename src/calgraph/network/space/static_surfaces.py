"""Floors and walls as several stationary sensors measure them: a plane in each cell."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se_n
from calgraph.network.space.persons import LEVELLING
from calgraph.surfaces.flat_cells import FlatCells, sum_moments
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel, SurfaceEquations, eliminate_surfaces
from calgraph.surfaces.surface_points import (
    THICKNESS_PER_GATE,
    SurfacePoints,
    differentiate_patches,
    fit_surfaces,
    meet_surfaces,
)

# Points of one sensor within a cube of this size are one, m: errors of rings and of relief are common to them. Of
# a 2-D scanner, a cell has one line of points.
_THINNED, _THINNED_LINE = 0.25, 0.1
# Vertical part of a normal up to which a surface is a wall. Height over the floor at which points of 2-D scanners
# are compared with walls, m: over furniture, where LiDARs measure them best. They are at their own height, too.
_WALL, _WALL_HEIGHT = 0.3, 1.5
# Least points of a sensor in a cell for it to measure that cell: three determine a plane.
_MIN_POINTS = 4


@dataclass(frozen=True, eq=False)
class SharedSurfaces:
    """The cells of the world that two sensors and more measure as planes, and their points."""

    surfaces: FlatCells
    points: Array
    """(N, 3) in the frames of their sensors, m."""
    sensor: Index
    """(N,)."""
    surface: Index
    """(N,) of each point."""
    level: NDArray[np.bool_]
    """(N,) whether a point is of a 2-D scanner, and on a wall: it does not show height and tilt."""


def thin_points(points: Array, flat: bool = False) -> Array:
    """Means of points (N, 3) within small cubes; of a 2-D scanner, which is flat, within smaller ones."""
    return sum_moments(points, _THINNED_LINE if flat else _THINNED).mean if len(points) else points


def map_points(points: Array, state: SensorState, flat: bool) -> Array:
    """Points (N, 3) of a sensor in the world, m; those of a 2-D scanner at the height where walls are compared."""
    world = state.place(points)[0]
    return np.column_stack([world[:, :2], np.full(len(world), _WALL_HEIGHT)]) if flat else world


def find_shared_surfaces(
    points: Sequence[Array], states: Sequence[SensorState], gate: float, flat: NDArray[np.bool_]
) -> SharedSurfaces:
    """The planes at the present states, with the points near them.

    A cell is flat if the points of each LiDAR are. Of thin walls, the side that most points are of counts.

    Args:
        points: (N, 3) of each sensor, in its frame, m.
        states: of the sensors.
        gate: distance from a plane up to which points are on it, m.
        flat: (S,) which sensors are 2-D scanners.
    """
    sensor = np.repeat(np.arange(len(points)), [len(one) for one in points])
    measured = np.concatenate(points)
    level = flat[sensor]
    world = np.concatenate([map_points(*one) for one in zip(points, states, flat, strict=True)])
    surfaces = fit_surfaces(world[~level], sensor[~level], gate * THICKNESS_PER_GATE)
    surface = surfaces.find(world)
    distance = np.einsum("ni,ni->n", world - surfaces.center[surface], surfaces.normals[surface])
    used = (surface >= 0) & (np.abs(distance) < gate)
    used &= ~level | (np.abs(surfaces.normals[surface, 2]) < _WALL)
    origins = np.array([se_n.translation(state.T_root_sensor) for state in states])
    side = np.einsum("ni,ni->n", origins[sensor] - surfaces.center[surface], surfaces.normals[surface]) > 0
    balance = np.bincount(surface[used], np.where(side[used], 1.0, -1.0), len(surfaces.keys))
    used &= side == (balance[surface] >= 0)
    counts = np.zeros((len(surfaces.keys), len(points)))
    np.add.at(counts, (surface[used], sensor[used]), 1)
    enough = counts >= _MIN_POINTS
    used &= (enough[surface, sensor]) & (enough.sum(axis=1)[surface] > 1)
    return SharedSurfaces(surfaces, measured[used], sensor[used], surface[used], level[used])


def linearize_surfaces(shared: SharedSurfaces, states: Sequence[SensorState]) -> SurfacePoints:
    """The residuals of points, n · (x - c), with derivatives where beams meet the plane."""
    surfaces, cell = shared.surfaces, shared.surface
    world, by_state = _place(shared, states, np.zeros(len(cell)))
    residual, incidence, beyond = meet_surfaces(world, -by_state[:, :, 1 - BESIDE_POSE], surfaces, cell)
    met, by_state = _place(shared, states, beyond)
    N = len(residual)
    return SurfacePoints(
        shared.sensor,
        cell,
        time=np.zeros(N),
        view=np.zeros(N, dtype=np.intp),
        residual=residual,
        patch=differentiate_patches(met, incidence, surfaces, cell),
        first=np.zeros(N, dtype=np.intp),
        by_control=np.zeros((N, 0)),
        by_sensor=np.einsum("ni,nij->nj", surfaces.normals[cell], by_state),
    )


def _place(shared: SharedSurfaces, states: Sequence[SensorState], beyond: Array) -> tuple[Array, Array]:
    """Points in the world (N, 3), m, and derivatives (N, 3, 12) by the state of the sensor of each."""
    world, by_state = np.zeros((len(beyond), 3)), np.zeros((len(beyond), 3, 6 + BESIDE_POSE))
    for k, state in enumerate(states):
        of = np.flatnonzero(shared.sensor == k)
        world[of], by_state[of] = state.place(shared.points[of], beyond[of])
    world[shared.level, 2] = shared.surfaces.center[shared.surface[shared.level], 2]
    by_state[shared.level, :, LEVELLING] = 0.0
    return world, by_state


def reduce_surfaces(
    shared: SharedSurfaces, states: Sequence[SensorState], noise: NoiseModel, free: NDArray[np.bool_]
) -> SurfaceEquations:
    """Normal equations of the free states (S, 12), with the surfaces eliminated."""
    return eliminate_surfaces(linearize_surfaces(shared, states), len(shared.surfaces.keys), noise, free, 0)
