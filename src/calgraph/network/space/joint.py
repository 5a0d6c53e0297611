"""The joint solution of a network in space: poses, clocks and range errors of all its LiDARs.

Persons on smooth paths connect sensors in the plane and in time, surfaces that several sensors measure connect
them in all directions but time. Each is eliminated for itself; what remains are the states of the sensors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.person_paths import (
    SHARED_MEAN,
    SHARED_STDDEV,
    BodyNoise,
    PersonEquations,
    reduce_person,
)
from calgraph.network.space.persons import BodySamples, find_persons, gather_samples
from calgraph.network.space.space_states import STATES, SpaceState
from calgraph.network.space.static_surfaces import SharedSurfaces, find_shared_surfaces, reduce_surfaces, thin_points
from calgraph.surfaces.surface_elimination import NoiseModel, SurfaceEquations

# Distances up to which tracks are of one person, and points of one surface, m, by iteration: from errors of the
# start to those of bodies and of noise.
_PERSON_GATES = (0.5, 0.4, 0.3, *[0.3] * 9)
_SURFACE_GATES = (0.3, 0.2, 0.15, 0.12, 0.1, *[0.09] * 7)
# Last steps, on persons and surfaces that stay the same, so that they converge.
_FIXED_STEPS = 6
# Start values of standard deviations: of samples over their first guesses, and of their views, m; of points, and of
# the views of surfaces, m.
_START_BODY = BodyNoise(np.ones(2), np.array([0.03, 0.02]))
_START_WHITE, _START_VIEW = 0.02, 0.01
# Least ones of these.
_MIN_SCALE, _MIN_BODY_VIEW, _MIN_WHITE, _MIN_VIEW = 0.2, 0.003, 0.002, 0.0005


@dataclass(frozen=True, eq=False)
class SpaceSolution:
    """Of S sensors."""

    states: Sequence[SpaceState]
    free: NDArray[np.bool_]
    """(S, 9) which states are estimated."""
    covariance: Array
    """(P, P) of these."""
    persons: Sequence[BodySamples]
    equations: Sequence[PersonEquations]
    """Of each person."""
    shared: SharedSurfaces
    surfaces: SurfaceEquations
    noise: NoiseModel
    body_noise: BodyNoise
    body: Array
    """(2,) mean depth of bodies and its change with the aspect, m."""
    squared_step: float
    """Squared last step, in standard deviations."""


def solve_space(
    observations: Sequence[SpaceObservations],
    states: Sequence[SpaceState],
    prior: Array,
    progress: Callable[[float], None] = lambda _: None,
) -> SpaceSolution:
    """Solves for all sensors jointly, by Gauss–Newton with persons and surfaces found again.

    Args:
        observations: by sensor.
        states: start values; the first is the root, in whose levelled frame the solution is.
        prior: (S, 9) standard deviations of these, 0 of what is fixed.
        progress: called with the fraction done.
    """
    free = prior > 0
    columns = np.append(np.flatnonzero(free), [free.size, free.size + 1])
    count = int(free.sum())
    information = np.concatenate([prior[free], SHARED_STDDEV]) ** -2.0
    samples = gather_samples(observations)
    points = [thin_points(one.static.points) for one in observations]
    noise = NoiseModel(np.full(len(states), _START_WHITE), np.full(2, _START_VIEW))
    body_noise, body, start = _START_BODY, SHARED_MEAN, list(states)
    states = start
    persons, shared = [], None
    for k, (person_gate, surface_gate) in enumerate(zip(_PERSON_GATES, _SURFACE_GATES, strict=True)):
        if k < len(_PERSON_GATES) - _FIXED_STEPS:
            persons = find_persons(samples, states, person_gate)
            shared = find_shared_surfaces(points, states, surface_gate)
        of_persons = [reduce_person(one, states, body_noise, body) for one in persons]
        of_surfaces = reduce_surfaces(shared, states, noise, free)
        H, g = np.diag(information), np.concatenate([_deviate(states, start)[free], body - SHARED_MEAN]) * information
        H[:count, :count] += of_surfaces.information
        g[:count] += of_surfaces.gradient
        for one in of_persons:
            H += one.information[np.ix_(columns, columns)]
            g += one.gradient[columns]
        step = -np.linalg.solve(H, g)
        full = np.zeros(free.shape)
        full[free] = step[:count]
        states = [state.moved(one) for state, one in zip(states, full, strict=True)]
        body = body + step[count:]
        body_noise = _estimate_body_noise(of_persons, body_noise)
        noise = _estimate_noise(of_surfaces, noise)
        progress((k + 1) / len(_PERSON_GATES))
    covariance = np.linalg.inv(H)
    return SpaceSolution(
        states, free, covariance, persons, of_persons, shared, of_surfaces, noise, body_noise, body,
        float(step @ H @ step),
    )  # fmt: skip


def _deviate(states: Sequence[SpaceState], start: Sequence[SpaceState]) -> Array:
    return np.array([state.deviation(first) for state, first in zip(states, start, strict=True)])


def _estimate_body_noise(persons: Sequence[PersonEquations], noise: BodyNoise) -> BodyNoise:
    if not persons:
        return noise
    white, view = (np.sum([getattr(one, name) for one in persons], axis=0) for name in ("white", "view"))
    return BodyNoise(
        np.maximum(np.sqrt(white[:, 0] / np.maximum(white[:, 1], 1)), _MIN_SCALE),
        np.maximum(np.sqrt(view[:, 0] / np.maximum(view[:, 1], 1)), _MIN_BODY_VIEW),
    )


def _estimate_noise(surfaces: SurfaceEquations, noise: NoiseModel) -> NoiseModel:
    white, counts = surfaces.white.T
    squares, number = surfaces.view.T
    view = np.where(number > 0, np.sqrt(squares / np.maximum(number, 1)), noise.view)
    return NoiseModel(
        np.maximum(np.where(counts > 0, white, noise.white), _MIN_WHITE), np.maximum(view, _MIN_VIEW)
    )
