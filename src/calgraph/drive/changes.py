"""Score tests of changes during a drive: a sensor that was bumped or comes loose, a clock that jumps or drifts.

Each sensor has a pose and a clock of its own in each period of a few seconds; the gradient by these at the joint
solution, with trajectory, surfaces and all that is constant eliminated, predicts a step after each period, and a
drift over all of them, and tests these. Errors of neighbouring points are correlated, so that the statistic is
divided by the scatter of what periods contribute beside the change.

Sources: Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948; Andrews, "Tests
for parameter instability and structural change with unknown change point", 1993.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import chdtri

from calgraph.drive.states import BESIDE_POSE, SensorState
from calgraph.geometry import Array, se_n
from calgraph.result.finding import Finding
from calgraph.solver.clustered_covariance import SCATTER_FACTOR

# Duration of a period, s: a whole number of views. Errors of points are correlated for about as long.
PERIOD = 3.0
# Periods that a step needs before and after it: fewer have no scatter.
_MIN_PERIODS = 2
# Probability with which one change is found where there is none, beside the correlation over longer times that
# SCATTER_FACTOR stands for. Of 45 minutes of real scans the statistics of four exceed the limit, up to 1.6 times,
# three of these by one clock in one minute. With a scanner that is moved by 50 mm and 1° in the middle of a
# minute, all of 15 do, by 1.2 to 8 times.
_FALSE_ALARM = 0.05
# Prior information (1/m², 1/rad², 1/s²) on a change: directions that nothing measures are invertible.
_CHANGE_INFORMATION = 1.0
# Sensors whose changes have a likelihood smaller than the largest by less than this factor are all named.
_INDISTINGUISHABLE_RATIO = 1e4
# Changes that are found: with more, something changes all the time.
_MAX_CHANGES = 4


@dataclass(frozen=True, eq=False)
class PeriodEquations:
    """Normal equations of the states of S sensors (F numbers each) in K periods, then of G constants.

    All else is eliminated. Rows of states that are not estimated are 0.
    """

    information: Array
    """(S K F + G, S K F + G)."""
    gradient: Array
    """(S K F + G,)."""
    free: NDArray[np.bool_]
    """(S, F) which states are estimated."""
    ends: Array
    """(K,) of the periods by the root's clock, s."""
    prior_information: Array
    """(S F + G,) on states that do not change, 1 for those that are not estimated, and on the constants,"""
    prior_gradient: Array
    """(S F + G,) and the gradient by these."""


@dataclass(frozen=True)
class Change:
    """A step or a drift of the pose or the clock of a sensor."""

    sensors: tuple[int, ...]
    """The sensor; several if the drive does not determine which of them it was."""
    kind: Literal["pose", "clock"]
    time: float | None
    """Of a step, by the root's clock, s; None of a drift."""
    size: tuple[float, ...]
    """Of the pose (n + d,) along the root's axes, m and rad, or of the clock (1,), s; of a drift, in all."""


