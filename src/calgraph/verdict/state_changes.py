"""Changes during a recording: a sensor that was bumped or comes loose, a clock that jumps or drifts.

Each sensor has a pose and a clock of its own in each period of a few seconds; score tests find a step after a
period, or a drift over all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from calgraph.geometry import Array, se_n
from calgraph.result.finding import Finding
from calgraph.solver.change_tests import PeriodEquations, search_changes

# Duration of a period, s: a whole number of views. Errors of points are correlated for about as long.
PERIOD = 3.0
# Periods that a step needs before and after it: fewer have no scatter.
_MIN_PERIODS = 2
# Probability with which one change is found where there is none, beside the correlation over longer times that
# SCATTER_FACTOR stands for. Of 45 minutes of real scans the statistics of four exceed the limit, up to 1.6 times,
# three of these by one clock in one minute. With a scanner that is moved by 50 mm and 1° in the middle of a
# minute, all of 15 do, by 1.2 to 8 times.
_FALSE_ALARM = 0.05
# Sensors whose changes have a likelihood smaller than the largest by less than this factor are all named.
_INDISTINGUISHABLE_RATIO = 1e4
# Changes that are found: with more, something changes all the time.
_MAX_CHANGES = 4
Kind = Literal["pose", "clock"]
"""Of what changes."""


@dataclass(frozen=True)
class Change:
    """A step or a drift of the pose or the clock of a sensor."""

    sensors: tuple[int, ...]
    """The sensor; several if the drive does not determine which of them it was."""
    kind: Kind
    time: float | None
    """Of a step, by the root's clock, s; None of a drift."""
    size: tuple[float, ...]
    """Of the pose (n + d,) along the root's axes, m and rad, or of the clock (1,), s; of a drift, in all."""


def find_changes(
    equations: PeriodEquations,
    free: NDArray[np.bool_],
    ends: Array,
    places: Array,
    kinds: Sequence[Kind] = ("pose", "clock"),
    false_alarm_probability: float = _FALSE_ALARM,
) -> list[Change]:
    """The significant changes of poses and clocks, the root's included, each searched beside those before it.

    Args:
        equations: of what is estimated of the states in K periods, sensor by sensor, then period by period, and
            of what is constant.
        free: (S, F) which of the states are estimated.
        ends: (K,) of the periods by the root's clock, s.
        places: (S, n) of the sensors from the first, the root, m.
        kinds: of changes.
        false_alarm_probability: of each change, where nothing does and errors are independent.
    """
    S = len(places)
    candidates = _list_candidates(len(equations.gradient), free, ends, places, kinds)
    directions = [one.direction for one in candidates]
    changes = []
    for best, tests in search_changes(equations, directions, _MAX_CHANGES, false_alarm_probability):
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
    return changes


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A change of the state of one sensor as a function of time."""

    sensor: int
    kind: Kind
    time: float | None
    """Of a step, s."""
    direction: csr_array
    """(R, c) by which the states in all periods change with it."""


def _list_candidates(
    rows: int, free: NDArray[np.bool_], ends: Array, places: Array, kinds: Sequence[Kind]
) -> list[_Candidate]:
    """Steps after each period, and drifts. Those of the root are those of all others the other way round."""
    S = len(places)
    inside = ends[_MIN_PERIODS - 1 : len(ends) - _MIN_PERIODS]
    functions: list[tuple[float | None, Array]] = [(float(time), (ends > time) * 1.0) for time in inside]
    if len(inside):
        functions.append((None, (ends - ends.mean()) / np.ptp(ends)))
    number, period, column = np.nonzero(np.repeat(free[:, None], len(ends), axis=1))
    found = []
    for sensor in range(0 if S > 2 else 1, S):
        for kind in kinds:
            by_state = _change_states(free.shape[1], places, sensor, kind)[number, column]
            for time, function in functions:
                direction = np.zeros((rows, by_state.shape[1]))
                direction[: len(period)] = by_state * function[period, None]
                found.append(_Candidate(sensor, kind, time, csr_array(direction)))
    return found


def _change_states(numbers: int, places: Array, sensor: int, kind: Kind) -> Array:
    """(S, F, c) change of states of F numbers with that of the pose (n + d,) or the clock (1,) of a sensor."""
    n = places.shape[1]
    size = n * (n + 1) // 2
    columns = np.arange(size) if kind == "pose" else np.array([size])
    change = np.zeros((len(places), numbers, len(columns)))
    for k in [sensor] if sensor else range(1, len(places)):
        change[k, columns] = np.eye(len(columns)) * (1 if sensor else -1)
        if sensor == 0 and kind == "pose":
            change[k, :n, n:size] = -se_n.rotation_jacobian(places[k])
    return change


def describe_changes(changes: Sequence[Change], names: Sequence[str], root: str, start: float) -> list[Finding]:
    """A finding for each change: what changed, when and by how much, and what to do.

    Args:
        changes: of the solution.
        names: of its sensors, the first of which the others were solved for.
        root: to which their poses are published.
        start: of the recording by the clock of the first, s.
    """
    found = []
    for change in changes:
        of = [names[k] for k in change.sensors]
        # Poses are relative to these two.
        weak = tuple(names) if {names[0], root} & set(of) else tuple(of)
        found.append(Finding(_describe_change(change, " or ".join(of), start), weak))
    return found


def _describe_change(change: Change, sensor: str, start: float) -> str:
    when = (
        "in the course of the recording" if change.time is None else f"{change.time - start:.0f} s from the start"
    )
    if change.kind == "clock":
        milliseconds = 1000 * abs(change.size[0])
        changed = f"drifts by {milliseconds:.1f} ms" if change.time is None else f"jumped by {milliseconds:.1f} ms"
        return f"the clock of {sensor} {changed} {when}: synchronize the clocks, and record again"
    n = 2 if len(change.size) == 3 else 3
    mm, degrees = 1000 * np.linalg.norm(change.size[:n]), np.degrees(np.linalg.norm(change.size[n:]))
    return (
        f"{sensor} moved by {mm:.1f} mm and {degrees:.2f}° {when}: fix it firmly, and record again; "
        "or what it measured moved along with it"
    )
