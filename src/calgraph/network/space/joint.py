"""The joint solution of a network in space: poses, clocks and range errors of all its LiDARs.

Persons on smooth paths connect sensors in the plane and in time, surfaces that several sensors measure connect
them in all directions but time. Each is eliminated for itself; what remains are the states of the sensors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se_n
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.periods import release_periods
from calgraph.network.space.person_paths import (
    SHAPE,
    SHARED_MEAN,
    SHARED_STDDEV,
    BodyNoise,
    PersonEquations,
    reduce_person,
)
from calgraph.network.space.persons import BodySamples, find_persons, gather_samples
from calgraph.network.space.static_directions import find_rows
from calgraph.network.space.static_surfaces import (
    SharedSurfaces,
    compare_walls,
    find_shared_surfaces,
    reduce_surfaces,
    thin_points,
)
from calgraph.solver.clustered_covariance import label_places, label_times, sum_clusters, widen_by_clusters
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState
from calgraph.surfaces.surface_elimination import NoiseModel
from calgraph.verdict.state_changes import PERIOD, Change, find_changes

# Distances up to which tracks are of one person, and points of one surface, m, by iteration: from errors of the
# start to those of bodies and of noise.
_PERSON_GATES = (0.5, 0.4, 0.3, *[0.3] * 13)
_SURFACE_GATES = (0.3, 0.2, 0.15, 0.12, 0.1, *[0.09] * 11)
# Last steps, on persons and surfaces that stay the same: after six, one of eight halls has not converged.
_FIXED_STEPS = 10
# Start values of standard deviations: of samples over their first guesses, and of their views, m; least ones.
_START_BODY = BodyNoise(np.ones(2), np.array([0.03, 0.02]))
_MIN_SCALE, _MIN_BODY_VIEW = 0.2, 0.003
# Probability with which one change of a clock is found where there is none: some fifty are tested, and errors of
# views last for longer than a period. Statistics are up to 10 in 17 halls without changes, 38 to 75 with jumps of
# 43 to 74 ms, 18 and 46 with drifts of 49 and 40 ms; the limit is 26.
_FALSE_ALARM = 0.01


@dataclass(frozen=True, eq=False)
class PeopleEquations:
    """Normal equations from all persons, of the P free states and the 6 means of the shapes of bodies."""

    information: Array
    """(P + 6, P + 6)."""
    gradient: Array
    """(P + 6,)."""
    scores: Array
    """(V, P + 6) what each view contributes to the gradient."""
    time: Array
    """(V,) of these by the root's clock, s."""
    source: Index
    """(V,) number of person and sensor."""


@dataclass(frozen=True, eq=False)
class SpaceSolution:
    """Of S sensors."""

    states: Sequence[SensorState]
    free: NDArray[np.bool_]
    """(S, 12) which states are estimated."""
    covariance: Array
    """(P, P) of these."""
    with_ranges: Array
    """(P, P) that it would be if the ranges of all sensors had no errors but noise."""
    persons: Sequence[BodySamples]
    """The measurements of each person whom several sensors measured."""
    people: PeopleEquations
    shared: SharedSurfaces
    noise: NoiseModel
    """Of static points."""
    body_noise: BodyNoise
    body: Array
    """(6,) means of the shapes of bodies."""
    agreement: Array
    """(S, S),"""
    balance: Array
    """(S, S) both of :func:`compare_walls`."""
    changes: Sequence[Change]
    """Of clocks, by number of the sensor; people show changes of poses from 0.2 m on only."""
    begin: float
    """Of what people show, by the root's clock, s."""
    squared_step: float
    """Squared last step, in standard deviations."""


