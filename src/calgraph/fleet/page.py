"""index.html: one row per robot, with its state, its drift, and links to reports; and words for results."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from calgraph.config import ChangeRules
from calgraph.fleet.changes import Comparison, Displacement, Move
from calgraph.fleet.run import RobotResult
from calgraph.io.atomic import write_text
from calgraph.report.formatting import format_angle, format_count, format_length
from calgraph.report.templates import make_environment


class State(NamedTuple):
    """What needs attention of a robot."""

    word: str
    css: str
    """Class of its badge."""
    of_several: str
    """The same of several robots."""


STATES = {
    "failed": State("failed", "lost", "with recordings that failed"),
    "moved": State("moved", "lost", "with a sensor that moved"),
    "off": State("differs", "lost", "that differ from their reference"),
    "lost": State("not calibrated", "lost", "with sensors that are not calibrated"),
    "warned": State("warning", "weak", "with warnings"),
    "weak": State("weak", "weak", "with weak poses"),
    "pending": State("pending", "weak", "not complete"),
    "good": State("good", "good", "good"),
}
"""States of a robot, the most urgent first."""


def summarize_fleet(robots: Sequence[RobotResult]) -> str:
    """One sentence on all robots."""
    counts = {state: sum(state in robot.states for robot in robots) for state in STATES}
    found = [f"{count} {STATES[state].of_several}" for state, count in counts.items() if count or state == "good"]
    return f"{format_count(len(robots), 'robot')}: {', '.join(found)}."


def describe_robot(robot: RobotResult) -> list[str]:
    """Sentences on what needs attention, the most urgent first."""
    lines = [f"{name}: {failure.message}" if name else failure.message for name, failure in robot.failures]
    lines += [describe_move(comparison, move) for comparison, move in robot.moves]
    for one in robot.recordings:
        lines += [f"{one.recording}: {warning}" for warning in one.warnings]
        for sensor in one.sensors:
            if sensor.outcome == "fail":
                lines.append(f"{one.recording}: {sensor.name} differs from the reference: {sensor.difference}")
            elif sensor.name in one.lost:
                lines.append(f"{one.recording}: {sensor.name} is not calibrated: {sensor.reason}")
    return lines


def describe_move(comparison: Comparison, move: Move) -> str:
    """What moved, when, and how far."""
    how_far = " and ".join(_format_displacement(move))
    return (
        f"{' or '.join(move.sensors)} moved by {how_far} (σ) between {comparison.earlier} and {comparison.later}"
    )


# rad; of sensors that have only shifted, in files of 15 digits.
_ROUNDING = 1e-9


def _format_displacement(one: Displacement) -> tuple[str, str]:
    """Distance, as 10.2 ± 0.9 mm, and angle."""
    distance = f"{1000 * one.distance:.1f} ± {format_length(one.distance_stddev)}"
    return distance, format_turn(one.angle, one.angle_stddev)


def format_turn(angle: float, stddev: float) -> str:
    """An angle with its standard deviation; 0 where it is rounding."""
    return f"{format_angle(angle if angle > _ROUNDING else 0.0)} ± {format_angle(stddev)}"


_SIGNS = {"lost": "✕", "weak": "!", "good": "✓"}
_URGENCY = list(STATES)
_MAX_SHOWN_DRIFT = 0.025
"""Largest change that the drawings of drift show, m."""
_MAX_LINKS = 6
_MAX_MESSAGES = 8
"""Of a robot: others are counted."""
_MAX_MESSAGE = 400
"""Characters of a message on the page; fleet.sqlite has all of it."""
_WIDTH, _HEIGHT, _MARGIN = 132, 36, 4
_MAX_BARS = 12
"""Recordings up to which standard deviations are drawn."""


def write_page(robots: Sequence[RobotResult], rules: ChangeRules, version: str, path: Path) -> None:
    """Writes index.html in one step.

    Args:
        robots: results.
        rules: when a sensor counts as moved.
        version: of calgraph.
        path: of the page, beside the folders that it links.

    Raises:
        InputError: it cannot be written.
    """
    write_text(path, render_page(robots, rules, version))


def render_page(robots: Sequence[RobotResult], rules: ChangeRules, version: str) -> str:
    """The text of the page."""
    ordered = sorted(robots, key=lambda robot: _URGENCY.index(robot.states[0]))
    changes = [change.distance for robot in robots for one in robot.comparisons for change in one.changes]
    scale = min(max([*changes, rules.min_translation]), _MAX_SHOWN_DRIFT)
    present = {state for robot in robots for state in robot.states}
    environment = make_environment("calgraph.fleet")
    environment.filters["quote"] = quote
    return environment.get_template("fleet.html").render(
        headline=summarize_fleet(robots),
        facts=_list_facts(robots),
        rules=rules,
        states=STATES,
        signs=_SIGNS,
        present=present,
        scale=scale,
        width=_WIDTH,
        height=_HEIGHT,
        margin=_MARGIN,
        rows=[_describe_row(robot, scale) for robot in ordered],
        version=version,
    )


def _list_facts(robots: Sequence[RobotResult]) -> str:
    recordings = sum(len(robot.plan.tasks) for robot in robots)
    failed = sum(bool(one.failure) for robot in robots for one in robot.recordings)
    seconds = sum(one.seconds for robot in robots for one in robot.recordings)
    return f"{format_count(recordings, 'recording')} · {failed} failed · {seconds / 60:.0f} min of computation"


def _describe_row(robot: RobotResult, scale: float) -> dict[str, Any]:
    base = _changes_since_start(robot)
    last = next((one for one in reversed(robot.recordings) if one.poses), None)
    changes = [change for one in robot.comparisons for change in one.changes]
    largest = max(changes, key=lambda change: change.distance, default=None)
    lines = describe_robot(robot)
    messages = [_shorten(line) for line in lines[:_MAX_MESSAGES]]
    if len(lines) > _MAX_MESSAGES:
        messages.append(f"and {len(lines) - _MAX_MESSAGES} more")
    return {
        "robot": robot,
        "urgency": _URGENCY.index(robot.states[0]),
        "earlier": robot.recordings[:-_MAX_LINKS],
        "latest": robot.recordings[-_MAX_LINKS:],
        "sensors": last.sensors if last else (),
        "changes": {one.sensor: ", ".join(_format_displacement(one)) for one in base[-1].changes} if base else {},
        "largest": largest.distance if largest else -1.0,
        "change": ", ".join(_format_displacement(largest)) if largest else "–",
        # One change of sensors that did not move is no course, and stands in the table.
        "lines": _draw_drift(robot, base, scale) if len(base) > 1 or (base and robot.moves) else [],
        "messages": messages,
    }


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_MESSAGE else f"{text[: _MAX_MESSAGE - 1]}…"


def _changes_since_start(robot: RobotResult) -> list[Comparison]:
    """The comparisons with the reference or the first recording, in the order of time."""
    start = next((one.earlier for one in robot.comparisons if one.since != "previous"), None)
    if start is None:
        return list(islice(robot.comparisons, 1))
    first = [one for one in robot.comparisons[:1] if one.earlier == start]
    return first + [one for one in robot.comparisons if one.since != "previous"]


def _draw_drift(robot: RobotResult, base: Sequence[Comparison], scale: float) -> list[tuple[bool, str]]:
    """By sensor whether it moved, and a path: the change of its position since the start."""
    names = [task.recording for task in robot.plan.tasks]
    span = max(len(names) - (base[0].earlier in names), 1)
    moved = {name for _, move in robot.moves for name in move.sensors}
    points: dict[str, list[tuple[float, float, float]]] = {}
    for one in base:
        x = _MARGIN + (_WIDTH - 2 * _MARGIN) * (names.index(one.later) + (base[0].earlier not in names)) / span
        for change in one.changes:
            points.setdefault(change.sensor, []).append((x, change.distance, change.distance_stddev))
    drawn = [(name in moved, _draw_line(of_sensor, scale)) for name, of_sensor in points.items()]
    return sorted(drawn, key=lambda one: one[0])


def _draw_line(points: Sequence[tuple[float, float, float]], scale: float) -> str:
    """A path from zero at the start through all points, with a bar of one standard deviation at each."""

    def y(distance: float) -> float:
        return _HEIGHT - _MARGIN - (_HEIGHT - 2 * _MARGIN) * min(max(distance, 0.0), scale) / scale

    line = f"M{_MARGIN} {_HEIGHT - _MARGIN}" + "".join(f"L{x:.0f} {y(d):.1f}" for x, d, _ in points)
    if len(points) > _MAX_BARS:
        return line
    return line + "".join(f"M{x:.0f} {y(d - s):.1f}V{y(d + s):.1f}" for x, d, s in points)
