"""``calgraph fleet``: calibrates or checks the recordings of many robots."""

import time
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from calgraph.cli.cache import find_cache
from calgraph.cli.common_options import (
    ClusterOption,
    JobsOption,
    NoCacheOption,
    Results,
    SeedOption,
    everyday,
    format_command,
    open_engine,
)
from calgraph.cli.console import console
from calgraph.cli.progress import progress_bars
from calgraph.config import FleetConfig, load_fleet
from calgraph.config.settings import DaskSettings
from calgraph.errors import CalibrationError, InputError
from calgraph.io.text_writing import format_json

if TYPE_CHECKING:
    from calgraph.fleet.plan import RecordingTask, RobotPlan
    from calgraph.fleet.recording_result import RecordingResult
    from calgraph.fleet.run import RobotResult

_FORMAT = "calgraph-fleet/1"
_PAGE, _TABLES = "index.html", "fleet.sqlite"
_OVERVIEW_INTERVAL = 30.0
"""Seconds between two overviews while recordings are calibrated."""
_MAX_LISTED = 30
"""Robots that the terminal lists: more are on the page."""


def fleet(
    fleet_file: Annotated[
        Path, typer.Argument(metavar="FLEET.yaml", help="Robots, their rig.yaml, and their recordings.")
    ],
    out: Results,
    retry_failed: Annotated[bool, everyday("--retry-failed", help="Repeat recordings that failed.")] = False,
    force: Annotated[bool, everyday("--force", help="Repeat all recordings.")] = False,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    no_cache: NoCacheOption = False,
    json: Annotated[bool, everyday("--json", help="Print the results as JSON.")] = False,
) -> None:
    """Calibrate or check the recordings of many robots, and report which sensor of which robot moved when.

    Writes into OUT an overview, index.html, the tables of fleet.sqlite, and a folder of results per recording.
    Recordings that have a result of the same inputs in OUT are not repeated: a run that was stopped goes on.

    Exit code 0: every sensor is calibrated, and none has moved; 1: a recording failed, a sensor is not calibrated,
    has moved, or differs from the reference; 2: invalid input.
    """
    # Takes seconds, which --help should not.
    from calgraph.fleet.plan import plan_fleet
    from calgraph.fleet.run import RunOptions, analyze_recordings, find_finished

    config = load_fleet(fleet_file)
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, a folder is to be written there")
    plans = plan_fleet(config, fleet_file.parent, out, seed)
    tasks = [task for plan in plans for task in plan.tasks]
    results = {} if force else find_finished(tasks, retry_failed=retry_failed)
    pending = [task for task in tasks if task not in results]
    options = RunOptions(format_command(), None if no_cache else find_cache())
    out.mkdir(parents=True, exist_ok=True)
    with progress_bars() as progress, open_engine(jobs, cluster, DaskSettings()) as engine:
        found = analyze_recordings(pending, options, engine)
        for done, _ in enumerate(_collect(found, results, plans, config, out), start=1):
            progress("recordings", done / len(pending))
    robots = _write_overview(plans, results, config, out)
    if json:
        typer.echo(_content(robots))
    else:
        _print(robots, len(tasks) - len(pending), out)
    _fail_if_not_acceptable(robots)


def _collect(
    found: "Iterable[tuple[RecordingTask, RecordingResult]]",
    results: "dict[RecordingTask, RecordingResult]",
    plans: "Sequence[RobotPlan]",
    config: FleetConfig,
    out: Path,
) -> "Iterable[RecordingResult]":
    """Adds results as they are found; the overview is written now and again, as the run may be stopped."""
    written = time.monotonic()
    for task, result in found:
        results[task] = result
        yield result
        if time.monotonic() - written > _OVERVIEW_INTERVAL:
            _write_overview(plans, results, config, out)
            written = time.monotonic()


def _write_overview(
    plans: "Sequence[RobotPlan]", results: "dict[RecordingTask, RecordingResult]", config: FleetConfig, out: Path
) -> "tuple[RobotResult, ...]":
    from calgraph.fleet.page import write_page
    from calgraph.fleet.run import collect_robots
    from calgraph.fleet.tables import write_tables

    robots = collect_robots(plans, results, config.changes)
    write_tables(robots, version("calgraph"), out / _TABLES)
    write_page(robots, config.changes, version("calgraph"), out / _PAGE)
    return robots


def _content(robots: "Sequence[RobotResult]") -> str:
    """All robots with what needs attention; m and rad."""
    content: dict[str, Any] = {
        "format": _FORMAT,
        "robots": {
            robot.name: {
                "states": robot.states,
                "recordings": {
                    one.recording: one.failure.kind if one.failure else {s.name: s.grade for s in one.sensors}
                    for one in robot.recordings
                },
                "warnings": {one.recording: one.warnings for one in robot.recordings if one.warnings},
                "failures": [
                    {"recording": name, "kind": failure.kind, "message": failure.message}
                    for name, failure in robot.failures
                ],
                "moved": [
                    {"earlier": comparison.earlier, "later": comparison.later, "sensors": move.sensors}
                    | vars(move)
                    for comparison, move in robot.moves
                ],
            }
            for robot in robots
        },
    }
    return format_json(content, indent=1)


def _print(robots: "Sequence[RobotResult]", kept: int, out: Path) -> None:
    """What needs attention, robot by robot."""
    from calgraph.fleet.page import describe_robot, summarize_fleet

    output = console()
    output.print(f"[bold]{escape(summarize_fleet(robots))}[/]")
    listed = [(robot, line) for robot in robots for line in describe_robot(robot)]
    for robot, line in listed[:_MAX_LISTED]:
        sign = "[yellow]![/]" if robot.is_acceptable else "[red]✕[/]"
        output.print(f"{sign} {escape(f'{robot.name}: {line}')}")
    if len(listed) > _MAX_LISTED:
        output.print(f"and {len(listed) - _MAX_LISTED} more")
    if kept:
        output.print(f"{kept} recordings had results of an earlier run.")
    output.print(f"Results are in {escape(str(out))}; open {escape(str(out / _PAGE))}")


def _fail_if_not_acceptable(robots: "Sequence[RobotResult]") -> None:
    """Raises CalibrationError if a recording failed, or a sensor is not calibrated, moved, or differs."""
    names = [robot.name for robot in robots if not robot.is_acceptable]
    if names:
        listed = ", ".join(names[:_MAX_LISTED]) + (", …" if len(names) > _MAX_LISTED else "")
        raise CalibrationError(f"{len(names)} of {len(robots)} robots need attention: {listed}")
