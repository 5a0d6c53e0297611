"""Equations of people with a state of each sensor in each period, for score tests of what changes with time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calgraph.geometry import Array
from calgraph.network.space.person_paths import BodyNoise, reduce_person
from calgraph.network.space.persons import BodySamples, date_samples
from calgraph.solver.change_tests import PeriodEquations
from calgraph.surfaces.sensor_states import SensorState
from calgraph.surfaces.surface_elimination import SurfaceEquations
from calgraph.verdict.state_changes import PERIOD


def release_periods(
    persons: Sequence[BodySamples],
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
    dates = [date_samples(one, states) for one in persons]
    begin, end = min(one[0] for one in dates), max(one[-1] for one in dates)
    K = max(int((end - begin) // PERIOD), 1)
    numbers = free.size * K
    sensor, period, column = np.nonzero(np.repeat(free[:, None], K, axis=1))
    rows = np.append((sensor * K + period) * free.shape[1] + column, numbers + np.arange(len(body)))
    H, g = np.zeros((len(rows),) * 2), np.zeros(len(rows))
    for one, times in zip(persons, dates, strict=True):
        of = np.clip((times - begin) // PERIOD, 0, K - 1).astype(np.intp)
        reduced = reduce_person(one, states, noise, body, (one.sensor * K + of, len(states) * K))
        H += reduced.information[np.ix_(rows, rows)]
        g += reduced.gradient[rows]
    P = int(free.sum())
    of_period = (np.cumsum(free).reshape(free.shape) - 1)[sensor, column]
    B = len(body)
    same = np.concatenate([of_period, P + np.arange(B), np.arange(P)])
    equations = PeriodEquations(
        block_diag(H, surfaces.information), np.append(g, surfaces.gradient),
        np.append(period, np.full(B + P, -1)), np.eye(P + B)[same], *prior,
    )  # fmt: skip
    return equations, begin + PERIOD * np.arange(1.0, K + 1)
