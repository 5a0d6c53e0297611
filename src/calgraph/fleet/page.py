"""index.html: one row per robot, with its state, its drift, and links to the reports of its recordings."""

from collections.abc import Sequence
from importlib.resources import files
from itertools import islice
from pathlib import Path
from string import Template
from urllib.parse import quote

from calgraph.config import ChangeRules
from calgraph.fleet.changes import Comparison, SensorChange
from calgraph.fleet.recording_result import RecordingResult
from calgraph.fleet.run import RobotResult
from calgraph.fleet.wording import STATE_WORDS, describe_robot, format_change, format_turn, summarize_fleet
from calgraph.io.atomic import write_text
from calgraph.report.formatting import escape_html, format_count

_BADGES = {
    "failed": "lost",
    "moved": "lost",
    "off": "lost",
    "lost": "lost",
    "warned": "weak",
    "weak": "weak",
    "pending": "weak",
}
_SIGNS = {"lost": "✕", "weak": "!", "good": "✓"}
_URGENCY = list(STATE_WORDS)
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
    return Template(_read_asset("fleet.html")).substitute(
        title=escape_html(f"Fleet of {format_count(len(robots), 'robot')}"),
        headline=escape_html(summarize_fleet(robots)),
        facts=escape_html(_list_facts(robots)),
        about=escape_html(_explain_moved(rules)),
        states="".join(
            f'<option value="{state}">{STATE_WORDS[state]}</option>' for state in _URGENCY if state in present
        ),
        drift_title=f"drift of sensors, 0 to {1000 * scale:.0f} mm",
        rows="\n".join(_render_row(robot, scale) for robot in ordered),
        version=escape_html(version),
        style=files("calgraph.report").joinpath("style.css").read_text(encoding="utf-8"),
        own_style=_read_asset("fleet.css"),
        script=_read_asset("fleet.js"),
    )


def _read_asset(name: str) -> str:
    return files("calgraph.fleet").joinpath(name).read_text(encoding="utf-8")


def _list_facts(robots: Sequence[RobotResult]) -> str:
    recordings = sum(len(robot.plan.tasks) for robot in robots)
    failed = sum(bool(one.failure) for robot in robots for one in robot.recordings)
    seconds = sum(one.seconds for robot in robots for one in robot.recordings)
    return f"{format_count(recordings, 'recording')} · {failed} failed · {seconds / 60:.0f} min of computation"


def _explain_moved(rules: ChangeRules) -> str:
    return (
        "Moved: the poses of two recordings differ by more than their standard deviations explain, with a "
        f"probability of a false alarm of {100 * rules.false_alarm_probability:g} % for the whole fleet, and "
        f"by {1000 * rules.min_translation:g} mm or {rules.min_rotation:g}° at least. If the root moved, "
        "all others appear to have moved, and the root is named. ±: one standard deviation. Changes are those of "
        "positions relative to the root, since the reference, or since the first recording."
    )


def _render_row(robot: RobotResult, scale: float) -> str:
    base = _changes_since_start(robot)
    changes = [change for one in robot.comparisons for change in one.changes]
    largest = max(changes, key=lambda change: change.distance, default=None)
    badges = "".join(map(_render_badge, robot.states))
    lines = describe_robot(robot)
    shown = [_shorten(line) for line in lines[:_MAX_MESSAGES]]
    if len(lines) > _MAX_MESSAGES:
        shown.append(f"and {len(lines) - _MAX_MESSAGES} more")
    messages = "".join(f"<p>{escape_html(line)}</p>" for line in shown)
    return (
        f'<tr data-states="{" ".join(robot.states)}"><th scope="row">{escape_html(robot.name)}</th>'
        f'<td data-sort="{_URGENCY.index(robot.states[0])}">{badges}</td>'
        f'<td class="words" data-sort="{len(robot.recordings)}">{_render_links(robot.recordings)}</td>'
        f'<td class="words" data-sort="{_count_sensors(robot)}">{_render_sensors(robot, base)}</td>'
        f'<td data-sort="{largest.distance if largest else -1:.6f}">{_describe_change(largest)}</td>'
        f"<td>{_draw_drift(robot, base, scale)}</td>"
        f'<td class="words">{messages}</td></tr>'
    )


def _render_badge(state: str) -> str:
    css = _BADGES.get(state, "good")
    return f'<span class="badge {css}"><span aria-hidden="true">{_SIGNS[css]}</span> {STATE_WORDS[state]}</span>'


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_MESSAGE else f"{text[: _MAX_MESSAGE - 1]}…"


