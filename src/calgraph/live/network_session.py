"""A live session of a network: from its messages to poses again and again, and what people should do."""

import math
from collections.abc import Sequence
from functools import cached_property

from calgraph.config.settings import LiveNetworkSettings
from calgraph.errors import Rejected
from calgraph.live.capture_finder import name_sensors
from calgraph.live.floor_grid import is_helped_by_walks
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.network_solution import LiveNetworkSolution, solve_recording
from calgraph.live.recorded_session import PAUSE, RecordedSession
from calgraph.live.sensor_solution import SensorSolution
from calgraph.live.session import ALL_DONE
from calgraph.live.state import Advice, Phase, SceneState, SessionState
from calgraph.live.tracked_intervals import MIN_INTERVAL
from calgraph.result.finding import split_clauses
from calgraph.verdict.grades import names_sources

# Standard deviations of means fall with the root of the time, and no faster for long.
_MAX_DECAY = 0.5


# Least exponent of the decay of standard deviations with the recorded time for which a time to the tolerance is
# stated: with 0.5 noise is averaged; close to zero more of the same does not help.
_MIN_DECAY = 0.2


class Forecast:
    """Extrapolates the uncertainties of the solutions so far.

    An uncertainty falls with a power of the recorded time, which is measured between the last solution and one
    from at most half of the time.

    Args:
        settings: limits.
    """

    def __init__(self, settings: LiveNetworkSettings) -> None:
        self._settings = settings
        self._history: list[tuple[float, dict[str, float]]] = []
        """Recorded time, s, and uncertainty relative to the tolerance by scanner with a pose."""

    def add(self, solution: LiveNetworkSolution) -> None:
        """Takes a solution; those that used no new messages replace the last."""
        duration = solution.recorded
        uncertainties = {one.name: one.uncertainty for one in solution.posed}
        if self._history and duration <= self._history[-1][0]:
            self._history.pop()
        self._history.append((duration, uncertainties))

    def minutes_left(self, names: Sequence[str]) -> float | None:
        """Until the uncertainties of sensors, which have a pose, are within tolerance, min; 0 if they are.

        None if that is unknown: there are none, the time is too long, or the uncertainty of one falls too slowly.
        """
        minutes = [self._minutes_left(name) for name in names]
        known = [one for one in minutes if one is not None]
        return max(known) if known and len(known) == len(minutes) else None

    def _minutes_left(self, name: str) -> float | None:
        now, uncertainties = self._history[-1]
        uncertainty = uncertainties[name]
        if uncertainty <= 1:
            return 0.0
        earlier = [(t, found[name]) for t, found in self._history if name in found and 0 < t <= now / 2]
        decay = _MAX_DECAY
        if earlier:
            then, before = earlier[-1]
            decay = min(math.log(before / uncertainty) / math.log(now / then), _MAX_DECAY)
        if decay < _MIN_DECAY:
            return None
        minutes = now * (uncertainty ** (1 / decay) - 1) / 60
        return minutes if minutes <= self._settings.max_minutes else None


class NetworkSession(RecordedSession[LiveNetworkSolution]):
    """Calibrates a network of scanners from its growing recording; see :class:`RecordedSession`."""

    solve = staticmethod(solve_recording)
    _scene: SceneState | None = None

    @cached_property
    def _forecast(self) -> Forecast:
        return Forecast(self.rig.settings.live.network)

    def describe(self) -> SessionState:
        """The session now; see :meth:`Session.describe`."""
        solution = self.solution
        phase, headline = self.find_unheard() or _describe_phase(solution, self._forecast)
        lag = _describe_lag(self.timeline, solution)
        return SessionState(
            "network",
            phase,
            headline,
            advice=None if solution is None or self.done else _advise(solution, self._forecast),
            notices=(*([lag] if lag else []), *(solution.remarks if solution else ())),
            scene=self._scene,
        )

    def is_due(self) -> bool:
        """See :meth:`RecordedSession.is_due`."""
        begin = self.timeline.start or 0.0
        first = begin + self.rig.settings.live.network.first
        return self.timeline.latest_arrival >= (self.solution.end + PAUSE if self.solution else first)

    def take(self, solution: LiveNetworkSolution | Rejected | None) -> None:
        """See :meth:`Session.take`."""
        super().take(solution)
        if isinstance(solution, LiveNetworkSolution):
            self._forecast.add(solution)
            connected = tuple(one.express_in(solution.T_plan_root) for one in solution.posed)
            self._scene = SceneState(connected, floor=solution.grid) if solution.grid else None


