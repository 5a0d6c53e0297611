"""Floors and walls as several stationary sensors measure them: a plane in each cell."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se_n
from calgraph.network.space.space_states import BIAS, STATES, SpaceState, place_points
from calgraph.surfaces.flat_cells import FlatCells, sum_moments
from calgraph.surfaces.surface_elimination import NoiseModel, SurfaceEquations, eliminate_surfaces
from calgraph.surfaces.surface_points import THICKNESS_PER_GATE, SurfacePoints, fit_surfaces

# Points of one sensor within a cube of this size are one, m: errors of rings and of relief are common to them.
_THINNED = 0.25
# Least points of a sensor in a cell for it to measure that cell: three determine a plane.
_MIN_POINTS = 4
# Least cosine of incidence by which it is found where a beam meets a surface: it is metres away at less.
_MIN_INCIDENCE = 0.05


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

    def count_by_sensors(self, sensors: int) -> Array:
        """(M, S) points of each sensor on each surface."""
        counts = np.zeros((len(self.surfaces.keys), sensors))
        np.add.at(counts, (self.surface, self.sensor), 1)
        return counts


def thin_points(points: Array) -> Array:
    """Means of points (N, 3) within small cubes."""
    return sum_moments(points, _THINNED).mean if len(points) else points


def find_shared_surfaces(points: Sequence[Array], states: Sequence[SpaceState], gate: float) -> SharedSurfaces:
    """The planes at the present states, with the points near them.

    A cell is flat if the points of each sensor are. Of thin walls, the side that most points are of counts.

    Args:
        points: (N, 3) of each sensor, in its frame, m.
        states: of the sensors.
        gate: distance from a plane up to which points are on it, m.
    """
    sensor = np.repeat(np.arange(len(points)), [len(one) for one in points])
    measured = np.concatenate(points)
    world = np.concatenate([place_points(*one)[0] for one in zip(states, points, strict=True)])
    surfaces = fit_surfaces(world, sensor, gate * THICKNESS_PER_GATE)
    surface = surfaces.find(world)
    distance = np.einsum("ni,ni->n", world - surfaces.center[surface], surfaces.normals[surface])
    used = (surface >= 0) & (np.abs(distance) < gate)
    origins = np.array([se_n.translation(state.T_world_sensor) for state in states])
    side = np.einsum("ni,ni->n", origins[sensor] - surfaces.center[surface], surfaces.normals[surface]) > 0
    balance = np.bincount(surface[used], np.where(side[used], 1.0, -1.0), len(surfaces.keys))
    used &= side == (balance[surface] >= 0)
    counts = np.zeros((len(surfaces.keys), len(points)))
    np.add.at(counts, (surface[used], sensor[used]), 1)
    enough = counts >= _MIN_POINTS
    used &= (enough[surface, sensor]) & (enough.sum(axis=1)[surface] > 1)
    return SharedSurfaces(surfaces, measured[used], sensor[used], surface[used])


def linearize_surfaces(shared: SharedSurfaces, states: Sequence[SpaceState]) -> SurfacePoints:
    """The residuals of points, n · (x - c), with derivatives where beams meet the plane."""
    center, axes = shared.surfaces.center[shared.surface], shared.surfaces.axes[shared.surface]
    normals = axes[:, :, 0]
    world, by_state = _place(shared, states, np.zeros(len(shared.points)))
    residual = np.einsum("ni,ni->n", normals, world - center)
    slant = -np.einsum("ni,ni->n", normals, by_state[:, :, BIAS])
    incidence = np.abs(slant)
    beyond = -residual / np.copysign(np.maximum(incidence, _MIN_INCIDENCE), slant)
    met, by_state = _place(shared, states, beyond)
    place = np.einsum("ni,nij->nj", met - center, axes[:, :, 1:]) / shared.surfaces.extent[shared.surface]
    N = len(residual)
    return SurfacePoints(
        shared.sensor,
        shared.surface,
        time=np.zeros(N),
        view=np.zeros(N, dtype=np.intp),
        residual=residual,
        patch=np.column_stack([np.ones(N), place, incidence]),
        first=np.zeros(N, dtype=np.intp),
        by_control=np.zeros((N, 0)),
        by_sensor=np.einsum("ni,nij->nj", normals, by_state),
    )


def _place(shared: SharedSurfaces, states: Sequence[SpaceState], beyond: Array) -> tuple[Array, Array]:
    """Points in the world (N, 3), m, and derivatives (N, 3, 9) by the state of the sensor of each."""
    world, by_state = np.zeros((len(beyond), 3)), np.zeros((len(beyond), 3, STATES))
    for k, state in enumerate(states):
        of = np.flatnonzero(shared.sensor == k)
        world[of], by_state[of] = place_points(state, shared.points[of], beyond[of])
    return world, by_state


def reduce_surfaces(
    shared: SharedSurfaces, states: Sequence[SpaceState], noise: NoiseModel, free: NDArray[np.bool_]
) -> SurfaceEquations:
    """Normal equations of the free states (S, 9), with the surfaces eliminated."""
    return eliminate_surfaces(linearize_surfaces(shared, states), len(shared.surfaces.keys), noise, free, 0)