def _render_links(recordings: Sequence[RecordingResult]) -> str:
    """Links to the reports, of many recordings to the last ones, with the others folded."""
    items = [_render_link(one) for one in recordings]
    earlier, shown = items[:-_MAX_LINKS], items[-_MAX_LINKS:]
    summary = f"<summary>{len(earlier)} earlier</summary>"
    folded = f"<details>{summary}<ul>{''.join(earlier)}</ul></details>" if earlier else ""
    return f"{folded}<ul>{''.join(shown)}</ul>"


def _render_link(one: RecordingResult) -> str:
    if one.failure:
        return f"<li>✕ {escape_html(one.recording)}</li>"
    sign = _SIGNS["lost" if one.lost or one.failed_checks else "weak" if one.is_weak or one.warnings else "good"]
    address = f"robots/{quote(one.robot)}/{quote(one.recording)}/report.html"
    return f'<li>{sign} <a href="{address}">{escape_html(one.recording)}</a></li>'


def _last_done(robot: RobotResult) -> RecordingResult | None:
    return next((one for one in reversed(robot.recordings) if one.poses), None)


def _count_sensors(robot: RobotResult) -> int:
    last = _last_done(robot)
    return len(last.sensors) if last else 0


def _render_sensors(robot: RobotResult, base: Sequence[Comparison]) -> str:
    """Verdicts of the last recording, and its changes, folded."""
    last = _last_done(robot)
    if last is None:
        return ""
    good = sum(sensor.grade == "good" for sensor in last.sensors)
    changes = {change.sensor: change for change in base[-1].changes} if base else {}
    items = "".join(
        f"<li>{escape_html(sensor.name)}: {sensor.grade}{_append_change(changes.get(sensor.name))}</li>"
        for sensor in last.sensors
    )
    return f"<details><summary>{good} of {len(last.sensors)} good</summary><ul>{items}</ul></details>"


def _append_change(change: SensorChange | None) -> str:
    return f", changed by {_describe_change(change)}" if change else ""


def _describe_change(change: SensorChange | None) -> str:
    if change is None:
        return "–"
    turn = format_turn(change.angle, change.angle_stddev)
    return f"{format_change(change.distance, change.distance_stddev)}, {turn}"


def _changes_since_start(robot: RobotResult) -> list[Comparison]:
    """The comparisons with the reference or the first recording, in the order of time."""
    start = next((one.earlier for one in robot.comparisons if one.since != "previous"), None)
    if start is None:
        return list(islice(robot.comparisons, 1))
    first = [one for one in robot.comparisons[:1] if one.earlier == start]
    return first + [one for one in robot.comparisons if one.since != "previous"]


def _draw_drift(robot: RobotResult, base: Sequence[Comparison], scale: float) -> str:
    """A line per sensor: the change of its position since the start, with standard deviations."""
    if not base:
        return ""
    names = [task.recording for task in robot.plan.tasks]
    span = max(len(names) - (base[0].earlier in names), 1)
    moved = {name for _, move in robot.moves for name in move.sensors}
    points: dict[str, list[tuple[float, float, float]]] = {}
    for one in base:
        x = _MARGIN + (_WIDTH - 2 * _MARGIN) * (names.index(one.later) + (base[0].earlier not in names)) / span
        for change in one.changes:
            points.setdefault(change.sensor, []).append((x, change.distance, change.distance_stddev))
    lines = "".join(
        f'<path{" class=moved" if name in moved else ""} d="{_draw_line(of_sensor, scale)}"/>'
        for name, of_sensor in sorted(points.items(), key=lambda item: item[0] in moved)
    )
    bottom = _HEIGHT - _MARGIN
    label = escape_html("; ".join(f"{c.sensor} {_describe_change(c)}" for c in base[-1].changes))
    return (
        f'<svg class="drift" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img"><title>{label}</title>'
        f'<path class="axis" d="M{_MARGIN} {bottom}H{_WIDTH - _MARGIN}"/>{lines}</svg>'
    )


def _draw_line(points: Sequence[tuple[float, float, float]], scale: float) -> str:
    """A path from zero at the start through all points, with a bar of one standard deviation at each."""

    def y(distance: float) -> float:
        return _HEIGHT - _MARGIN - (_HEIGHT - 2 * _MARGIN) * min(max(distance, 0.0), scale) / scale

    line = f"M{_MARGIN} {_HEIGHT - _MARGIN}" + "".join(f"L{x:.0f} {y(d):.1f}" for x, d, _ in points)
    if len(points) > _MAX_BARS:
        return line
    return line + "".join(f"M{x:.0f} {y(d - s):.1f}V{y(d + s):.1f}" for x, d, s in points)
