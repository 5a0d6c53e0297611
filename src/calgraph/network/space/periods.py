"""Equations of people with a state of each sensor in each period, for score tests of what changes with time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from calgraph.geometry import Array, Index
from calgraph.network.space.person_batches import LocalPerson, find_columns, number_columns
from calgraph.network.space.person_paths import SHAPE, BodyNoise, reduce_person
from calgraph.network.space.persons import date_samples
from calgraph.solver.change_tests import PeriodEquations
from calgraph.surfaces.sensor_states import SensorState
from calgraph.verdict.state_changes import PERIOD


def release_periods(
    persons: Sequence[LocalPerson],
    states: Sequence[SensorState],
    noise: BodyNoise,
    body: Array,
    prior: tuple[Array, Array],
    free: NDArray[np.bool_],
) -> tuple[PeriodEquations, Array]:
    """The equations, and the ends (K,) of periods by the root's clock, s.

    Args:
        persons: measurements of each.
        states: the solution.
        noise: of bodies.
        body: (6,) means of the shapes of bodies.
        prior: (P + 6,) information on states and means of shapes, and the gradient by it.
        free: (S, 12) which states are estimated.
    """
    own = [[states[k] for k in one.sensors] for one in persons]
    dates = [date_samples(one.samples, some) for one, some in zip(persons, own, strict=True)]
    begin, end = min(one[0] for one in dates), max(one[-1] for one in dates)
    K = max(int((end - begin) // PERIOD), 1)
    sensor, period, column = np.nonzero(np.repeat(free[:, None], K, axis=1))
    number, size = number_columns((sensor * K + period) * free.shape[1] + column, free.size * K)
    g = np.zeros(size)
    blocks: list[tuple[Array, Index, Index]] = []
    for one, some, times in zip(persons, own, dates, strict=True):
        of = np.clip((times - begin) // PERIOD, 0, K - 1).astype(np.intp)
        reduced = reduce_person(one.samples, some, noise, body, (one.samples.sensor * K + of, len(some) * K))
        in_periods = (one.sensors[:, None] * K + np.arange(K)).ravel()
        used, columns = find_columns(in_periods, number, free.shape[1])
        block = reduced.information[np.ix_(used, used)]
        row, other = np.nonzero(block)
        blocks.append((block[row, other], columns[row], columns[other]))
        g[columns] += reduced.gradient[used]
    values, row, other = (np.concatenate(one) for one in zip(*blocks, strict=True))
    H = csr_array((values, (row, other)), shape=(size, size))
    P = int(free.sum())
    same = np.append((np.cumsum(free).reshape(free.shape) - 1)[sensor, column], P + np.arange(SHAPE))
    constant = np.full(SHAPE, -1)
    equations = PeriodEquations(H, g, np.append(period, constant), np.eye(P + SHAPE)[same], *prior)
    return equations, begin + PERIOD * np.arange(1.0, K + 1)
