"""What a fleet's results are called, on its page and in the terminal."""

from collections.abc import Sequence

from calgraph.fleet.changes import Comparison, Move
from calgraph.fleet.run import RobotResult
from calgraph.report.formatting import format_angle, format_count, format_length

STATE_WORDS = {
    "failed": "failed",
    "moved": "moved",
    "off": "differs",
    "lost": "not calibrated",
    "warned": "warning",
    "weak": "weak",
    "pending": "pending",
    "good": "good",
}
"""Word for each state of a robot, the most urgent first."""


def summarize_fleet(robots: Sequence[RobotResult]) -> str:
    """One sentence on all robots."""
    counts = {state: sum(state in robot.states for robot in robots) for state in STATE_WORDS}
    parts = {
        "failed": "with recordings that failed",
        "moved": "with a sensor that moved",
        "off": "that differ from their reference",
        "lost": "with sensors that are not calibrated",
        "warned": "with warnings",
        "weak": "with weak poses",
        "pending": "not complete",
    }
    found = [f"{counts[state]} {words}" for state, words in parts.items() if counts[state]]
    found.append(f"{counts['good']} good")
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
    return (
        f"{' or '.join(move.sensors)} moved by {format_change(move.distance, move.distance_stddev)} and "
        f"{format_turn(move.angle, move.angle_stddev)} (σ) between {comparison.earlier} and {comparison.later}"
    )


# rad; of sensors that have only shifted, in files of 15 digits.
_ROUNDING = 1e-9


def format_change(distance: float, stddev: float) -> str:
    """A distance with its standard deviation, as 10.2 ± 0.9 mm."""
    return f"{1000 * distance:.1f} ± {format_length(stddev)}"


def format_turn(angle: float, stddev: float) -> str:
    """An angle with its standard deviation; 0 where it is rounding."""
    return f"{format_angle(angle if angle > _ROUNDING else 0.0)} ± {format_angle(stddev)}"