def _describe_phase(solution: LiveNetworkSolution | None, forecast: Forecast) -> tuple[Phase, str]:
    if solution is None:
        return "measuring", "Walk through the views of all sensors, one after the other and back again"
    if solution.problem:
        return "measuring", f"No poses yet: {solution.problem}"
    if solution.done:
        return "ready", ALL_DONE
    has_areas = solution.grid is not None and bool(solution.grid.wanted.any())
    if apart := _find_unconnected(solution):
        return "measuring", _say_where_to_walk(apart[0]) + (": try the orange areas" if has_areas else "")
    weak = _find_weak(solution)
    beyond = _find_beyond(weak)
    if not beyond:
        return "measuring", weak[0].reason
    if not (helped := _find_helped(beyond)):
        source = next(filter(names_sources, split_clauses(weak[0].reason)))
        advice = split_clauses(weak[0].reason)[-1]
        return "measuring", f"For {weak[0].name}: {advice} ({source.replace(' of it:', ':')})"
    minutes = forecast.minutes_left(helped)
    left = "" if minutes is None else f": about {_format_minutes(minutes)} more"
    where = "in the orange areas" if has_areas else "where several sensors detect you"
    return "measuring", f"Walk {where}, for {name_sensors(helped)}{left}"


def _find_beyond(weak: Sequence[SensorSolution]) -> list[SensorSolution]:
    """Those that are beyond the tolerance."""
    return [one for one in weak if one.uncertainty > 1]


def _find_helped(sensors: Sequence[SensorSolution]) -> list[str]:
    """Names of those that walks help."""
    return [one.name for one in sensors if is_helped_by_walks(one.reason)]


def _format_minutes(minutes: float) -> str:
    return "1 minute" if minutes <= 1 else f"{math.ceil(minutes)} minutes"


def _find_unconnected(solution: LiveNetworkSolution) -> list[SensorSolution]:
    """The scanners without a pose, those that have detected no person first."""
    apart = [one for one in solution.sensors if one.T_root_sensor is None]
    return sorted(apart, key=lambda one: one.tracks > 0)


def _find_weak(solution: LiveNetworkSolution) -> list[SensorSolution]:
    """The scanners with a pose that is not good, the worst first."""
    weak = [one for one in solution.posed if one.grade != "good"]
    return sorted(weak, key=lambda one: -one.uncertainty)


def _say_where_to_walk(scanner: SensorSolution) -> str:
    if not scanner.tracks:
        return f"Walk where {scanner.name} detects you, and on to where another sensor does"
    return f"Walk where {scanner.name} and another sensor both detect you, in curves"


def _advise(solution: LiveNetworkSolution, forecast: Forecast) -> Advice | None:
    apart, weak = _find_unconnected(solution), _find_weak(solution)
    sentences = [
        f"{_say_where_to_walk(one)} ({one.reason})" if one.reason else _say_where_to_walk(one) for one in apart
    ]
    sentences += dict.fromkeys(clause for one in weak if one.reason for clause in split_clauses(one.reason))
    if not sentences:
        return None
    helped = _find_helped(beyond := _find_beyond(weak))
    minutes = None if apart or len(helped) < len(beyond) else forecast.minutes_left(helped)
    expected = f"within tolerance in about {_format_minutes(minutes)}" if minutes else ""
    return Advice("; ".join(sentences), expected=expected)


def _describe_lag(timeline: LiveTimeline, solution: LiveNetworkSolution | None) -> str:
    """That what is shown is old, or of a part of the recording only; empty if it is not."""
    if solution is None or timeline.start is None:
        return ""
    notes = []
    behind = timeline.latest_arrival - solution.end
    # A solution may take as long as the pause after it, and the time in which people would be background.
    usual = MIN_INTERVAL + 2 * (solution.seconds + PAUSE)
    if behind > usual:
        notes.append(f"Poses and plan are {behind:.0f} s old: the computer is slower than the scanners")
    whole = solution.recorded
    if solution.used < 0.95 * whole:
        notes.append(
            f"Poses are of {solution.used / 60:.0f} of {whole / 60:.0f} minutes: all are calibrated at the end"
        )
    return "; ".join(notes)
