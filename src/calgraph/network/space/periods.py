"""Equations of people with a state of each sensor in each period, for score tests of what changes with time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_array

from calgraph.geometry import Array, Index
from calgraph.network.space.person_batches import LocalPerson, find_columns, number_columns
from calgraph.network.space.person_paths import BodyNoise, reduce_person
from calgraph.network.space.persons import date_samples
from calgraph.solver.change_tests import PeriodEquations
from calgraph.surfaces.sensor_states import SensorState
from calgraph.surfaces.surface_elimination import SurfaceEquations
from calgraph.verdict.state_changes import PERIOD


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
    of_period = (np.cumsum(free).reshape(free.shape) - 1)[sensor, column]
    same = np.concatenate([of_period, P + np.arange(B), np.arange(P)])
    equations = PeriodEquations(
        csr_array(block_diag([H, surfaces.information])), np.append(g, surfaces.gradient),
        np.append(period, np.full(B + P, -1)), np.eye(P + B)[same], *prior,
    )  # fmt: skip
    return equations, begin + PERIOD * np.arange(1.0, K + 1)
