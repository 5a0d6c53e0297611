"""Floors and walls as several stationary sensors measure them: a plane in each cell."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se_n
from calgraph.network.space.persons import LEVELLING
from calgraph.surfaces.flat_cells import FlatCells, sum_moments
from calgraph.surfaces.map_agreement import compare_maps
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
# Vertical part of a normal up to which a surface is a wall. Heights over the floor at which each point of a 2-D
# scanner counts, m: over furniture, where LiDARs measure walls best, and apart, as walls are upright.
_WALL, _WALL_HEIGHTS = 0.3, (1.2, 1.8)
# Vertical part of a normal from which a surface is level (26°): floors, ramps, and tops of furniture.
_LEVEL = 0.9
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
    height: Array
    """(N,) at which a point of a 2-D scanner is taken to be, m: it does not show height and tilt; else NaN."""


def thin_points(points: Array, flat: bool = False) -> Array:
    """Means of points (N, 3) within small cubes; of a 2-D scanner, which is flat, within smaller ones."""
    return sum_moments(points, _THINNED_LINE if flat else _THINNED).mean if len(points) else points


def map_points(points: Array, state: SensorState, flat: bool) -> Array:
    """Points (N, 3) of a sensor in the world, m; those of a 2-D scanner (2N, 3) at each height of walls."""
    world = state.place(points)[0]
    if not flat:
        return world
    return np.concatenate([np.column_stack([world[:, :2], np.full(len(world), z)]) for z in _WALL_HEIGHTS])


def find_shared_surfaces(
    points: Sequence[Array], states: Sequence[SensorState], gate: float, flat: NDArray[np.bool_]
) -> SharedSurfaces:
    """The planes at the present states, with the points near them.

    A cell is flat if the points of each sensor are. Of thin walls, the side that most points are of counts.

    Args:
        points: (N, 3) of each sensor, in its frame, m.
        states: of the sensors.
        gate: distance from a plane up to which points are on it, m.
        flat: (S,) which sensors are 2-D scanners.
    """
    repeats = np.where(flat, len(_WALL_HEIGHTS), 1)
    sensor = np.repeat(np.arange(len(points)), repeats * [len(one) for one in points])
    measured = np.concatenate([np.tile(one, (n, 1)) for one, n in zip(points, repeats.tolist(), strict=True)])
    level = flat[sensor]
    world = np.concatenate([map_points(*one) for one in zip(points, states, flat, strict=True)])
    surfaces = fit_surfaces(world, sensor, gate * THICKNESS_PER_GATE)
    surface = surfaces.find(world)
    distance = np.einsum("ni,ni->n", world - surfaces.center[surface], surfaces.normals[surface])
    used = (surface >= 0) & (np.abs(distance) < gate)
    used &= ~level | (np.abs(surfaces.normals[surface, 2]) < _WALL)
    origins = np.array([se_n.translation(state.T_root_sensor) for state in states])
    side = np.einsum("ni,ni->n", origins[sensor] - surfaces.center[surface], surfaces.normals[surface]) > 0
    balance = np.bincount(surface[used], np.where(side[used], 1.0, -1.0), len(surfaces.keys))
    used &= side == (balance[surface] >= 0)
    counts = np.zeros((len(surfaces.keys), len(points)))
    np.add.at(counts, (surface[used], sensor[used]), 1 / repeats[sensor[used]])
    enough = counts >= _MIN_POINTS
    used &= (enough[surface, sensor]) & (enough.sum(axis=1)[surface] > 1)
    height = np.where(level, world[:, 2], np.nan)
    return SharedSurfaces(surfaces, measured[used], sensor[used], surface[used], height[used])


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
    level = np.isfinite(shared.height)
    world[level, 2] = shared.height[level]
    by_state[level, :, LEVELLING] = 0.0
    return world, by_state


def count_level_cells(shared: SharedSurfaces, sensors: int) -> Array:
    """(S, S) number of cells of floors, and other level surfaces, that two sensors measured, too."""
    measured = np.zeros((sensors, len(shared.surfaces.keys)))
    level = np.abs(shared.surfaces.normals[shared.surface, 2]) > _LEVEL
    measured[shared.sensor[level], shared.surface[level]] = 1.0
    return measured @ measured.T


def reduce_surfaces(
    shared: SharedSurfaces, states: Sequence[SensorState], noise: NoiseModel, free: NDArray[np.bool_]
) -> SurfaceEquations:
    """Normal equations of the free states (S, 12), with the surfaces eliminated."""
    return eliminate_surfaces(linearize_surfaces(shared, states), len(shared.surfaces.keys), noise, free, 0)


def compare_walls(
    points: Sequence[Array], states: Sequence[SensorState], flat: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """(S, S) number of walls on which the maps of two sensors agree, less those on which they do not; and balance.

    The balance is that over the number of both, from -1 to 1. Walls count by the squares of their level normals:
    floors agree wherever a sensor is.

    Args:
        points: (N, 3) of each sensor, in its frame, m.
        states: of the sensors.
        flat: (S,) which sensors are 2-D scanners.
    """
    world = [map_points(*one) for one in zip(points, states, flat.tolist(), strict=True)]
    compared = compare_maps([(one, np.zeros(len(one), dtype=np.intp)) for one in world])
    agree, differ = np.trace(compared[..., :2, :2], axis1=-2, axis2=-1)
    return agree - differ, (agree - differ) / np.maximum(agree + differ, 1)
