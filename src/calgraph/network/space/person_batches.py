"""Equations of persons, each of the sensors that measured them, and their sums over a network.

Score tests of what changes with time have a state of each sensor in each period.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array, vstack

from calgraph.geometry import Array, Index
from calgraph.network.space.person_paths import BodyNoise, PersonEquations, reduce_person
from calgraph.network.space.persons import BodySamples, date_samples
from calgraph.parallel.engine import MapEngine
from calgraph.parallel.kept_values import Kept
from calgraph.solver.change_tests import PeriodEquations
from calgraph.surfaces.sensor_states import SensorState, number_free
from calgraph.surfaces.surface_elimination import SurfaceEquations
from calgraph.verdict.state_changes import PERIOD


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
