"""Score tests of changes in time of what a solution takes as constant.

Each number has a value of its own in each period; the gradient by these at the solution, with all that is constant
eliminated, predicts a change in time, and tests it. Errors of neighbouring data are correlated, so that the
statistic is divided by the scatter of what periods contribute beside the change.

Sources: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948; Andrews, "Tests
for parameter instability and structural change with unknown change point", 1993.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array
from scipy.special import chdtri

from calgraph.geometry import Array, Index
from calgraph.solver.clustered_covariance import SCATTER_FACTOR

# Prior information on a change, per square of its unit (m, rad, s): directions that nothing measures are
# invertible.
_CHANGE_INFORMATION = 1.0


@dataclass(frozen=True, eq=False)
class PeriodEquations:
    """Normal equations of R numbers, most of which are values in one of K periods; all else is eliminated."""

    information: Array | csr_array
    """(R, R)."""
    gradient: Array
    """(R,)."""
    period: Index
    """(R,) the period of each number, -1 of those that are the same in all."""
    model: Array
    """(R, C) their changes with what is estimated: values that are the same in all periods, and found changes."""
    prior_information: Array
    """(C,) on what is estimated,"""
    prior_gradient: Array
    """(C,) and the gradient by it."""

    def with_change(self, direction: Array) -> "PeriodEquations":
        """The equations whose model has a change in time, of direction (R, c)."""
        c = direction.shape[1]
        return replace(
            self,
            model=np.column_stack([self.model, direction]),
            prior_information=np.concatenate([self.prior_information, np.full(c, _CHANGE_INFORMATION)]),
            prior_gradient=np.concatenate([self.prior_gradient, np.zeros(c)]),
        )


@dataclass(frozen=True, eq=False)
class ChangeTest:
    """Of one change."""

    gain: float
    """Squared Mahalanobis distance of the change from none."""
    statistic: float
    """The same over the scatter of periods."""
    limit: float
    """Above which it is significant."""
    size: Array
    """(c,) of the change."""


def search_changes(
    equations: PeriodEquations, directions: Sequence[Array | csr_array], most: int, false_alarm_probability: float
) -> Iterator[tuple[int, list[ChangeTest]]]:
    """The significant changes, each searched beside those before it: its number, and the tests of all.

    Args:
        equations: at the solution.
        directions: (R, c) of each change that may be, by which numbers change with it.
        most: number of changes that are searched for.
        false_alarm_probability: of each test, where nothing changes.
    """
    for _ in range(most if directions else 0):
        tests = _test_changes(equations, directions, false_alarm_probability)
        significant = [k for k, test in enumerate(tests) if test.statistic > test.limit]
        if not significant:
            return
        # What explains most: beside a change whose time is between periods, others have less scatter.
        best = max(significant, key=lambda k: tests[k].gain / tests[k].limit)
        yield best, tests
        equations = equations.with_change(_to_dense(directions[best]))


def _test_changes(
    equations: PeriodEquations, directions: Sequence[Array | csr_array], false_alarm_probability: float
) -> list[ChangeTest]:
    """Rao's tests of changes beside the model."""
    H, A = equations.information, csr_array(equations.model)
    HA = H @ A
    factor = cho_factor(_to_dense(A.T @ HA) + np.diag(equations.prior_information))
    # What is left to the minimum without a change.
    rest = -cho_solve(factor, A.T @ equations.gradient + equations.prior_gradient)
    g = equations.gradient + HA @ rest
    own = np.flatnonzero(equations.period >= 0)
    K = int(equations.period.max()) + 1
    tests = []
    for direction in map(_to_dense, directions):
        # The change, with the model following it.
        rows = np.flatnonzero(direction.any(axis=1))
        moved = direction[rows]
        follow = cho_solve(factor, HA[rows].T @ moved)
        D, HD = direction - A @ follow, H[rows].T @ moved - HA @ follow
        information = direction.T @ HD
        measured = max(int(np.sum(np.diag(information) > _CHANGE_INFORMATION)), 1)
        information += _CHANGE_INFORMATION * np.eye(len(information))
        gradient = direction.T @ g
        size = -np.linalg.solve(information, gradient)
        by_period = np.zeros((K, len(size)))
        np.add.at(by_period, equations.period[own], (D * (g + HD @ size)[:, None])[own])
        squares = float(np.sum(by_period.T * np.linalg.solve(information, by_period.T)))
        scatter = max(squares / measured * K / (K - 1), 1.0)
        limit = SCATTER_FACTOR * float(chdtri(measured, false_alarm_probability))
        gain = float(-gradient @ size)
        tests.append(ChangeTest(gain, gain / scatter, limit, size))
    return tests


def _to_dense(matrix: Array | csr_array) -> Array:
    return np.asarray(matrix if isinstance(matrix, np.ndarray) else matrix.toarray())
