"""Persons in the joint solution of a network in space: what their paths leave to the states of sensors.

For the sample x of a person at time t, measured by sensor i along the horizontal unit vector e from it, n across,

    radial      r = e · (x - c(t') - l h w) + a - a' cos 2φ + a" cos φ + s h + d ρ - b_r
    tangential  r = n · (x - c(t') - l h w) - b_t

with the path c, a spline, at t' = t - o_i - δ_i (t - m_i) by a clock of drift δ_i, which has the offset o_i at
m_i; the depth a of the axis behind the front, its changes a' and a" with the angle φ between view and walk w, s
with the height h over the middle of the body, and d with the distance ρ; the lean l; and errors of shape b that
are the same for all samples of a view: of one track, during a second. Errors of views are eliminated in closed
form, then path and body of each person. Sums over a network are of the sensors that measured each person; score
tests of what changes with time have a state of each sensor in each period.

Sources: Harville, "Maximum likelihood approaches to variance component estimation", 1977, for the variances;
Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989, for the weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import block_diag, csr_array, vstack

from calgraph.geometry import Array, Index, measure_lengths
from calgraph.network.joint.splines import Knots, evaluate_spline
from calgraph.network.space.persons import (
    FRONT,
    UPPER_SLICES,
    BodySamples,
    date_samples,
    derive_places,
    place_samples,
    point_outward,
)
from calgraph.parallel.engine import MapEngine
from calgraph.parallel.kept_values import Kept
from calgraph.solver.change_tests import PeriodEquations
from calgraph.surfaces.sensor_states import BESIDE_POSE, DRIFT, TIMING, SensorState, number_free
from calgraph.surfaces.surface_elimination import SurfaceEquations
from calgraph.verdict.state_changes import PERIOD

SHAPE = 6
"""Numbers of a slice of a body: depth of the axis behind the front, m, its change with the aspect, between front
and back, m, lean, and the change of the depth with height and with distance."""
SHARED_MEAN = np.array([FRONT, 0.04, 0.0, 0.06, 0.0, 0.0])
"""(6,) the mean over persons: an ellipse of 0.25 by 0.45 m has a depth of 0.15 m, and 0.045 of it with the aspect,
at its median beam."""
SHARED_STDDEV = np.array([0.04, 0.03, 0.03, 0.1, 0.1, 0.02])
"""(6,) how well it is known before. Depths change by up to 5 mm with each metre of distance, which would
else be taken for a scale of ranges."""
# By how much slices that 2-D scanners measure, of legs, hips or chests, are less known: depths are twice as
# different. Their lean is that of this height over the middle of the upper body, m: legs do not lean.
_UNKNOWN_SLICE, _BELOW = np.array([2.0, 2.0, 1.0, 1.0, 1.0, 1.0]), -0.4
# Depth and its change with the aspect of the highest slice, m: heads of 0.2 by 0.16 m, and necks are round.
_HEAD = 0.07, 0.0
# By which persons differ from the mean: they carry bags, and lean forward by up to 0.12 rad.
_PERSON_STDDEV = np.array([0.02, 0.02, 0.03, 0.08, 0.05, 0.005])
# Height in the middle of the upper body, and usual distance, m.
_MIDDLE, _USUAL_DISTANCE = 1.35, 8.0
# Time between knots, s, and standard deviation of accelerations, m/s²: the trunk of a person who walks swings with
# 1 to 2 m/s² at 2 Hz. Smaller ones bind where little is measured, and are felt by what is measured well.
_KNOTS, _ACCELERATION = 0.2, 15.0
# Time for which errors of shape are taken as constant, s: two steps.
_VIEW = 1.0
# Degrees of freedom of Student's t: arms, bags, and points of something else.
_FREEDOM = 4.0
# Fits with weights from the residuals of the one before.
_ROUNDS = 4
# Fits with directions and aspects from the path of the one before.
_PASSES = 3
# Speed from which a person faces where they go, m/s.
_WALKING = 0.3


@dataclass(frozen=True, eq=False)
class BodyNoise:
    """Standard deviations of radial errors of B slices of bodies, then of tangential ones."""

    scale: Array
    """(2B,) of samples, over their first guesses."""
    view: Array
    """(2B,) of views, m."""


@dataclass(frozen=True, eq=False)
class PersonEquations:
    """What a person contributes to the normal equations of P = S F + 6B unknowns: states, then what all share."""

    information: Array
    """(P, P)."""
    gradient: Array
    """(P,)."""
    scores: Array
    """(V, P) what each view contributes to the gradient."""
    view_time: Array
    """(V,) the mean time of these by the root's clock, s,"""
    view_sensor: Index
    """(V,) and their sensors."""
    white: Array
    """(2B, 2) expected sums of squared errors of samples over first guesses, and their numbers."""
    view: Array
    """(2B, 2) of the errors of views, m²."""
    residual: Array
    """(N, 2) of samples beside the errors of views, m."""
    weight: Array
    """(N, 2) of Student's t."""
    path: Array
    """(N, 2) places of the person at the times of samples, world, m."""


