"""What people who walk through a network are shown of its session."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calgraph.config import Rig
from calgraph.live.capture_finder import SILENCE, name_sensors
from calgraph.live.live_timeline import LiveTimeline
from calgraph.live.network_forecast import Forecast
from calgraph.live.network_solution import LiveNetworkSolution, ScannerSolution
from calgraph.live.state import Advice, Phase, SensorState, SessionState
from calgraph.live.tracked_intervals import MIN_INTERVAL

# Messages whose delays are compared: a second of the slowest scanners, and more of others.
_DELAYS = 15


@dataclass
class ScannerMessages:
    """What is known of the messages of one scanner besides their times."""

    delays: "deque[float]" = field(default_factory=lambda: deque(maxlen=_DELAYS))
    """Stamps minus arrivals of the last ones, s."""
    malformed: int = 0
    """Number of its messages that could not be used."""
    problem: str = ""
    """Why the last of them could not."""

    def note_malformed(self, problem: str) -> None:
        """Counts a message that cannot be used."""
        self.malformed += 1
        self.problem = problem


def describe_network_session(
    rig: Rig,
    source: str,
    timeline: LiveTimeline,
    messages: Mapping[str, ScannerMessages],
    solution: LiveNetworkSolution | None,
    forecast: Forecast,
    floor_plan: str,
    problem: str,
) -> SessionState:
    """The state of a session.

    Args:
        rig: the network.
        source: name of the source.
        timeline: when scanners measured.
        messages: by scanner.
        solution: the last one.
        forecast: of the solutions so far.
        floor_plan: the image of the solution.
        problem: what keeps the session from working; empty if nothing does.
    """
    solved = {one.name: one for one in solution.scanners} if solution else {}
    done = solution is not None and solution.done
    phase, headline = _describe_phase(rig, timeline, solution, forecast)
    lag = _describe_lag(timeline, solution)
    return SessionState(
        kind="network",
        phase=phase,
        headline=problem or headline,
        source=source,
        root=rig.root,
        sensors=tuple(_describe_sensor(name, rig, timeline, messages, solved.get(name)) for name in rig.sensors),
        advice=None if solution is None or done else _advise(solution, forecast),
        tolerance_mm=1000 * rig.tolerance.translation,
        tolerance_degrees=rig.tolerance.rotation,
        done=done,
        notices=(*([lag] if lag else []), *(solution.remarks if solution else ())),
        floor_plan=floor_plan,
    )


def _describe_phase(
    rig: Rig, timeline: LiveTimeline, solution: LiveNetworkSolution | None, forecast: Forecast
) -> tuple[Phase, str]:
    unheard = [name for name in rig.sensors if timeline.age(name) is None]
    silent = [name for name in rig.sensors if _is_silent(name, timeline)]
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


def _find_unconnected(solution: LiveNetworkSolution) -> list[ScannerSolution]:
    """The scanners without a pose, those that have detected no person first."""
    apart = [one for one in solution.scanners if one.T_root_scanner is None]
    return sorted(apart, key=lambda one: one.tracks > 0)


def _find_weak(solution: LiveNetworkSolution) -> list[ScannerSolution]:
    """The scanners with a pose that is not good, the worst first."""
    weak = [one for one in solution.scanners if one.T_root_scanner is not None and one.grade != "good"]
    return sorted(weak, key=lambda one: -one.uncertainty)


def _say_where_to_walk(scanner: ScannerSolution) -> str:
    if not scanner.tracks:
        return f"Walk where {scanner.name} detects you, and on to where another scanner does"
    return f"Walk where {scanner.name} and another scanner both detect you, in curves"


def _advise(solution: LiveNetworkSolution, forecast: Forecast) -> Advice | None:
    apart, weak = _find_unconnected(solution), _find_weak(solution)
    sentences = [
        f"{_say_where_to_walk(one)} ({one.reason})" if one.reason else _say_where_to_walk(one) for one in apart
    ]
    sentences += [one.reason for one in weak if one.reason]
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


def _describe_sensor(
    name: str,
    rig: Rig,
    timeline: LiveTimeline,
    messages: Mapping[str, ScannerMessages],
    solved: ScannerSolution | None,
) -> SensorState:
    age = timeline.age(name)
    problems = []
    if malformed := messages[name].malformed:
        problems.append(f"{malformed} unusable messages: {messages[name].problem}")
    if _is_silent(name, timeline):
        problems.append(f"no messages for {age:.0f} s")
    if clock := _describe_clock(name, messages):
        problems.append(clock)
    stddev = None if solved is None or name == rig.root else solved.stddev
    return SensorState(
        name=name,
        kind=rig.sensors[name].kind,
        rate=timeline.rate(name),
        age=age,
        problem="; ".join(problems),
        reason=solved.reason if solved else "",
        captures=solved.tracks if solved else 0,
        stddev_mm=None if stddev is None else 1000 * float(stddev[:2].max()),
        stddev_degrees=None if stddev is None else float(np.degrees(stddev[2])),
        progress=solved.progress if solved else 0.0,
        grade=solved.grade if solved else "",
    )


def _is_silent(name: str, timeline: LiveTimeline) -> bool:
    age = timeline.age(name)
    return age is not None and age > SILENCE


# Difference of a scanner's clock from the median of all, s, from which it is named: the calibration measures
# smaller ones.
_MAX_CLOCK_DIFFERENCE = 1.0


def _describe_clock(name: str, messages: Mapping[str, ScannerMessages]) -> str:
    """By how much a scanner's clock differs from those of the others, if it is much; else empty."""
    delays = {one: float(np.median(found.delays)) for one, found in messages.items() if found.delays}
    if name not in delays or len(delays) < 2:
        return ""
    # Which one of two is right is unknown.
    others: Sequence[float] = [value for one, value in delays.items() if one != name or len(delays) > 2]
    difference = delays[name] - float(np.median(others))
    if abs(difference) <= _MAX_CLOCK_DIFFERENCE:
        return ""
    return f"its clock is {abs(difference):.1f} s {'ahead of' if difference > 0 else 'behind'} the others"
