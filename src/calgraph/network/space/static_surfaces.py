"""Floors and walls as several stationary sensors measure them: a plane in each cell."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se_n
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

# Points of one sensor within a cube of this size are one, m: errors of rings and of relief are common to them.
_THINNED = 0.25
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


def thin_points(points: Array) -> Array:
    """Means of points (N, 3) within small cubes."""
    return sum_moments(points, _THINNED).mean if len(points) else points


def find_shared_surfaces(points: Sequence[Array], states: Sequence[SensorState], gate: float) -> SharedSurfaces:
    """The planes at the present states, with the points near them.

    A cell is flat if the points of each sensor are. Of thin walls, the side that most points are of counts.

    Args:
        points: (N, 3) of each sensor, in its frame, m.
        states: of the sensors.
        gate: distance from a plane up to which points are on it, m.
    """
    sensor = np.repeat(np.arange(len(points)), [len(one) for one in points])
    measured = np.concatenate(points)
    world = np.concatenate([state.place(one)[0] for state, one in zip(states, points, strict=True)])
    surfaces = fit_surfaces(world, sensor, gate * THICKNESS_PER_GATE)
    surface = surfaces.find(world)
    distance = np.einsum("ni,ni->n", world - surfaces.center[surface], surfaces.normals[surface])
    used = (surface >= 0) & (np.abs(distance) < gate)
    origins = np.array([se_n.translation(state.T_root_sensor) for state in states])
    side = np.einsum("ni,ni->n", origins[sensor] - surfaces.center[surface], surfaces.normals[surface]) > 0
    balance = np.bincount(surface[used], np.where(side[used], 1.0, -1.0), len(surfaces.keys))
    used &= side == (balance[surface] >= 0)
    counts = np.zeros((len(surfaces.keys), len(points)))
    np.add.at(counts, (surface[used], sensor[used]), 1)
    enough = counts >= _MIN_POINTS
    used &= (enough[surface, sensor]) & (enough.sum(axis=1)[surface] > 1)
    return SharedSurfaces(surfaces, measured[used], sensor[used], surface[used])


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
    return world, by_state


def reduce_surfaces(
    shared: SharedSurfaces, states: Sequence[SensorState], noise: NoiseModel, free: NDArray[np.bool_]
) -> SurfaceEquations:
    """Normal equations of the free states (S, 12), with the surfaces eliminated."""
    return eliminate_surfaces(linearize_surfaces(shared, states), len(shared.surfaces.keys), noise, free, 0)


def compare_walls(points: Sequence[Array], states: Sequence[SensorState]) -> tuple[Array, Array]:
    """(S, S) number of walls on which the maps of two sensors agree, less those on which they do not; and balance.

    The balance is that over the number of both, from -1 to 1. Walls count by the squares of their level normals:
    floors agree wherever a sensor is.

    Args:
        points: (N, 3) of each sensor, in its frame, m.
        states: of the sensors.
    """
    world = [state.place(one)[0] for state, one in zip(states, points, strict=True)]
    compared = compare_maps([(one, np.zeros(len(one), dtype=np.intp)) for one in world])
    agree, differ = np.trace(compared[..., :2, :2], axis1=-2, axis2=-1)
    return agree - differ, (agree - differ) / np.maximum(agree + differ, 1)