def expect_shapes(bands: int) -> tuple[Array, Array]:
    """(6B,) the mean over persons of the shapes of B slices of bodies, and how well it is known before."""
    mean = np.tile(SHARED_MEAN, (bands, 1))
    mean[UPPER_SLICES - 1, :2] = _HEAD
    return mean.ravel(), _repeat_stddev(SHARED_STDDEV, bands)


def _repeat_stddev(of_upper: Array, bands: int) -> Array:
    stddev = np.tile(of_upper, (bands, 1))
    stddev[UPPER_SLICES:] *= _UNKNOWN_SLICE
    return stddev.ravel()


def reduce_person(
    samples: BodySamples,
    states: Sequence[SensorState],
    noise: BodyNoise,
    shared: Array,
    numbered: tuple[Index, int] | None = None,
) -> PersonEquations:
    """The equations of one person, with path and body fitted to the states.

    Args:
        samples: of the person, in order of time.
        states: of all sensors.
        noise: of samples and views.
        shared: (6B,) the mean of the shapes of persons.
        numbered: which state each sample belongs to (N,), and of how many, where states change with time; one of
            each sensor if left out.
    """
    of_state, count = (samples.sensor, len(states)) if numbered is None else numbered
    times = date_samples(samples, states)
    knots = Knots.spanning(float(times[0]), float(times[-1]), _KNOTS)
    first, weights, slopes = knots.basis_at(times)
    prior, mean = _arrange_prior(knots.count, shared)
    measured = place_samples(samples, states)
    outward = point_outward(samples, states, measured[:, :2])
    distance = measure_lengths(samples.center)
    gather = _gather_views(samples.track * (len(shared) // SHAPE) + samples.band, times)
    heading = np.zeros_like(outward)
    for _ in range(_PASSES):
        rows = _arrange_rows(
            samples, measured, distance, outward, (first, weights, knots.count), heading, gather, len(shared)
        )
        fit = _fit(rows, noise, prior, mean)
        control = fit.own[: -len(shared)].reshape(-1, 2)
        path, velocity = (evaluate_spline(control, first, some) for some in (weights, slopes))
        heading = _face(velocity)
        # Where bodies are, not where they are measured: errors of places would be multiplied with themselves, and
        # make the network smaller, by 0.3 to 0.5 % of simulated halls.
        outward = point_outward(samples, states, path)
    error = (fit.residual[:, None] * rows.direction).reshape(2, -1, 2).sum(axis=0)
    by_state = derive_places(samples, states, measured - np.pad(error, ((0, 0), (0, 1))))
    by_state[:, :, -BESIDE_POSE] = velocity
    mid_times = np.array([one.mid_time for one in states])
    by_state[:, :, DRIFT] = velocity * (samples.time - mid_times[samples.sensor])[:, None]
    by_states = _arrange_derivatives(rows.direction, by_state, of_state, count)
    H, g, response = _eliminate(rows, fit, by_states, prior, mean)
    # Accelerations are relative to the size of the network: they would else make it smaller, by 0.05 % of halls.
    path_prior = control.ravel() @ prior[: control.size, : control.size] @ control.ravel()
    size = by_state.shape[2]
    g[size - TIMING - 1 : size * count : size] += path_prior * np.bincount(of_state, minlength=count) / len(times)
    force = (fit.residual - fit.error[rows.view]) * fit.information
    scores = rows.gather @ by_states.multiply(force[:, None]).toarray()
    scores = np.column_stack([scores, np.zeros((len(scores), len(shared)))])
    scores += (rows.gather @ rows.by_own.multiply(force[:, None]).tocsr()) @ response
    sizes = np.asarray(rows.gather.sum(axis=1))
    white, of_views = _expect_squares(rows, fit)
    return PersonEquations(
        H, g, scores,
        rows.gather @ np.tile(times, 2) / sizes,
        np.rint(rows.gather @ np.tile(samples.sensor, 2) / sizes).astype(np.intp),
        white, of_views,
        (fit.residual - fit.error[rows.view]).reshape(2, -1).T,
        fit.weight.reshape(2, -1).T,
        path,
    )  # fmt: skip


def _face(velocity: Array) -> Array:
    """(N, 2) unit vectors in which a person faces: those of the walk; who stands faces where they went before."""
    speed = np.hypot(*velocity.T)
    walking = np.flatnonzero(speed > _WALKING)
    if not len(walking):
        return np.zeros_like(velocity)
    last = walking[np.maximum(np.searchsorted(walking, np.arange(len(speed)), side="right") - 1, 0)]
    return np.asarray(velocity[last] / speed[last, None])


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residuals of the N samples of one person, radial ones first."""

    base: Array
    """(2N,) with the path at the origin and a body without depth, m."""
    direction: Array
    """(2N, 2) along which errors are measured."""
    stddev: Array
    """(2N,) first guesses, m."""
    by_own: csr_array
    """(2N, C) derivatives by control points and body."""
    gather: csr_array
    """(V, 2N) sums over the rows of each view, radial views first."""
    view: Index
    """(2N,) of each row."""
    kind: Index
    """(2N,) which standard deviations of :class:`BodyNoise` are of each row."""
    shape: int
    """Numbers 6B of the shape of the body."""


def _gather_views(track: Index, times: Array) -> csr_array:
    """(V, 2N) of :class:`_Rows`."""
    second = np.floor((times - times[0]) / _VIEW).astype(np.intp)
    view = np.unique(track * (int(second.max()) + 1) + second, return_inverse=True)[1].ravel()
    views, rows = int(view.max()) + 1, np.arange(2 * len(track))
    return csr_array(
        (np.ones(len(rows)), (np.concatenate([view, view + views]), rows)), shape=(2 * views, len(rows))
    )


def _arrange_prior(controls: int, shared: Array) -> tuple[Array, Array]:
    """Information (C, C) on path and body, and (C,) what they are expected to be."""
    second = np.diff(np.eye(controls), 2, axis=0) / (_ACCELERATION * _KNOTS**2)
    bands = len(shared) // SHAPE
    size = 2 * controls + len(shared)
    prior, mean = np.zeros((size, size)), np.zeros(size)
    for axis in range(2):
        path = np.arange(axis, 2 * controls, 2)
        prior[np.ix_(path, path)] = second.T @ second
    stddev = _repeat_stddev(_PERSON_STDDEV, bands)
    prior[2 * controls :, 2 * controls :] = np.diag(stddev**-2.0)
    mean[2 * controls :] = shared
    return prior, mean


def _arrange_rows(
    samples: BodySamples,
    places: Array,
    distance: Array,
    outward: Array,
    basis: tuple[Index, Array, int],
    heading: Array,
    gather: csr_array,
    numbers: int,
) -> _Rows:
    """Rows for places (N, 3), unit vectors of view (N, 2), and of walk (N, 2), 0 of who never walks."""
    N, (first, weights, controls) = len(places), basis
    direction = np.concatenate([outward, np.column_stack([-outward[:, 1], outward[:, 0]])])
    above = np.where(samples.band >= UPPER_SLICES, _BELOW, places[:, 2] - _MIDDLE)
    shape = _derive_by_shape(direction, heading, above, distance)
    row, sample = np.arange(2 * N), np.tile(np.arange(N), 2)
    control = 2 * (first[sample, None] + np.arange(4))[:, :, None] + np.arange(2)
    by_control = -weights[sample][:, :, None] * direction[:, None, :]
    values = np.concatenate([by_control.ravel(), shape.ravel()])
    of_shape = 2 * controls + SHAPE * samples.band[sample, None] + np.arange(SHAPE)
    column = np.concatenate([control.ravel(), of_shape.ravel()])
    of_row = np.concatenate([np.repeat(row, 8), np.repeat(row, SHAPE)])
    return _Rows(
        np.einsum("ri,ri->r", direction, places[sample, :2]),
        direction,
        samples.stddev.T.ravel(),
        csr_array((values, (of_row, column)), shape=(2 * N, 2 * controls + numbers)),
        gather,
        np.asarray(gather.tocsc().indices, dtype=np.intp),
        np.concatenate([samples.band, samples.band + numbers // SHAPE]),
        numbers,
    )


def _derive_by_shape(direction: Array, heading: Array, above: Array, distance: Array) -> Array:
    """(2N, 6) derivatives by the shape of the slice of the body that is measured.

    Args:
        direction: (2N, 2) unit vectors, radial ones first.
        heading: (N, 2) unit vectors of walk, 0 of who never walks.
        above: (N,) heights over the middle of the upper body, m.
        distance: (N,) from the sensor, m.
    """
    N = len(heading)
    along = np.einsum("ri,ri->r", direction, np.tile(heading, (2, 1)))
    shape = np.zeros((2 * N, SHAPE))
    shape[:N, 0] = 1.0
    shape[:N, 1] = np.where(heading.any(axis=1), 1 - 2 * along[:N] ** 2, 0.0)
    shape[:N, 2] = along[:N]
    shape[:, 3] = -np.tile(above, 2) * along
    shape[:N, 4] = above
    shape[:N, 5] = distance - _USUAL_DISTANCE
    return shape


@dataclass(frozen=True, eq=False)
class _Fit:
    """Path and body that fit best, and the weights of rows with which they do."""

    own: Array
    """(C,)."""
    factor: tuple[Array, bool]
    """Cholesky factor of their information (C, C)."""
    information: Array
    """(2N,) of each row, 1/m²."""
    gain: Array
    """(V,) by which the sum of a view's weighted residuals becomes its error, m²."""
    residual: Array
    """(2N,) with the errors of views, m."""
    error: Array
    """(V,) of the views, m."""
    weight: Array
    """(2N,) of Student's t."""


def _fit(rows: _Rows, noise: BodyNoise, prior: Array, mean: Array) -> _Fit:
    """By weights from the residuals of the fit before."""
    stddev = noise.scale[rows.kind] * rows.stddev
    variance = noise.view[_find_kinds(rows)] ** 2
    weight = np.ones(len(stddev))
    for _ in range(_ROUNDS):
        information = weight / stddev**2
        gain = variance / (1 + variance * (rows.gather @ information))
        H = _square(rows, information, gain, rows.by_own, rows.by_own) + prior
        g = _square(rows, information, gain, rows.by_own, rows.base[:, None])[:, 0] - prior @ mean
        factor = cho_factor(H, lower=True, check_finite=False)
        own = -np.asarray(cho_solve(factor, g, check_finite=False))
        residual = rows.base + rows.by_own @ own
        error = gain * (rows.gather @ (information * residual))
        weight = (_FREEDOM + 1) / (_FREEDOM + ((residual - error[rows.view]) / stddev) ** 2)
    return _Fit(own, factor, information, gain, residual, error, weight)


def _find_kinds(rows: _Rows) -> Index:
    """(V,) which standard deviations are of each view."""
    return np.asarray(rows.kind[rows.gather.indices[rows.gather.indptr[:-1]]], dtype=np.intp)


def _square(rows: _Rows, information: Array, gain: Array, A: csr_array, B: csr_array | Array) -> Array:
    """``Aᵀ V⁻¹ B`` with the covariance V of rows, whose errors are independent beside those of views."""
    D = csr_array((information, np.arange(len(information)), np.arange(len(information) + 1)))
    weighted_a, weighted_b = D @ A, D @ B
    sums = csr_array((gain, np.arange(len(gain)), np.arange(len(gain) + 1))) @ (rows.gather @ weighted_b)
    product = A.T @ weighted_b - (rows.gather @ weighted_a).T @ sums
    return np.asarray(product if isinstance(product, np.ndarray) else product.toarray())


def _arrange_derivatives(direction: Array, by_state: Array, of_state: Index, count: int) -> csr_array:
    """(2N, count F) derivatives of rows by states, from those of places (N, 2, F)."""
    N = len(by_state)
    sample = np.tile(np.arange(N), 2)
    values = np.einsum("ri,rif->rf", direction, by_state[sample])
    size = by_state.shape[2]
    column = size * of_state[sample, None] + np.arange(size)
    return csr_array(
        (values.ravel(), (np.repeat(np.arange(2 * N), size), column.ravel())), shape=(2 * N, size * count)
    )


def _eliminate(
    rows: _Rows, fit: _Fit, by_states: csr_array, prior: Array, mean: Array
) -> tuple[Array, Array, Array]:
    """Normal equations of states and shared unknowns without path and body, and (C, P) how these follow."""
    P, numbers = by_states.shape[1], rows.shape
    shape = prior[-numbers:, -numbers:]
    cross = np.zeros((len(prior), P + numbers))
    cross[:, :P] = _square(rows, fit.information, fit.gain, rows.by_own, by_states)
    cross[-numbers:, P:] = -shape
    H, g = np.zeros((P + numbers,) * 2), np.zeros(P + numbers)
    H[:P, :P] = _square(rows, fit.information, fit.gain, by_states, by_states)
    H[P:, P:] = shape
    g[:P] = _square(rows, fit.information, fit.gain, by_states, fit.residual[:, None])[:, 0]
    g[P:] = -shape @ (fit.own[-numbers:] - mean[-numbers:])
    response = -np.asarray(cho_solve(fit.factor, cross, check_finite=False))
    return H + cross.T @ response, g, response


def _expect_squares(rows: _Rows, fit: _Fit) -> tuple[Array, Array]:
    """Expected squares of errors given the data (the E step of EM): see :class:`PersonEquations`."""
    gained = rows.by_own.multiply(fit.information[:, None]).tocsr()
    by_view = (rows.gather @ gained).multiply(fit.gain[:, None]).tocsr()
    rest = rows.by_own - by_view[rows.view]
    P = np.asarray(cho_solve(fit.factor, np.eye(len(fit.own)), check_finite=False))
    left = fit.gain
    of_views = fit.error**2 + left + np.einsum("vc,vc->v", by_view @ P, by_view.toarray())
    error = fit.residual - fit.error[rows.view]
    square = error**2 + left[rows.view] + np.einsum("rc,rc->r", rest @ P, rest.toarray())
    kinds = 2 * rows.shape // SHAPE
    white, views = (
        np.stack([np.bincount(kind, some, kinds), np.bincount(kind, minlength=kinds)], axis=1, dtype=np.float64)
        for kind, some in ((rows.kind, fit.weight * square / rows.stddev**2), (_find_kinds(rows), of_views))
    )
    return white, views


@dataclass(frozen=True, eq=False)
class PeopleEquations:
    """Normal equations from all persons, of the P free states and the 6B means of the shapes of bodies."""

    information: Array
    """(P + 6B, P + 6B)."""
    gradient: Array
    """(P + 6B,)."""
    scores: csr_array
    """(V, P + 6B) what each view contributes to the gradient."""
    time: Array
    """(V,) of these by the root's clock, s."""
    source: Index
    """(V,) number of person and sensor."""


def eliminate_direction(values: Array, information: Array, direction: Array) -> Array:
    """Information, gradient, or sums of scores (..., P) where a move along a direction is eliminated as well.

    Args:
        values: of the equations.
        information: (P, P) of the same.
        direction: (P,) along which the unknowns move by a further one.
    """
    by_direction = information @ direction
    total = max(float(direction @ by_direction), np.finfo(np.float64).tiny)
    return np.asarray(values - np.multiply.outer(values @ direction / total, by_direction))


@dataclass(frozen=True, eq=False)
class LocalPerson:
    """A person among the sensors that measured it."""

    sensors: Index
    """(L,) ascending."""
    samples: BodySamples
    """With sensors as numbers among these."""
    kept: Kept
    """The samples, for calls of an engine."""

    @classmethod
    def of(cls, samples: BodySamples) -> "LocalPerson":
        """With the sensors of a network as numbers."""
        sensors, number = np.unique(samples.sensor, return_inverse=True)
        local = replace(samples, sensor=number.ravel())
        return cls(sensors, local, Kept.of(local))


def reduce_persons(
    persons: Sequence[LocalPerson], states: Sequence[SensorState], noise: BodyNoise, body: Array, engine: MapEngine
) -> list[PersonEquations]:
    """The equations of each person, of the states of its sensors; for the arguments see :func:`reduce_person`."""
    work = [(one.kept, [states[k] for k in one.sensors], noise, body) for one in persons]
    return list(engine.map(_reduce_aligned, work))


def _reduce_aligned(
    samples: BodySamples, states: Sequence[SensorState], noise: BodyNoise, body: Array
) -> PersonEquations:
    """The equations of a person; poses from elsewhere need not be aligned, and would round differently."""
    aligned = [replace(state, T_root_sensor=state.T_root_sensor.copy()) for state in states]
    return reduce_person(samples, aligned, noise, body)


def add_persons(
    persons: Sequence[LocalPerson], reduced: Sequence[PersonEquations], free: NDArray[np.bool_], shape: int
) -> PeopleEquations:
    """The sum of the equations of persons, of the free states (S, 12) and the numbers of the shape of bodies."""
    number, size = number_columns(np.flatnonzero(free), free.size, shape)
    H, g = np.zeros((size, size)), np.zeros(size)
    scores = [csr_array((0, size))]
    time, source = [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    for k, (person, one) in enumerate(zip(persons, reduced, strict=True)):
        used, columns = find_columns(person.sensors, number, free.shape[1], shape)
        H[np.ix_(columns, columns)] += one.information[np.ix_(used, used)]
        g[columns] += one.gradient[used]
        rows = len(one.scores)
        index = np.tile(columns, rows), np.arange(rows + 1) * len(columns)
        scores.append(csr_array((one.scores[:, used].ravel(), *index), shape=(rows, size)))
        time.append(one.view_time)
        source.append(person.sensors[one.view_sensor] + len(free) * k)
    return PeopleEquations(H, g, csr_array(vstack(scores)), np.concatenate(time), np.concatenate(source))


def number_columns(estimated: Index, count: int, shape: int) -> tuple[Index, int]:
    """Column (count + shape,) of each number of states and of the shape of bodies, -1 of others; and how many."""
    number = np.full(count + shape, -1)
    rows = np.append(estimated, count + np.arange(shape))
    number[rows] = np.arange(len(rows))
    return number, len(rows)


def find_columns(states: Index, number: Index, numbers: int, shape: int) -> tuple[Index, Index]:
    """Which numbers of some states (L,), and of the shape, are estimated, and their columns.

    Args:
        states: of the equations of a person.
        number: as from :func:`number_columns`.
        numbers: of each state.
        shape: numbers of the shape of bodies.
    """
    own = (numbers * states[:, None] + np.arange(numbers)).ravel()
    columns = number[np.append(own, len(number) - shape + np.arange(shape))]
    used = np.flatnonzero(columns >= 0)
    return used, columns[used]


def release_periods(
    persons: Sequence[LocalPerson],
    states: Sequence[SensorState],
    noise: BodyNoise,
    body: Array,
    prior: tuple[Array, Array],
    free: NDArray[np.bool_],
    surfaces: SurfaceEquations,
) -> tuple[PeriodEquations, Array]:
    """The equations, and the ends (K,) of periods by the root's clock, s.

    Args:
        persons: measurements of each.
        states: the solution.
        noise: of bodies.
        body: (6B,) means of the shapes of bodies.
        prior: (P + 6B,) information on states and means of shapes, and the gradient by it.
        free: (S, 12) which states are estimated.
        surfaces: equations of these from what stands still. People alone leave places open by 0.2 m, which hides
            jumps of clocks, and imitates them.
    """
    own = [[states[k] for k in one.sensors] for one in persons]
    dates = [date_samples(one.samples, some) for one, some in zip(persons, own, strict=True)]
    begin, end = min(one[0] for one in dates), max(one[-1] for one in dates)
    K = max(int((end - begin) // PERIOD), 1)
    sensor, period, column = np.nonzero(np.repeat(free[:, None], K, axis=1))
    B = len(body)
    number, size = number_columns((sensor * K + period) * free.shape[1] + column, free.size * K, B)
    g = np.zeros(size)
    blocks: list[tuple[Array, Index, Index]] = []
    for one, some, times in zip(persons, own, dates, strict=True):
        of = np.clip((times - begin) // PERIOD, 0, K - 1).astype(np.intp)
        reduced = reduce_person(one.samples, some, noise, body, (one.samples.sensor * K + of, len(some) * K))
        in_periods = (one.sensors[:, None] * K + np.arange(K)).ravel()
        used, columns = find_columns(in_periods, number, free.shape[1], B)
        block = reduced.information[np.ix_(used, used)]
        row, other = np.nonzero(block)
        blocks.append((block[row, other], columns[row], columns[other]))
        g[columns] += reduced.gradient[used]
    values, row, other = (np.concatenate(one) for one in zip(*blocks, strict=True))
    H = csr_array((values, (row, other)), shape=(size, size))
    P = int(free.sum())
    of_period = number_free(free)[sensor, column]
    same = np.concatenate([of_period, P + np.arange(B), np.arange(P)])
    equations = PeriodEquations(
        csr_array(block_diag([H, surfaces.information])), np.append(g, surfaces.gradient),
        np.append(period, np.full(B + P, -1)), np.eye(P + B)[same], *prior,
    )  # fmt: skip
    return equations, begin + PERIOD * np.arange(1.0, K + 1)
