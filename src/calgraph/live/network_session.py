"""A live session of a network: from its messages to poses again and again, and what people should do."""

import math
import time
from collections.abc import Callable
from pathlib import Path

from calgraph.config import Rig
from calgraph.config.settings import LiveNetworkSettings
from calgraph.errors import RecordingError, Rejected
from calgraph.live.capture_finder import SILENCE, name_sensors
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.network_solution import LiveNetworkSolution, solve_recording
from calgraph.live.sensor_solution import SensorSolution
from calgraph.live.session import ALL_DONE, Session, SessionPools
from calgraph.live.source import LiveMessage
from calgraph.live.state import Advice, Phase, SceneState, SensorState, SessionState
from calgraph.live.tracked_intervals import MIN_INTERVAL
from calgraph.result.reasons import split_clauses

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
        uncertainties = {
            scanner.name: scanner.uncertainty for scanner in solution.scanners if scanner.T_root_sensor is not None
        }
        if self._history and duration <= self._history[-1][0]:
            self._history.pop()
        self._history.append((duration, uncertainties))

    def minutes_left(self) -> float | None:
        """Until the uncertainties of all scanners with a pose are within tolerance, min; 0 if they are.

        None if that is unknown: no scanner has a pose, the time is too long, or the uncertainty of one falls
        too slowly.
        """
        if not self._history or not self._history[-1][1]:
            return None
        minutes = [self._minutes_left(name) for name in self._history[-1][1]]
        known = [one for one in minutes if one is not None]
        return max(known) if len(known) == len(minutes) else None

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


Solve = Callable[[Rig, Path, LiveNetworkSolution | None], LiveNetworkSolution | None]
"""Calibrates from a recording; defined at module level. See :func:`solve_recording`."""


# Maximum share of the time in which solutions are computed.
_MAX_LOAD = 0.5