def solve_space(
    observations: Sequence[SpaceObservations],
    states: Sequence[SensorState],
    prior: Array,
    progress: Callable[[float], None] = lambda _: None,
) -> SpaceSolution:
    """Solves for all sensors jointly, by Gauss–Newton with persons and surfaces found again.

    Args:
        observations: by sensor.
        states: start values; the first is the root, in whose levelled frame the solution is.
        prior: (S, 12) standard deviations of these, 0 of what is fixed.
        progress: called with the fraction done.
    """
    free, start = prior > 0, states
    count = int(free.sum())
    information = np.concatenate([prior[free], SHARED_STDDEV]) ** -2.0
    samples = gather_samples(observations)
    points = [thin_points(one.static.points) for one in observations]
    noise = NoiseModel.at_start(len(states))
    body_noise, body = _START_BODY, SHARED_MEAN
    persons: list[BodySamples] = []
    for k, (person_gate, surface_gate) in enumerate(zip(_PERSON_GATES, _SURFACE_GATES, strict=True)):
        if k < len(_PERSON_GATES) - _FIXED_STEPS:
            persons = find_persons(samples, states, person_gate)
            shared = find_shared_surfaces(points, states, surface_gate)
        reduced = [reduce_person(one, states, body_noise, body) for one in persons]
        people = _add_persons(reduced, free)
        surfaces = reduce_surfaces(shared, states, noise, free)
        H = people.information + np.diag(information)
        g = people.gradient + np.append(_deviate(states, start)[free], body - SHARED_MEAN) * information
        H[:count, :count] += surfaces.information
        g[:count] += surfaces.gradient
        step = -np.asarray(np.linalg.solve(H, g), dtype=np.float64)
        full = np.zeros(free.shape)
        full[free] = step[:count]
        states = [state.moved(one) for state, one in zip(states, full, strict=True)]
        body = body + step[count:]
        body_noise, noise = _estimate_body_noise(reduced, body_noise), noise.estimated_again([surfaces])
        progress((k + 1) / len(_PERSON_GATES))
    along = surfaces.scores.along(np.eye(count, len(H)))
    clusters = [
        sum_clusters(people.scores, label_times(people.time)),
        sum_clusters(people.scores, people.source),
        sum_clusters(along, label_places(shared.surfaces.center[shared.surface])),
        sum_clusters(along, _label_rings(shared)),
    ]
    inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
    covariance = widen_by_clusters(inverse, clusters)[:count, :count]
    agreement, balance = compare_walls([one.static.points for one in observations], states)
    changes: list[Change] = []
    begin = 0.0
    if persons:
        left = np.append(_deviate(states, start)[free], body - SHARED_MEAN) * information
        equations, ends = release_periods(persons, states, body_noise, body, (information, left), free, surfaces)
        places: Array = np.array([se_n.translation(one.T_root_sensor) for one in states])
        changes = find_changes(equations, free, ends, places - places[0], ("clock",), _FALSE_ALARM)
        begin = float(ends[0] - PERIOD)
    return SpaceSolution(
        states, free, covariance, _condition_on_ranges(covariance, free),
        persons, people, shared, noise, body_noise, body,
        agreement=agreement,
        balance=balance,
        changes=changes,
        begin=begin,
        squared_step=float(step[:count] @ np.linalg.solve(covariance, step[:count])),
    )  # fmt: skip


def _condition_on_ranges(covariance: Array, free: NDArray[np.bool_]) -> Array:
    """The covariance (P, P) of free states for known range biases and scales."""
    column = np.nonzero(free)[1]
    ranges = np.flatnonzero(
        (column == free.shape[1] - BESIDE_POSE + 1) | (column == free.shape[1] - BESIDE_POSE + 2)
    )
    if not len(ranges):
        return covariance
    cross = covariance[:, ranges]
    return np.asarray(covariance - cross @ np.linalg.solve(covariance[np.ix_(ranges, ranges)], cross.T))


def _add_persons(persons: Sequence[PersonEquations], free: NDArray[np.bool_]) -> PeopleEquations:
    columns = np.append(np.flatnonzero(free), free.size + np.arange(SHAPE))
    size, none = len(columns), np.zeros(0, dtype=np.intp)
    H, g = np.zeros((size, size)), np.zeros(size)
    for one in persons:
        H += one.information[np.ix_(columns, columns)]
        g += one.gradient[columns]
    return PeopleEquations(
        H, g,
        np.concatenate([np.zeros((0, size)), *(one.scores[:, columns] for one in persons)]),
        np.concatenate([np.zeros(0), *(one.view_time for one in persons)]),
        np.concatenate([none, *(one.view_sensor + len(free) * k for k, one in enumerate(persons))]),
    )  # fmt: skip


def _label_rings(shared: SharedSurfaces) -> Index:
    """(N,) number of the sensor and ring of each static point: errors of rings are the same everywhere."""
    row = find_rows(shared.points)
    label = np.unique(shared.sensor * (int(row.max(initial=0)) + 1) + row, return_inverse=True)[1]
    return np.asarray(label.ravel(), dtype=np.intp)


def _deviate(states: Sequence[SensorState], start: Sequence[SensorState]) -> Array:
    return np.array([state.deviation_from(first) for state, first in zip(states, start, strict=True)])


def _estimate_body_noise(persons: Sequence[PersonEquations], noise: BodyNoise) -> BodyNoise:
    if not persons:
        return noise
    white, view = (np.sum([getattr(one, name) for one in persons], axis=0) for name in ("white", "view"))
    return BodyNoise(
        np.maximum(np.sqrt(white[:, 0] / np.maximum(white[:, 1], 1)), _MIN_SCALE),
        np.maximum(np.sqrt(view[:, 0] / np.maximum(view[:, 1], 1)), _MIN_BODY_VIEW),
    )
