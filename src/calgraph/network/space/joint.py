"""The joint solution of a network in space: poses, clocks and range errors of all its LiDARs.

Persons on smooth paths connect sensors in the plane and in time, surfaces that several sensors measure connect
them in all directions but time. Each is eliminated for itself; what remains are the states of the sensors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calgraph.geometry import Array, Index, se_n
from calgraph.network.joint.planar_poses import ScannerPrior
from calgraph.network.space.observations import SpaceObservations
from calgraph.network.space.person_paths import (
    BodyNoise,
    LocalPerson,
    PeopleEquations,
    PersonEquations,
    add_persons,
    eliminate_direction,
    expect_shapes,
    reduce_persons,
    release_periods,
)
from calgraph.network.space.persons import UPPER_SLICES, find_persons, gather_samples
from calgraph.network.space.static_surfaces import (
    SharedSurfaces,
    compare_walls,
    find_shared_surfaces,
    reduce_surfaces,
    thin_points,
)
from calgraph.network.space.vehicle_pairs import VehiclePair, find_vehicle_pairs, reduce_vehicles
from calgraph.parallel.engine import THIS_PROCESS, MapEngine
from calgraph.solver.clustered_covariance import (
    label_places,
    label_rings,
    label_times,
    sum_clusters,
    widen_by_clusters,
)
from calgraph.surfaces.sensor_states import BESIDE_POSE, SensorState, measure_deviations, move_states, number_free
from calgraph.surfaces.surface_elimination import NoiseModel
from calgraph.verdict.state_changes import PERIOD, Change, find_changes

# Distances up to which tracks are of one person, and points of one surface, m, by iteration: from errors of the
# start to those of bodies and of noise.
_PERSON_GATES = (0.5, 0.4, 0.3, *[0.3] * 13)
_SURFACE_GATES = (0.3, 0.2, 0.15, 0.12, 0.1, *[0.09] * 11)
# Last steps, on persons and surfaces that stay the same: after six, one of eight halls has not converged.
_FIXED_STEPS = 10
# Start values of standard deviations: of samples over their first guesses, and of their views, m, radial and
# tangential, of LiDARs and of 2-D scanners; least ones.
_START_VIEWS = (0.03, 0.05), (0.02, 0.05)
_MIN_SCALE, _MIN_BODY_VIEW = 0.2, 0.003
# Probability with which one change of a clock is found where there is none: some fifty are tested, and errors of
# views last for longer than a period. Statistics are up to 10 in 17 halls without changes, 38 to 75 with jumps of
# 43 to 74 ms, 19, 41 and 1600 with drifts of 0.2, 0.5 and 3 per mille, which are beyond the prior of clocks; the
# limit is 26. Those of 0.2 per mille are not found: 6 ms at the ends of a minute.
_FALSE_ALARM = 0.01


@dataclass(frozen=True, eq=False)
class SpaceSolution:
    """Of S sensors."""

    states: Sequence[SensorState]
    prior: Array
    """(S, 12) how well they are known before; 0 of what is not estimated."""
    covariance: Array
    """(P, P) of what is."""
    with_ranges: Array
    """(P, P) that it would be if the ranges of all sensors had no errors but noise."""
    persons: Sequence[LocalPerson]
    """The measurements of each person whom several sensors measured."""
    vehicles: Sequence[VehiclePair]
    """Tracks of vehicles that two sensors measured."""
    people: PeopleEquations
    shared: SharedSurfaces
    noise: NoiseModel
    """Of static points."""
    body: Array
    """(6B,) means of the shapes of bodies."""
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

    @property
    def free(self) -> NDArray[np.bool_]:
        """(S, 12) which numbers of the states are estimated."""
        return self.prior > 0

    def scale_covariance(self, factor: float) -> "SpaceSolution":
        """The solution with variances that are larger by a factor."""
        return replace(self, covariance=factor * self.covariance, with_ranges=factor * self.with_ranges)


def solve_space(
    observations: Sequence[SpaceObservations],
    states: Sequence[SensorState],
    prior: Array,
    earlier: ScannerPrior | None = None,
    engine: MapEngine = THIS_PROCESS,
    progress: Callable[[float], None] = lambda _: None,
) -> SpaceSolution:
    """Solves for all sensors jointly, by Gauss–Newton with persons, vehicles and surfaces found again.

    Args:
        observations: by sensor.
        states: start values; the first is the root, in whose levelled frame the solution is.
        prior: (S, 12) standard deviations of these, 0 of what is fixed.
        earlier: what is known of poses in that frame from an earlier calibration.
        engine: evaluates persons; does not affect the result.
        progress: called with the fraction done.
    """
    middle = float(observations[0].coverage[[0, -1], [0, 1]].mean())
    states = [replace(one, mid_time=middle + one.clock_offset) for one in states]
    free, start = prior > 0, states
    count = int(free.sum())
    flat: NDArray[np.bool_] = np.array([one.flat for one in observations])
    expected, stddev = expect_shapes(UPPER_SLICES + int(flat.sum()))
    information = np.concatenate([prior[free], stddev]) ** -2.0
    samples = gather_samples(observations)
    points = [thin_points(one.static.points, one.flat) for one in observations]
    noise = NoiseModel.at_start(len(states))
    views = np.repeat(np.array(_START_VIEWS).ravel(), [UPPER_SLICES, int(flat.sum())] * 2)
    body_noise, body = BodyNoise(np.ones(len(views)), views), expected
    persons: list[LocalPerson] = []
    for k, (person_gate, surface_gate) in enumerate(zip(_PERSON_GATES, _SURFACE_GATES, strict=True)):
        if k < len(_PERSON_GATES) - _FIXED_STEPS:
            persons = [LocalPerson.of(one) for one in find_persons(samples, states, person_gate)]
            vehicles = find_vehicle_pairs(observations, states, person_gate)
            shared = find_shared_surfaces(points, states, surface_gate, flat)
        reduced = reduce_persons(persons, states, body_noise, body, engine)
        people, larger = add_persons(persons, reduced, free, len(body)), _enlarge(states, free, len(body))
        surfaces = reduce_surfaces(shared, states, noise, free)
        driven = reduce_vehicles(vehicles, states, free).without(larger[:count])
        H, g = (
            eliminate_direction(one, people.information, larger) for one in (people.information, people.gradient)
        )
        H += np.diag(information)
        g += np.append(measure_deviations(states, start)[free], body - expected) * information
        H[:count, :count] += surfaces.information + driven.information
        g[:count] += surfaces.gradient + driven.gradient
        if earlier is not None:
            _add_poses(earlier, states, free, H, g)
        step = -np.asarray(np.linalg.solve(H, g), dtype=np.float64)
        states = move_states(states, free, step[:count])
        body = body + step[count:]
        body_noise, noise = _estimate_body_noise(reduced, body_noise), noise.estimated_again([surfaces])
        progress((k + 1) / len(_PERSON_GATES))
    clusters = [
        eliminate_direction(sum_clusters(people.scores, label), people.information, larger)
        for label in (label_times(people.time), people.source)
    ]
    for label in (
        label_places(shared.surfaces.center[shared.surface]), label_rings(shared.sensor, shared.points)
    ):  # fmt: skip
        clusters.append(np.pad(surfaces.scores.sum_by(label), ((0, 0), (0, len(body)))))
    for label in (label_times(driven.time), driven.source):
        clusters.append(np.pad(sum_clusters(driven.scores, label), ((0, 0), (0, len(body)))))
    inverse = np.asarray(np.linalg.inv(H), dtype=np.float64)
    covariance = widen_by_clusters(inverse, clusters)[:count, :count]
    agreement, balance = compare_walls([one.static.points for one in observations], states, flat)
    changes: list[Change] = []
    begin = 0.0
    if persons:
        left = np.append(measure_deviations(states, start)[free], body - expected) * information
        if earlier is not None:
            _add_poses(earlier, states, free, np.zeros_like(H), left)
        held = replace(
            surfaces,
            information=surfaces.information + driven.information,
            gradient=surfaces.gradient + driven.gradient,
        )
        equations, ends = release_periods(persons, states, body_noise, body, (information, left), free, held)
        places: Array = np.array([se_n.translation(one.T_root_sensor) for one in states])
        changes = find_changes(equations, free, ends, places - places[0], ("clock",), _FALSE_ALARM)
        begin = float(ends[0] - PERIOD)
    return SpaceSolution(
        states, prior, covariance, condition_on(covariance, _find_ranges(free)),
        persons, vehicles, people, shared, noise, body,
        agreement=agreement,
        balance=balance,
        changes=changes,
        begin=begin,
        squared_step=float(step[:count] @ np.linalg.solve(covariance, step[:count])),
    )  # fmt: skip


def _enlarge(states: Sequence[SensorState], free: NDArray[np.bool_], shape: int) -> Array:
    """How free states, and shapes of bodies, change if network and ranges become larger, as a share (P + 6B,).

    Persons determine this to 2 % at best, ranges to 0.2 %. Small errors of outlines that distance and aspect do
    not explain are far more than these 2 %: halls of four LiDARs were 0.04 to 0.1 % too small by them. Four halls
    with vehicles only were 0.09 to 0.17 % too small by errors of registrations.
    """
    change, places = np.zeros(free.shape), np.array([se_n.translation(one.T_root_sensor) for one in states])
    change[:, : places.shape[1]] = places - places[0]
    change[:, free.shape[1] - BESIDE_POSE + 2] = -1.0
    return np.append(change[free], np.zeros(shape))


def _find_ranges(free: NDArray[np.bool_]) -> Index:
    """Which free states are range biases and scales."""
    ranges = np.zeros_like(free)
    ranges[:, 1 - BESIDE_POSE : 3 - BESIDE_POSE] = True
    return np.flatnonzero(ranges[free])


def condition_on(covariance: Array, known: Index) -> Array:
    """The covariance (P, P) of states if some of them were known."""
    cross = covariance[:, known]
    return np.asarray(covariance - cross @ np.linalg.solve(covariance[np.ix_(known, known)], cross.T))


def _add_poses(
    earlier: ScannerPrior, states: Sequence[SensorState], free: NDArray[np.bool_], H: Array, g: Array
) -> None:
    """Adds what is known of poses to the equations of free states (S, 12), in place."""
    T = np.reshape([states[k].T_root_sensor for k in earlier.nodes], (-1, 4, 4))
    rows = number_free(free)[earlier.nodes, :6].ravel()
    H[np.ix_(rows, rows)] += earlier.information
    g[rows] += earlier.information @ se_n.difference(T, earlier.T_root_scanner).ravel()


def _estimate_body_noise(persons: Sequence[PersonEquations], noise: BodyNoise) -> BodyNoise:
    if not persons:
        return noise
    white, view = (np.sum([getattr(one, name) for one in persons], axis=0) for name in ("white", "view"))
    scale, bias = (np.sqrt(one[:, 0] / np.maximum(one[:, 1], 1)) for one in (white, view))
    return BodyNoise(
        np.where(white[:, 1] > 0, np.maximum(scale, _MIN_SCALE), noise.scale),
        np.where(view[:, 1] > 0, np.maximum(bias, _MIN_BODY_VIEW), noise.view),
    )