def find_changes(equations: PeriodEquations, states: Sequence[SensorState]) -> list[Change]:
    """The significant changes of poses and clocks, the root's included, each searched beside those before it.

    Args:
        equations: at the solution.
        states: of the solution; the first is the root.
    """
    (S, F), K = equations.free.shape, len(equations.ends)
    constants = len(equations.gradient) - S * K * F
    same = np.kron(np.eye(S), np.kron(np.ones((K, 1)), np.eye(F)))
    model = _Model(
        np.block([[same, np.zeros((len(same), constants))], [np.zeros((constants, S * F)), np.eye(constants)]]),
        equations.prior_information,
        equations.prior_gradient,
    )
    candidates = _list_candidates(equations, states)
    changes: list[Change] = []
    while candidates and len(changes) < _MAX_CHANGES:
        tests = _test_candidates(equations, model, candidates)
        best = int(np.argmax([test.statistic / test.limit for test in tests]))
        if tests[best].statistic <= tests[best].limit:
            break
        chosen = candidates[best]
        near = tests[best].statistic - 2 * np.log(_INDISTINGUISHABLE_RATIO)
        alike = {
            one.sensor
            for one, test in zip(candidates, tests, strict=True)
            if (one.kind, one.time) == (chosen.kind, chosen.time) and test.statistic > near
        }
        # Of two sensors, one moves relative to the other.
        sensors = range(S) if S == 2 else sorted(alike)
        changes.append(Change(tuple(sensors), chosen.kind, chosen.time, tuple(tests[best].size.tolist())))
        model = model.with_change(chosen.direction)
    return changes


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A change of the state of one sensor as a function of time."""

    sensor: int
    kind: Literal["pose", "clock"]
    time: float | None
    """Of a step, s."""
    direction: Array
    """(S K F + G, c) by which the states in all periods change with it."""


def _list_candidates(equations: PeriodEquations, states: Sequence[SensorState]) -> list[_Candidate]:
    """Steps after each period, and drifts. Those of the root are those of all others the other way round."""
    (S, _), ends = equations.free.shape, equations.ends
    inside = ends[_MIN_PERIODS - 1 : len(ends) - _MIN_PERIODS]
    functions: list[tuple[float | None, Array]] = [(float(time), (ends > time) * 1.0) for time in inside]
    if len(inside):
        functions.append((None, (ends - ends.mean()) / np.ptp(ends)))
    kinds: tuple[Literal["pose", "clock"], ...] = ("pose", "clock")
    found = []
    for sensor in range(0 if S > 2 else 1, S):
        for kind in kinds:
            by_state = _change_states(equations.free, states, sensor, kind)
            for time, function in functions:
                by_period = np.einsum("sfc,k->skfc", by_state, function)
                direction = np.zeros((len(equations.gradient), by_state.shape[2]))
                direction[: by_period[..., 0].size] = by_period.reshape(-1, by_state.shape[2])
                found.append(_Candidate(sensor, kind, time, direction))
    return found


def _change_states(
    free: NDArray[np.bool_], states: Sequence[SensorState], sensor: int, kind: Literal["pose", "clock"]
) -> Array:
    """(S, F, c) change of all states with that of the pose (n + d,) or the clock (1,) of one sensor."""
    S, F = free.shape
    pose = np.arange(F - BESIDE_POSE)
    columns = pose if kind == "pose" else np.array([F - BESIDE_POSE])
    change = np.zeros((S, F, len(columns)))
    for k in [sensor] if sensor else range(1, S):
        change[k, columns] = np.eye(len(columns)) * (1 if sensor else -1)
        if sensor == 0 and kind == "pose":
            t = se_n.translation(states[k].T_root_sensor)
            change[k, : len(t), len(t) : len(pose)] = -se_n.rotation_jacobian(t)
    change[~free] = 0.0
    return change


@dataclass(frozen=True, eq=False)
class _Test:
    """Of one change."""

    statistic: float
    """Squared Mahalanobis distance of the change from none, over the scatter of periods."""
    limit: float
    """Above which it is significant."""
    size: Array
    """(c,) of the change."""


@dataclass(frozen=True, eq=False)
class _Model:
    """What is estimated: states that are the same in all periods, and the changes that were found."""

    basis: Array
    """(S K F + G, C) changes of the states by that."""
    prior_information: Array
    """(C,)."""
    prior_gradient: Array
    """(C,)."""

    def with_change(self, direction: Array) -> "_Model":
        """The model with a change, whose direction is (S K F + G, c)."""
        c = direction.shape[1]
        return _Model(
            np.column_stack([self.basis, direction]),
            np.concatenate([self.prior_information, np.full(c, _CHANGE_INFORMATION)]),
            np.concatenate([self.prior_gradient, np.zeros(c)]),
        )


def _test_candidates(equations: PeriodEquations, model: _Model, candidates: Sequence[_Candidate]) -> list[_Test]:
    """Rao's tests of changes beside the model."""
    H, A = equations.information, model.basis
    HA = H @ A
    factor = cho_factor(A.T @ HA + np.diag(model.prior_information))
    # What is left to the minimum without a change.
    rest = -cho_solve(factor, A.T @ equations.gradient + model.prior_gradient)
    g = equations.gradient + HA @ rest
    tests = []
    for one in candidates:
        # The change, with the model following it.
        rows = np.flatnonzero(one.direction.any(axis=1))
        moved = one.direction[rows]
        follow = cho_solve(factor, HA[rows].T @ moved)
        D, HD = one.direction - A @ follow, H[:, rows] @ moved - HA @ follow
        information = one.direction.T @ HD
        measured = max(int(np.sum(np.diag(information) > _CHANGE_INFORMATION)), 1)
        information += _CHANGE_INFORMATION * np.eye(len(information))
        gradient = one.direction.T @ g
        size = -np.linalg.solve(information, gradient)
        by_period = _sum_by_period(equations, D * (g + HD @ size)[:, None])
        squares = float(np.sum(by_period.T * np.linalg.solve(information, by_period.T)))
        K = len(by_period)
        scatter = max(squares / measured * K / (K - 1), 1.0)
        limit = SCATTER_FACTOR * float(chdtri(measured, _FALSE_ALARM))
        tests.append(_Test(float(-gradient @ size) / scatter, limit, size))
    return tests


def _sum_by_period(equations: PeriodEquations, contributions: Array) -> Array:
    """(K, c) sums of contributions (S K F + G, c) of the states in each period."""
    (S, F), K = equations.free.shape, len(equations.ends)
    return np.asarray(contributions[: S * K * F].reshape(S, K, F, -1).sum(axis=(0, 2)))


def describe_changes(changes: Sequence[Change], names: Sequence[str], root: str, start: float) -> list[Finding]:
    """A finding for each change: what changed, when and by how much, and what to do.

    Args:
        changes: of the solution.
        names: of its sensors, the first of which the others were solved for.
        root: to which their poses are published.
        start: of the drive by the clock of the first, s.
    """
    found = []
    for change in changes:
        of = [names[k] for k in change.sensors]
        # Poses are relative to these two.
        weak = tuple(names) if {names[0], root} & set(of) else tuple(of)
        found.append(Finding(_describe_change(change, " or ".join(of), start), weak))
    return found


def _describe_change(change: Change, sensor: str, start: float) -> str:
    when = "in the course of the drive" if change.time is None else f"{change.time - start:.0f} s from the start"
    if change.kind == "clock":
        milliseconds = 1000 * abs(change.size[0])
        changed = f"drifts by {milliseconds:.1f} ms" if change.time is None else f"jumped by {milliseconds:.1f} ms"
        return f"the clock of {sensor} {changed} {when}: synchronize the clocks, and record again"
    n = 2 if len(change.size) == 3 else 3
    mm, degrees = 1000 * np.linalg.norm(change.size[:n]), np.degrees(np.linalg.norm(change.size[n:]))
    return (
        f"{sensor} moved by {mm:.1f} mm and {degrees:.2f}° {when}: fix it to the robot, and record again; "
        "or what it measured moved along with the robot"
    )