class NetworkSession(Session):
    """Calibrates a network of scanners from its growing recording, as often as one process allows.

    Everything that is shown besides rates is computed from the
    recording, so that a session that is resumed needs nothing else.

    Args:
        rig: the network, as its user wrote it.
        source: name of the source.
        pools: where it computes: ``solving``.
        recording: path of the recording that receives the messages.
        print_line: takes a line on poses that are all within tolerance.
        solve: calibrates.
        clock: time by which the load is limited, s.
    """

    def __init__(
        self,
        rig: Rig,
        source: str,
        pools: SessionPools,
        recording: Path,
        print_line: Callable[[str], object],
        *,
        solve: Solve = solve_recording,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(rig, source, pools, print_line)
        self._recording, self._solve, self._clock = recording, solve, clock
        self._sensor_of = {topic: name for name, topic in rig.topics.items()}
        self.timeline = LiveTimeline(rig.sensors)
        self.solution: LiveNetworkSolution | None = None
        """The last one; None before the first."""
        self._forecast = Forecast(rig.settings.live.network)
        self._scene: SceneState | None = None
        self._began, self._next = 0.0, -math.inf
        """When the last solution began and when the next may, s."""

    def feed(self, message: LiveMessage) -> None:
        """Takes a message that has been recorded; scans are read from the recording, by another process."""
        self.timeline.note_arrival(message.arrival / 1e9)
        name = self._sensor_of.get(message.channel.topic)
        if name is not None:
            try:
                self.timeline.add(name, message.read(self._source, self.rig.settings.limits))
            except RecordingError as error:
                self.timeline.sensors[name].note_malformed(str(error))
        self.advance()

    def describe(self) -> SessionState:
        """The session now, without what concerns source, recorder and end."""
        rig, solution = self.rig, self.solution
        solved = {one.name: one for one in solution.scanners} if solution else {}
        sensors = (_describe_sensor(one, rig, self.timeline, solved.get(one)) for one in rig.sensors)
        done = solution is not None and solution.done
        phase, headline = _describe_phase(rig, self.timeline, solution, self._forecast)
        lag = _describe_lag(self.timeline, solution)
        return SessionState(
            kind="network",
            phase=phase,
            headline=headline,
            source=self._source,
            root=rig.root,
            sensors=tuple(sensors),
            advice=None if solution is None or done else _advise(solution, self._forecast),
            tolerance_mm=1000 * rig.tolerance.translation,
            tolerance_degrees=rig.tolerance.rotation,
            done=done,
            notices=(*([lag] if lag else []), *(solution.remarks if solution else ())),
            scene=self._scene,
        )

    def advance(self) -> None:
        """Calibrates if the process is free, the load allows it, and there is something new."""
        settings, begin = self.rig.settings.live.network, self.timeline.start
        if begin is None or not self._solver.idle or self._clock() < self._next:
            return
        until = begin + settings.first if self.solution is None else self.solution.end + PAUSE
        if self.timeline.latest_arrival < until:
            return
        self._began = self._clock()
        self._solver.run(self._set_solution, self._solve, self.rig, self._recording, self.solution)

    def _set_solution(self, solution: LiveNetworkSolution | Rejected | None) -> None:
        # The process rests as long as it worked, where half of the time is allowed.
        now = self._clock()
        self._next = now + max(PAUSE, (now - self._began) * (1 / _MAX_LOAD - 1))
        if isinstance(solution, Rejected):
            self._problem = f"No poses from the recording until now: {solution.reason}"
        elif solution is not None:
            if solution.done and not (self.solution and self.solution.done):
                self._print_line(ALL_DONE)
            self.solution, self._problem = solution, ""
            self._forecast.add(solution)
            connected = tuple(one for one in solution.scanners if one.T_root_sensor is not None)
            self._scene = SceneState(connected, floor=solution.grid) if solution.grid else None


def _describe_phase(
    rig: Rig, timeline: LiveTimeline, solution: LiveNetworkSolution | None, forecast: Forecast
) -> tuple[Phase, str]:
    unheard = [name for name in rig.sensors if timeline.age(name) is None]
    silent = [name for name in rig.sensors if _describe_silence(name, timeline)]
    if unheard:
        return "connecting", f"Waiting for messages of {name_sensors(unheard)}"
    if silent:
        return "measuring", f"{name_sensors(silent)}: no messages any more"
    if solution is None:
        return "measuring", "Walk through the views of all scanners, one after the other and back again"
    if solution.problem:
        return "measuring", f"No poses yet: {solution.problem}"
    if solution.done:
        return "ready", "All scanners are within tolerance: finish"
    has_areas = solution.grid is not None and bool(solution.grid.wanted.any())
    if apart := _find_unconnected(solution):
        return "measuring", _say_where_to_walk(apart[0]) + (": try the orange areas" if has_areas else "")
    weak = _find_weak(solution)
    beyond = [one.name for one in weak if one.uncertainty > 1]
    if not beyond:
        return "measuring", weak[0].reason
    minutes = forecast.minutes_left()
    left = "" if minutes is None else f": about {_format_minutes(minutes)} more"
    where = "in the orange areas" if has_areas else "where several scanners detect you"
    return "measuring", f"Walk {where}, for {name_sensors(beyond)}{left}"


def _format_minutes(minutes: float) -> str:
    return "1 minute" if minutes <= 1 else f"{math.ceil(minutes)} minutes"


def _find_unconnected(solution: LiveNetworkSolution) -> list[SensorSolution]:
    """The scanners without a pose, those that have detected no person first."""
    apart = [one for one in solution.scanners if one.T_root_sensor is None]
    return sorted(apart, key=lambda one: one.tracks > 0)


def _find_weak(solution: LiveNetworkSolution) -> list[SensorSolution]:
    """The scanners with a pose that is not good, the worst first."""
    weak = [one for one in solution.scanners if one.T_root_sensor is not None and one.grade != "good"]
    return sorted(weak, key=lambda one: -one.uncertainty)


def _say_where_to_walk(scanner: SensorSolution) -> str:
    if not scanner.tracks:
        return f"Walk where {scanner.name} detects you, and on to where another scanner does"
    return f"Walk where {scanner.name} and another scanner both detect you, in curves"


def _advise(solution: LiveNetworkSolution, forecast: Forecast) -> Advice | None:
    apart, weak = _find_unconnected(solution), _find_weak(solution)
    sentences = [
        f"{_say_where_to_walk(one)} ({one.reason})" if one.reason else _say_where_to_walk(one) for one in apart
    ]
    sentences += dict.fromkeys(clause for one in weak if one.reason for clause in split_clauses(one.reason))
    if not sentences:
        return None
    minutes = None if apart else forecast.minutes_left()
    expected = f"within tolerance in about {_format_minutes(minutes)}" if minutes else ""
    return Advice("; ".join(sentences), expected=expected)


# Minimum time from the end of a solution to the next, s, so that there is something new.
PAUSE = 2.0


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


def _describe_sensor(name: str, rig: Rig, timeline: LiveTimeline, solved: SensorSolution | None) -> SensorState:
    difference = timeline.find_wrong_clocks().get(name, 0.0)
    clock = f"its clock is {abs(difference):.1f} s {'ahead of' if difference > 0 else 'behind'} the others"
    silence = _describe_silence(name, timeline)
    problems = timeline.sensors[name].describe_malformed(), silence, clock if difference else ""
    state = SensorState(
        name=name,
        kind=rig.sensors[name].kind,
        rate=timeline.sensors[name].rate,
        problem="; ".join(filter(None, problems)),
        reason=solved.reason if solved else "",
        captures=solved.tracks if solved else 0,
    )
    return state.with_pose(solved, rig.root)


def _describe_silence(name: str, timeline: LiveTimeline) -> str:
    age = timeline.age(name)
    return f"no messages for {age:.0f} s" if age is not None and age > SILENCE else ""
