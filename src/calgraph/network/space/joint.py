"""The joint solution of a network in space: poses, clocks and range errors of all its LiDARs.

Persons on smooth paths connect sensors in the plane and in time, surfaces that several sensors measure connect
them in all directions but time. Each is eliminated for itself; what remains are the states of the sensors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from calgraph.geometry import Array, Index, se_n
from calgraph.network.joint.scanner_prior import ScannerPrior
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.periods import release_periods
from calgraph.network.space.person_batches import LocalPerson, PeopleEquations, add_persons, reduce_persons
from calgraph.network.space.person_paths import SHAPE, SHARED_MEAN, SHARED_STDDEV, BodyNoise, PersonEquations
from calgraph.network.space.persons import find_persons, gather_samples
from calgraph.network.space.static_directions import find_rows
from calgraph.network.space.static_surfaces import (
    SharedSurfaces,
    find_shared_surfaces,
    reduce_surfaces,
    thin_points,
)
from calgraph.parallel.engine import THIS_PROCESS, MapEngine
from calgraph.solver.clustered_covariance import label_places, label_times, sum_clusters, widen_by_clusters
from calgraph.surfaces.map_agreement import measure_agreement
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
# Axes of a pose that people and surfaces both determine, by how much these may differ, m and rad, and the
# probability with which a difference is found where there is none.
_PLANAR = np.array([0, 1, 5])
_SPLIT_STDDEV = np.array([1.0, 1.0, 0.2])
_FALSE_ALARM = 0.001


@dataclass(frozen=True)
class Contradiction:
    """How far people and surfaces are apart on the place and heading of a sensor."""

    significance: float
    """Squared distance in standard deviations, over the limit of what chance explains."""
    shift: float
    """m."""
    turn: float
    """rad."""


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
    persons: Sequence[LocalPerson]
    """The measurements of each person whom several sensors measured."""
    people: PeopleEquations
    shared: SharedSurfaces
    noise: NoiseModel
    """Of static points."""
    body_noise: BodyNoise
    body: Array
    """(6,) means of the shapes of bodies."""
    agreement: Array
    """(S, S) of the maps of two sensors; see :func:`measure_agreement`."""
    contradiction: Sequence[Contradiction]
    """By sensor: where people and surfaces would move its pose."""
    changes: Sequence[Change]
    """Of poses and clocks, by number of the sensor."""
    begin: float
    """Of what people show, by the root's clock, s."""
    squared_step: float
    """Squared last step, in standard deviations."""


def solve_space(
    observations: Sequence[SpaceObservations],
    states: Sequence[SensorState],
    prior: Array,
    earlier: ScannerPrior | None = None,
    engine: MapEngine = THIS_PROCESS,
    progress: Callable[[float], None] = lambda _: None,
) -> SpaceSolution:
    """Solves for all sensors jointly, by Gauss–Newton with persons and surfaces found again.

    Args:
        observations: by sensor.
        states: start values; the first is the root, in whose levelled frame the solution is.
        prior: (S, 12) standard deviations of these, 0 of what is fixed.
        earlier: what is known of poses in that frame from an earlier calibration.
        engine: evaluates persons; does not affect the result.
        progress: called with the fraction done.
    """
    free, start = prior > 0, states
    count = int(free.sum())
    information = np.concatenate([prior[free], SHARED_STDDEV]) ** -2.0
    samples = gather_samples(observations)
    points = [thin_points(one.static.points) for one in observations]
    noise = NoiseModel.at_start(len(states))
    body_noise, body = _START_BODY, SHARED_MEAN
    persons: list[LocalPerson] = []
    for k, (person_gate, surface_gate) in enumerate(zip(_PERSON_GATES, _SURFACE_GATES, strict=True)):
        if k < len(_PERSON_GATES) - _FIXED_STEPS:
            persons = [LocalPerson.of(one) for one in find_persons(samples, states, person_gate)]
            shared = find_shared_surfaces(points, states, surface_gate)
        reduced = reduce_persons(persons, states, body_noise, body, engine)
        people = add_persons(persons, reduced, free)
        surfaces = reduce_surfaces(shared, states, noise, free)
        H = people.information + np.diag(information)
        g = people.gradient + np.append(_deviate(states, start)[free], body - SHARED_MEAN) * information
        H[:count, :count] += surfaces.information
        g[:count] += surfaces.gradient
        if earlier is not None:
            _add_poses(earlier, states, free, H, g)
        step = -np.asarray(np.linalg.solve(H, g), dtype=np.float64)
        full = np.zeros(free.shape)
        full[free] = step[:count]
        states = [state.moved(one) for state, one in zip(states, full, strict=True)]
        body = body + step[count:]
        body_noise, noise = _estimate_body_noise(reduced, body_noise), noise.estimated_again([surfaces])
        progress((k + 1) / len(_PERSON_GATES))
    clusters = [sum_clusters(people.scores, label) for label in (label_times(people.time), people.source)]
    for label in (label_places(shared.surfaces.center[shared.surface]), _label_rings(shared)):
        clusters.append(np.pad(surfaces.scores.sum_by(label), ((0, 0), (0, SHAPE))))
    inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
    covariance = widen_by_clusters(inverse, clusters)[:count, :count]
    world = [state.place(one.static.points)[0] for state, one in zip(states, observations, strict=True)]
    changes: list[Change] = []
    begin = 0.0
    if persons:
        left = np.append(_deviate(states, start)[free], body - SHARED_MEAN) * information
        if earlier is not None:
            _add_poses(earlier, states, free, np.zeros_like(H), left)
        equations, ends = release_periods(persons, states, body_noise, body, (information, left), free)
        places: Array = np.array([se_n.translation(one.T_root_sensor) for one in states])
        changes = find_changes(equations, free, ends, places - places[0])
        begin = float(ends[0] - PERIOD)
    return SpaceSolution(
        states, free, covariance, _condition_on_ranges(covariance, free),
        persons, people, shared, noise, body_noise, body,
        agreement=measure_agreement([[(one, np.zeros(len(one), dtype=np.intp)) for one in world]]),
        contradiction=_compare_people(people, inverse, free),
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


def _label_rings(shared: SharedSurfaces) -> Index:
    """(N,) number of the sensor and ring of each static point: errors of rings are the same everywhere."""
    row = find_rows(shared.points)
    label = np.unique(shared.sensor * (int(row.max(initial=0)) + 1) + row, return_inverse=True)[1]
    return np.asarray(label.ravel(), dtype=np.intp)


def _compare_people(people: PeopleEquations, inverse: Array, free: NDArray[np.bool_]) -> list[Contradiction]:
    """Rao's score test of another place and heading of each sensor for people than for surfaces.

    Args:
        people: their equations at the solution.
        inverse: (P + 6, P + 6) of the information of people and surfaces.
        free: (S, 12).
    """
    found = []
    number = np.cumsum(free.ravel()).reshape(free.shape) - 1
    for k in range(len(free)):
        if not free[k, 0]:
            found.append(Contradiction(0.0, 0.0, 0.0))
            continue
        rows = number[k, _PLANAR]
        response = inverse @ people.information[:, rows]
        information = people.information[np.ix_(rows, rows)] - people.information[rows] @ response
        information += np.diag(_SPLIT_STDDEV**-2.0)
        size = -np.linalg.solve(information, people.gradient[rows])
        # What independent groups of people contribute scatters more than independent errors.
        sums = sum_clusters(people.scores[:, rows] - people.scores @ response, people.source)
        covariance = widen_by_clusters(np.asarray(np.linalg.inv(information)), [sums])
        statistic = float(size @ np.linalg.solve(covariance, size))
        found.append(
            Contradiction(
                statistic / float(chdtri(len(_PLANAR), _FALSE_ALARM)),
                float(np.hypot(*size[:2])), abs(float(size[2])),
            )
        )  # fmt: skip
    return found


def _add_poses(
    earlier: ScannerPrior, states: Sequence[SensorState], free: NDArray[np.bool_], H: Array, g: Array
) -> None:
    """Adds what is known of poses to the equations of free states (S, 12), in place."""
    T = np.reshape([states[k].T_root_sensor for k in earlier.nodes], (-1, 4, 4))
    rows = (np.cumsum(free.ravel()).reshape(free.shape) - 1)[earlier.nodes, :6].ravel()
    H[np.ix_(rows, rows)] += earlier.information
    g[rows] += earlier.information @ se_n.difference(T, earlier.T_root_scanner).ravel()


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
